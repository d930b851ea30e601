"""Spectra and sums moved to the safe side by more than floating point can err (docs/certificates.md)."""

import numpy as np
from jaxtyping import Float

from nbs_pin.base.arrays import Matrices, Scalars

SLACK = 1e-9
"""Relative allowance for the rounding of everything that leads to a bound: about 1e6 times what such sums lose."""


def spectrum_slack(matrix: Matrices) -> Scalars:
    """8 n ε ‖A‖_F: more than the symmetric eigenvalue solver's error, by Weyl's inequality."""
    n = matrix.shape[-1]
    return np.asarray(8.0 * n * np.finfo(float).eps * np.linalg.norm(matrix, axis=(-2, -1)))


def least_eigenvalues(matrices: Matrices) -> Scalars:
    """At most λ_min of each symmetric matrix."""
    return np.asarray(np.linalg.eigvalsh(matrices)[..., 0] - spectrum_slack(matrices))


def largest_eigenvalues(matrices: Matrices) -> Scalars:
    """At least λ_max of each symmetric matrix."""
    return np.asarray(np.linalg.eigvalsh(matrices)[..., -1] + spectrum_slack(matrices))


def least_eigenvalue(matrix: Float[np.ndarray, "n n"]) -> float:
    """At most λ_min of a symmetric matrix, and > 0 for positive definite ones with grams beside tonnes.

    The better of A itself and of A = EBE with diag(B) = 1: λ_min(A) ≥ λ_min(B) min A_ii for B ≻ 0.
    """
    direct, diagonal = float(least_eigenvalues(matrix)), np.diag(matrix)
    if not (diagonal > 0.0).all():
        return direct
    root = np.sqrt(diagonal)
    inner = float(least_eigenvalues(matrix / root / root[:, None]))
    return max(direct, inner * float(diagonal.min()) * (1.0 - 1e-12)) if inner > 0.0 else direct


def largest_eigenvalue(matrix: Float[np.ndarray, "n n"]) -> float:
    """At least λ_max of a symmetric matrix."""
    return float(largest_eigenvalues(matrix))


def up(value: float) -> float:
    """A bound from above, moved up by the allowance."""
    return float(value) + SLACK * abs(float(value))


def down(value: float) -> float:
    """A bound from below, moved down by the allowance."""
    return float(value) - SLACK * abs(float(value))
