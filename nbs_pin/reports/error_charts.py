"""Figures of model errors, in the style of `plotting`: a page per model, and errors against the amount of data."""

from collections.abc import Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.colors import LinearSegmentedColormap, LogNorm
from matplotlib.figure import SubFigure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator

from nbs_pin.accuracy.compare import Growth, ModelErrors
from nbs_pin.accuracy.energy_drift import FreeMotion
from nbs_pin.accuracy.error_maps import ErrorMap
from nbs_pin.accuracy.mismatch import Mismatch
from nbs_pin.base.units import TURNING, JointUnits, counted, percent, several, weighed
from nbs_pin.reports.plotting import (
    ACTUAL,
    ERROR,
    INK,
    LIMIT,
    NOTE,
    REFERENCE,
    SATURATED,
    TORQUE,
    VIOLET,
    picture,
)  # fmt: skip
from nbs_pin.reports.verdicts import Verdict

PALE = "#eef3f9"
LOOKS = {
    "mass_matrix": ("M", ACTUAL),
    "coriolis": ("C v", REFERENCE),
    "gravity": ("G", TORQUE),
    "inverse": ("torque", ERROR),
    "forward": ("acceleration", VIOLET),
}
"""Label and colour of every entry of `Errors`, the same in all panels."""
LEAST, MOST = 1e-17, 1e12
"""Errors outside this range are drawn at its ends."""
_HEAT = LinearSegmentedColormap.from_list(
    "error", ["#eaf2fb", "#a9c9ea", "#f6d365", "#ff8c1a", "#b3261e", "#43090b"], N=256
)
_DASHED = (0, (4, 2))


def plot_model_errors(
    errors: ModelErrors,
    heat: ErrorMap | None,
    path: str | Path,
    *,
    title: str,
    joints: Sequence[str],
    units: Sequence[JointUnits] | None = None,
    missing: str = "no closed loop was run",
    verdict: Verdict | None = None,
) -> Path:
    """Plot the result of `compare` on one page and write the picture (`plotting.picture`); returns its path.

    The figures in a row; maps of the errors of M, C v and G over two joints (omitted without a map); errors against
    speed and against distance from the centre of the box, and the torque error of every joint; the errors of single
    samples, energy in free motion, and ‖δ‖ along the closed loop with its bound. missing: the note in its place if no
    closed loop was run. joints: their names with units. units: of every joint, None if all of them turn.
    """
    units = [TURNING] * len(joints) if units is None else units
    joints, rows = [joint.replace("$", r"\$") for joint in joints], 2 if heat is None else 3
    with picture(path, 13.5, 1.4 + 3.3 * rows) as figure:
        heights = (1.4, *([3.3] if heat is not None else []), 6.6)
        parts = np.ravel(np.asarray(figure.subfigures(len(heights), 1, height_ratios=heights)))
        _draw_figures(parts[0], errors, title, several(of.velocity for of in units), verdict)
        if heat is not None:
            _draw_maps(parts[1], heat, joints)
        growth, last = parts[-1].subplots(2, 3)
        _draw_growth(growth, errors, joints, [of.torque for of in units])
        _draw_samples(last[0], errors)
        if errors.motion is None:
            _leave_out(last[1], "no free motion was run")
        else:
            _draw_energy(last[1], errors.motion)
        if errors.mismatch is None:
            _leave_out(last[2], missing)
        else:
            _draw_mismatch(last[2], errors.mismatch, several(of.torque for of in units))
    return Path(path)


