"""Checks before a simulation: motion and start against the limits of the arm, the law against the arm."""

import numpy as np

from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.units import units
from nbs_pin.controllers.controller import Controller
from nbs_pin.dynamics.provider import DynamicsProvider
from nbs_pin.motions.references import DesiredMotion, check_reference
from nbs_pin.robots.joint_differences import difference_of_joints
from nbs_pin.robots.robot import Robot
from nbs_pin.simulation.loop import Loop

_SAMPLES = 501
"""Times at which the motion is compared with the limits."""
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
    friction = getattr(loop.plant.at(0.0), "joint_friction", "drop")
    check_reference(
        reference,
        limited,
        loop.steps * loop.period,
        samples=_SAMPLES,
        joint_friction="keep" if friction == "keep" else "drop",
    )
    check_start(start[0].reshape(-1, robot.nv), robot)


def check_start(q: np.ndarray, robot: Robot) -> None:
    """Raise ArgumentError unless the starts (starts, n) are within the position limits."""
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
    problem = difference_of_joints(other, robot, "the plant")
    if problem:
        raise ArgumentError(
            f"the law is for {other.name} and the plant is {robot.name}: {problem}; build both for one arm, or "
            "simulate with check=False."
        )
