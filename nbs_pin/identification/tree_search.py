"""A rigid tree during the search for its geometry: its torque, the derivatives, and steps of its parameters."""

import functools
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from nbs_pin.base.arrays import JointArray
from nbs_pin.dynamics.chain import Tree
from nbs_pin.dynamics.pseudo_inertia import BASIS, symmetric
from nbs_pin.identification.levenberg_marquardt import Normal
from nbs_pin.kernels.layout import Packed
from nbs_pin.kernels.threads import cores
from nbs_pin.kernels.tree_layout import tree_workspace
from nbs_pin.kernels.tree_parameters import COLUMNS, INERTIA, ROTOR, tree_derivatives
from nbs_pin.kernels.trees import tree_torques

R = TypeVar("R")
_CHUNK = 512
PLACE, JOINT = 6, 16
"""Numbers of parameters of a placement, and of a joint: placement and body."""


@dataclass(frozen=True, eq=False)
class Measurements:
    """Rows of states and torques, with a scale of the residuals of each joint."""

    q: Float[np.ndarray, "rows n"]
    v: Float[np.ndarray, "rows n"]
    a: Float[np.ndarray, "rows n"]
    tau: Float[np.ndarray, "rows n"]
    scale: JointArray
    """Unit of the residuals [N·m]."""
    kinds: Float[np.ndarray, "kinds rows n"]
    """Factors of the numbers of the drives (`drive_terms`)."""
    back: Float[np.ndarray, "n n"] | None = None
    """N⁻¹ if torques, their scale and the factors are those of motors that turn by N q; None for those of joints."""

    def of_motors(self, table: Float[np.ndarray, "rows n *columns"]) -> Float[np.ndarray, "rows n *columns"]:
        """Torques of the joints, or derivatives of these, as those of the motors."""
        if self.back is None:
            return table
        return (self.back.T @ table.reshape(*table.shape[:2], -1)).reshape(table.shape)

    def some(self, rows: np.ndarray) -> "Measurements":
        """The given rows."""
        states = {name: np.ascontiguousarray(getattr(self, name)[rows]) for name in ("q", "v", "a", "tau")}
        return replace(self, **states, kinds=self.kinds[:, rows])


