"""Checks before a simulation: motion and start against the limits of the arm, the law against the arm."""

import numpy as np
import pinocchio as pin

from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.units import units
from nbs_pin.controllers.controller import Controller
from nbs_pin.dynamics.provider import DynamicsProvider
from nbs_pin.motions.references import DesiredMotion, check_reference
from nbs_pin.robots.robot import Robot
from nbs_pin.simulation.loop import Loop

_SAMPLES = 501
"""Times at which the motion is compared with the limits."""
_NEAR, _TURNED = 0.02, 0.1
"""Joints of two models of one arm are at most this far apart [m] and turned [rad]: calibration stays below."""
_ROUNDING = 1e-9


def check_loop(
    loop: Loop, controller: Controller, reference: DesiredMotion, start: tuple[np.ndarray, np.ndarray]
) -> None:
    """Raise ArgumentError where the arm of the plant cannot do what is asked; nothing is known of a plant without one.

    The motion must be within the position, velocity and effort limits (`check_reference`), the start within the
    position limits, and the law must be for an arm with these joints: it may believe in another mass or load, but
    another arm is a mistake.
    """
    robot = loop.plant.robot
    if robot is None:
        return
    _check_law(controller, robot)
    limited = robot if np.array_equal(loop.limit, robot.effort_limit) else robot.with_effort_limit(loop.limit)
    friction = getattr(loop.plant, "joint_friction", "drop")
    check_reference(
        reference,
        limited,
        loop.steps * loop.period,
        samples=_SAMPLES,
        joint_friction="keep" if friction == "keep" else "drop",
    )
    _check_start(start[0].reshape(-1, robot.nv), robot)


def _check_start(q: np.ndarray, robot: Robot) -> None:
    outside = (q < robot.lower - _ROUNDING) | (q > robot.upper + _ROUNDING)
    if not outside.any():
        return
    k, i = np.argwhere(outside)[0]
    (unit,) = units("position", [robot.joints[i].prismatic])
    degrees = " (are these degrees?)" if abs(q[k, i]) > 2.0 * np.pi and unit == "rad" else ""
    raise ArgumentError(
        f"the start {q[k, i]:.6g} {unit} of joint '{robot.joint_names[i]}' is outside "
        f"[{robot.lower[i]:.6g}, {robot.upper[i]:.6g}]{degrees}; start inside, or simulate with check=False."
    )


def _check_law(controller: Controller, robot: Robot) -> None:
    """Raise ArgumentError unless the law's model has the joints of the arm; a law without a model is not judged."""
    dynamics = getattr(controller, "dynamics", None)
    other = dynamics.robot if isinstance(dynamics, DynamicsProvider) else None
    if other is None or other is robot or other.nv != robot.nv:
        return
    problem = ""
    if other.joint_names != robot.joint_names:
        problem = f"its joints are {', '.join(other.joint_names)}, those of the plant {', '.join(robot.joint_names)}"
    for i in range(1, robot.nv + 1):
        if not problem and not _alike(other.model, robot.model, i):
            problem = f"joint '{robot.joint_names[i - 1]}' is of another kind, or lies elsewhere on its link"
    if problem:
        raise ArgumentError(
            f"the law is for {other.name} and the plant is {robot.name}: {problem}; build both for one arm, or "
            "simulate with check=False."
        )


def _alike(one: pin.Model, other: pin.Model, joint: int) -> bool:
    """Whether the joint is at the same place on the same link, about or along the same axis.

    Of joints on the base only kind and axis are compared: how an arm is mounted is not part of it.
    """
    axes = [np.asarray(model.createData().joints[joint].S).ravel() for model in (one, other)]
    if one.parents[joint] != other.parents[joint]:
        return False
    if one.parents[joint] == 0:
        return bool(np.abs(axes[0] - axes[1]).max() <= _TURNED)
    apart = one.jointPlacements[joint].actInv(other.jointPlacements[joint])
    turned = np.abs(axes[0] - apart.action @ axes[1]).max() > _TURNED
    return bool(np.linalg.norm(apart.translation) <= _NEAR and not turned)
