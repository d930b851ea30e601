"""Maximise b·y subject to A₀ + Σ y_i A_i ⪰ 0: Newton's method with a logarithmic barrier, for a few dozen unknowns."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

STEPS = 25
"""Newton steps for each weight of the barrier, at most."""


@dataclass(frozen=True, eq=False)
class Inequality:
    """A₀ + Σ y_i A_i ≻ 0, |y_i| < reach_i, and y_i > 0 where `positive`."""

    constant: Float[np.ndarray, "m m"]
    terms: Float[np.ndarray, "k m m"]
    positive: Bool[np.ndarray, " k"]
    reach: Float[np.ndarray, " k"]

    def matrix(self, y: Float[np.ndarray, " k"]) -> Float[np.ndarray, "m m"]:
        """A₀ + Σ y_i A_i."""
        return self.constant + np.tensordot(y, self.terms, 1)

    def barrier(self, y: Float[np.ndarray, " k"]) -> float:
        """−log det(A₀ + Σ y_i A_i) − Σ log y_i − Σ log(1 − (y_i/reach_i)²); inf outside."""
        share = y / self.reach
        if (y[self.positive] <= 0.0).any() or (np.abs(share) >= 1.0).any():
            return np.inf
        values = np.linalg.eigvalsh(self.matrix(y))
        if values[0] <= 0.0:
            return np.inf
        return float(-np.log(values).sum() - np.log(y[self.positive]).sum() - np.log1p(-(share**2)).sum())

    def newton(self, y: Float[np.ndarray, " k"], slope: Float[np.ndarray, " k"]) -> tuple[np.ndarray, float]:
        """The step towards the least of −slope·y + barrier, and how much it promises."""
        half = np.linalg.inv(np.linalg.cholesky(self.matrix(y)))
        seen = half @ self.terms @ half.T
        share = y / self.reach
        gradient = -slope - np.trace(seen, axis1=1, axis2=2) + 2.0 * share / (1.0 - share**2) / self.reach
        flat = seen.reshape(len(y), -1)
        hessian = flat @ flat.T
        bend = 2.0 * (1.0 + share**2) / (1.0 - share**2) ** 2 / self.reach**2
        inside = np.where(self.positive, y, np.inf)
        gradient -= 1.0 / inside
        hessian[np.diag_indices(len(y))] += bend + 1.0 / inside**2
        scale = 1.0 / np.sqrt(np.diag(hessian))
        scaled = hessian * scale * scale[:, None] + 1e-11 * np.eye(len(y))
        step = -scale * np.linalg.solve(scaled, gradient * scale)
        return step, float(-gradient @ step)


def maximise(
    inequality: Inequality,
    y: Float[np.ndarray, " k"],
    target: int,
    *,
    gap: float = 1e-4,
    enough: float = np.inf,
) -> Float[np.ndarray, " k"]:
    """From a y that satisfies the inequality to one that does with y[target] near its greatest, or beyond `enough`.

    gap: how far below the greatest the barrier leaves y[target], relative to it; a wider one leaves the matrix more
    positive.
    """
    slope = np.zeros(len(y))
    weight = max(abs(float(y[target])), 1e-6)
    size = len(inequality.constant) + 2.0 * len(y)
    while y[target] <= enough:
        slope[target] = 1.0 / weight
        for _ in range(STEPS):
            step, promise = inequality.newton(y, slope)
            if promise < 1e-2 or y[target] > enough:
                break
            y = _along(inequality, y, step, promise, slope)
        if weight * size < gap * abs(float(y[target])) or weight < 1e-12:
            break
        weight *= 0.2
    return y


def _along(inequality: Inequality, y: np.ndarray, step: np.ndarray, promise: float, slope: np.ndarray) -> np.ndarray:
    """As much of the step as keeps a tenth of its promise; none where even a 1e-8th of it does not."""
    here = inequality.barrier(y) - slope @ y
    share = 1.0
    while share > 1e-8:
        there = y + share * step
        if inequality.barrier(there) - slope @ there <= here - 0.1 * share * promise:
            return there
        share *= 0.5
    return y
