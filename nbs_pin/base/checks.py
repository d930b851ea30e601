"""Checks of numbers and arrays for the whole package; each raises ArgumentError stating what was given and expected."""

import math
import operator
from numbers import Integral, Real
from typing import Any, TypeAlias

import numpy as np

from nbs_pin.base.exceptions import ArgumentError

PerJoint: TypeAlias = Any
"""A number, or one number per joint."""
LARGEST = 1e100
"""Largest magnitude of a number that is not infinite: products of three of them do not overflow."""
SMALLEST = 1e-100
"""Smallest number that counts as positive: its inverse does not overflow."""
MOST_NUMBERS = 2**28
"""Largest number of entries of an array given as an argument (2 GiB)."""
_SHORT = 8
_FEW = 4096  # BLAS sums longer arrays with threads, which spin on every core for a while afterwards


def told(value: Any) -> str:
    """The value as a noun phrase of an error message, short and without running code of its class."""
    if isinstance(value, np.ma.MaskedArray):
        return "a masked array"
    if isinstance(value, np.ndarray):
        if value.size <= _SHORT and value.dtype.kind in "biufc" and type(value) is np.ndarray:
            return str(value.tolist())
        kind = "a matrix" if isinstance(value, np.matrix) else "an array"
        return f"{kind} of {value.dtype} and shape {value.shape}"
    if value is None or type(value) in (bool, int, float, complex, str, bytes) or isinstance(value, np.generic):
        return _clipped(value)
    if type(value) in (list, tuple) and len(value) <= _SHORT and all(_is_plain(x) for x in value):
        return _clipped(value)
    if type(value) in (list, tuple, dict, set):
        return f"a {type(value).__name__} of {len(value)}"
    if isinstance(value, type):
        return f"the class {value.__name__}"
    name = type(value).__name__
    if name == "Tensor" and hasattr(value, "requires_grad"):
        return f"a {value.dtype} tensor{' that requires grad' if value.requires_grad else ''}"
    return f"{'an' if name[:1] in 'AEIOUaeiou' else 'a'} {name}"


def _is_plain(x: Any) -> bool:
    return x is None or type(x) in (bool, int, float, str) or isinstance(x, np.generic)


def _clipped(value: Any) -> str:
    if type(value) is int and value.bit_length() > 64:
        return f"a whole number of {value.bit_length()} bits"
    text = repr(value) if isinstance(value, str | bytes) else str(value)
    return text if len(text) <= 100 else f"{text[:100]}…"


def real(value: Any) -> float | None:
    """The value as a float if it is one real number, else None: no bool, no text, nothing complex, masked or a tensor.

    An array without axes counts as a number. A whole number too large for a float is infinite.
    """
    if type(value) is float:
        return value
    if isinstance(value, np.ndarray) and type(value) is np.ndarray and value.ndim == 0 and value.dtype.kind in "iuf":
        return float(value)
    if isinstance(value, bool | np.bool_) or not isinstance(value, Real):
        return None
    try:
        return float(value)
    except OverflowError:
        return math.inf if abs(value) == value else -math.inf


def integral(value: Any) -> int | None:
    """The value as an int if it is one whole number, such as 3, 3.0 or np.int64(3), else None."""
    if isinstance(value, Integral) and not isinstance(value, bool | np.bool_):
        return operator.index(value)
    number = real(value)
    return int(number) if number is not None and math.isfinite(number) and number == int(number) else None


def floats(name: str, value: Any, *, truths: bool = False) -> np.ndarray:
    """The value as a float array; raises ArgumentError unless all entries are real numbers, in rows of equal length.

    NaN and inf are numbers here. Text, dates, None, bools, complex numbers, masked arrays, tensors that require grad
    and arrays of objects are refused, as are more than `MOST_NUMBERS` numbers. With `truths`, bools count as 0 and 1.
    """
    if type(value) is np.ndarray and value.dtype == float and value.size <= MOST_NUMBERS:
        return value
    array = _as_array(name, value)
    if array.dtype.kind not in ("iufb" if truths else "iuf"):
        kinds = {"c": "complex numbers", "b": "truth values", "U": "text", "S": "bytes", "M": "dates", "m": "durations"}
        entries = kinds.get(array.dtype.kind, "entries that are no numbers")
        raise ArgumentError(f"{name} is {told(value)}, with {entries}; give real numbers.")
    return array.astype(float, copy=False)


