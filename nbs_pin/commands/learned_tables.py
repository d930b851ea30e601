"""What `nbs-pin learn` prints of a learned model."""

from typing import Any

from rich.console import Console
from rich.text import Text

from nbs_pin.base.summaries import SUMMARY
from nbs_pin.base.units import column
from nbs_pin.commands.results import table, tell
from nbs_pin.reports.verdicts import verdict_of

_ENDED = {"held out": "no further progress on held-out data", "iterations": "all iterations done"}


def print_learned(console: Console, title: str, figures: dict[str, Any], *, verbose: bool, interrupted: bool) -> None:
    """Print how good the model is, and a row per joint."""
    test, viscous, of = figures["rms_test_torque_error_Nm"], figures["viscous_friction"], figures["units"]
    none = ["none"] * len(figures["joints"])
    coulomb = [f"{x:.3g}" for x in figures["coulomb_friction_Nm"] or ()] or none
    columns = [
        column("torque\ndeviation", [f"{x:.4g}" for x in figures["torque_deviation_Nm"]], of["torque"]),
        column("error", [f"{x:.2e}" for x in figures["rms_torque_error_Nm"]], of["torque"]),
        column("error, held\nout", none if test is None else [f"{x:.2e}" for x in test], of["torque"]),
        column("viscous\nfriction", none if viscous is None else [f"{x:.3g}" for x in viscous], of["damping"]),
        column("Coulomb\nfriction", coulomb, of["torque"]),
    ]
    columns += _drives(figures)
    shown = table(title, *(heading for heading, _ in columns))
    for joint, *row in zip(figures["joints"], *(cells for _, cells in columns), strict=True):
        shown.add_row(Text(joint), *row)
    verdict = verdict_of(figures, interrupted=interrupted)
    tell(
        console,
        f"{title}: {verdict.said}",
        [*verdict.more, *_lines(figures)],
        [shown, *_left(figures)],
        verbose=verbose,
    )


def _drives(figures: dict[str, Any]) -> list[tuple[str, list[str]]]:
    """Columns of what was found of the drives besides viscous and Coulomb friction."""
    of = figures["units"]
    kinds = (
        ("offset_Nm", "offset", of["torque"]),
        ("rotor_inertia", "rotor\ninertia", of["inertia"]),
        ("viscous_asymmetry", "viscous,\n± by sign", of["damping"]),
        ("stribeck_friction_Nm", "Stribeck\nfriction", of["torque"]),
        ("stribeck_speed", "Stribeck\nspeed", of["velocity"]),
    )
    found = [column(head, [f"{x:.3g}" for x in figures[name]], unit) for name, head, unit in kinds if figures.get(name)]
    share = figures.get("load_friction_share")
    return found + ([("friction\nover load", [f"{x:.1%}" for x in share])] if share else [])


def _left(figures: dict[str, Any]) -> list[Any]:
    """The table of what is left of the torque, and of the share of that which single effects would explain."""
    left, of = figures["left"], figures["units"]
    if not left:
        return []
    headings = {"constant": "constant", "τ earlier or later": "delay"}
    columns = [
        column("mean", [f"{x:+.2e}" for x in left["mean_Nm"]], of["torque"]),
        ("share of\nvariance", ["—" if x is None else f"{x:.2e}" for x in left["nmse"]]),
        *((headings.get(name, name), [f"{x:.0%}" for x in share]) for name, share in left["explained_by"].items()),
    ]
    where = "on the data" if figures["test_nmse"] is None else "on held-out data"
    shown = table(
        f"what is left {where}, and the share of it that would be explained by", *(head for head, _ in columns)
    )
    for joint, *row in zip(figures["joints"], *(cells for _, cells in columns), strict=True):
        shown.add_row(Text(joint), *row)
    return [shown]


def _lines(figures: dict[str, Any]) -> list[str]:
    train, test = (figures[name] for name in ("train_nmse", "test_nmse"))
    shown, more = figures["unidentifiable"][:3], len(figures["unidentifiable"]) - 3
    return [
        f"mean squared torque error over the variance of the torque: {_short(train)} on {figures['samples']} samples"
        + ("" if test is None else f", {_short(test)} on {figures['test_samples']} of trajectories held out"),
        f"{figures['parameters']} numbers learned in {figures['seconds']:.1f} s "
        f"({_ENDED.get(figures['stopped'], figures['stopped'])})",
        *_masses(figures["details"]),
        *([f"to try next: {figures['next_try']}"] if figures["next_try"] else []),
        *(f"the data do not determine: {text}" for text in shown),
        *([f"… and {more} more in {SUMMARY}"] if more > 0 else []),
    ]


def _short(value: float | None) -> str:
    return "none" if value is None else f"{value:.2e}"


def _masses(details: dict[str, Any]) -> list[str]:
    """The mass that was found beside that of the URDF, and outliers."""
    found, stated, outliers = (details.get(name) for name in ("mass_kg", "stated_mass_kg", "outliers"))
    mass = (
        [f"mass {found:.3g} kg, {stated:.3g} kg in the URDF; of it the base and parallel axes show little"]
        if found
        else []
    )
    return mass + ([f"{outliers} torques are far from all others, and count little"] if outliers else [])
