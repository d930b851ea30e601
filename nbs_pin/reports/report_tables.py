"""Tables of a report: HTML of the figures in summary.json, with the units that their names and joints say."""

import html
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from nbs_pin.base.units import SLIDING, TURNING, by_quantity, measured, percent, several
from nbs_pin.reports.pages import written

_UNITS = {
    "rad_per_s2": "acceleration",
    "rad_per_s": "velocity",
    "rad": "position",
    "Nm": "torque",
    "Nm_per_rad": "stiffness",
    "Nms_per_rad": "damping",
    "rad_per_s_per_Nm": "rate",
    "kgm2": "inertia",
}
"""Quantities of `JointUnits`, by the ends of the names of figures."""
_DERIVED = {"rad2": ("position", "²"), "Nm_per_s": ("torque", "/s")}
"""The unit of such a quantity and what follows it."""
_PLAIN = {"s": "s", "us": "µs", "ms": "ms", "m": "m", "per_s": "1/s", "MB": "MB"}
_ENDS = sorted([*_UNITS, *_DERIVED, *_PLAIN], key=len, reverse=True)
_RATES = ("bandwidth_rad_per_s", "frequency_rad_per_s")
"""Figures in rad/s whatever the joints do."""
_SKIPPED = ("joints", "units", "curves", "certificate", "transient", "monitor", "attack", "by_speed", "by_distance")
_PER_JOINT = {
    "rms_error_late_rad": (
        "rms_error_rad",
        "rms_error_late_rad",
        "rms_error_last_30_percent_rad",
        "joint_peak_torque_Nm",
        "effort_limit_Nm",
        "outside_position_range_rad",
    ),
    "rms_test_torque_error_Nm": (
        "torque_deviation_Nm",
        "rms_torque_error_Nm",
        "rms_test_torque_error_Nm",
        "viscous_friction",
        "coulomb_friction_Nm",
        "offset_Nm",
    ),
    "relative_error": ("torque_rms_Nm", "torque_deviation_Nm"),
    "covered_range_fraction": (
        "q_least_rad",
        "q_most_rad",
        "covered_range_fraction",
        "rms_velocity_rad_per_s",
        "peak_velocity_rad_per_s",
        "rms_acceleration_rad_per_s2",
        "rms_torque_Nm",
        "peak_torque_Nm",
        "torque_limit_Nm",
        "at_torque_limit_fraction",
    ),
}
"""Figures with a number for each joint, by the figure that tells the results of one command from others: a list may
also be as long as the arm has joints by chance."""
_LARGEST = ("rms_error_rad", "rms_error_late_rad", "joint_peak_torque_Nm", "rms_test_torque_error_Nm")
"""Those of which the largest says most."""


def joints_table(figures: Mapping[str, Any]) -> str:
    """A row per joint, a column per figure that has a number for each; empty if there are none."""
    columns = _columns(figures)
    heads, rows = [], [[name] for name in figures["joints"]] if columns else []
    for name, values in columns.items():
        words, _ = _split(name)
        heads.append(words)
        for row, value, unit in zip(rows, values, _units(figures, name), strict=True):
            row.append(_share(value) if "fraction" in words else _told(value, unit))
    return table(["joint", *heads], rows) if columns else ""


def numbers_table(results: Mapping[str, Mapping[str, Any]]) -> str:
    """A row per figure of the whole arm, and for the largest of some of its joints; a column per result."""
    told = {label: dict((*_largest(figures), *_scalars(figures, figures))) for label, figures in results.items()}
    names = list(dict.fromkeys(name for texts in told.values() for name in texts))
    rows = [[name, *(texts.get(name, "none") for texts in told.values())] for name in names]
    return table(["figure", *told], rows) if rows else ""


def certificate_tables(figures: Mapping[str, Any]) -> str:
    """The bounds of a certificate, what it assumes, the conditions, and every other claim, folded."""
    found = figures["certificate"]
    attack = figures["attack"] or {}
    worst = attack.get("joint_errors_rad") or [None] * len(found["joints"])
    starts = found["joint_overshoots_rad"]
    columns = {
        "in the long run its error stays below": found["joint_errors_rad"],
        **({} if starts is None else {"and from the start given, at all times, below": starts}),
        "the worst motion found reaches": worst,
    }
    bounds = [
        [name, *("" if value is None else measured(value, unit) for value in values)]
        for name, unit, *values in zip(found["joints"], found["units"], *columns.values(), strict=True)
    ]
    assumed = [[line["assumption"], line["checked"]] for line in found["assumptions"]]
    conditions = [
        [line["name"], "holds" if line["holds"] else "FAILS", line["label"], line["because"]]
        for line in found["conditions"]
    ]
    claims = [
        [line["name"], _told(line["value"], line["unit"]), line["label"], line["because"]] for line in found["lines"]
    ]
    return "".join(
        [
            "<p>The bounds are void, as conditions fail.</p>" if found["void"] else "",
            table(["joint", *columns], bounds),
            folded("what it assumes", table(["assumption", "checked"], assumed)),
            folded("conditions", table(["condition", "", "known", "because"], conditions)),
            folded("every number behind it", table(["quantity", "value", "known", "because"], claims)),
        ]
    )