def plot_sample_sizes(
    panels: Mapping[str, Mapping[str, Mapping[int, Sequence[float]]]], path: str | Path, *, ylabel: str
) -> Path:
    """Plot errors against the number of samples on logarithmic axes and write the picture (PNG); returns its path.

    panels: title -> model -> number of samples -> one error per seed. A line joins the medians of the finite errors and
    a band spans their range; a model has the same colour in all panels.
    """
    names = list(dict.fromkeys(name for models in panels.values() for name in models))
    colours = dict(zip(names, cycle((ACTUAL, REFERENCE, TORQUE, ERROR, VIOLET, LIMIT, SATURATED)), strict=False))
    seen = np.concatenate([_seen(x) for models in panels.values() for curve in models.values() for x in curve.values()])
    with picture(path, 1.0 + 4.3 * len(panels), 4.2) as figure:
        grid = figure.subplots(1, len(panels), squeeze=False, sharey=True)[0]
        for axes, (title, models) in zip(grid, panels.items(), strict=True):
            for name, curve in models.items():
                _draw_seeds(axes, curve, colours[name], name)
            axes.set_xscale("log")
            _plain_ticks(axes, sorted({float(size) for curve in models.values() for size in curve}))
            axes.set(xlabel="samples", yscale="log", ylim=_limits(float(np.nanmin(seen)), float(np.nanmax(seen))))
            axes.set_title(title, loc="left", color=INK)
            _log_ticks(axes.yaxis, *axes.get_ylim())
        grid[0].set_ylabel(ylabel)
        handles, labels = grid[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper right", ncols=len(labels), frameon=False)
    return Path(path)


def _draw_seeds(axes: Axes, curve: Mapping[int, Sequence[float]], colour: str, name: str) -> None:
    sizes = sorted(curve)
    values = [_seen(curve[size]) for size in sizes]
    low, middle, high = ([float(of(x)) for x in values] for of in (np.nanmin, np.nanmedian, np.nanmax))
    axes.plot(sizes, middle, "o-", color=colour, markersize=3.5, label=name)
    axes.fill_between(sizes, low, high, color=colour, alpha=0.12, linewidth=0)


def _draw_figures(head: SubFigure, errors: ModelErrors, title: str, unit: str, verdict: Verdict | None) -> None:
    """The title, the verdict and a row of tiles, each with a name and a number."""
    low, high = errors.mass_ratio
    tiles = {f"error of {label}": number(getattr(errors, name)) for name, (label, _) in LOOKS.items()}
    tiles |= {
        "least eigenvalue of M̂": number(errors.eigenvalue_margin),
        "M̂ ÷ M is off 1 by": number(max(1.0 - low, high - 1.0)),
        "best common factor": f"{errors.scale.factor:.5g}",
        "energy drift": _drift(errors),
    }
    head.text(0.012, 0.86, title.replace("$", r"\$"), fontsize=14, fontweight="bold", color=INK, va="center")
    fast = errors.box.speed
    speed = f"{fast[0]:.3g}" if np.ptp(fast) == 0.0 else f"{fast.min():.3g} to {fast.max():.3g}"
    where = f"{errors.samples} uniform states, |v| ≤ {speed} {unit}, seed {errors.seed}"
    head.text(0.988, 0.86, where, color=NOTE, ha="right", va="center")
    if verdict is not None:
        head.text(0.012, 0.67, verdict.text.replace("$", r"\$"), color=INK, va="center")
    axes = head.add_axes((0.0, 0.04, 1.0, 0.52))
    axes.set(xlim=(0.0, 1.0), ylim=(0.0, 1.0))
    axes.set_axis_off()
    width = 0.976 / len(tiles)
    for k, (name, value) in enumerate(tiles.items()):
        left = 0.012 + k * width
        axes.axvspan(left, left + 0.94 * width, color=PALE, linewidth=0)
        axes.text(left + 0.05 * width, 0.76, name, color=NOTE, fontsize=7.5, va="center")
        axes.text(left + 0.05 * width, 0.33, value, color=INK, fontsize=12.5, fontweight="bold", va="center")


def _drift(errors: ModelErrors) -> str:
    """The energy drift, as an upper bound if the integrator drifts as much."""
    if errors.motion is None:
        return "not run"
    resolved = errors.energy_drift > 2.0 * float(errors.motion.floor.max())
    return f"{'' if resolved else '≤ '}{number(errors.energy_drift)}"


def _draw_maps(part: SubFigure, heat: ErrorMap, names: Sequence[str]) -> None:
    """Errors of M, C v and G over two joints on one colour scale, whose lower end is the 2 % quantile."""
    kinds = ("mass_matrix", "coriolis", "gravity")
    shown = [_seen(getattr(heat.errors, kind)) for kind in kinds]
    seen = np.concatenate([x[np.isfinite(x)] for x in shown])
    low, high = (np.percentile(seen, 2.0), seen.max()) if seen.size else (LEAST, 1.0)
    scale = LogNorm(min(low, high / 3.0), high)
    across, up = (names[j] for j in heat.joints)
    panels = part.subplots(1, 3)
    for axes, values, kind in zip(panels, shown, kinds, strict=True):
        mesh = axes.pcolormesh(heat.x, heat.y, values, norm=scale, cmap=_HEAT, shading="gouraud")
        axes.set(xlabel=across, ylabel=up)
        axes.set_title(f"relative error of {LOOKS[kind][0]}", loc="left", color=INK)
        axes.grid(False)
        for ruler in (axes.xaxis, axes.yaxis):
            ruler.set_major_locator(MaxNLocator(5))
    bar = part.colorbar(mesh, ax=list(panels), pad=0.012, aspect=18)
    bar.set_label("relative error")
    bar.outline.set_visible(False)
    bar.ax.tick_params(length=0)
    _log_ticks(bar.ax.yaxis, *bar.ax.get_ylim())


def _draw_growth(panels: np.ndarray, errors: ModelErrors, names: Sequence[str], units: Sequence[str]) -> None:
    """Errors against speed, against distance, and per joint."""
    speed, distance, joints = panels
    _draw_curves(speed, errors.by_speed, ("coriolis", "inverse", "forward"))
    speed.set_xscale("log", base=2)
    _plain_ticks(speed, errors.by_speed.at)
    speed.set(xlabel="speed as a share of the box's", xlim=(errors.by_speed.at[0], errors.by_speed.at[-1]))
    speed.set_title("relative error by speed", loc="left", color=INK)
    _draw_curves(distance, errors.by_distance, ("mass_matrix", "coriolis", "gravity"))
    distance.set(xlabel="distance from the middle (1 is the surface of the box)", xlim=(errors.by_distance.at[0], None))
    distance.set_title("relative error inside and outside the box", loc="left", color=INK)
    for axes, growth in ((speed, errors.by_speed), (distance, errors.by_distance)):
        axes.axvspan(1.0, growth.at[-1], color=PALE, zorder=0)
        axes.set_xlim(growth.at[0], growth.at[-1])
    distance.annotate("outside", (0.985, 0.03), xycoords="axes fraction", ha="right", color=NOTE)
    _draw_joints(joints, errors, names, units)


def _draw_curves(axes: Axes, growth: Growth, shown: Sequence[str]) -> None:
    for name in shown:
        label, colour = LOOKS[name]
        values = _seen([getattr(e, name) for e in growth.errors])
        axes.plot(growth.at, values, "o-", color=colour, markersize=3.5, label=label, clip_on=False)
    _log_errors(axes)
    axes.legend(frameon=False, ncols=len(shown))


def _draw_joints(axes: Axes, errors: ModelErrors, names: Sequence[str], units: Sequence[str]) -> None:
    """Torque error of every joint, relative to the standard deviation of its torque."""
    rows = np.arange(len(names))
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = _seen(errors.torque_rms / errors.torque_deviation)
    low, high = _limits(np.nanmin(shares), np.nanmax(shares))
    axes.hlines(rows, low, shares, color=LOOKS["inverse"][1], alpha=0.35, linewidth=3.0)
    axes.plot(shares, rows, "o", color=LOOKS["inverse"][1], markersize=5.5, clip_on=False)
    for row, (value, torque, unit) in enumerate(zip(shares, errors.torque_rms, units, strict=True)):
        axes.annotate(
            f"{number(torque)} {unit}",
            (value, row),
            xytext=(7, 0),
            textcoords="offset points",
            va="center",
            fontsize=7.5,
        )
    axes.set_xscale("log")
    axes.set(xlim=(low, high * (high / low) ** 0.25), ylim=(len(names) - 0.4, -0.6))
    axes.set_yticks(rows, [name.partition(" [")[0] for name in names])
    _log_ticks(axes.xaxis, *axes.get_xlim())
    axes.grid(False, axis="y")
    axes.set(xlabel="RMS error ÷ standard deviation of the torque")
    axes.set_title("torque error by joint", loc="left", color=INK)


def _draw_samples(axes: Axes, errors: ModelErrors) -> None:
    """Share of the samples with a smaller error, per quantity, with a dot at the RMS over all."""
    ranks = np.arange(1, errors.samples + 1) / errors.samples
    for name, (label, colour) in LOOKS.items():
        values, rms = np.sort(_seen(getattr(errors.each, name))), float(_seen(getattr(errors, name)))
        if np.isfinite(values).all():
            axes.plot(values, ranks, color=colour, label=label)
            axes.plot(rms, np.interp(rms, values, ranks), "o", color=colour, markersize=5)
    axes.set_xscale("log")
    _log_ticks(axes.xaxis, *axes.get_xlim())
    axes.set(ylim=(0.0, 1.02), xlabel="relative error (dot: RMS over all)")
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: percent(value)))
    axes.set_title("samples with a smaller error", loc="left", color=INK)
    axes.legend(frameon=False)


