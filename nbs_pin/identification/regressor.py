"""The equations of motion of an arm, linear in its unknowns: inertias, friction and rotors.

    τ = Y(q, v, v̇) π + terms of the drives (`drive_terms`)

π are the coordinates of the bodies' pseudo-inertias. Y depends on the geometry alone: `Geometry` is what the fit needs
of it, `RobotGeometry` that of a URDF, with Pinocchio's regressor.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
import pinocchio as pin
from jaxtyping import Float

from nbs_pin.base.arrays import JointArray
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.dynamics.pseudo_inertia import PARAMETERS_OF_COORDINATES, coordinates
from nbs_pin.identification.consistent_fit import in_factors
from nbs_pin.identification.datasets import Dataset
from nbs_pin.robots.robot import Robot

_CHUNK = 1_000
"""Samples whose regressors are held in memory at once."""
_BLOCK = 500
"""Rows that are decomposed at once, which the cache holds."""
_FRICTION_SHARE = 0.05
"""Expected share of friction, and of rotor inertia, in the torque."""
_STILL = 0.1
"""Least speed for the expected friction of a joint, as a share of the fastest joint's."""


@runtime_checkable
class Geometry(Protocol):
    """The geometry of an arm, without its masses."""

    @property
    def names(self) -> Sequence[str]:
        """Names of its n joints."""

    @property
    def places(self) -> tuple[Sequence[int], Float[np.ndarray, "n 3"]]:
        """Parents of the joints, 0 for the base and i + 1 for joint i, and positions in the parents' frames [m]."""

    def regressor(
        self, q: Float[np.ndarray, "rows n"], v: Float[np.ndarray, "rows n"], a: Float[np.ndarray, "rows n"]
    ) -> Float[np.ndarray, "rows n unknowns"]:
        """Y: derivatives of the torque with respect to ten coordinates per body (`dynamics.pseudo_inertia`)."""


@dataclass(frozen=True, eq=False)
class RobotGeometry:
    """The geometry of a URDF."""

    robot: Robot

    @property
    def names(self) -> Sequence[str]:
        """Joint names."""
        return self.robot.joint_names

    @property
    def places(self) -> tuple[Sequence[int], Float[np.ndarray, "n 3"]]:
        """Parents and positions [m]."""
        model, joints = self.robot.model, range(1, self.robot.nv + 1)
        return list(model.parents)[1:], np.array([model.jointPlacements[i].translation for i in joints])

    def regressor(
        self, q: Float[np.ndarray, "rows n"], v: Float[np.ndarray, "rows n"], a: Float[np.ndarray, "rows n"]
    ) -> Float[np.ndarray, "rows n unknowns"]:
        """Y by Pinocchio, without armature."""
        model, scratch, n = self.robot.model, self.robot.model.createData(), self.robot.nv
        rows = np.array(
            [pin.computeJointTorqueRegressor(model, scratch, *state) for state in zip(q, v, a, strict=True)]
        )
        return (rows.reshape(-1, n, n, 10) @ PARAMETERS_OF_COORDINATES).reshape(-1, n, 10 * n)


@dataclass(frozen=True, eq=False)
class Expected:
    """Expected values of the unknowns before any data: the units of the fit."""

    bodies: Float[np.ndarray, "n 4 4"]
    """Lower triangular factors of pseudo-inertias."""
    scalars: Float[np.ndarray, " scalars"]
    """Friction coefficients and rotor inertias."""

    def in_units(self, triangles: Float[np.ndarray, "n rows columns"]) -> Float[np.ndarray, "n rows columns"]:
        """The equations for unknowns in these units."""
        split = 10 * len(self.bodies)
        rows = triangles[:, :, :split].reshape(-1, split)
        bodies = in_factors(rows, self.bodies).reshape(*triangles.shape[:2], -1)
        return np.concatenate([bodies, triangles[:, :, split:] * np.append(self.scalars, 1.0)], axis=-1)


