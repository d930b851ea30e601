"""Argument checks for the whole package; each raises ArgumentError stating what was given and what was expected."""

import math
from typing import Any, TypeAlias

import numpy as np

from nbs_pin.base.exceptions import ArgumentError

PerJoint: TypeAlias = Any
"""A number, or one number per joint."""


def floats(name: str, value: Any) -> np.ndarray:
    """The value as a float array; raises ArgumentError if it is not numeric or its rows differ in length."""
    try:
        return np.asarray(value, dtype=float)
    except (TypeError, ValueError) as error:
        raise ArgumentError(
            f"{name} is {value!s:.200}, expected numbers in rows of equal length; correct it."
        ) from error


def per_joint(record: Any, *names: str) -> None:
    """Convert the named fields of a frozen record to finite float arrays of shape () or (n,), with one n for all."""
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
        raise ArgumentError(f"{kind} was given {stated} numbers; give single numbers or lists of equal length.")


def positive(name: str, value: float, unit: str) -> None:
    """Raise ArgumentError unless 0 < value < inf."""
    if not 0.0 < value < math.inf:
        raise ArgumentError(f"{name} is {value} {unit}, expected a finite number > 0; correct it.")


def whole(total: float, part: float, total_name: str, part_name: str) -> int:
    """The number total / part of two times [s]; raises ArgumentError unless it is ≥ 1 and whole to nine digits."""
    positive(total_name, total, "s")
    positive(part_name, part, "s")
    ratio = total / part
    if round(ratio) < 1 or not math.isclose(ratio, round(ratio), rel_tol=1e-9):
        raise ArgumentError(
            f"{total_name} {total:.12g} s is {ratio:.12g} times the {part_name} {part:g} s, expected a whole number; "
            f"take for instance {max(1, round(ratio)) * part:.12g} s for the {total_name}."
        )
    return round(ratio)


def all_finite(x: np.ndarray) -> bool:
    """Whether all numbers are finite; the sum of squares is a five times faster test, unless it overflows."""
    return math.isfinite(np.vdot(x, x)) or bool(np.isfinite(x).all())