def _draw_energy(axes: Axes, motion: FreeMotion) -> None:
    """Drift of energy in free motion: median and worst of the starts."""
    for values, colour, label in (
        (motion.drift, ERROR, "true energy, model's motion"),
        (motion.own, ACTUAL, "model's energy, model's motion"),
        (motion.floor, LIMIT, "true energy, true motion"),
    ):
        seen = _seen(values)[1:]
        gone = np.isnan(seen).any(axis=1)
        median, worst = (np.where(gone, np.nan, statistic(seen, axis=1)) for statistic in (np.median, np.max))
        axes.plot(motion.t[1:], median, color=colour, linewidth=1.6, label=label)
        axes.plot(motion.t[1:], worst, color=colour, linewidth=0.4, alpha=0.5)
        axes.fill_between(motion.t[1:], median, worst, color=colour, alpha=0.15, linewidth=0)
    _log_errors(axes)
    low, high = axes.get_ylim()
    axes.set_ylim(low * (low / high) ** 0.3, high)
    axes.set(xlabel="time [s]", xlim=(0.0, motion.t[-1]))
    axes.set_title("free motion: drift of energy ÷ largest kinetic energy", loc="left", color=INK)
    axes.legend(frameon=False, loc="lower right", title="median to worst start", title_fontsize=7.5, alignment="left")