@dataclass(frozen=True, eq=False)
class TreeEstimate:
    """Placements and bodies of a tree, and friction.

    A body may be any symmetric matrix, in which the torque is linear: constraints that keep bodies physical add bad
    local minima, and `identify.explain` finds physical ones for the same geometry. Joint 0 lies in the base frame, in
    which gravity has any direction.
    """

    layout: Int[np.ndarray, " layout"]
    down: Float[np.ndarray, "3"]
    """Minus gravity in the base frame [m/s²]."""
    rotations: Float[np.ndarray, "n 3 3"]
    positions: Float[np.ndarray, "n 3"]
    bodies: Float[np.ndarray, "n 4 4"]
    """Pseudo-inertias [[Σ m xxᵀ, Σ m x], [·, Σ m]]."""
    drag: Float[np.ndarray, "kinds n"]
    """Coefficients of `Measurements.kinds`: friction and rotor inertias."""

    @classmethod
    def of(cls, tree: Tree, layout: np.ndarray, kinds: int) -> "TreeEstimate":
        """A tree without friction, in the frame of joint 0 at q = 0 as the base frame."""
        rotations, positions = Rotation.from_rotvec(tree.turns).as_matrix(), tree.positions.copy()
        base, at_base = rotations[0].copy(), layout[1::2] == 0
        rotations[at_base] = base.T @ rotations[at_base]
        positions[at_base] = (positions[at_base] - tree.positions[0]) @ base
        bodies = tree.factors @ tree.factors.swapaxes(1, 2)
        return cls(layout, -base.T @ tree.field, rotations, positions, bodies, np.zeros((kinds, len(bodies))))

    def tree(self, factors: Float[np.ndarray, "n 4 4"]) -> Tree:
        """The parameters of a `Chain` with these placements and the given bodies LLᵀ."""
        return Tree(Rotation.from_matrix(self.rotations).as_rotvec(), self.positions, factors, -self.down)

    def packed(self) -> Packed:
        """Layout and weights for the kernels."""
        weights = [self.down]
        for rotation, position, body in zip(self.rotations, self.positions, _moments(self.bodies), strict=True):
            weights += [rotation.ravel(), position, body, np.zeros(1)]
        return Packed(self.layout, np.concatenate(weights))

    def residual(self, data: Measurements) -> Float[np.ndarray, "rows n"]:
        """Torque residual, measured minus predicted [N·m]."""
        tree, tau = self.packed(), np.empty(data.q.shape)

        def evaluate(part: slice) -> None:
            q, v, a = data.q[part], data.v[part], data.a[part]
            tree_torques(q, v, v, a, *tree, np.empty(tree_workspace(tree)), tau[part])

        _by_chunks(evaluate, len(tau))
        return data.tau - data.of_motors(tau) - self._dragged(data.kinds)

    def cost(self, data: Measurements) -> float:
        """Mean square of the weighted residuals."""
        return float(np.mean(np.square(self.residual(data) / data.scale)))

    def normal(self, data: Measurements) -> Normal:
        """The cost and its normal equations in the steps of `moved`."""

        def evaluate(part: slice) -> tuple[float, np.ndarray, np.ndarray]:
            kinds = data.kinds[:, part]
            tau, table = self._derivatives(data.q[part], data.v[part], data.a[part])
            tau, table = data.of_motors(tau), data.of_motors(table)
            left = ((data.tau[part] - tau - self._dragged(kinds)) / data.scale).ravel()
            own = np.einsum("ksj,ij->sikj", kinds, np.eye(len(self.drag.T))).reshape(*tau.shape, -1)
            rows = (np.concatenate([table, own], axis=-1) / data.scale[:, None]).reshape(len(left), -1)
            return left @ left, rows.T @ left, rows.T @ rows

        parts = _by_chunks(evaluate, len(data.q))
        cost, gradient, hessian = (sum(part[k] for part in parts) / data.q.size for k in range(3))
        chart = self._chart()
        return Normal(float(cost), chart.T @ gradient, chart.T @ hessian @ chart)

    def regressor(
        self, q: Float[np.ndarray, "rows n"], v: Float[np.ndarray, "rows n"], a: Float[np.ndarray, "rows n"]
    ) -> Float[np.ndarray, "rows n unknowns"]:
        """Derivatives of the torque with respect to the coordinates of every body (`dynamics.pseudo_inertia`)."""
        n = len(self.bodies)
        tables = _by_chunks(lambda part: self._derivatives(q[part], v[part], a[part])[1], len(q))
        bodies = np.concatenate(tables)[..., 3:].reshape(*q.shape, n, COLUMNS)[..., INERTIA:ROTOR]
        return (bodies @ _MOMENTS).reshape(*q.shape, 10 * n)

    def moved(self, step: Float[np.ndarray, " parameters"]) -> "TreeEstimate":
        """The estimate after a step: gravity, the body of joint 0, placement and body of each other joint, friction."""
        n = len(self.bodies)
        inner = 3 + JOINT * n - PLACE
        joints = np.concatenate([np.zeros(PLACE), step[3:inner]]).reshape(n, JOINT)
        return replace(
            self,
            down=self.down + step[:3],
            rotations=self.rotations @ Rotation.from_rotvec(joints[:, :3]).as_matrix(),
            positions=self.positions + joints[:, 3:PLACE],
            bodies=self.bodies + symmetric(joints[:, PLACE:]),
            drag=self.drag + step[inner:].reshape(self.drag.shape),
        )

    def _dragged(self, kinds: np.ndarray) -> np.ndarray:
        return np.einsum("kj,ksj->sj", self.drag, kinds)

    def _derivatives(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Torques (rows, n) and their derivatives, (rows, n, 3 + 17n)."""
        tree, tau = self.packed(), np.empty(q.shape)
        table = np.empty((*q.shape, 3 + COLUMNS * len(self.bodies)))
        tree_derivatives(q, v, a, *tree, np.empty(tree_workspace(tree)), tau, table)
        return tau, table

    def _chart(self) -> np.ndarray:
        """Derivative of the kernels' parameters and of friction with respect to the steps of `moved`."""
        n, kinds = self.drag.T.shape
        inner, free = 3 + COLUMNS * n, 3 + JOINT * n - PLACE
        joint = np.zeros((COLUMNS, JOINT))
        joint[:PLACE, :PLACE], joint[INERTIA:ROTOR, PLACE:] = np.eye(PLACE), _MOMENTS
        chart = np.zeros((inner + kinds * n, free + kinds * n))
        chart[:3, :3] = np.eye(3)
        chart[3:inner, 3:free] = np.kron(np.eye(n), joint)[:, PLACE:]
        chart[inner:, free:] = np.eye(kinds * n)
        return chart


@dataclass(frozen=True, eq=False)
class TreeGeometry:
    """The placements of a tree estimate, as a `regressor.Geometry`."""

    guess: TreeEstimate

    @property
    def names(self) -> Sequence[str]:
        """Joint numbers, as the data have no names."""
        return [f"joint {i + 1}" for i in range(len(self.guess.positions))]

    @property
    def places(self) -> tuple[Sequence[int], Float[np.ndarray, "n 3"]]:
        """Parents and positions [m]."""
        return self.guess.layout[1::2].tolist(), self.guess.positions

    def regressor(
        self, q: Float[np.ndarray, "rows n"], v: Float[np.ndarray, "rows n"], a: Float[np.ndarray, "rows n"]
    ) -> Float[np.ndarray, "rows n unknowns"]:
        """Derivatives of the torque with respect to the bodies."""
        return self.guess.regressor(q, v, a)


def _moments(bodies: Float[np.ndarray, "*batch 4 4"]) -> Float[np.ndarray, "*batch 10"]:
    """m, h, E (xx, xy, xz, yy, yz, zz) of pseudo-inertias, as the kernels take them."""
    rows, columns = (3, 0, 1, 2, 0, 0, 0, 1, 1, 2), (3, 3, 3, 3, 0, 1, 2, 1, 2, 2)
    return bodies[..., rows, columns]


_MOMENTS = _moments(BASIS).T
"""(10, 10): from coordinates of a pseudo-inertia to its moments."""


def _by_chunks(function: Callable[[slice], R], rows: int) -> list[R]:
    """The results of `function` for slices of at most 512 rows, in order, computed on all cores."""
    slices = [slice(k, min(k + _CHUNK, rows)) for k in range(0, rows, _CHUNK)]
    return [function(slices[0])] if len(slices) == 1 else list(_pool().map(function, slices))


@functools.cache
def _pool() -> ThreadPoolExecutor:
    """The threads of `_by_chunks`, which a descent calls thousands of times."""
    return ThreadPoolExecutor(cores())


os.register_at_fork(after_in_child=_pool.cache_clear)
