"""Figures of studies, over many runs, in the style of `plotting`."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator

from nbs_pin.base.records import Run
from nbs_pin.base.units import counted, percent, several
from nbs_pin.reports.plotting import ACTUAL, ERROR, LIMIT, REFERENCE, SATURATED, TORQUE, Heading, picture
from nbs_pin.simulation.metrics import PAPER_THRESHOLD, squared_error

FAR = 1000.0
"""Motions are not drawn where ‖z1‖ exceeds this [rad]."""


def plot_scaling(
    joints: Sequence[float], series: Mapping[str, Sequence[float]], path: str | Path, heading: Heading | None = None
) -> Path:
    """Plot cost [µs] against the number of joints, one line per series, and write the picture; returns its path."""
    with picture(path, 6.4, 4.4, heading=heading) as figure:
        axes = figure.add_subplot()
        for (name, values), colour in zip(series.items(), (ACTUAL, REFERENCE, TORQUE, ERROR), strict=False):
            axes.plot(joints, values, "o-", color=colour, markersize=3.5, label=name)
        axes.set(xlabel="joints", ylabel="one control step, median [µs]", xlim=(0, None), ylim=(0, None))
        axes.legend(frameon=False, loc="upper left")
    return Path(path)


def plot_training(
    history: Float[np.ndarray, " epochs"],
    held_out: Float[np.ndarray, " checked"],
    best_epoch: int,
    before: Run,
    after: Run,
    path: str | Path,
    heading: Heading | None = None,
) -> Path:
    """Plot the effect of training and write the picture (`plotting.picture`); returns its path.

    Left: mean cost of the training and the held-out motions by epoch (`Training`), the best epoch marked. Right: ‖z1‖
    over time of the same motions before and after training, median and worst at each time. A line ends where ‖z1‖
    exceeds `FAR` or is not finite.
    """
    with picture(path, 11.0, 4.2, heading=heading) as figure:
        costs, errors = figure.subplots(1, 2)
        _draw_costs(costs, history, held_out, best_epoch)
        _draw_errors(errors, {"before": before, "after": after})
    return Path(path)


def _draw_costs(
    axes: Axes, history: Float[np.ndarray, " epochs"], held_out: Float[np.ndarray, " checked"], best: int
) -> None:
    for name, values, colour in (("training", history, ACTUAL), ("held out", held_out, REFERENCE)):
        axes.plot(values, color=colour, label=name)
    chosen, colour = (held_out, REFERENCE) if held_out.size else (history, ACTUAL)
    lowered = f"best, {percent(1.0 - chosen[best] / chosen[0])} lower"
    axes.plot(best, chosen[best], "o", color=colour, markersize=5, clip_on=False, label=lowered)
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(MaxNLocator(6))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.3g}"))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set(xlabel="epoch", xlim=(0, max(len(history) - 1, 1)))
    axes.set_title("mean cost of a motion (no unit)", loc="left")
    axes.legend(frameon=False)


def _draw_errors(axes: Axes, runs: Mapping[str, Run]) -> None:
    for (name, run), colour in zip(runs.items(), (LIMIT, ACTUAL), strict=True):
        with np.errstate(over="ignore", invalid="ignore"):  # motions may diverge
            size = np.sqrt(squared_error(run)).reshape(len(run.t), -1)
            size = np.where(size <= FAR, size, np.inf)
            median, worst = (np.where(np.isfinite(x), x, np.nan) for x in (np.median(size, axis=1), size.max(axis=1)))
        axes.plot(run.t, median, color=colour, linewidth=1.8, label=f"{name}, median")
        axes.plot(run.t, worst, color=colour, linewidth=1.0, linestyle=(0, (4, 2)), label=f"{name}, worst")
        axes.fill_between(run.t, median, worst, color=colour, alpha=0.12, linewidth=0)
    mark = float(np.sqrt(PAPER_THRESHOLD))
    axes.axhline(mark, color=ERROR, linewidth=0.8, linestyle=(0, (1, 2)))
    axes.annotate("converged", (1.0, mark), xycoords=("axes fraction", "data"), ha="right", va="bottom", color=ERROR)
    axes.set_yscale("log")
    axes.set(xlabel="time [s]", xlim=(0.0, run.t[-1]))
    axes.set_title(
        f"‖error‖ of {counted(size.shape[1], 'fresh motion')} [{several(of.position for of in run.units)}]", loc="left"
    )
    axes.legend(frameon=False)


def plot_comparison(rows: Sequence[Mapping[str, Any]], path: str | Path) -> Path:
    """Plot the errors of the fair comparison and write the picture (PNG); returns its path.

    rows: `benchmarks.fair.Row` as dictionaries. There is a panel per arm, on a common axis, with a dot per law at the
    median of the trials and a line to the worst one, which ends in an arrow at the right edge where that diverged.
    """
    arms = list(dict.fromkeys(row["arm"] for row in rows))
    errors = 1e3 * np.array([[row["error_median_rad"], row["error_worst_rad"]] for row in rows])
    seen = errors[np.isfinite(errors) & (errors > 0.0)]
    limits = 0.7 * seen.min(initial=100.0), 1.5 * seen.max(initial=0.1)
    with picture(path, 2.6 + 3.4 * len(arms), 1.0 + 0.26 * math.ceil(len(rows) / len(arms))) as figure:
        grid = figure.subplots(1, len(arms), squeeze=False, sharey=True)[0]
        for axes, arm in zip(grid, arms, strict=True):
            _draw_comparison(axes, [row for row in rows if row["arm"] == arm], limits)
            axes.set_title(arm, loc="left")
            axes.set_xlabel("RMS error, worst joint [mrad]")
    return Path(path)


def _draw_comparison(axes: Axes, rows: Sequence[Mapping[str, Any]], limits: tuple[float, float]) -> None:
    edge = limits[1] / 1.08
    for y, row in enumerate(rows):
        colour = ACTUAL if row["law"].startswith("NBS") else LIMIT
        median, worst = 1e3 * row["error_median_rad"], 1e3 * row["error_worst_rad"]
        axes.plot([min(median, edge), min(worst, edge)], [y, y], color=colour, linewidth=1.0, alpha=0.6)
        axes.plot(min(worst, edge), y, "|" if math.isfinite(worst) else ">", color=colour, markersize=5)
        if math.isfinite(median):
            axes.plot(median, y, "o", color=colour, markersize=4.5)
    axes.set_xscale("log")
    axes.set(xlim=limits, ylim=(len(rows) - 0.5, -0.5))
    axes.set_yticks(range(len(rows)), [row["law"] for row in rows])
    axes.grid(False, axis="y")
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 3.0)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_locator(NullLocator())


def plot_motions(columns: Mapping[str, Mapping[str, Sequence[Run]]], path: str | Path, *, until: float) -> Path:
    """Plot two-joint motions side by side and write the picture (PNG); returns its path.

    columns: title -> label -> runs, each with any batch of starts; one colour per label, joint 1 solid, joint 2 dashed.
    Rows: angles and tracking errors up to the time `until` [s], and ‖z1‖² over the whole time on logarithmic axes.
    """
    with picture(path, 1.2 + 4.2 * max(len(columns), 1.6), 8.4) as figure:
        grid = figure.subplots(3, len(columns), squeeze=False, sharey="row")
        for axes, (title, runs) in zip(grid.T, columns.items(), strict=True):
            for (label, several), colour in zip(runs.items(), (ACTUAL, ERROR, TORQUE, REFERENCE), strict=False):
                _draw_motions(axes, several, colour, label, until)
            axes[0].set_title(title, loc="left")
            axes[0].legend(frameon=False, loc="best")
        for axes, name in zip(grid[:, 0], ("angles [rad]", "tracking errors z1 [rad]", "‖z1‖² [rad²]"), strict=True):
            axes.set_ylabel(name)
    return Path(path)


def _draw_motions(axes: np.ndarray, runs: Sequence[Run], colour: str, label: str, until: float) -> None:
    """The motions of one colour in a column of `plot_motions`."""
    angles, errors, squares = axes
    for run in runs:
        shown, starts = run.t <= until, run.q.reshape(len(run.t), -1, run.nv)
        z1 = starts - run.q_ref.reshape(starts.shape)
        width = 1.2 if starts.shape[1] * len(runs) == 1 else 0.7
        for joint, style in ((0, "-"), (1, "--")):
            angles.plot(run.t[shown], starts[shown, :, joint], style, color=colour, linewidth=width)
            errors.plot(run.t[shown], z1[shown, :, joint], style, color=colour, linewidth=width)
            wanted = run.q_ref.reshape(starts.shape)[shown, 0, joint]
            angles.plot(run.t[shown], wanted, style, color="#1d2733", linewidth=0.9, zorder=3)
        squares.loglog(run.t[1:], (z1**2).sum(-1)[1:], color=colour, linewidth=width)
    angles.plot([], [], color=colour, label=label)
    squares.axhline(PAPER_THRESHOLD, color=LIMIT, linewidth=0.9, linestyle=(0, (5, 3)))
    for panel, end in ((angles, until), (errors, until), (squares, None)):
        panel.set(xlabel="time [s]", xlim=(run.period if end is None else 0.0, end))


def plot_bounds(
    alpha: Float[np.ndarray, " alphas"],
    panels: Mapping[str, Mapping[str, Float[np.ndarray, " alphas"]]],
    path: str | Path,
) -> Path:
    """Plot ‖z1‖² [rad²] against α, one panel per title, and write the picture (PNG); returns its path.

    panels: title -> name -> values, drawn as a line if the name contains "bound", else as dots.
    """
    with picture(path, 5.6 * len(panels), 4.6) as figure:
        grid = figure.subplots(1, len(panels), squeeze=False, sharey=True)[0]
        for axes, (title, series) in zip(grid, panels.items(), strict=True):
            bounds = iter((LIMIT, REFERENCE))
            measured = iter((ACTUAL, TORQUE, SATURATED, ERROR))
            for name, values in series.items():
                if "bound" in name:
                    axes.plot(alpha, values, color=next(bounds), linewidth=1.8, label=name)
                else:
                    axes.plot(alpha, values, "o", color=next(measured), markersize=3.2, label=name)
            axes.set_yscale("log")
            axes.set(xlabel="α", xlim=(0.0, 1.02 * float(alpha.max())))
            axes.set_title(title, loc="left")
            axes.legend(frameon=False, loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=2)
        grid[0].set_ylabel("‖z1‖² [rad²]")
    return Path(path)
