"""Tables of a report: HTML of the figures in summary.json, with the units that their names and joints say."""

import html
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from nbs_pin.base.units import TURNING, measured

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
_PLAIN = {"s": "s", "us": "µs", "ms": "ms", "m": "m", "rad2": "rad²", "Nm_per_s": "N·m/s", "per_s": "1/s", "MB": "MB"}
_ENDS = sorted([*_UNITS, *_PLAIN], key=len, reverse=True)
_SKIPPED = ("joints", "units", "curves", "certificate", "monitor", "attack", "by_speed", "by_distance")


def joints_table(figures: Mapping[str, Any]) -> str:
    """A row per joint, a column per figure that has a number for each; empty if there are none."""
    joints, units = figures.get("joints"), figures.get("units")
    if not isinstance(joints, list) or not isinstance(units, Mapping):
        return ""
    columns = {
        name: values
        for name, values in figures.items()
        if isinstance(values, list) and len(values) == len(joints) and name != "joints" and _all_numbers(values)
    }
    heads, rows = [], [[name] for name in joints]
    for name, values in columns.items():
        words, quantity = _split(name)
        of = units.get(_UNITS.get(quantity, ""), [_PLAIN.get(quantity, "")] * len(joints))
        heads.append(words)
        for row, value, unit in zip(rows, values, of, strict=True):
            row.append(_share(value) if "fraction" in words else _told(value, unit))
    return table(["joint", *heads], rows) if columns else ""


def numbers_table(several: Mapping[str, Mapping[str, Any]]) -> str:
    """A row per figure of the whole arm, a column per result; what is the same everywhere is left out of several."""
    flat = {label: dict(_scalars(figures)) for label, figures in several.items()}
    names = list(dict.fromkeys(name for numbers in flat.values() for name in numbers))
    rows = [[_split(name)[0], *(_scalar(name, numbers.get(name)) for numbers in flat.values())] for name in names]
    return table(["figure", *flat], rows) if rows else ""


def certificate_tables(figures: Mapping[str, Any]) -> str:
    """The bounds of a certificate, what it assumes, the conditions, and every other claim, folded."""
    found = figures["certificate"]
    attack = figures["attack"] or {}
    worst = attack.get("joint_errors_rad") or [None] * len(found["joints"])
    each = zip(found["joints"], found["joint_errors_rad"], found["units"], worst, strict=True)
    bounds = [[name, _told(bound, of), "" if seen is None else _told(seen, of)] for name, bound, of, seen in each]
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
            table(["joint", "its error stays below", "the worst motion found reaches"], bounds),
            folded("what it assumes", table(["assumption", "checked"], assumed)),
            folded("conditions", table(["condition", "", "known", "because"], conditions)),
            folded("every number behind it", table(["quantity", "value", "known", "because"], claims)),
        ]
    )


def bench_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """The rows of a bench."""
    cells = []
    for row in rows:
        figures = ", ".join(f"{name} {value:.4g}" for name, value in row["figures"].items() if value is not None)
        cells.append([f"{row['what']}, {row['how']}", row["arm"], figures])
    return table(["what", "arm", "figures"], cells)


def table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """An HTML table that scrolls sideways on a phone, numbers to the right; all texts are escaped."""
    head = "".join(f"<th>{html.escape(text)}</th>" for text in heads)
    body = "".join(f"<tr>{''.join(map(_cell, row))}</tr>" for row in rows)
    return f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def _cell(text: str) -> str:
    is_number = re.match(r"[-−]?[0-9]|none$|$", text)
    return f"<td{'' if is_number else ' class=text'}>{html.escape(text)}</td>"


def folded(title: str, content: str) -> str:
    """The content under a title that opens it."""
    return f"<details><summary>{html.escape(title)}</summary>{content}</details>"


def _scalars(figures: Mapping[str, Any], before: str = "") -> Iterable[tuple[str, Any]]:
    for name, value in figures.items():
        if isinstance(value, Mapping) and name not in _SKIPPED:
            yield from _scalars(value, f"{before}{name}: ")
        elif isinstance(value, int | float | str | None) and name not in _SKIPPED:
            yield f"{before}{name}", value


def _scalar(name: str, value: Any) -> str:
    words, quantity = _split(name)
    if value is None or isinstance(value, bool | str):
        return value if isinstance(value, str) else "none" if value is None else "yes" if value else "no"
    if "fraction" in words or words.endswith("lowered by"):
        return _share(value)
    of = _UNITS.get(quantity)
    return _told(value, _PLAIN.get(quantity, "") if of is None else getattr(TURNING, of))


def _split(name: str) -> tuple[str, str]:
    """The words of a figure's name, and the unit at its end."""
    end = next((end for end in _ENDS if name.endswith(f"_{end}")), "")
    words = name.removesuffix(f"_{end}") if end else name
    return re.sub(r"\brms\b", "RMS", words.replace("_", " ")), end


def _all_numbers(values: list[Any]) -> bool:
    return all(value is None or (isinstance(value, int | float) and not isinstance(value, bool)) for value in values)


def _told(value: float | None, unit: str) -> str:
    return "none" if value is None else measured(value, unit)


def _share(value: float | None) -> str:
    return "none" if value is None else f"{value:.2%}"
