"""Helpers for code that runs on numpy arrays and on torch tensors and returns the type it was given."""

from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np
from array_api_compat import array_namespace, is_torch_array
from jaxtyping import Float

from nbs_pin.base.checks import MOST_NUMBERS, all_finite, floats, told
from nbs_pin.base.exceptions import ArgumentError, TooLarge

Array: TypeAlias = Any
"""A `numpy.ndarray` or a `torch.Tensor`; shapes are annotated with jaxtyping around it."""

Vectors: TypeAlias = Float[Array, "*batch n"]
"""One number per joint, shape (..., n), with any leading batch axes."""
Matrices: TypeAlias = Float[Array, "*batch n n"]
"""A joint-space matrix, shape (..., n, n)."""
Scalars: TypeAlias = Float[Array, "*batch"]
"""One number per state, shape (...)."""
JointArray: TypeAlias = Float[np.ndarray, " n"]
"""One number per joint, a numpy array of shape (n,)."""

_FLOAT = np.dtype(float)
_LARGE = 1e50
"""Smaller numbers overflow no product of a few of them."""

__all__ = [
    "Array",
    "JointArray",
    "Matrices",
    "Scalars",
    "Vectors",
    "array_namespace",
    "as_vectors",
    "constant_like",
    "finite_result",
    "is_torch_array",
    "matvec",
    "over_rows",
]


def matvec(matrix: Array, vector: Array) -> Array:
    """Product of matrices (..., m, n) with vectors (..., n), shape (..., m)."""
    return (matrix @ vector[..., None])[..., 0]


def as_vectors(nv: int, **vectors: Array) -> tuple[Array, ...]:
    """The given vectors as arrays of one type, broadcast to a common shape (..., nv).

    Lists and numbers become float64 numpy arrays; tensors stay tensors.

    Raises:
        ArgumentError: If one is not made of real numbers (`checks.floats`), numpy and torch are mixed, a tensor is not
            float64, a last axis is not nv, or the batch shapes do not broadcast.
    """
    given = tuple(vectors.values())
    shape = getattr(given[0], "shape", None)
    if type(shape) is tuple and shape and shape[-1] == nv:
        for x in given:
            if type(x) is not np.ndarray or x.dtype is not _FLOAT or x.shape != shape:
                break
        else:
            if x.size <= MOST_NUMBERS:
                return given  # fast path of the common case
    arrays = [x if is_torch_array(x) else floats(name, x) for name, x in vectors.items()]
    if len({is_torch_array(x) for x in arrays}) > 1:
        kinds = ", ".join(f"{k} {type(x).__name__}" for k, x in vectors.items())
        raise ArgumentError(f"numpy and torch were mixed ({kinds}); give numpy arrays only or tensors only.")
    for name, x in zip(vectors, arrays, strict=True):
        if is_torch_array(x) and (x.is_sparse or x.is_meta):
            raise ArgumentError(f"{name} is {told(x)} without dense numbers; give {name}.to_dense().")
        if str(x.dtype) not in ("float64", "torch.float64"):
            raise ArgumentError(f"{name} is {told(x)}, expected float64; give {name}.double().")
        if x.ndim == 0 or x.shape[-1] != nv:
            raise ArgumentError(f"{name} has shape {tuple(x.shape)}, expected (..., {nv}): one number per joint.")
    if len({tuple(x.shape) for x in arrays}) == 1:
        return tuple(arrays)
    try:
        return tuple(array_namespace(*arrays).broadcast_arrays(*arrays))
    except (ValueError, RuntimeError) as error:
        shapes = ", ".join(f"{k} {tuple(x.shape)}" for k, x in zip(vectors, arrays, strict=True))
        raise ArgumentError(f"batch shapes do not broadcast ({shapes}); give equal leading axes.") from error


def finite_result(what: str, result: Array, *arguments: Array) -> Array:
    """The result; raises TooLarge if finite numpy arguments gave one that is not, since they are too large.

    Where an argument itself is not finite, neither need the result be, nor where a model is not finite for numbers of
    usual size. Tensors are not looked at.
    """
    if (
        isinstance(result, np.ndarray | np.float64)
        and not all_finite(np.asarray(result))
        and all(all_finite(x) for x in arguments)
    ):
        largest = max((float(np.abs(x).max()) for x in arguments if x.size), default=0.0)
        if largest < _LARGE:
            return result  # not for its arguments
        raise TooLarge(f"{what} is too large to be computed for numbers up to {largest:.3g}; give smaller ones.")
    return result


def constant_like(x: Array, constant: np.ndarray) -> Array:
    """The numpy constant with the array type, dtype and device of x."""
    if not is_torch_array(x):
        return constant
    return array_namespace(x).asarray(constant, dtype=x.dtype, device=x.device)


def over_rows(function: Callable[..., np.ndarray], *arguments: np.ndarray) -> np.ndarray:
    """The function applied to every row of numpy arrays with equal leading axes, stacked along those axes."""
    batch = arguments[0].shape[:-1]
    rows = [x.reshape(-1, x.shape[-1]) for x in arguments]
    values = [function(*row) for row in zip(*rows, strict=True)]
    shape = values[0].shape if values else function(*(np.zeros(x.shape[-1]) for x in arguments)).shape
    return np.array(values).reshape((*batch, *shape))
