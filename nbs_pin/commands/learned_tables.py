"""What `nbs-pin learn` prints of a learned model."""

from typing import Any

from rich.console import Console
from rich.text import Text

from nbs_pin.base.summaries import SUMMARY
from nbs_pin.base.units import column, counted, percent
from nbs_pin.commands.results import table, tell
from nbs_pin.identification.coupling import Coupling
from nbs_pin.reports.verdicts import verdict_of

_WIDE = 4
"""Columns of the drives in one table."""
_HEADINGS = {
    "constant": "const",
    "sign v": "±v",
    "√|v| sign v": "±√v",
    "|τ| sign v": "±load",
    "τ earlier or later": "delay",
}
_KNOWN = 0.1
"""Standard deviation of the mass of all bodies, as a share of it, up to which the data determine it."""
_ENDED = {
    "held out": "no further progress on held-out data",
    "iterations": "all iterations done",
    "starts": "all starts tried",
}


def print_learned(console: Console, title: str, figures: dict[str, Any], *, verbose: bool, interrupted: bool) -> None:
    """Print how good the model is, and a row per joint."""
    verdict = verdict_of(figures, interrupted=interrupted)
    lines, tables = [*verdict.more, *_lines(figures)], [_errors(title, figures), *_drives(figures), *_left(figures)]
    tell(console, f"{title}: {verdict.said}", lines, tables, verbose=verbose)


def _per_joint(title: str, figures: dict[str, Any], columns: list[tuple[str, list[str]]]) -> Any:
    shown = table(title, *(heading for heading, _ in columns))
    for joint, *row in zip(figures["joints"], *(cells for _, cells in columns), strict=True):
        shown.add_row(Text(joint), *row)
    return shown


def _errors(title: str, figures: dict[str, Any]) -> Any:
    """How far the torque is off."""
    test, of, left = figures["rms_test_torque_error_Nm"], figures["units"], figures["left"]
    columns = [
        column("torque\ndeviation", [f"{x:.4g}" for x in figures["torque_deviation_Nm"]], of["torque"]),
        column("error", [f"{x:.2e}" for x in figures["rms_torque_error_Nm"]], of["torque"]),
    ]
    if test is not None:
        columns.append(column("error, held\nout", [f"{x:.2e}" for x in test], of["torque"]))
    if left:
        columns.append(column("mean of\nit", [f"{x:+.1e}" for x in left["mean_Nm"]], of["torque"]))
    return _per_joint(title, figures, columns)


def _drives(figures: dict[str, Any]) -> list[Any]:
    """What was found of the drives, in tables that a narrow terminal holds."""
    of = figures["units"]
    kinds = (
        ("viscous_friction", "viscous\nfriction", of["damping"]),
        ("coulomb_friction_Nm", "Coulomb\nfriction", of["torque"]),
        ("offset_Nm", "offset", of["torque"]),
        ("rotor_inertia", "rotor\ninertia", of["inertia"]),
        ("viscous_asymmetry", "viscous,\n± by sign", of["damping"]),
        ("stribeck_friction_Nm", "Stribeck\nfriction", of["torque"]),
        ("stribeck_speed", "Stribeck\nspeed", of["velocity"]),
    )
    found = [column(head, [f"{x:.3g}" for x in figures[name]], unit) for name, head, unit in kinds if figures.get(name)]
    if figures.get("load_friction_share"):
        found.append(("friction\nover load", [percent(x, 1) for x in figures["load_friction_share"]]))
    parts = [found[k : k + _WIDE] for k in range(0, len(found), _WIDE)]
    return [_per_joint("drives" if k == 0 else "drives, continued", figures, part) for k, part in enumerate(parts)]


def _left(figures: dict[str, Any]) -> list[Any]:
    """Of what is left of the torque, the share that single effects would explain."""
    left = figures["left"]
    if not left:
        return []
    columns = [
        ("share of\nvariance", ["—" if x is None else f"{x:.1e}" for x in left["nmse"]]),
        *((_HEADINGS.get(name, name), [percent(x) for x in share]) for name, share in left["explained_by"].items()),
    ]
    where = "the data" if figures["test_nmse"] is None else "held-out data"
    title = f"left of the torque on {where}: share of its variance, and of that left, by effect"
    return [_per_joint(title, figures, columns)]


def _lines(figures: dict[str, Any]) -> list[str]:
    train, test = (figures[name] for name in ("train_nmse", "test_nmse"))
    shown, more = figures["unidentifiable"][:3], len(figures["unidentifiable"]) - 3
    return [
        f"mean squared torque error over the variance of the torque: {_short(train)} on "
        + counted(figures["samples"], "sample")
        + ("" if test is None else f", {_short(test)} on {figures['test_samples']} of trajectories held out"),
        f"{counted(figures['parameters'], 'number')} learned in {figures['seconds']:.1f} s "
        f"({_ENDED.get(figures['stopped'], figures['stopped'])})",
        *_coupling(figures),
        *_masses(figures["details"]),
        *([f"to try next: {figures['next_try']}"] if figures["next_try"] else []),
        *(f"the data do not determine: {text}" for text in shown),
        *([f"… and {more} more in {SUMMARY}"] if more > 0 else []),
    ]


def _short(value: float | None) -> str:
    return "none" if value is None else f"{value:.2e}"


def _coupling(figures: dict[str, Any]) -> list[str]:
    """How the motors turn with the joints, where some turn several."""
    coupled = Coupling.of_plain(figures["details"])
    return [] if coupled is None else [coupled.said(figures["joints"])]


def _masses(details: dict[str, Any]) -> list[str]:
    """The mass that was found beside that of the URDF, as far as torques depend on it, and outliers."""
    names = ("mass_kg", "mass_deviation_kg", "stated_mass_kg", "outliers")
    found, deviation, stated, outliers = (details.get(name) for name in names)
    mass = []
    if found and deviation <= _KNOWN * found:
        beside = "" if stated is None else f", {stated:.3g} kg in the URDF"
        mass.append(f"masses add up to {found:.3g} kg, give or take {deviation:.2g} kg{beside}")
    elif found:
        mass.append("these torques do not show what the bodies weigh in all; those of the model are one choice of many")
    far = counted(outliers or 0, "torque is", "torques are")
    return mass + ([f"{far} far from all others, and count little"] if outliers else [])
