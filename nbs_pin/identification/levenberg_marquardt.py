"""Levenberg–Marquardt least squares for points on a manifold, which a function moves by a step."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float

T = TypeVar("T")
_FLOOR = 0.1
_WEAKEST, _STRONGEST = 1e-14, 1e8


class Normal(NamedTuple):
    """A mean of squared residuals f at one point, and its normal equations: f(δ) ≈ f − 2 gᵀδ + δᵀHδ."""

    cost: float
    gradient: Float[np.ndarray, " parameters"]
    hessian: Float[np.ndarray, "parameters parameters"]


@dataclass(frozen=True, eq=False)
class Descent(Generic[T]):
    """End point and record of a descent."""

    at: T
    cost: float
    history: list[float]
    """Cost at the start and after every step."""


def levenberg_marquardt(
    start: T,
    normal: Callable[[T], Normal],
    cost: Callable[[T], float],
    moved: Callable[[T, np.ndarray], T],
    *,
    iterations: int = 100,
    tolerance: float = 1e-28,
    patience: int = 10,
    stall: float = 0.01,
) -> Descent[T]:
    """Descend from `start`; a point x may be of any type on which `moved(x, δ)` takes a step.

    (H + λD) δ = g with D = diag H + 0.1 max(diag H): Marquardt's scaling, bounded below so that directions which the
    data hardly determine do not move. With diag H alone they drift to where two of them are unobservable together, and
    convergence stops. λ follows the ratio of actual to predicted decrease (Nielsen 1999).

    Ends at a cost of `tolerance`, after `iterations` steps, if the cost fell by less than the share `stall` in
    `patience` steps, or if no step decreases it.
    """
    x, at, damping, growth = start, normal(start), 1e-2, 2.0
    history = [at.cost]
    while at.cost > tolerance and len(history) <= iterations and at.gradient.any():
        scale = np.diag(at.hessian) + _FLOOR * np.diag(at.hessian).max()
        step = np.linalg.solve(at.hessian + damping * np.diag(scale), at.gradient)
        there = moved(x, step)
        gain = at.cost - cost(there)
        predicted = step @ (2.0 * at.gradient - at.hessian @ step)
        if not gain > 0.0 < predicted:  # NaN counts as no decrease
            damping, growth = damping * growth, 2.0 * growth
            if damping > _STRONGEST:
                break
            continue
        damping = max(damping * max(0.2, 1.0 - (2.0 * gain / predicted - 1.0) ** 3), _WEAKEST)
        x, at, growth = there, normal(there), 2.0
        history.append(at.cost)
        if len(history) > patience and history[-1] > (1.0 - stall) * history[-1 - patience]:
            break
    return Descent(x, at.cost, history)
