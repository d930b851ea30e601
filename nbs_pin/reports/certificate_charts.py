"""Figures of certificates: bounds beside what happened, in the style of `plotting`."""

from collections.abc import Sequence
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator

from nbs_pin.base.units import measured, several
from nbs_pin.certificates.adaptive_bound import TransientBound
from nbs_pin.certificates.attack import Attack
from nbs_pin.certificates.certificate import Certificate
from nbs_pin.certificates.claims import Assumption
from nbs_pin.certificates.monitor import Monitored
from nbs_pin.certificates.transient_attack import TransientAttack
from nbs_pin.certificates.transient_check import TransientCheck
from nbs_pin.reports.captions import failing
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
    Heading,
    picture,
    stretches,
    thin,
)  # fmt: skip
from nbs_pin.reports.verdicts import BAD, Verdict, monitor_level
from nbs_pin.robots.robot import configuration_difference

_DASHED, _DOTTED = (0, (5, 3)), (0, (1, 2))
_LEGEND: Any = {"frameon": False, "ncols": 6, "handlelength": 1.4, "columnspacing": 1.2, "borderaxespad": 0.1}
_DECADES = 12  # of V that are drawn, at most
_TERMS = {
    "potential": ("−∇ΦᵀΛ∇Φ", TORQUE),
    "damping": ("−z2ᵀ(ωM + D)z2", ACTUAL),
    "disturbance": ("z2ᵀτ_d", REFERENCE),
    "held": ("z2ᵀ(held − law)", VIOLET),
    "saturation": ("z2ᵀ(τ − τ_command)", SATURATED),
}


def plot_monitor(
    monitored: Monitored,
    path: str | Path,
    *,
    units: Sequence[str] = ("rad",),
    title: str = "A run against its certificate",
    settings: Sequence[str] = (),
) -> Path:
    """Plot a run against its certificate and write the picture (`plotting.picture`); returns its path.

    V and its bound on a logarithmic scale; ‖z1‖ and its bound, with the |z1_i| that exceeds its own most; V̇ and each of
    its terms; and when each assumption failed. Saturated stretches are shaded, exceeded bounds are marked. units: of
    every joint's error; title and settings: above it, with the verdict.
    """
    rows = max(len(monitored.failures), 1)
    level = monitor_level(is_kept=monitored.is_kept, broken=monitored.broken)
    heading = Heading(title, settings, Verdict(level, monitored.verdict))
    with picture(path, 11.0, 8.6 + 0.34 * rows, heading=heading) as figure:
        heights = [2.6, 1.8, 3.0, 0.35 + 0.34 * rows]
        storage, error, terms, flags = figure.subplots(4, 1, sharex=True, height_ratios=heights)
        _draw_storage(storage, monitored)
        _draw_error(error, monitored, several(units))
        _draw_terms(terms, monitored)
        _draw_flags(flags, monitored)
        for axes in (storage, error, terms):
            _shade(axes, monitored)
        flags.set(xlabel="time [s]", xlim=(monitored.t[0], monitored.t[-1]))
    return Path(path)


def plot_certificate(
    certificate: Certificate,
    attack: Attack | None,
    path: str | Path,
    *,
    settings: Sequence[str] = (),
    verdict: Verdict | None = None,
) -> Path:
    """Plot the bounds and the worst motion found, and write the picture (`plotting.picture`); returns its path.

    With an attack: ‖z1(t)‖ of its worst motion, the certified bound and the one that the paper prints. Always: the
    bound of each joint, beside its largest error found. The title says how the bounds are known, or why they are void;
    settings and a verdict may stand below it.
    """
    if certificate.void:
        failed = failing(certificate.void, [condition.plain() for condition in certificate.conditions])
        verdict = Verdict(BAD, f"the bounds are void, as these conditions fail: {failed}")
    arm = "" if certificate.robot is None else f"{certificate.robot.name}, "
    heading = Heading(f"{arm}{certificate.disturbance}: {certificate.label}, in {certificate.clock}", settings, verdict)
    size = (6.4, 4.6) if attack is None else (11.0, 5.0)
    with picture(path, *size, heading=heading) as figure:
        if attack is None:
            _draw_joints(figure.add_subplot(), certificate, None)
        else:
            motion, joints = figure.subplots(1, 2, width_ratios=[1.25, 1.0])
            _draw_attack(motion, certificate, attack)
            _draw_joints(joints, certificate, attack)
    return Path(path)