def _draw_mismatch(axes: Axes, mismatch: Mismatch, unit: str) -> None:
    """‖δ‖ over time, median and worst trajectory, with the largest bound at the same states."""
    bound = mismatch.bound(mismatch.q_norm, mismatch.v_norm)
    size = _seen(mismatch.size)
    median, worst = np.median(size, axis=1), size.max(axis=1)
    axes.plot(mismatch.t, _seen(bound.max(axis=1)), color=INK, linewidth=1.6, label="bound, largest")
    axes.plot(mismatch.t, worst, color=ERROR, linewidth=1.0, linestyle=_DASHED, label="‖δ‖, worst start")
    axes.plot(mismatch.t, median, color=ERROR, linewidth=1.6, label="‖δ‖, median")
    axes.fill_between(mismatch.t, median, worst, color=ERROR, alpha=0.12, linewidth=0)
    _log_errors(axes)
    low, high = axes.get_ylim()
    axes.set_ylim(low, high * (high / low) ** 0.45)
    axes.set(xlabel="time [s]", xlim=(mismatch.t[0], mismatch.t[-1]))
    axes.set_title(f"closed loop: mismatch ‖δ‖ [{unit}]", loc="left", color=INK)
    axes.legend(frameon=False, ncols=3, loc="upper left", bbox_to_anchor=(0.0, 0.87), handlelength=1.4)
    if mismatch.violation < 1.0:
        sure = (
            f"a further start exceeds it: ≤ {percent(mismatch.violation, 1)} (confidence 1 − {number(mismatch.doubt)})"
        )
    else:
        sure = "too few starts to bound further ones"
    told = weighed({"‖q‖": number(mismatch.a), "‖v‖": number(mismatch.b)}, number(mismatch.c))
    note = f"‖δ‖ ≤ {told}   ({counted(mismatch.trajectories, 'start')})\n{sure}"
    axes.annotate(note, (0.02, 0.985), xycoords="axes fraction", va="top", fontsize=7.8, color=INK)


def _seen(values: Any) -> np.ndarray:
    """The values clipped to the drawn range, NaN for those that are not finite."""
    values = np.asarray(values, dtype=float)
    return np.asarray(np.clip(np.where(np.isfinite(values), values, np.nan), LEAST, MOST))


def _leave_out(axes: Axes, why: str) -> None:
    axes.set_axis_off()
    axes.text(0.5, 0.5, why, ha="center", va="center", color=NOTE, wrap=True)


def number(value: float) -> str:
    """The number in at most three digits, as 1.3e-6 rather than 0.0000013."""
    if not np.isfinite(value):
        return "not finite"
    if value == 0.0 or 1e-2 <= abs(value) < 1e4:
        return f"{value:.3g}"
    mantissa, power = f"{value:.2e}".split("e")
    return f"{float(mantissa):g}e{int(power)}"


def _limits(low: float, high: float) -> tuple[float, float]:
    """A range of at least one decade around the numbers, for a logarithmic axis."""
    middle = np.sqrt(low * high)
    return float(min(low, middle / 3.2) / 1.2), float(max(high, middle * 3.2) * 1.2)


def _log_errors(axes: Axes) -> None:
    axes.set_yscale("log")
    drawn = [np.asarray(line.get_ydata(), dtype=float) for line in axes.lines]
    seen = np.concatenate([y[np.isfinite(y)] for y in drawn]) if drawn else np.ones(1)
    if seen.size:
        axes.set_ylim(*_limits(float(seen.min()), float(seen.max())))
    _log_ticks(axes.yaxis, *axes.get_ylim())


def _log_ticks(ruler: Axis, low: float, high: float) -> None:
    """Ticks at powers of ten for more than three decades, otherwise also at small multiples of them."""
    if high / low > 1e3:
        ruler.set_major_locator(LogLocator(numticks=7))
    else:
        ruler.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high / low < 50.0 else (1.0, 3.0), numticks=20))
        ruler.set_major_formatter(FuncFormatter(lambda value, _: number(value)))
    ruler.set_minor_locator(NullLocator())


def _plain_ticks(axes: Axes, at: Sequence[float]) -> None:
    axes.set_xticks(list(at), [f"{value:g}" for value in at])
    axes.xaxis.set_minor_locator(NullLocator())
