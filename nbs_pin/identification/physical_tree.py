"""A rigid tree with physically consistent bodies, as a point of a descent: the last step of the chain fit.

Placements and bodies together minimise the squared residuals, in units of the noise, plus the prior of
`consistent_fit`, 2γ Σᵢ (tr Xᵢ − log det Xᵢ) + 2γ Σₖ (yₖ − log yₖ) + γ Σₗ zₗ², for bodies and drives in units of their
expected values. Steps along X = L exp(S) Lᵀ and y exp(s) keep them positive; the Hessian of the prior is approximated
by 2γ, its value along L(1 + S)Lᵀ, y(1 + s) and z + s.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from nbs_pin.dynamics.pseudo_inertia import BASIS, coordinates, symmetric
from nbs_pin.identification.levenberg_marquardt import Normal
from nbs_pin.identification.regressor import Expected
from nbs_pin.identification.tree_search import JOINT, PLACE, Measurements, TreeEstimate

FREE, PARALLEL, RIGHT = 0, 1, 2


@dataclass(frozen=True, eq=False)
class PhysicalTree:
    """The placements of `guess`, whose bodies and friction are not used, with physical bodies and friction."""

    guess: TreeEstimate
    factors: Float[np.ndarray, "n 4 4"]
    """Square roots L of the pseudo-inertias LLᵀ, not necessarily triangular."""
    drag: Float[np.ndarray, "kinds n"]
    """Numbers of the drives, > 0 unless signed."""
    signed: Bool[np.ndarray, "kinds n"]
    """Which of them may be negative."""
    expected: Expected
    strength: float
    """γ."""
    angles: tuple[int, ...] = ()
    """FREE, PARALLEL or RIGHT: constraint between the axis of each joint and its parent's; empty if all are free."""

    def whole(self) -> TreeEstimate:
        """The tree estimate with these bodies and friction."""
        return replace(self.guess, bodies=self.factors @ self.factors.swapaxes(1, 2), drag=self.drag)

    def cost(self, data: Measurements) -> float:
        """The objective divided by the number of residuals."""
        local, share = self._in_units(), self.drag / self._usual()
        _, logarithm = np.linalg.slogdet(local)
        divergence = np.square(local).sum() - 2.0 * logarithm.sum() - 4.0 * len(local)
        positive = share[~self.signed]
        divergence += (positive - np.log(positive) - 1.0).sum() + 0.5 * np.square(share[self.signed]).sum()
        return self.whole().cost(data) + 2.0 * self.strength * float(divergence) / data.q.size

    def normal(self, data: Measurements) -> Normal:
        """The cost and its normal equations in the steps of `moved`."""
        plain, chart, free = self.whole().normal(data), self._chart(), self._free()
        local, weight = self._in_units(), self.strength / data.q.size
        bodies = coordinates(local.swapaxes(1, 2) @ local - np.eye(4))
        slope = self._step(bodies, self.drag / self._usual() - ~self.signed)
        added = self._step(np.ones_like(bodies), np.ones_like(self.drag))
        gradient = chart.T @ plain.gradient - weight * slope
        hessian = chart.T @ plain.hessian @ chart + weight * np.diag(added)
        return Normal(self.cost(data), free.T @ gradient, free.T @ hessian @ free)

    def moved(self, step: Float[np.ndarray, " parameters"]) -> "PhysicalTree":
        """The tree after a step, in the order of `TreeEstimate.moved` without those that `angles` constrain."""
        n, whole = len(self.factors), self._free() @ step
        inner = 3 + JOINT * n - PLACE
        bodies = np.concatenate([np.zeros(PLACE), whole[3:inner]]).reshape(n, JOINT)[:, PLACE:]
        guess = self.guess.moved(whole)
        return replace(
            self,
            guess=replace(guess, rotations=_held(guess.rotations, self.angles)),
            factors=self.factors @ expm(0.5 * symmetric(bodies)),
            drag=self._dragged(whole[inner:].reshape(self.drag.shape)),
        )

    def at_right_angles(self, data: Measurements, errors: float) -> "PhysicalTree":
        """The tree with axes held at 0° or 90° to their parents' that are so within `errors` standard errors."""
        tree = replace(self, angles=())
        information = data.q.size * tree.normal(data).hessian  # of standard errors if the tree is a minimum
        covariance = np.linalg.pinv(information, hermitian=True)
        angles = [FREE]
        for i, rotation in enumerate(self.guess.rotations[1:], start=1):
            parallel = abs(rotation[2, 2]) > np.sqrt(0.5)
            rows = [0, 1] if parallel else [2]
            at = JOINT * i + 3 - PLACE
            slope = np.column_stack([-rotation[rows, 1], rotation[rows, 0]])  # of column z in rotations about x and y
            spread = slope @ covariance[at : at + 2, at : at + 2] @ slope.T
            off = rotation[rows, 2]
            near = off @ np.linalg.solve(spread, off) < errors**2
            angles.append((PARALLEL if parallel else RIGHT) if near else FREE)
        rotations = _held(self.guess.rotations, tuple(angles))
        return replace(self, guess=replace(self.guess, rotations=rotations), angles=tuple(angles))

    def _in_units(self) -> np.ndarray:
        return np.linalg.solve(self.expected.bodies, self.factors)

    def _dragged(self, step: np.ndarray) -> np.ndarray:
        """The numbers of the drives after a step."""
        grown = self.drag * np.exp(np.where(self.signed, 0.0, step))
        return np.where(self.signed, self.drag + step * self._usual(), grown)

    def _usual(self) -> np.ndarray:
        return self.expected.scalars.reshape(self.drag.shape)

    def _step(self, bodies: np.ndarray, drag: np.ndarray) -> np.ndarray:
        """The parts of a step in one vector, zero for gravity and placements; joint 0 has no placement."""
        joints = np.hstack([np.zeros((len(bodies), PLACE)), bodies])
        return np.concatenate([np.zeros(3), joints.ravel()[PLACE:], drag.ravel()])

    def _free(self) -> np.ndarray:
        """A basis of the steps that satisfy `angles`."""
        size = 3 + JOINT * len(self.factors) - PLACE + self.drag.size
        columns, keep = np.eye(size), np.ones(size, dtype=bool)
        for i in np.flatnonzero(self.angles):
            at = JOINT * i + 3 - PLACE
            if self.angles[i] == PARALLEL:
                keep[at : at + 2] = False
            else:  # a rotation about the parent's axis, the third row, keeps a right angle
                columns[at : at + 2, at] = self.guess.rotations[i, 2, :2]
                keep[at + 1] = False
        return columns[:, keep]

    def _chart(self) -> np.ndarray:
        """Derivative of the parameters of `TreeEstimate` with respect to a step."""
        n, kinds = len(self.factors), self.drag.size
        size = 3 + JOINT * n - PLACE + kinds
        chart = np.eye(size)
        maps = coordinates(np.einsum("nij,kjl,nml->nkim", self.factors, BASIS, self.factors)).swapaxes(1, 2)
        for i in range(n):
            body = slice(3 + JOINT * i, 3 + JOINT * i + 10)
            chart[body, body] = maps[i]
        chart[size - kinds :, size - kinds :] = np.diag(np.where(self.signed, self._usual(), self.drag).ravel())
        return chart


def _held(rotations: Float[np.ndarray, "n 3 3"], angles: tuple[int, ...]) -> Float[np.ndarray, "n 3 3"]:
    """The rotations, turned by the least angle that makes their z axes parallel or perpendicular to the parent's."""
    held = rotations.copy()
    for i in np.flatnonzero(angles):
        z = rotations[i, :, 2]
        if angles[i] == PARALLEL:
            target = np.array([0.0, 0.0, np.sign(z[2])])
        else:
            target = np.array([z[0], z[1], 0.0]) / np.hypot(z[0], z[1])
        cross = np.cross(z, target)
        length = np.linalg.norm(cross)
        if length > 0.0:
            angle = np.arctan2(length, z @ target)
            held[i] = Rotation.from_rotvec(angle / length * cross).as_matrix() @ rotations[i]
    return held