def plot_transient(
    bound: TransientBound,
    path: str | Path,
    *,
    attack: TransientAttack | None = None,
    settings: Sequence[str] = (),
    verdict: Verdict | None = None,
) -> Path:
    """Plot the bounds of a law that adapts and write the picture (`plotting.picture`); returns its path.

    A bar per joint up to its bound, one inside up to the error of the law with a fixed model, if that is known, and a
    mark at the largest error that an attack found.
    """
    title = f"{bound.law.robot.name}, any load of 0 to {bound.load_mass:.3g} kg at {bound.frame}: {bound.label}"
    with picture(path, 6.4, 4.6, heading=Heading(title, settings, verdict)) as figure:
        axes, at = figure.add_subplot(), np.arange(len(bound.joint_errors))
        axes.barh(at, bound.joint_errors, height=0.7, color=LIMIT, alpha=0.35, label="the law that adapts, at most")
        if bound.fixed is not None:
            axes.barh(at, bound.fixed.joint_errors, height=0.38, color=ERROR, label="with a fixed model, simulated")
        if attack is not None:
            axes.plot(attack.joint_errors, at, "|", color=INK, markersize=14, label="worst found")
        axes.set_yticks(at, [_plain(name) for name in bound.joint_names])
        axes.invert_yaxis()
        axes.grid(visible=False, axis="y")
        axes.set(xlabel=f"error of each joint, |z1| [{several(bound.joint_units)}]")
        figure.legend(loc="outside lower left", **_LEGEND)
    return Path(path)


def plot_transient_check(
    seen: TransientCheck, path: str | Path, *, title: str = "", settings: Sequence[str] = ()
) -> Path:
    """Plot each |z1_i| of a run as a share of its bound and write the picture; returns its path."""
    level = monitor_level(is_kept=seen.is_kept, broken=tuple(seen.failures))
    with picture(path, 8.0, 4.6, heading=Heading(title, settings, Verdict(level, seen.verdict))) as figure:
        axes = figure.add_subplot()
        for name, share in zip(seen.joint_names, (seen.joint_errors / seen.joint_bounds).T, strict=True):
            axes.plot(*thin(seen.t, 100.0 * share), label=_plain(name))
        axes.axhline(100.0, color=LIMIT, linestyle=_DASHED, label="bound")
        axes.set(xlabel="time [s]", ylabel="error, of its bound [%]", xlim=(seen.t[0], seen.t[-1]))
        figure.legend(loc="outside lower left", **_LEGEND)
    return Path(path)


def _draw_storage(axes: Axes, seen: Monitored) -> None:
    values = np.concatenate([seen.storage, seen.promise])
    top = values.max() if values.max() > 0.0 else 1.0
    low = max(values[values > 0.0].min(initial=top), top * 10.0**-_DECADES)
    axes.fill_between(*thin(seen.t, seen.promise), low * 1e-3, color=LIMIT, alpha=0.12, linewidth=0)
    axes.plot(*thin(seen.t, seen.promise), color=LIMIT, linestyle=_DASHED, label="bound, V(0) exp(−ct) + V∞")
    axes.plot(*thin(seen.t, np.where(seen.storage > 0.0, seen.storage, np.nan)), color=ACTUAL, label="V")
    _mark(axes, seen, "V", seen.storage)
    axes.set(yscale="log", ylim=(0.5 * low, 3.0 * top))
    axes.yaxis.set_major_locator(LogLocator(numticks=7))
    axes.yaxis.set_minor_locator(NullLocator())
    _title(axes, "storage function [J]")


