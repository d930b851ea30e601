"""The least time in which a path can be followed within velocity, acceleration and effort limits, by toppra.

toppra (Pham and Pham 2018) keeps limits at the ends of the intervals of its grid, between which s̈ is constant. What
happens between them is measured, and the limits given to toppra are reduced until the arm's own are kept there too.
"""

import warnings
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from jaxtyping import Float

from nbs_pin.base.arrays import JointArray
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.units import percent, units
from nbs_pin.motions.joint_paths import JointPath
from nbs_pin.motions.timings import Stepped
from nbs_pin.robots.robot import Robot

INTERVALS = 1000
"""Intervals of the grid."""
_WITHIN = 16
"""Points of each interval at which limits are measured, its ends included."""
_ROUNDS = 12
_SAFE = 1.0 - 1e-6
_SPARE = 1e-4
"""Reduction of a limit beyond what was measured."""


class Shares(NamedTuple):
    """Velocity, acceleration and effort as shares of their limits."""

    velocity: Float[np.ndarray, "*batch n"]
    acceleration: Float[np.ndarray, "*batch n"]
    effort: Float[np.ndarray, "*batch n"]


def least_time(robot: Robot, joints: JointPath, acceleration: JointArray | None = None) -> Stepped:
    """The timing of least duration from rest to rest, whose limits hold between the nodes of the grid too.

    `acceleration` is the largest |a| of each joint [rad/s²], None for none.

    Raises:
        ArgumentError: If the arm cannot hold its own weight on the path, with the joint and the share that is missing,
            or has neither effort limits nor an acceleration limit.
    """
    most = np.full(robot.nv, np.inf) if acceleration is None else acceleration
    if not (np.isfinite(most) | np.isfinite(robot.effort_limit)).all():
        i = int(np.argmin(np.isfinite(most) | np.isfinite(robot.effort_limit)))
        raise ArgumentError(
            f"joint '{robot.joint_names[i]}' of {robot.name} has no effort limit, so that nothing limits how fast it "
            "starts; give its effort limit, or acceleration."
        )
    _check_weight(robot, joints)
    grid, left = np.linspace(0.0, 1.0, INTERVALS + 1), np.ones(3)
    for _ in range(_ROUNDS):
        timing = Stepped(grid, _speeds(robot, joints, most, grid, left))
        worst = np.array([share.max() for share in between(robot, joints, timing, most)])
        if (worst <= _SAFE).all():
            return timing
        left = left / np.where(worst > _SAFE, worst * (1.0 + _SPARE), 1.0)
    raise ArgumentError(
        f"no timing of the path was found that keeps the limits of {robot.name} between {INTERVALS + 1} points; "
        "smooth the path, or give a duration."
    )


def _speeds(
    robot: Robot, joints: JointPath, most: np.ndarray, grid: np.ndarray, left: np.ndarray
) -> Float[np.ndarray, " nodes"]:
    """ṡ at the nodes by toppra, within these shares of the limits of velocity, acceleration and effort."""
    import toppra
    from toppra.constraint import (
        DiscretizationType,
        JointAccelerationConstraint,
        JointTorqueConstraint,
        JointVelocityConstraint,
    )

    class Path(toppra.interpolator.AbstractGeometricPath):
        dof = robot.nv
        path_interval = np.array([0.0, 1.0])

        def __call__(self, s: Any, order: int = 0) -> np.ndarray:
            return joints(np.asarray(s), order)

    data, effort = robot.model.createData(), robot.effort_limit

    def share_of_effort(q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        return np.asarray(pin.rnea(robot.model, data, q, v, a)) / effort

    ones = np.ones(robot.nv)
    limits = [
        JointTorqueConstraint(share_of_effort, _both(left[2] * ones), 0.0 * ones, DiscretizationType.Interpolation)
    ]
    if np.isfinite(robot.velocity_limit).any():
        limits.append(JointVelocityConstraint(_both(left[0] * np.minimum(robot.velocity_limit, 1e6))))
    if np.isfinite(most).any():
        limits.append(JointAccelerationConstraint(_both(left[1] * np.minimum(most, 1e9))))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        solver = toppra.algorithm.TOPPRA(limits, Path(), gridpoints=grid, solver_wrapper="seidel")
        _, speed, _ = solver.compute_parameterization(0.0, 0.0)
    if speed is None or not np.isfinite(speed).all():
        raise ArgumentError(
            f"toppra found no timing of the path within the limits of {robot.name}; give a duration instead."
        )
    return np.asarray(speed)


def _both(limit: np.ndarray) -> np.ndarray:
    return np.stack([-limit, limit], axis=-1)


def between(robot: Robot, joints: JointPath, timing: Stepped, most: np.ndarray) -> Shares:
    """The shares of limits at points of every interval, its ends from within: shape (intervals, points, n)."""
    part = np.linspace(0.0, 1.0, _WITHIN)
    square = timing.speed[:-1, None] ** 2 + np.diff(timing.speed**2)[:, None] * part
    s = timing.grid[:-1, None] + np.diff(timing.grid)[:, None] * part
    ds, dds = np.sqrt(square)[..., None], np.broadcast_to(timing.acceleration[:, None, None], (*s.shape, 1))
    first, second = joints(s, 1), joints(s, 2)
    v, acceleration = first * ds, second * ds**2 + first * dds
    data, n = robot.model.createData(), robot.nv
    rows = zip(joints(s).reshape(-1, n), v.reshape(-1, n), acceleration.reshape(-1, n), strict=True)
    torque = np.array([pin.rnea(robot.model, data, *row) for row in rows]).reshape(v.shape)
    shares = (v / robot.velocity_limit, acceleration / most, torque / robot.effort_limit)
    return Shares(*(np.abs(share) for share in shares))


def _check_weight(robot: Robot, joints: JointPath) -> None:
    """Raise ArgumentError where the arm cannot hold still on the path."""
    s, data = np.linspace(0.0, 1.0, INTERVALS + 1), robot.model.createData()
    weight = np.abs([pin.computeGeneralizedGravity(robot.model, data, q) for q in joints(s)])
    share = weight / robot.effort_limit
    if share.max() < 1.0:
        return
    k, i = np.argwhere(share >= 1.0)[0]
    (unit,) = units("torque", [robot.joints[i].prismatic])
    raise ArgumentError(
        f"joint '{robot.joint_names[i]}' needs {weight[k, i]:.4g} {unit} to hold its weight at {percent(s[k], 1)} of "
        f"the path, and {robot.effort_limit[i]:.4g} {unit} are left for the motion: {percent(share[k, i] - 1.0, 1)} "
        "are missing; choose another posture, raise the limit or give a smaller margin."
    )
