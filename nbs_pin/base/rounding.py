"""Eigenvalue and sum bounds with a margin for floating-point errors (docs/certificates.md)."""

import numpy as np
from jaxtyping import Float

from nbs_pin.base.arrays import Matrices, Scalars

SLACK = 1e-9
"""Relative allowance for all rounding errors in a bound, about 1e6 times those of such sums."""


def spectrum_slack(matrix: Matrices) -> Scalars:
    """8 n ε ‖A‖_F, which by Weyl's inequality bounds the error of the symmetric eigenvalue solver."""
    n = matrix.shape[-1]
    return np.asarray(8.0 * n * np.finfo(float).eps * np.linalg.norm(matrix, axis=(-2, -1)))


def least_eigenvalues(matrices: Matrices) -> Scalars:
    """A lower bound on λ_min of each symmetric matrix."""
    return np.asarray(np.linalg.eigvalsh(matrices)[..., 0] - spectrum_slack(matrices))


def largest_eigenvalues(matrices: Matrices) -> Scalars:
    """An upper bound on λ_max of each symmetric matrix."""
    return np.asarray(np.linalg.eigvalsh(matrices)[..., -1] + spectrum_slack(matrices))


def least_eigenvalue(matrix: Float[np.ndarray, "n n"]) -> float:
    """A lower bound on λ_min of a symmetric matrix, > 0 also for A ≻ 0 with entries of very different magnitude.

    The larger of two bounds: of A itself, and with A = EBE, diag(B) = 1: λ_min(A) ≥ λ_min(B) min A_ii for B ≻ 0.
    """
    direct, diagonal = float(least_eigenvalues(matrix)), np.diag(matrix)
    if not (diagonal > 0.0).all():
        return direct
    root = np.sqrt(diagonal)
    inner = float(least_eigenvalues(matrix / root / root[:, None]))
    return max(direct, inner * float(diagonal.min()) * (1.0 - 1e-12)) if inner > 0.0 else direct


def diagonal_below(matrix: Float[np.ndarray, "n n"]) -> Float[np.ndarray, " n"]:
    """The diagonal of a diagonal matrix ⪯ W for W ≻ 0: its own if W is diagonal, else times λ_min of W scaled to 1."""
    diagonal = np.diag(matrix)
    if np.array_equal(matrix, np.diag(diagonal)):
        return np.asarray(diagonal)
    root = np.sqrt(diagonal)
    return np.asarray(diagonal * least_eigenvalue(matrix / root / root[:, None]))


def largest_eigenvalue(matrix: Float[np.ndarray, "n n"]) -> float:
    """An upper bound on λ_max of a symmetric matrix."""
    return float(largest_eigenvalues(matrix))


def exceeds_every_perturbation(matrix: Float[np.ndarray, "n n"], radius: float) -> bool:
    """Whether A + E ≻ 0 for every symmetric E with ‖E‖₂ ≤ `radius`, verified by one Cholesky factorisation.

    If the factorisation of A − cI in floating point is completed, A − cI ≻ −α tr(A) I with α = γ_{n+1}/(1 − γ_{n+1}),
    γ_k = ku/(1 − ku), u = ε/2, whatever the order of its sums. So c ≥ radius + α tr(A), with the rounding of the shift
    and an allowance for underflow, proves it. Only the lower triangle of A counts.
    Source: Rump 2006, "Verification of positive definiteness", BIT Numerical Mathematics 46.
    """
    n, unit, diagonal = len(matrix), 0.5 * np.finfo(float).eps, np.diag(matrix)
    if not (np.isfinite(matrix).all() and (diagonal > 0.0).all() and 0.0 <= radius < np.inf):
        return False
    gamma = (n + 1) * unit / (1.0 - (n + 1) * unit)
    rounded = gamma / (1.0 - gamma) * float(diagonal.sum()) + 4.0 * unit * float(diagonal.max())
    shift = (radius + 1.01 * rounded) * (1.0 + 8.0 * unit) + 1e-280
    try:
        np.linalg.cholesky(matrix - shift * np.eye(n))
    except np.linalg.LinAlgError:
        return False
    return True


def up(value: float) -> float:
    """An upper bound, increased by the relative allowance `SLACK`."""
    return float(value) + SLACK * abs(float(value))


def down(value: float) -> float:
    """A lower bound, decreased by the relative allowance `SLACK`."""
    return float(value) - SLACK * abs(float(value))