def _draw_error(axes: Axes, seen: Monitored, unit: str) -> None:
    axes.plot(
        *thin(seen.t, seen.error_bound), color=LIMIT, linestyle=_DASHED, label=f"bound, {_ends(seen.error_bound, unit)}"
    )
    axes.plot(*thin(seen.t, seen.error), color=ERROR, label=f"‖z1‖, at most {seen.error.max():.3g} {unit}")
    _mark(axes, seen, "‖z1‖", seen.error)
    names = [f"|z1| of {name}" for name in seen.joint_names]
    i = int((seen.joint_errors - seen.joint_bounds).max(axis=0).argmax())
    if names[i] in seen.excesses:
        axes.plot(*thin(seen.t, seen.joint_errors[:, i]), color=VIOLET, linewidth=1.0, label=_plain(names[i]))
        axes.plot(*thin(seen.t, seen.joint_bounds[:, i]), color=VIOLET, linewidth=1.0, linestyle=_DASHED)
    axes.set_ylim(0.0, 1.15 * max(float(seen.error_bound.max()), float(seen.error.max()), 1e-12))
    axes.yaxis.set_major_locator(MaxNLocator(4))
    _title(axes, f"tracking error [{unit}]")


def _draw_terms(axes: Axes, seen: Monitored) -> None:
    middle = 0.5 * (seen.t[1:] + seen.t[:-1])
    for name, (label, colour) in _TERMS.items():
        values = getattr(seen.balance, name)
        if values.any():
            axes.plot(*thin(middle, values), color=colour, linewidth=1.0, label=label)
    axes.plot(*thin(middle, seen.balance.change), color=INK, linewidth=1.0, linestyle=_DOTTED, label="V̇")
    axes.axhline(0.0, color=LIMIT, linewidth=0.7)
    peak = max(float(np.abs(line.get_ydata()).max()) for line in axes.lines) or 1.0
    most = 10.0 ** np.floor(np.log10(peak))
    axes.set_yscale("symlog", linthresh=1e-4 * peak)  # what comes after the first instants is far smaller
    axes.set_yticks([-most, -0.01 * most, 0.0, 0.01 * most, most])
    axes.yaxis.set_minor_locator(NullLocator())
    _title(axes, "rate of V and its terms [W]")


def _draw_flags(axes: Axes, seen: Monitored) -> None:
    """A line per assumption that failed, drawn while it failed."""
    names = list(seen.failures)
    for k, name in enumerate(names):
        bars = [(seen.t[begin], seen.t[end] - seen.t[begin]) for begin, end in stretches(seen.failures[name])]
        axes.broken_barh(bars, (k - 0.35, 0.7), color=SATURATED if name is Assumption.EFFORT else ERROR, linewidth=0)
    axes.set_yticks(range(len(names)), [fill(name, 26) for name in names])
    axes.set_ylim(max(len(names), 1) - 0.5, -0.5)
    axes.grid(visible=False, axis="y")
    if not names:
        axes.annotate("none", (0.5, 0.5), xycoords="axes fraction", ha="center", va="center", color=NOTE)
    axes.set_title("assumptions that failed", loc="left", color=INK)


