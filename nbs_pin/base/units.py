"""Units of joints: rad and N·m where a joint turns, m and N where it slides; all that shows numbers asks here."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple


class JointUnits(NamedTuple):
    """The units of what belongs to one joint."""

    position: str
    velocity: str
    acceleration: str
    torque: str
    stiffness: str
    damping: str
    rate: str
    curvature: str
    inertia: str


TURNING = JointUnits("rad", "rad/s", "rad/s²", "N·m", "N·m/rad", "N·m·s/rad", "rad/s per N·m", "J/rad²", "kg·m²")
SLIDING = JointUnits("m", "m/s", "m/s²", "N", "N/m", "N·s/m", "m/s per N", "J/m²", "kg")


def units_of(prismatic: Iterable[Any]) -> tuple[JointUnits, ...]:
    """The units of every joint, of which `prismatic` says (True, False) whether it slides."""
    return tuple(SLIDING if slides else TURNING for slides in prismatic)


def units(quantity: str, prismatic: Iterable[Any]) -> tuple[str, ...]:
    """The unit of a quantity (a field of `JointUnits`) for every joint."""
    return tuple(getattr(of, quantity) for of in units_of(prismatic))


def several(given: Iterable[str]) -> str:
    """The units of numbers that are taken together, such as a norm over all joints: each once, as in "rad, m"."""
    return ", ".join(sorted(dict.fromkeys(given), key=lambda unit: unit in SLIDING))


def by_quantity(prismatic: Iterable[Any]) -> dict[str, list[str]]:
    """The unit of every joint, by quantity, as JSON can store it."""
    return {
        name: list(given)
        for name, given in zip(JointUnits._fields, zip(*units_of(prismatic), strict=True), strict=True)
    }


def over_joints(unit: str, prismatic: Iterable[Any]) -> str:
    """The unit of a number over all joints, such as a norm or a maximum: `unit` if all of them turn."""
    if unit not in TURNING:
        return unit
    return several(of[TURNING.index(unit)] for of in units_of(prismatic))


def measured(value: float, unit: str) -> str:
    """A number with its unit and what one pictures of an angle or a length: "0.0209 rad (1.2°)", "0.002 m (2 mm)"."""
    text = f"{value:.3g} {unit}".rstrip()
    if not math.isfinite(value) or unit not in (TURNING.position, SLIDING.position):
        return text
    pictured, sign = (math.degrees(value), "°") if unit == TURNING.position else (1e3 * value, " mm")
    return f"{text} ({pictured:.{3 if abs(pictured) < 100.0 else 4}g}{sign})"


def percent(share: float, digits: int = 0) -> str:
    """A share in percent, as in "63 %"."""
    return f"{share:.{digits}%}".replace("%", " %")


def counted(count: int, noun: str, plural: str = "") -> str:
    """A number of things in words: "1 start", "2 starts"; plural: of a noun that takes more than an s."""
    return f"{count} {noun if count == 1 else plural or f'{noun}s'}"


def weighed(factors: Mapping[str, str], constant: str = "0", unit: str = "") -> str:
    """A sum of numbers times symbols and a constant: "2 a + b + 3 N" for {"a": "2", "b": "1", "c": "0"}, "3", "N"."""
    terms = [of if factor == "1" else f"{factor} {of}" for of, factor in factors.items() if factor != "0"]
    return " + ".join([*terms, *([f"{constant} {unit}".rstrip()] if constant != "0" or not terms else [])])


def with_units(texts: Sequence[str], given: Sequence[str]) -> list[str]:
    """Numbers with the units of their joints, left out if all are alike; "none" has no unit."""
    if len(set(given)) == 1:
        return list(texts)
    return [text if text == "none" else f"{text} {unit}" for text, unit in zip(texts, given, strict=True)]


def column(name: str, texts: Sequence[str], given: Sequence[str]) -> tuple[str, list[str]]:
    """Heading and cells of a table with a row per joint: the unit is in the heading, or in the cells if they differ."""
    if len(set(given)) == 1:
        return f"{name}\n[{given[0]}]", list(texts)
    return name, with_units(texts, given)