def _as_array(name: str, value: Any) -> np.ndarray:
    """The value as an array of any kind of entries."""
    expected = "expected numbers in rows of equal length"
    parts = value if type(value) in (list, tuple) else (value,)
    if any(isinstance(part, np.ma.MaskedArray) for part in parts):
        raise ArgumentError(f"{name} is a masked array; give a plain array of the numbers to use.")
    if any(getattr(part, "requires_grad", False) for part in parts):
        raise ArgumentError(f"{name} is {told(value)}, {expected}; give {name.split()[-1]}.detach().numpy().")
    if _size(value) > MOST_NUMBERS:
        raise ArgumentError(f"{name} has {_size(value)} entries, expected at most {MOST_NUMBERS}; give fewer.")
    try:
        return np.asarray(value)
    except Exception as error:  # the class of the value converts it, which may raise anything
        raise ArgumentError(f"{name} is {told(value)}, {expected}; correct it.") from error


def _size(value: Any) -> int:
    if isinstance(value, np.ndarray):
        return int(value.size)
    return len(value) if isinstance(value, list | tuple | range | bytes | bytearray | memoryview) else 0


def vector_of(name: str, value: Any, n: int, unit: str = "") -> np.ndarray:
    """n finite numbers, one per joint, as a float array (n,); raises ArgumentError otherwise."""
    array = floats(name, value)
    if array.shape != (n,) or not is_usual(array):
        raise ArgumentError(f"{name} is {told(value)}, expected {n} finite numbers{_in(unit)}; give one per joint.")
    return array


def is_usual(x: np.ndarray) -> bool:
    """Whether every number is finite and at most `LARGEST` in magnitude; the sum of squares is the faster test."""
    return (x.size <= _FEW and bool(np.vdot(x, x) <= LARGEST**2)) or bool((np.abs(x) <= LARGEST).all())


def per_joint(record: Any, *names: str) -> None:
    """Convert the named fields of a frozen record to finite float arrays of shape () or (n,), with one n for all."""
    kind = type(record).__name__
    for name in names:
        value = getattr(record, name)
        array = floats(f"{kind}'s {name}", value)
        if array.ndim > 1 or array.size == 0 or not is_usual(array):
            raise ArgumentError(
                f"{kind}'s {name} is {told(value)}, expected one finite number or one per joint; correct it."
            )
        object.__setattr__(record, name, array)
    sizes = {name: getattr(record, name).size for name in names}
    if len(set(sizes.values()) - {1}) > 1:
        stated = ", ".join(f"{name} {size}" for name, size in sizes.items())
        raise ArgumentError(f"{kind} was given {stated} numbers; give single numbers or lists of equal length.")


def positive(name: str, value: float, unit: str) -> float:
    """The value as a float; raises ArgumentError unless it is a number from `SMALLEST` to `LARGEST`."""
    number = real(value)
    if number is None or not SMALLEST <= number <= LARGEST:
        raise ArgumentError(f"{name} is {told(value)}, expected a finite number > 0{_in(unit)}; correct it.")
    return number


def whole(total: float, part: float, total_name: str, part_name: str, most: float = math.inf) -> int:
    """The number total / part of two times [s]; raises ArgumentError unless it is ≥ 1 and whole to nine digits.

    More than `most` are refused, as work without end.
    """
    total, part = positive(total_name, total, "s"), positive(part_name, part, "s")
    ratio = total / part
    if ratio > most:
        raise ArgumentError(
            f"{total_name} {total:.12g} s is {ratio:.3g} times the {part_name} {part:g} s, expected at most {most:g};"
            f" make the {total_name} shorter or the {part_name} longer."
        )
    if round(ratio) < 1 or not math.isclose(ratio, round(ratio), rel_tol=1e-9):
        raise ArgumentError(
            f"{total_name} {total:.12g} s is {ratio:.12g} times the {part_name} {part:g} s, expected a whole number; "
            f"take for instance {max(1, round(ratio)) * part:.12g} s for the {total_name}."
        )
    return round(ratio)


def all_finite(x: np.ndarray) -> bool:
    """Whether all numbers are finite; the sum of squares is a five times faster test, unless it overflows."""
    return (x.size <= _FEW and math.isfinite(np.vdot(x, x))) or bool(np.isfinite(x).all())


def _in(unit: str) -> str:
    return f" [{unit}]" if unit else ""
