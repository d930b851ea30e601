"""The equations of motion of an arm, linear in its unknowns: inertias, friction and rotors.

    τ = Y(q, v, v̇) π + viscous·v + coulomb·tanh(v / transition) + rotor·v̇

π are the coordinates of the bodies' pseudo-inertias. Y depends on the geometry alone: `Geometry` is what the fit needs
of it, `RobotGeometry` that of a URDF, with Pinocchio's regressor.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
import pinocchio as pin
from jaxtyping import Float

from nbs_pin.base.arrays import JointArray
from nbs_pin.base.doors import in_words
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.dynamics.pseudo_inertia import PARAMETER_NAMES, PARAMETERS_OF_COORDINATES, coordinates
from nbs_pin.identification.consistent_fit import in_factors
from nbs_pin.identification.datasets import Dataset
from nbs_pin.robots.robot import Robot

_CHUNK = 1_000
"""Samples whose regressors are held in memory at once."""
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


@dataclass(frozen=True)
class Scalars:
    """The unknowns of every joint besides the inertia of its body: those of friction, then the rotor inertia."""

    friction: bool
    rotor_inertia: bool
    transition: float
    """Speed scale of the Coulomb friction [rad/s]."""

    def factors(
        self, v: Float[np.ndarray, "samples n"], a: Float[np.ndarray, "samples n"]
    ) -> Float[np.ndarray, "kinds samples n"]:
        """Factor of each kind in the torque of its joint: v, tanh(v/transition), v̇."""
        kinds = [v, np.tanh(v / self.transition)] if self.friction else []
        return np.array([*kinds, *([a] if self.rotor_inertia else [])]).reshape(-1, *v.shape)

    def names(self, joints: Sequence[str]) -> list[str]:
        """Names of all unknowns of the arm, those of the bodies first."""
        kinds = (["viscous", "coulomb"] if self.friction else []) + (["rotor"] if self.rotor_inertia else [])
        bodies = [f"{parameter}({joint})" for joint in joints for parameter in PARAMETER_NAMES]
        return bodies + [f"{kind}({joint})" for kind in kinds for joint in joints]


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


def joint_triangles(geometry: Geometry, data: Dataset, scalars: Scalars) -> Float[np.ndarray, "n rows columns"]:
    """R of each joint's QR-decomposed equations, torque last: the same least squares problem in fewer rows."""
    triangles = np.zeros((data.nv, 0, len(scalars.names(geometry.names)) + 1))
    for rows in _rows(geometry, data, scalars):
        triangles = triangle(np.concatenate([triangles, rows], axis=1))
    return triangles


def triangle(rows: Float[np.ndarray, "*batch rows columns"]) -> Float[np.ndarray, "*batch fewer columns"]:
    """R of the QR decomposition: fewer rows of the same least squares problem."""
    return np.asarray(np.linalg.qr(rows, mode="r"))


def expectation(
    geometry: Geometry, data: Dataset, scalars: Scalars, triangles: Float[np.ndarray, "n rows columns"]
) -> Expected:
    """Balls along the links, with masses that give torques of the recorded size; a small share of these is friction.

    Raises:
        ArgumentError: If the torque depends on no inertia, as at rest without gravity.
    """
    factors, n = np.linalg.cholesky(_balls(*geometry.places)), data.nv
    size = torque_size(triangles, len(data))
    balls = coordinates(factors @ factors.swapaxes(1, 2)).ravel()
    torque = np.linalg.norm(triangles[:, :, : 10 * n] @ balls, axis=1) / np.sqrt(len(data))
    if not torque.any():
        raise ArgumentError(
            f"the arm of {in_words(data, 'the data')} neither moves nor carries weight; record motions."
        )
    scale = np.sqrt(n / np.square(torque / size).sum())
    speed = np.sqrt(np.square(scalars.factors(data.v, data.a)).mean(axis=1))
    least = _STILL * speed.max(axis=-1, keepdims=True, initial=1e-9)
    return Expected(np.sqrt(scale) * factors, (_FRICTION_SHARE * size / np.maximum(speed, least)).ravel())


def torque_size(triangles: Float[np.ndarray, "n rows columns"], samples: int) -> JointArray:
    """Root mean square torque per joint [N·m], at least a millionth of the largest."""
    size = np.linalg.norm(triangles[:, :, -1], axis=1) / np.sqrt(samples)
    return np.maximum(size, 1e-6 * size.max())


def _rows(geometry: Geometry, data: Dataset, scalars: Scalars) -> Iterator[np.ndarray]:
    """Blocks (n, samples, unknowns + 1) of the equations, one per joint and sample, the torque last."""
    n = data.nv
    for begin in range(0, len(data), _CHUNK):
        q, v, a, tau = (x[begin : begin + _CHUNK] for x in (data.q, data.v, data.a, data.tau))
        own = np.einsum("ksj,ij->iskj", scalars.factors(v, a), np.eye(n)).reshape(n, len(q), -1)
        yield np.concatenate([geometry.regressor(q, v, a).swapaxes(0, 1), own, tau.T[..., None]], axis=-1)


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
