"""Least squares over bodies that exist: a convex problem, solved by damped Newton steps.

Unknown are pseudo-inertias Xᵢ ≻ 0 and scalars yₖ > 0 (friction, rotor inertia), each in units of what is expected:

    minimise  ½‖A x − b‖² + γ Σᵢ (tr Xᵢ − log det Xᵢ) + γ Σₖ (yₖ − log yₖ)

where x holds the coordinates of all Xᵢ and all yₖ. The γ terms are smallest at Xᵢ = 1, yₖ = 1 and infinite where a body
stops being one. With A and b in units of the noise they are a prior about as strong as γ measurements: what the data
say well they leave alone, what the data do not say stays as expected, and a bound that the data touch is missed by one
standard error. So one γ serves clean and noisy data alike. Source: Lee, Wensing and Park, "Geometric robot dynamic
identification: a convex programming approach", T-RO 2020, whose entropic divergence this is.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from nbs_pin.dynamics.pseudo_inertia import BASIS, coordinates, symmetric

_NEAR = 0.1
"""Newton decrement below which a step leaves an error of a hundredth of a standard error."""
_DAMPED = 0.25
"""Newton decrement above which a full step may leave the region where it is known to help."""
_STAGE = 10.0
"""γ falls by this factor from one stage of the path to the next."""
_STEPS = 100
"""Most Newton steps of a stage; the theory of self-concordant functions promises a handful."""


@dataclass(frozen=True, eq=False)
class ConsistentFit:
    """The minimiser, in the units of the prior."""

    factors: Float[np.ndarray, "bodies 4 4"]
    """Lower triangular L with X = LLᵀ: positive definite whatever rounding does."""
    scalars: Float[np.ndarray, " scalars"]
    """yₖ > 0."""
    steps: int
    """Newton steps taken."""
    decrement: float
    """The last Newton decrement: distance to the minimum, in the units of its curvature over γ."""


def consistent_fit(
    design: Float[np.ndarray, "rows unknowns"], target: Float[np.ndarray, " rows"], bodies: int, strength: float
) -> ConsistentFit:
    """The minimiser of ½‖A x − b‖² + γ (divergence from the prior), see above.

    design, target: A and b in units of the noise; the first 10·bodies columns belong to the coordinates of the Xᵢ, the
    others to the yₖ. strength: γ > 0. The path begins where the prior rules and follows the minimum as γ falls.
    """
    factors, scalars = np.tile(np.eye(4), (bodies, 1, 1)), np.ones(design.shape[1] - 10 * bodies)
    gamma, steps = max(strength, float(np.square(design @ _unknowns(factors, scalars)).sum())), 0
    while True:
        for _ in range(_STEPS):
            step, decrement = _newton(design, target, factors, scalars, gamma)
            steps += 1
            size = 1.0 if decrement < _DAMPED else 1.0 / (1.0 + decrement)
            factors, scalars = _moved(factors, scalars, size * step)
            if decrement < _NEAR:
                break
        if gamma <= strength:
            return ConsistentFit(factors, scalars, steps, decrement)
        gamma = max(strength, gamma / _STAGE)


def _unknowns(factors: np.ndarray, scalars: np.ndarray) -> np.ndarray:
    """X: coordinates of the LLᵀ, then the scalars."""
    return np.concatenate([coordinates(factors @ factors.swapaxes(1, 2)).ravel(), scalars])


def in_factors(columns: Float[np.ndarray, "rows p"], factors: Float[np.ndarray, "bodies 4 4"]) -> np.ndarray:
    """Columns for coordinates of Xᵢ = LᵢSᵢLᵢᵀ, in those of Sᵢ."""
    maps = coordinates(np.einsum("nij,kjl,nml->nkim", factors, BASIS, factors))  # (bodies, coordinate of S, of X)
    blocks = columns.reshape(len(columns), len(factors), 10)
    return np.einsum("rnk,nsk->rns", blocks, maps).reshape(columns.shape)


def _newton(
    design: np.ndarray, target: np.ndarray, factors: np.ndarray, scalars: np.ndarray, gamma: float
) -> tuple[np.ndarray, float]:
    """The Newton step s and its decrement, for X = L(1 + S)Lᵀ and y(1 + s): there the divergence has Hessian 1."""
    split = 10 * len(factors)
    local = np.hstack([in_factors(design[:, :split], factors), design[:, split:] * scalars])
    slope = np.concatenate([coordinates(factors.swapaxes(1, 2) @ factors - np.eye(4)).ravel(), scalars - 1.0])
    residual = design @ _unknowns(factors, scalars) - target
    root = np.sqrt(gamma)
    orthogonal, triangle = np.linalg.qr(np.vstack([local, root * np.eye(len(slope))]))
    step = np.linalg.solve(triangle, -orthogonal.T @ np.concatenate([residual, root * slope]))
    return step, float(np.sqrt(step @ step + np.square(local @ step).sum() / gamma))


def _moved(factors: np.ndarray, scalars: np.ndarray, step: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The factors of L(1 + S)Lᵀ and y(1 + s)."""
    split = 10 * len(factors)
    grown = np.linalg.cholesky(np.eye(4) + symmetric(step[:split].reshape(-1, 10)))
    return factors @ grown, scalars * (1.0 + step[split:])
