"""A rigid tree whose bodies exist, as a point of a descent: the last step of learning a chain.

Placements and bodies together minimise the squared residuals, in units of the noise, plus what `consistent_fit` adds:
2γ Σᵢ (tr Xᵢ − log det Xᵢ) + 2γ Σₖ (yₖ − log yₖ), for bodies and friction in units of what is expected. The bodies step
along X = L exp(S) Lᵀ and y exp(s), where they stay positive and the added term has Hessian 2γ.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from nbs_pin.dynamics.pseudo_inertia import BASIS, coordinates, symmetric
from nbs_pin.learning.levenberg_marquardt import Normal
from nbs_pin.learning.regressor import Expected
from nbs_pin.learning.tree_guess import JOINT, PLACE, Measured, TreeGuess


@dataclass(frozen=True, eq=False)
class PhysicalTree:
    """Placements from `guess`, whose own bodies and friction are not looked at, and physical bodies and friction."""

    guess: TreeGuess
    factors: Float[np.ndarray, "n 4 4"]
    """L of the pseudo-inertias LLᵀ, in any order of columns."""
    drag: Float[np.ndarray, "kinds n"]
    """Friction coefficients > 0."""
    expected: Expected
    strength: float
    """γ."""

    def whole(self) -> TreeGuess:
        """The tree that the kernels see."""
        return replace(self.guess, bodies=self.factors @ self.factors.swapaxes(1, 2), drag=self.drag)

    def cost(self, data: Measured) -> float:
        """The objective per residual."""
        local, share = self._in_units(), self.drag / self._usual()
        _, logarithm = np.linalg.slogdet(local)
        divergence = np.square(local).sum() - 2.0 * logarithm.sum() - 4.0 * len(local)
        divergence += (share - np.log(share) - 1.0).sum()
        return self.whole().cost(data) + 2.0 * self.strength * float(divergence) / data.q.size

    def normal(self, data: Measured) -> Normal:
        """The same with its normal equations in the steps of `moved`."""
        plain, chart = self.whole().normal(data), self._chart()
        local, weight = self._in_units(), self.strength / data.q.size
        bodies = coordinates(local.swapaxes(1, 2) @ local - np.eye(4))
        slope = self._step(np.zeros(3), np.zeros((len(local), PLACE)), bodies, self.drag / self._usual() - 1.0)
        added = self._step(np.zeros(3), np.zeros((len(local), PLACE)), np.ones_like(bodies), np.ones_like(self.drag))
        return Normal(
            self.cost(data),
            chart.T @ plain.gradient - weight * slope,
            chart.T @ plain.hessian @ chart + weight * np.diag(added),
        )

    def moved(self, step: Float[np.ndarray, " parameters"]) -> "PhysicalTree":
        """The tree a step away, in the order of `TreeGuess.moved`."""
        from scipy.linalg import expm

        n = len(self.factors)
        inner = 3 + JOINT * n - PLACE
        bodies = np.concatenate([np.zeros(PLACE), step[3:inner]]).reshape(n, JOINT)[:, PLACE:]
        return replace(
            self,
            guess=self.guess.moved(step),
            factors=self.factors @ expm(0.5 * symmetric(bodies)),
            drag=self.drag * np.exp(step[inner:].reshape(self.drag.shape)),
        )

    def _in_units(self) -> np.ndarray:
        return np.linalg.solve(self.expected.bodies, self.factors)

    def _usual(self) -> np.ndarray:
        return self.expected.scalars.reshape(self.drag.shape)

    def _step(self, down: np.ndarray, places: np.ndarray, bodies: np.ndarray, drag: np.ndarray) -> np.ndarray:
        """Parts of a step in one vector; joint 0 has no place."""
        return np.concatenate([down, np.hstack([places, bodies]).ravel()[PLACE:], drag.ravel()])

    def _chart(self) -> np.ndarray:
        """Derivative of the parameters of `TreeGuess` with respect to a step."""
        n, kinds = len(self.factors), self.drag.size
        size = 3 + JOINT * n - PLACE + kinds
        chart = np.eye(size)
        maps = coordinates(np.einsum("nij,kjl,nml->nkim", self.factors, BASIS, self.factors)).swapaxes(1, 2)
        for i in range(n):
            body = slice(3 + JOINT * i, 3 + JOINT * i + 10)
            chart[body, body] = maps[i]
        chart[size - kinds :, size - kinds :] = np.diag(self.drag.ravel())
        return chart
