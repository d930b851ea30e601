"""A certificate as tables for people."""

import math
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

_BOUNDS = ("rate of decay", "c of V", "V∞", "Φ∞", "V(0) of", "‖z1‖ from")
_SAMPLED = ("longest control period", "longest delay")
_BESIDE = ("‖z1‖", "printed ‖z1‖", "|z1| of ")
"""Bounds in radians, which have a table of their own."""


def print_certificate(console: Console, title: str, figures: dict[str, Any]) -> None:
    """Design, constants, conditions, bounds and assumptions; `figures` as `studies.certifying.figures` gives them."""
    certificate = figures["certificate"]
    console.print(Text(f"{title}: {certificate['disturbance']}", style="bold"), soft_wrap=True)
    if figures["design"] is not None:
        console.print(_design(figures))
    groups: dict[str, list[dict[str, Any]]] = {"disturbance": figures["loads"], "constants": [], "bounds": [],
                                               "sampled control": []}  # fmt: skip
    for line in certificate["lines"]:
        if not line["name"].startswith(_BESIDE) or line["name"].startswith(_BOUNDS):
            groups[_group(line["name"])].append(line)
    for name, lines in groups.items():
        if lines:
            console.print(_claims(name, lines))
    console.print(_conditions(certificate["conditions"]))
    console.print(_errors(figures))
    for text in _closing(figures):
        console.print(text, highlight=False, markup=False, soft_wrap=True)


def _group(name: str) -> str:
    if name.startswith(_BOUNDS):
        return "bounds"
    return "sampled control" if name.startswith(_SAMPLED) else "constants"


def _table(title: str, *headings: str) -> Table:
    table = Table(title=Text(title), box=box.SIMPLE_HEAD, title_justify="left", title_style="bold")
    for k, heading in enumerate(headings):
        wraps = k == 0 or heading == "because"
        table.add_column(Text(heading), justify="left" if wraps or heading == "known" else "right", no_wrap=not wraps,
                         overflow="fold")  # fmt: skip
    return table


def _claims(title: str, lines: list[dict[str, Any]]) -> Table:
    table = _table(title, "", "value", "known", "because")
    for line in lines:
        table.add_row(Text(line["name"]), _with_unit(line["value"], line["unit"]), line["label"], Text(line["because"]))
    return table


def _conditions(conditions: list[dict[str, Any]]) -> Table:
    table = _table("conditions", "", "left", "right", "holds", "known")
    for line in conditions:
        holds = "yes" if line["holds"] else Text("NO", style="bold red")
        unit = line["unit"]
        table.add_row(Text(line["name"]), _number(line["left"]), _with_unit(line["right"], unit), holds, line["label"])
    return table


def _errors(figures: dict[str, Any]) -> Table:
    """What is certified beside what the paper prints and the worst that was found."""
    certificate, found = figures["certificate"], figures["attack"]
    headings = [
        "certified\n[rad]",
        "paper prints\n[rad]",
        *(["worst found\n[rad]", "certified ÷\nworst found"] if found else []),
    ]
    table = _table("errors", "", *headings)
    table.add_row("‖z1‖", *_row(certificate["error_rad"], certificate["printed_error_rad"],
                                found and found["error_rad"], found is not None))  # fmt: skip
    rows = zip(figures["joints"], certificate["joint_errors_rad"], strict=True)
    for k, (joint, bound) in enumerate(rows):
        worst = found["joint_errors_rad"][k] if found else None
        table.add_row(Text(f"|z1| of {joint}"), *_row(bound, math.nan, worst, found is not None))
    return table


def _row(bound: float | None, printed: float | None, worst: float | None, attacked: bool) -> list[str]:
    cells = [_number(bound), "" if printed is not None and math.isnan(printed) else _number(printed)]
    if attacked:
        ratio = f"{bound / worst:.2f}" if bound is not None and worst else ""
        cells += [_number(worst), ratio]
    return cells


def _design(figures: dict[str, Any]) -> Table:
    design = figures["design"]
    title = (
        f"design: ω = {design['bandwidth_rad_per_s']:.3g} rad/s, control period {1e3 * design['period_s']:g} ms, "
        f"{design['torque_share'] or 0.0:.0%} of a torque limit at the bound"
    )
    table = _table(title, "joint", "K\n[N·m/rad]", "Λ\n[rad/s per N·m]", "D₀\n[N·m·s/rad]", "torque\n[N·m]")
    columns = ("stiffness_Nm_per_rad", "rate_rad_per_s_per_Nm", "damping_Nms_per_rad", "torque_Nm")
    for joint, *values in zip(figures["joints"], *(design[name] for name in columns), strict=True):
        table.add_row(Text(joint), *(_number(value) for value in values))
    return table


def _closing(figures: dict[str, Any]) -> list[str]:
    certificate, found, watched = figures["certificate"], figures["attack"], figures["monitor"]
    label = certificate["label"]
    lines = [f"{label}, assuming: {'; '.join(certificate['assumptions'])}"]
    if figures["loads"]:
        lines.append(f"the bound on the disturbance itself is {figures['disturbance_label']}")
    if found is not None:
        how = f"{found['found_by']}, {found['duration_s']:.3g} s at {1e3 * found['period_s']:g} ms"
        search = how if found["thorough"] else f"{how}; waves alone, --attack searches further"
        lines.append(f"worst found by {search}")
    if watched is not None:
        lines.append(f"the run: {watched['verdict']}")
    return lines


def _with_unit(value: float | None, unit: str) -> str:
    return f"{_number(value)} {unit}".rstrip()


def _number(value: float | None) -> str:
    return "none" if value is None else f"{value:.3g}"
