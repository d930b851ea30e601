"""Rigid trees for the inertia bounds: placements, bodies and travel of the joints."""

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from jaxtyping import Bool, Float, Int

from nbs_pin.base.arrays import JointArray
from nbs_pin.base.rounding import least_eigenvalues
from nbs_pin.dynamics.pinocchio_tree import pack_model
from nbs_pin.kernels.layout import Packed
from nbs_pin.kernels.tree_layout import ARMATURE, BASE, BODY, FIRST, MASS, SECOND
from nbs_pin.robots.robot import Robot

Arm: TypeAlias = "Robot | Packed | RigidTree"
"""A robot, a rigid tree packed by `kernels/tree_layout.py` (for instance of a chain network), or a `RigidTree`."""


@dataclass(frozen=True, eq=False)
class RigidTree:
    """Joint i moves body i about or along the z axis of frame i; parents come before children, and −1 is the base."""

    parents: Int[np.ndarray, " n"]
    prismatic: Bool[np.ndarray, " n"]
    rotation: Float[np.ndarray, "n 3 3"]
    """Rotation of frame i in its parent's frame at q_i = 0."""
    position: Float[np.ndarray, "n 3"]
    """Origin of frame i in its parent's frame at q_i = 0 [m]."""
    mass: JointArray
    """Mass of each body [kg]."""
    centre: Float[np.ndarray, "n 3"]
    """Centre of mass in frame i [m]."""
    inertia: Float[np.ndarray, "n 3 3"]
    """Inertia about the centre of mass, in frame i [kg·m²]."""
    armature: JointArray
    """Rotor inertia, added to the diagonal of M [kg·m², kg]."""
    lower: JointArray
    upper: JointArray
    """Travel of a prismatic joint [m]; revolute joints may turn fully."""

    @classmethod
    def of(cls, arm: Arm) -> "RigidTree":
        """The tree of an arm, without travel limits for a packed tree; raises ArgumentError as `pack_model` does."""
        if isinstance(arm, RigidTree):
            return arm
        packed = arm if isinstance(arm, Packed) else pack_model(arm.model)
        n = int(packed.layout[0])
        joints = packed.layout[1:].reshape(n, 2)
        rows = packed.weights[BASE:].reshape(n, BODY)
        mass, first = rows[:, MASS], rows[:, FIRST : FIRST + 3]
        centre = first / np.where(mass > 0.0, mass, 1.0)[:, None]
        second = np.zeros((n, 3, 3))
        i, j = np.triu_indices(3)
        second[:, i, j] = second[:, j, i] = rows[:, SECOND : SECOND + 6]
        second -= first[:, :, None] * centre[:, None, :]
        inertia = np.trace(second, axis1=1, axis2=2)[:, None, None] * np.eye(3) - second
        free = np.full(n, np.inf)
        travel = (-free, free) if isinstance(arm, Packed) else (arm.lower, arm.upper)
        placement = (rows[:, :9].reshape(n, 3, 3), rows[:, 9:12])
        body = (mass, centre, inertia, rows[:, ARMATURE])
        return cls(joints[:, 0] - 1, joints[:, 1] == 1, *placement, *body, *travel)

    @property
    def nv(self) -> int:
        """Number of joints."""
        return len(self.parents)

    def path(self, i: int) -> list[int]:
        """Joint i and its ancestors, i first."""
        joints = [i]
        while self.parents[joints[-1]] >= 0:
            joints.append(int(self.parents[joints[-1]]))
        return joints

    @property
    def absent(self) -> Bool[np.ndarray, " n"]:
        """Joints that M does not depend on: those on the base, and prismatic ones without a revolute ancestor."""
        first = self.parents < 0
        fixed = [all(self.prismatic[j] for j in self.path(i)) for i in range(self.nv)]
        return first | np.array(fixed)

    @property
    def endless(self) -> Int[np.ndarray, " k"]:
        """Prismatic joints that M depends on and whose travel is unbounded."""
        travel = np.isfinite(self.lower) & np.isfinite(self.upper)
        return np.flatnonzero(self.prismatic & ~self.absent & ~travel)

    def stops(self, i: int) -> tuple[float, ...]:
        """Ends of the travel of a prismatic joint [m], between which energies are convex; 0 if it is `absent`."""
        return (0.0,) if self.absent[i] else (float(self.lower[i]), float(self.upper[i]))

    @property
    def physical(self) -> bool:
        """Whether every body has mass ≥ 0 and inertia ⪰ 0, up to rounding; learned bodies may not."""
        least = least_eigenvalues(self.inertia) + 2.0 * self._rounding
        return bool((self.mass >= 0.0).all() and (least >= 0.0).all())

    @property
    def least_inertia(self) -> JointArray:
        """Lower bound of λ_min of each body's inertia about its centre of mass [kg·m²], at least 0."""
        return np.maximum(least_eigenvalues(self.inertia) - self._rounding, 0.0)

    @property
    def _rounding(self) -> JointArray:
        """Allowance for rounding of the inertias, to which m c cᵀ was added and subtracted again."""
        size = np.linalg.norm(self.inertia, axis=(1, 2)) + self.mass * (self.centre**2).sum(1)
        return 64.0 * np.finfo(float).eps * size

    def placed(self, i: int, q: Float[np.ndarray, " samples"]) -> tuple[np.ndarray, np.ndarray]:
        """Rotation (samples, 3, 3) and position (samples, 3) [m] of frame i in its parent's frame, at each q_i."""
        if self.prismatic[i]:
            rotation = np.broadcast_to(self.rotation[i], (len(q), 3, 3))
            return rotation, self.position[i] + q[:, None] * self.rotation[i, :, 2]
        turn = np.zeros((len(q), 3, 3))
        turn[:, 0, 0] = turn[:, 1, 1] = np.cos(q)
        turn[:, 1, 0] = np.sin(q)
        turn[:, 0, 1] = -turn[:, 1, 0]
        turn[:, 2, 2] = 1.0
        return self.rotation[i] @ turn, np.broadcast_to(self.position[i], (len(q), 3))

    def spatial_inertia(self, i: int) -> Float[np.ndarray, "6 6"]:
        """Spatial inertia of body i in its frame: twice its kinetic energy as a form in the twist (v, ω)."""
        to_centre = np.hstack([np.eye(3), -cross(self.centre[i])])
        form = self.mass[i] * to_centre.T @ to_centre
        form[3:, 3:] += self.inertia[i]
        return form


def cross(vectors: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3 3"]:
    """[v]×, with [v]× w = v × w."""
    out = np.zeros((*vectors.shape, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -vectors[..., 2], vectors[..., 1], -vectors[..., 0]
    return out - np.swapaxes(out, -1, -2)
