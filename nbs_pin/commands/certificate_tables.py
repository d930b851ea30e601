"""A certificate as tables on the console."""

from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from nbs_pin.base.units import SLIDING, column, percent, units
from nbs_pin.certificates.claims import Role
from nbs_pin.commands.results import tell, titled
from nbs_pin.reports.verdicts import verdict_of

_ERRORS = ("rad", "m", "rad, m")
"""Units of the error bounds, which have a table of their own."""
_ORDER = (
    "disturbance",
    "friction",
    "errors of the bodies",
    "bounds",
    "sampled control",
    "model error",
    "inertia",
    "constants",
    "structure",
)
"""Groups of claims, in the order in which they are printed."""

_GAINS = {
    "K": ("stiffness_Nm_per_rad", "stiffness"),
    "Λ": ("rate_rad_per_s_per_Nm", "rate"),
    "D₀": ("damping_Nms_per_rad", "damping"),
    "torque": ("torque_Nm", "torque"),
}
"""Columns of a design per joint: the figures, and the fields of `JointUnits` that say in what they are."""


def print_certificate(console: Console, figures: dict[str, Any], *, verbose: bool) -> None:
    """Print the promise, and all that it rests on if wanted; `figures` from `commands.certify.figures`."""
    verdict = verdict_of(figures)
    tell(console, verdict.said, verbose=verbose)
    if figures["design"] is not None:
        console.print(_design(figures))
    if verbose:
        _print_grounds(console, figures)
    for text in verdict.more:
        console.print(text, highlight=False, markup=False, soft_wrap=True)


def _print_grounds(console: Console, figures: dict[str, Any]) -> None:
    """Print the error bounds first, then what they rest on."""
    certificate = figures["certificate"]
    bounds = [line for line in certificate["lines"] if line["group"] == "bounds" and line["unit"] in _ERRORS]
    reasons = [line["because"] for line in bounds]
    bounds.sort(key=lambda line: reasons.index(line["because"]))
    console.print(_errors(bounds, figures))
    console.print(_assumptions(certificate["assumptions"]))
    console.print(_conditions(certificate["conditions"]))
    for name in _ORDER:
        lines = [line for line in certificate["lines"] if line["group"] == name and line not in bounds]
        if lines:
            console.print(claims_table(name, lines))


def _table(title: str, *headings: str) -> Table:
    table = titled(title)
    for k, heading in enumerate(headings):
        wraps = k == 0 or heading == "because"
        table.add_column(Text(heading), justify="left" if wraps or heading == "known" else "right", no_wrap=not wraps,
                         overflow="fold")  # fmt: skip
    return table


def claims_table(title: str, lines: Sequence[Mapping[str, Any]]) -> Table:
    """Every claim with its value, its label and its reason."""
    table = _table(title, "", "value", "known", "because")
    for line in lines:
        table.add_row(Text(line["name"]), _with_unit(line["value"], line["unit"]), line["label"], Text(line["because"]))
    return table


def _conditions(conditions: list[dict[str, Any]]) -> Table:
    """The conditions, each with its reason below it."""
    table = _table("conditions", "", "left", "right", "holds", "known")
    for line in conditions:
        # What nothing rests on may fail: then it is only not shown.
        fails = "not shown" if line["role"] == Role.COMPARISON else Text("NO", style="bold red")
        holds = "yes" if line["holds"] else fails
        name = Text.assemble(line["name"], ("\n" + line["because"], "dim"))
        table.add_row(name, _number(line["left"]), _with_unit(line["right"], line["unit"]), holds, line["label"])
    return table


def _assumptions(assumptions: list[dict[str, Any]]) -> Table:
    """What the bounds assume, and how far it was checked."""
    table = _table("assumptions", "", "by the conditions below")
    for line in assumptions:
        failed = line["checked"] == "FAILS"
        table.add_row(Text(line["assumption"]), Text(line["checked"], style="bold red" if failed else ""))
    return table


def _errors(bounds: list[dict[str, Any]], figures: dict[str, Any]) -> Table:
    """Every error bound beside the largest error found; bounds with a common reason have it below the last one."""
    certificate, found = figures["certificate"], figures["attack"]
    worst = {} if found is None else _worst(certificate["joints"], found)
    searched = [] if found is None else ["worst\nfound", "bound ÷\nfound"]
    table = _table("errors", "", "bound", *searched, "known")
    for k, line in enumerate(bounds):
        ends = k + 1 == len(bounds) or bounds[k + 1]["because"] != line["because"]
        name = Text.assemble(line["name"], ("\n" + line["because"] if ends else "", "dim"))
        beside = [] if found is None else _beside(line["value"], worst.get(line["name"]))
        table.add_row(name, _with_unit(line["value"], line["unit"]), *beside, line["label"])
    return table


def _worst(joints: list[str], found: dict[str, Any]) -> dict[str, float]:
    """The largest errors found, by the names of their bounds."""
    of_joints = zip(joints, found["joint_errors_rad"], strict=True)
    return {"‖z1‖": found["error_rad"]} | {f"|z1| of {joint}": error for joint, error in of_joints}


def _beside(bound: float | None, worst: float | None) -> list[Text]:
    """The error found and the ratio of the bound to it, red if the bound is smaller."""
    if worst is None or bound is None:
        return [Text(""), Text("")]
    ratio = f"{bound / worst:.2f}" if worst > 0.0 else ""
    return [Text(_number(worst)), Text(ratio, style="bold red" if worst > bound else "")]


def _design(figures: dict[str, Any]) -> Table:
    design = figures["design"]
    title = (
        f"design: ω = {design['bandwidth_rad_per_s']:.3g} rad/s, control period {1e3 * design['period_s']:g} ms, "
        f"{percent(design['torque_share'] or 0.0)} of a torque limit at the bound"
    )
    slides = [unit == SLIDING.position for unit in figures["certificate"]["units"]]
    columns = [
        column(name, [_number(value) for value in design[key]], units(quantity, slides))
        for name, (key, quantity) in _GAINS.items()
    ]
    table = _table(title, "joint", *(heading for heading, _ in columns))
    for joint, *cells in zip(figures["certificate"]["joints"], *(cells for _, cells in columns), strict=True):
        table.add_row(Text(joint), *cells)
    return table


def _with_unit(value: float | None, unit: str) -> str:
    return f"{_number(value)} {unit}".rstrip()


def _number(value: float | None) -> str:
    return "none" if value is None else f"{value:.3g}"
