"""The regressor of a planned motion in the units in which `identify` solves for an arm's unknowns."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from nbs_pin.base.arrays import JointArray
from nbs_pin.base.records import Reference
from nbs_pin.dynamics.pseudo_inertia import PARAMETERS_OF_COORDINATES
from nbs_pin.identification.datasets import Dataset
from nbs_pin.identification.drive_terms import DriveTerms
from nbs_pin.identification.explain import base_directions
from nbs_pin.identification.regressor import (
    Expected,
    RobotGeometry,
    equation_rows,
    expectation,
    of_all_joints,
    triangle,
)
from nbs_pin.robots.robot import Robot

_STATES = 400
"""Random states within the limits of the motion, which stand for its data."""


@dataclass(frozen=True, eq=False)
class Units:
    """What makes regressors of an arm comparable: columns in units of the prior, rows in those of the effort limits.

    The condition number of such a regressor on the base parameters is `IdentificationReport.condition` of data whose
    torque noise is the same share of every joint's effort limit.
    """

    robot: Robot
    terms: DriveTerms
    effort: JointArray
    """Effort limits [N·m]."""
    expected: Expected
    base: Float[np.ndarray, "unknowns base"]
    """Orthonormal directions of the base parameters, in these units."""

    @classmethod
    def of(cls, robot: Robot, terms: DriveTerms, effort: JointArray, lowest: Reference, highest: Reference) -> "Units":
        """The units for motions whose states (n,) lie between the lowest and the highest."""
        rng = np.random.default_rng(0)
        between = zip(lowest, highest, strict=True)
        q, v, a = (low + (high - low) * rng.random((_STATES, robot.nv)) for low, high in between)
        tau = effort * rng.choice([-1.0, 1.0], size=q.shape)
        data, geometry = _dataset(robot, q, v, a, tau), RobotGeometry(robot)
        expected = expectation(geometry, len(data), terms.factors(data), _triangles(geometry, data, terms))
        return cls(robot, terms, effort, expected, base_directions(geometry, data, terms, expected))

    @property
    def columns(self) -> Float[np.ndarray, "unknowns base"]:
        """The map from Pinocchio's parameters of all bodies, then friction and rotors, to base parameters here."""
        bodies, unknowns = 10 * self.robot.nv, len(self.base)
        rows = np.zeros((1, unknowns, unknowns + 1))
        rows[0, :bodies, :bodies] = np.kron(np.eye(self.robot.nv), PARAMETERS_OF_COORDINATES)
        rows[0, bodies:, bodies:-1] = np.eye(unknowns - bodies)
        return np.asarray(self.expected.in_units(rows)[0, :, :-1] @ self.base)

    def singular_values(self, motion: Reference) -> Float[np.ndarray, " base"]:
        """Of the regressor of the motion, states (rows, n)."""
        data = _dataset(self.robot, *motion, 0.0 * motion.q)
        rows = self.expected.in_units(_triangles(RobotGeometry(self.robot), data, self.terms))
        design = (rows[:, :, :-1] / self.effort[:, None, None]).reshape(-1, len(self.base))
        return np.asarray(np.linalg.svd(design @ self.base, compute_uv=False))

    def condition(self, motion: Reference) -> float:
        """The largest over the smallest singular value; inf where a direction is not excited."""
        values = self.singular_values(motion)
        return float(values[0] / values[-1]) if values[-1] > 0.0 else np.inf


def _triangles(geometry: RobotGeometry, data: Dataset, terms: DriveTerms) -> np.ndarray:
    """R of each joint's equations, columns of all joints and the torque last."""
    return of_all_joints(triangle(equation_rows(geometry, data, terms.factors(data))))


def _dataset(robot: Robot, q: np.ndarray, v: np.ndarray, a: np.ndarray, tau: np.ndarray) -> Dataset:
    """States of an arm as one trajectory."""
    rows = np.arange(len(q))
    return Dataset(q, v, a, tau, rows.astype(float), 0 * rows, robot.parents, robot.prismatic, robot.name, {})
