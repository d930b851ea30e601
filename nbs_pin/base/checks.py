"""Checks of arguments that several rooms share; each raises ArgumentError saying what was given and expected."""

import math
from typing import Any, TypeAlias

import numpy as np

from nbs_pin.base.exceptions import ArgumentError

PerJoint: TypeAlias = Any
"""A number, or one number per joint."""


def floats(name: str, value: Any) -> np.ndarray:
    """The numbers as a float array; raises ArgumentError when they are no numbers or rows of unequal length."""
    try:
        return np.asarray(value, dtype=float)
    except (TypeError, ValueError) as error:
        raise ArgumentError(f"{name} is {value!s:.200}, expected numbers in equal rows; correct it.") from error


def per_joint(record: Any, *names: str) -> None:
    """Turn the named fields of a frozen record into float arrays of shape () or (n,), finite, n the same for all."""
    kind = type(record).__name__
    for name in names:
        value = getattr(record, name)
        array = floats(f"{kind}'s {name}", value)
        if array.ndim > 1 or array.size == 0 or not np.isfinite(array).all():
            raise ArgumentError(f"{kind}'s {name} is {value}, expected one finite number or one per joint; correct it.")
        object.__setattr__(record, name, array)
    sizes = {name: getattr(record, name).size for name in names}
    if len(set(sizes.values()) - {1}) > 1:
        stated = ", ".join(f"{name} {size}" for name, size in sizes.items())
        raise ArgumentError(f"{kind} was given {stated} numbers; give equally many, or one for all.")


def positive(name: str, value: float, unit: str) -> None:
    """Check 0 < value < inf."""
    if not 0.0 < value < math.inf:
        raise ArgumentError(f"{name} is {value} {unit}, expected a finite number > 0; correct it.")


def whole(total: float, part: float, total_name: str, part_name: str) -> int:
    """How many parts make the total [both s], a whole number ≥ 1 to nine digits."""
    positive(total_name, total, "s")
    positive(part_name, part, "s")
    ratio = total / part
    if round(ratio) < 1 or not math.isclose(ratio, round(ratio), rel_tol=1e-9):
        raise ArgumentError(
            f"{total_name} {total:g} s is {ratio:.6g} times the {part_name} {part:g} s, expected a whole number; "
            f"take for instance {max(1, round(ratio)) * part:.12g} s for the {total_name}."
        )
    return round(ratio)


def all_finite(x: np.ndarray) -> bool:
    """Whether all numbers are finite; a sum of squares tells it five times as fast, unless it overflows."""
    return math.isfinite(np.vdot(x, x)) or bool(np.isfinite(x).all())
