"""Vectors (3,) and matrices (3, 3), row by row, within flat arrays."""

from typing import TypeAlias

from nbs_pin.kernels.jit import inlined
from nbs_pin.kernels.records import Vec

Three: TypeAlias = tuple[float, float, float]


@inlined
def get(x: Vec, at: int) -> Three:
    """The vector that begins there."""
    return x[at], x[at + 1], x[at + 2]


@inlined
def put(x: Vec, at: int, y: Three) -> None:
    """Write a vector there."""
    x[at], x[at + 1], x[at + 2] = y


@inlined
def add(x: Vec, at: int, y: Three) -> None:
    """Add a vector to the one there."""
    for k in range(3):
        x[at + k] += y[k]


@inlined
def times(x: Vec, at: int, y: Three) -> Three:
    """The matrix that begins there, times y."""
    return dot(get(x, at), y), dot(get(x, at + 3), y), dot(get(x, at + 6), y)


@inlined
def transposed_times(x: Vec, at: int, y: Three) -> Three:
    """The transpose of the matrix that begins there, times y."""
    a, b, c = get(x, at), get(x, at + 3), get(x, at + 6)
    return dot((a[0], b[0], c[0]), y), dot((a[1], b[1], c[1]), y), dot((a[2], b[2], c[2]), y)


@inlined
def plus(x: Three, y: Three) -> Three:
    """The sum."""
    return x[0] + y[0], x[1] + y[1], x[2] + y[2]


@inlined
def cross(x: Three, y: Three) -> Three:
    """The vector product."""
    return x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0]


@inlined
def dot(x: Three, y: Three) -> float:
    """The scalar product."""
    return x[0] * y[0] + x[1] * y[1] + x[2] * y[2]


@inlined
def scaled(a: float, x: Three) -> Three:
    """The multiple."""
    return a * x[0], a * x[1], a * x[2]
