"""Least squares over physically consistent bodies: a convex problem, solved by a damped Newton method.

Unknown are pseudo-inertias Xᵢ ≻ 0, scalars yₖ > 0 (friction, rotor inertia) and scalars zₗ of any sign (offsets), each
in units of its expected size:

    minimise  ½‖A x − b‖² + γ Σᵢ (tr Xᵢ − log det Xᵢ) + γ Σₖ (yₖ − log yₖ) + ½γ Σₗ zₗ²

where x holds the coordinates of all Xᵢ and all yₖ and zₗ. The γ terms are smallest at Xᵢ = 1, yₖ = 1, zₗ = 0 and
infinite at the boundary of the consistent bodies. With A and b in units of the noise they are a prior worth about γ
measurements: it hardly changes what the data determine well, keeps the rest near its expected value, and stays about
one standard error off an active bound. One γ therefore serves clean and noisy data. Source: Lee, Wensing and Park,
"Geometric robot dynamic identification: a convex programming approach", T-RO 2020, whose entropic divergence this is.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from nbs_pin.dynamics.pseudo_inertia import BASIS, coordinates, symmetric

_NEAR = 0.1
"""Newton decrement that ends a stage: the error after the step is about a hundredth of a standard error."""
_DAMPED = 0.25
"""Newton decrement above which steps are damped, as a full step need not decrease the objective."""
_STAGE = 10.0
"""Factor by which γ falls from one stage of the path to the next."""
_STEPS = 100
"""Most Newton steps of a stage; a few suffice for a self-concordant function."""


@dataclass(frozen=True, eq=False)
class ConsistentFit:
    """The minimiser, in units of the expected values."""

    factors: Float[np.ndarray, "bodies 4 4"]
    """Lower triangular L with X = LLᵀ, which keeps X positive definite under rounding."""
    scalars: Float[np.ndarray, " scalars"]
    """yₖ > 0 and zₗ."""
    steps: int
    """Newton steps taken."""
    decrement: float
    """The last Newton decrement: distance to the minimum in the norm of the Hessian over γ."""

    @property
    def converged(self) -> bool:
        """Whether the last step led to the minimum."""
        return self.decrement < _NEAR


def consistent_fit(
    design: Float[np.ndarray, "rows unknowns"],
    target: Float[np.ndarray, " rows"],
    bodies: int,
    strength: float,
    signed: Bool[np.ndarray, " scalars"] | None = None,
) -> ConsistentFit:
    """The minimiser of the objective above, followed from a γ at which the prior dominates down to γ = `strength`.

    Args:
        design: A in units of the noise; first 10·bodies columns for coordinates of the Xᵢ, then those for scalars.
        target: b in units of the noise.
        bodies: Number of bodies.
        strength: γ > 0.
        signed: Which scalars may be negative; None is none.
    """
    count = design.shape[1] - 10 * bodies
    signed = np.zeros(count, dtype=bool) if signed is None else signed
    factors, scalars = np.tile(np.eye(4), (bodies, 1, 1)), np.where(signed, 0.0, 1.0)
    gamma, steps = max(strength, float(np.square(design @ _unknowns(factors, scalars)).sum())), 0
    while True:
        for _ in range(_STEPS):
            step, decrement = _newton(design, target, factors, scalars, signed, gamma)
            steps += 1
            size = 1.0 if decrement < _DAMPED else 1.0 / (1.0 + decrement)
            factors, scalars = _moved(factors, scalars, signed, size * step)
            if decrement < _NEAR:
                break
        if gamma <= strength:
            return ConsistentFit(factors, scalars, steps, decrement)
        gamma = max(strength, gamma / _STAGE)


def _unknowns(factors: np.ndarray, scalars: np.ndarray) -> np.ndarray:
    """x: coordinates of the LLᵀ, then the scalars."""
    return np.concatenate([coordinates(factors @ factors.swapaxes(1, 2)).ravel(), scalars])


def in_factors(columns: Float[np.ndarray, "rows p"], factors: Float[np.ndarray, "bodies 4 4"]) -> np.ndarray:
    """Columns for the coordinates of Xᵢ = LᵢSᵢLᵢᵀ, rewritten for those of Sᵢ."""
    maps = coordinates(np.einsum("nij,kjl,nml->nkim", factors, BASIS, factors))  # (bodies, coordinate of S, of X)
    blocks = columns.reshape(len(columns), len(factors), 10)
    return np.einsum("rnk,nsk->rns", blocks, maps).reshape(columns.shape)


def _newton(
    design: np.ndarray, target: np.ndarray, factors: np.ndarray, scalars: np.ndarray, signed: np.ndarray, gamma: float
) -> tuple[np.ndarray, float]:
    """The Newton step s and its decrement, for X = L(1 + S)Lᵀ, y(1 + s) and z + s, where the prior has Hessian γ."""
    split = 10 * len(factors)
    local = np.hstack([in_factors(design[:, :split], factors), design[:, split:] * np.where(signed, 1.0, scalars)])
    slope = np.concatenate(
        [coordinates(factors.swapaxes(1, 2) @ factors - np.eye(4)).ravel(), np.where(signed, scalars, scalars - 1.0)]
    )
    residual = design @ _unknowns(factors, scalars) - target
    root = np.sqrt(gamma)
    orthogonal, triangle = np.linalg.qr(np.vstack([local, root * np.eye(len(slope))]))
    step = np.linalg.solve(triangle, -orthogonal.T @ np.concatenate([residual, root * slope]))
    return step, float(np.sqrt(step @ step + np.square(local @ step).sum() / gamma))


def _moved(
    factors: np.ndarray, scalars: np.ndarray, signed: np.ndarray, step: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The factors of L(1 + S)Lᵀ, and y(1 + s) or z + s."""
    split = 10 * len(factors)
    grown = np.linalg.cholesky(np.eye(4) + symmetric(step[:split].reshape(-1, 10)))
    return factors @ grown, scalars + step[split:] * np.where(signed, 1.0, scalars)
