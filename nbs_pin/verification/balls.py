"""Ball arithmetic on arrays of FLINT's arb numbers: a comparison is true only if it is certain."""

from typing import Any, TypeAlias

import numpy as np

from nbs_pin.base.exceptions import MissingExtra

try:
    from flint import arb, arb_mat, ctx
except ModuleNotFoundError as error:
    raise MissingExtra("verify needs ball arithmetic: pip install 'nbs-pin[verify]'.") from error

__all__ = ["Balls", "arb", "balls", "certain", "ctx", "inverse", "positive_definite", "skew"]
Balls: TypeAlias = Any
"""An array of arb numbers, of dtype object."""


def balls(numbers: Any) -> Balls:
    """Numbers, or texts of decimal numbers, as balls that contain them exactly."""
    return np.vectorize(arb, otypes=[object])(np.array(numbers, dtype=object))


def certain(*true: Any) -> bool:
    """Whether all comparisons of scalars or arrays are true."""
    return all(bool(x) for each in true for x in np.ravel(each))


def positive_definite(matrix: Balls) -> bool:
    """Whether a symmetric matrix is certainly positive definite: all pivots of its LDLᵀ factorisation are."""
    rest = matrix.copy()
    for k in range(len(rest)):
        if not rest[k, k] > 0:
            return False
        rest[k + 1 :, k + 1 :] -= np.outer(rest[k + 1 :, k] / rest[k, k], rest[k, k + 1 :])
    return True


def inverse(matrix: Balls) -> Balls:
    """The inverse; raises ZeroDivisionError for a matrix that may be singular."""
    return balls(arb_mat(matrix.tolist()).inv().tolist())


def skew(v: Balls) -> Balls:
    """[v]×, with [v]× w = v × w."""
    x, y, z = v
    return balls([[0, -z, y], [z, 0, -x], [-y, x, 0]])