def _draw_attack(axes: Axes, certificate: Certificate, attack: Attack) -> None:
    run, unit = attack.run, several(certificate.joint_units)
    z1 = configuration_difference(run.q, run.q_ref, run.continuous)
    axes.plot(
        *thin(run.t, np.linalg.norm(z1, axis=-1)), color=ERROR, label=f"worst found, {measured(attack.error, unit)}"
    )
    said = "void" if certificate.void else "certified"
    bounds = [(certificate.error, INK, _DASHED, f"{said}, {measured(certificate.error, unit)}")]
    # For inertia-shaped gains it equals the certified one, and one line is enough.
    if abs(certificate.printed_error - certificate.error) > 0.01 * certificate.error:
        printed = f"printed in the paper, {certificate.printed_error:.3g}"
        bounds.append((certificate.printed_error, REFERENCE, _DOTTED, printed))
    for value, colour, style, label in bounds:
        axes.axhline(value, color=colour, linestyle=style, label=label)
    axes.set(xlabel="time [s]", xlim=(0.0, run.t[-1]), ylim=(0.0, 1.35 * max(certificate.error, attack.error)))
    has_ratio = attack.error > 0.0 and not certificate.void
    ratio = f": certified ÷ found = {certificate.error / attack.error:.2f}" if has_ratio else ""
    axes.set_title(f"all errors together, ‖z1‖ [{unit}], {attack.found_by}{ratio}", loc="left", color=INK)
    axes.legend(frameon=False, loc="upper left", ncols=1)


def _draw_joints(axes: Axes, certificate: Certificate, attack: Attack | None) -> None:
    """A bar per joint up to its bound, with a bar inside up to the largest error found."""
    bounds, units = certificate.joint_errors, certificate.joint_units
    at = np.arange(len(bounds))
    axes.barh(at, bounds, height=0.7, color=LIMIT, alpha=0.35, label="void" if certificate.void else "certified")
    found = np.zeros(len(at)) if attack is None else attack.joint_errors
    if attack is not None:
        axes.barh(at, found, height=0.38, color=ERROR, label="worst found")
    if certificate.overshoot is not None:
        axes.plot(certificate.overshoot[1], at, "|", color=INK, markersize=14, label="from the start given")
    for y, bound, end, unit in zip(at.tolist(), bounds.tolist(), np.maximum(bounds, found), units, strict=True):
        axes.annotate(f" {measured(bound, unit)}", (end, y), va="center", fontsize=7.5, color=NOTE)
    axes.set_yticks(at, [_plain(name) for name in certificate.joint_names])
    axes.invert_yaxis()
    axes.grid(visible=False, axis="y")
    most = max(bounds.max(), found.max(), 0.0 if certificate.overshoot is None else certificate.overshoot[1].max())
    axes.set_xlim(0.0, 1.35 * float(most) or 1.0)
    axes.xaxis.set_major_locator(MaxNLocator(5))
    axes.set_title(f"error of each joint in the long run, |z1| [{several(units)}]", loc="left", color=INK)
    if attack is not None or certificate.overshoot is not None:  # below the panel, whose title takes its width
        axes.legend(loc="upper left", bbox_to_anchor=(0.0, -0.07), **_LEGEND)
    if not bounds.any():
        axes.set_xticks([0.0])
        axes.annotate("every bound is 0: no disturbance", (0.5, 0.5), xycoords="axes fraction", ha="center",
                      va="center", color=NOTE)  # fmt: skip


def _shade(axes: Axes, seen: Monitored) -> None:
    bars = [(seen.t[begin], seen.t[end] - seen.t[begin]) for begin, end in stretches(seen.saturated)]
    axes.broken_barh(bars, (0.0, 1.0), transform=axes.get_xaxis_transform(), color=SATURATED, alpha=0.3, linewidth=0)


def _ends(values: np.ndarray, unit: str) -> str:
    first, last = (f"{x:.3g}" for x in values[[0, -1]].tolist())
    return f"{first} {unit}" if first == last else f"{first} to {last} {unit}"


def _mark(axes: Axes, seen: Monitored, name: str, values: np.ndarray) -> None:
    """Mark where the quantity of that name exceeds its bound."""
    if name in seen.excesses:
        where = np.where(seen.excesses[name], values, np.nan)
        label = "bound exceeded" if name == next(iter(seen.excesses)) else None
        axes.plot(*thin(seen.t, where), color=ERROR, linewidth=2.2, label=label)


def _title(axes: Axes, title: str) -> None:
    axes.set_title(title, loc="left", color=INK)
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), **_LEGEND)


def _plain(text: str) -> str:
    """Text in which no dollar begins a formula."""
    return text.replace("$", r"\$")