def equation_rows(
    geometry: Geometry, data: Dataset, factors: Float[np.ndarray, "kinds samples n"]
) -> Float[np.ndarray, "n samples columns"]:
    """The equations of each joint: factors of the coordinates of all bodies and of its own numbers, then the torque."""
    blocks = []
    for begin in range(0, len(data), _CHUNK):
        part = slice(begin, begin + _CHUNK)
        bodies = geometry.regressor(data.q[part], data.v[part], data.a[part]).swapaxes(0, 1)
        blocks.append(
            np.concatenate([bodies, factors[:, part].transpose(2, 1, 0), data.tau[part].T[..., None]], axis=-1)
        )
    return np.concatenate(blocks, axis=1)


def of_all_joints(rows: Float[np.ndarray, "n rows columns"]) -> Float[np.ndarray, "n rows all"]:
    """The equations with a column for the numbers of every joint, kind by kind, in place of those of their own."""
    n, split = len(rows), 10 * len(rows)
    own = np.einsum("irk,ij->irkj", rows[:, :, split:-1], np.eye(n)).reshape(*rows.shape[:2], -1)
    return np.concatenate([rows[:, :, :split], own, rows[:, :, -1:]], axis=-1)


def triangle(rows: Float[np.ndarray, "*batch rows columns"]) -> Float[np.ndarray, "*batch fewer columns"]:
    """R of the QR decomposition: fewer rows of the same least squares problem."""
    size = max(_BLOCK, 4 * rows.shape[-1])
    found = rows[..., :size, :]
    for begin in range(size, rows.shape[-2], size):
        found = np.concatenate([np.linalg.qr(found, mode="r"), rows[..., begin : begin + size, :]], axis=-2)
    return np.asarray(np.linalg.qr(found, mode="r"))


def expectation(
    geometry: Geometry,
    samples: int,
    factors: Float[np.ndarray, "kinds samples n"],
    triangles: Float[np.ndarray, "n rows columns"],
) -> Expected:
    """Balls along the links, with masses that give torques of the recorded size; a small share of these is friction.

    triangles: R of the equations of `of_all_joints`, of that many samples.

    Raises:
        ArgumentError: If the torque depends on no inertia, as at rest without gravity.
    """
    shapes, n = np.linalg.cholesky(_balls(*geometry.places)), len(triangles)
    size = torque_size(triangles, samples)
    balls = coordinates(shapes @ shapes.swapaxes(1, 2)).ravel()
    torque = np.linalg.norm(triangles[:, :, : 10 * n] @ balls, axis=1) / np.sqrt(samples)
    if not torque.any():
        raise ArgumentError("the arm of the data neither moves nor carries weight; record motions.")
    scale = np.sqrt(n / np.square(torque / size).sum())
    speed = np.sqrt(np.square(factors).mean(axis=1))
    least = _STILL * speed.max(axis=-1, keepdims=True, initial=1e-9)
    return Expected(np.sqrt(scale) * shapes, (_FRICTION_SHARE * size / np.maximum(speed, least)).ravel())


def torque_size(triangles: Float[np.ndarray, "n rows columns"], samples: int) -> JointArray:
    """Root mean square torque per joint [N·m], at least a millionth of the largest."""
    size = np.linalg.norm(triangles[:, :, -1], axis=1) / np.sqrt(samples)
    return np.maximum(size, 1e-6 * size.max())


def _balls(parents: Sequence[int], places: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 4 4"]:
    """Pseudo-inertias of balls midway between a joint and the next, of as many kg as joints from there to the tip."""
    n, lengths = len(places), np.linalg.norm(places, axis=1)
    usual = float(lengths[lengths > 1e-6].mean()) if (lengths > 1e-6).any() else 0.1
    balls, mass = np.zeros((n, 4, 4)), np.ones(n)
    for i in reversed(range(n)):
        children = [c for c in range(n) if parents[c] == i + 1]
        centre = np.append(0.5 * places[children].mean(axis=0) if children else np.zeros(3), 1.0)
        radius = max(float(np.linalg.norm(centre[:3])), 0.25 * usual)
        mass[i] += mass[children].max(initial=0.0)
        balls[i] = mass[i] * (np.outer(centre, centre) + np.diag([radius**2 / 5.0] * 3 + [0.0]))
    return balls