def transient_tables(figures: Mapping[str, Any]) -> str:
    """The bounds of a law that adapts, beside the law with a fixed model, and every claim, folded."""
    found = figures["transient"]
    nothing = [None] * len(found["joints"])
    columns = {
        "its error stays below": found["joint_errors_rad"],
        "at all times below": found["joint_errors_always_rad"] or nothing,
        "fixed model, certified": found["fixed_joint_error_bounds_rad"] or nothing,
        "fixed model, simulated": found["fixed_joint_errors_rad"] or nothing,
    }
    if figures.get("attack"):
        columns["the worst run found reaches"] = figures["attack"]["joint_errors_rad"]
    bounds = [
        [name, *("none" if value is None else measured(value, unit) for value in values)]
        for name, unit, *values in zip(found["joints"], found["units"], *columns.values(), strict=True)
    ]
    claims = [
        [line["name"], _told(line["value"], line["unit"]), line["label"], line["because"]] for line in found["lines"]
    ]
    shown = table(["quantity", "value", "known", "because"], claims)
    return table(["joint", *columns], bounds) + folded("every number behind it", shown)


def bench_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """The rows of a bench."""
    cells = []
    for row in rows:
        figures = ", ".join(f"{name} {value:.4g}" for name, value in row["figures"].items() if value is not None)
        cells.append([f"{row['what']}, {row['how']}", row["arm"], figures])
    return table(["what", "arm", "figures"], cells)


def table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """An HTML table that scrolls sideways on a phone, numbers to the right; all texts are escaped."""
    head = "".join(f"<th>{written(text)}</th>" for text in heads)
    body = "".join(f"<tr>{''.join(map(_cell, row))}</tr>" for row in rows)
    return f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def _cell(text: str) -> str:
    is_number = re.match(r"[-−]?[0-9]|none$|$", text)
    return f"<td{'' if is_number else ' class=text'}>{written(text)}</td>"


def folded(title: str, content: str) -> str:
    """The content under a title that opens it."""
    return f"<details><summary>{html.escape(title)}</summary>{content}</details>"


def _columns(figures: Mapping[str, Any]) -> dict[str, list[float | None]]:
    """The figures with a number per joint; empty for a batch of starts, which has a list for each."""
    names = next((names for kind, names in _PER_JOINT.items() if kind in figures), ())
    joints = figures.get("joints") or []
    found = {name: figures.get(name) for name in names}
    return {name: values for name, values in found.items() if isinstance(values, list) and _are_numbers(values, joints)}


def _are_numbers(values: list[Any], joints: Sequence[str]) -> bool:
    return len(values) == len(joints) and all(value is None or isinstance(value, int | float) for value in values)


def _units(figures: Mapping[str, Any], name: str) -> list[str]:
    """The unit of a figure for each joint, or of all of them where the figures hold it so."""
    quantity = "damping" if name == "viscous_friction" else _split(name)[1]
    if name.endswith(_RATES):
        return [TURNING.velocity]
    joints = _of_joints(figures)
    if quantity in _DERIVED:  # only of numbers over all joints
        base, end = _DERIVED[quantity]
        return [f"{unit}{end}" for unit in several(joints[base]).split(", ")]
    of = list(joints.get(_UNITS.get(quantity, ""), ()))
    return of or [_PLAIN.get(quantity, "")] * max(1, len(figures.get("joints") or ()))


def _of_joints(figures: Mapping[str, Any]) -> Mapping[str, Sequence[str]]:
    """The units of the joints by quantity; those of a certificate follow from those of its bounds."""
    given, certificate = figures.get("units"), figures.get("certificate")
    if isinstance(given, Mapping):
        return {name: [of] if isinstance(of, str) else of for name, of in given.items()}
    turning = [TURNING.position] * max(1, len(figures.get("joints") or ()))
    bounds = certificate["units"] if isinstance(certificate, Mapping) else turning
    return by_quantity(unit == SLIDING.position for unit in bounds)


def _largest(figures: Mapping[str, Any]) -> Iterable[tuple[str, str]]:
    """The largest number of the joints with one unit, as numbers of different units do not compare."""
    for name, values in _columns(figures).items():
        if name in _LARGEST and None not in values:
            each = list(zip(values, _units(figures, name), strict=True))
            most = {unit: max(value for value, of in each if of == unit and value is not None) for _, unit in each}
            yield f"largest {_split(name)[0]}", ", ".join(_told(value, unit) for unit, value in most.items())


def _scalars(figures: Mapping[str, Any], whole: Mapping[str, Any], before: str = "") -> Iterable[tuple[str, str]]:
    """Every figure that is one number or text, in words; `whole` has the units."""
    for name, value in figures.items():
        if name in _SKIPPED:
            continue
        if isinstance(value, Mapping):
            tool = {"units": by_quantity([False])}  # of which positions are in m, and angles in rad
            yield from _scalars(value, tool if name == "tool" else whole, f"{before}{name}: ")
        elif isinstance(value, int | float | str | None):
            yield f"{before}{_split(name)[0]}", _scalar(name, value, whole)


def _scalar(name: str, value: float | str | None, whole: Mapping[str, Any]) -> str:
    words = _split(name)[0]
    if value is None or isinstance(value, bool | str):
        return value if isinstance(value, str) else "none" if value is None else "yes" if value else "no"
    if "fraction" in words or words.endswith("lowered by"):
        return _share(value)
    return _told(value, several(_units(whole, name)))


def _split(name: str) -> tuple[str, str]:
    """The words of a figure's name, and the unit at its end; what is words already has names of a file in it."""
    if " " in name:
        return name, ""
    end = next((end for end in _ENDS if name.endswith(f"_{end}")), "")
    words = name.removesuffix(f"_{end}") if end else name
    return re.sub(r"\brms\b", "RMS", words.replace("_", " ")), end


def _told(value: float | None, unit: str) -> str:
    return "none" if value is None else measured(value, unit)


def _share(value: float | None) -> str:
    return "none" if value is None else percent(value, 2)
