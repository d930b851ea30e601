"""What a reference must leave of the limits of an arm, so that the arm keeps them whatever disturbs it."""

import math
from typing import Any

import numpy as np

from nbs_pin.base.arguments import checked, joints, maybe
from nbs_pin.base.arrays import JointArray
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.certificates.certificate import CERTIFICATE, Certificate
from nbs_pin.certificates.coriolis import CoriolisBounds, MotionBounds
from nbs_pin.certificates.effort_bound import Asked, speed_bound, torque_bound
from nbs_pin.certificates.held_torque import why_no_arm_bounds
from nbs_pin.certificates.sampled_law import Curvature, SampledLaw
from nbs_pin.motions.limits import Margins
from nbs_pin.robots.robot import Robot


@checked(
    certificate=CERTIFICATE,
    acceleration=joints(above=0.0, unit="rad/s²"),
    velocity=maybe(joints(above=0.0, unit="rad/s")),
)
def certified_margins(certificate: Certificate, acceleration: Any, velocity: Any = None) -> Margins:
    """The distance from its limits that a reference must keep, so that the arm stays within them.

    Position margins bound |z1_i|, velocity margins |v_i − v_d,i|, and effort margins the difference of each torque of
    the law, friction that it feeds forward included, from M(q_d)a_d + C(q_d, v_d)v_d + G(q_d): on {V ≤ V̄} with
    V̄ = max(V(0), V∞), from a start on the reference or the one certified, for every admissible disturbance
    (docs/certificates.md §15). They are known like the certificate's bounds (`Certificate.label`), in continuous time:
    a torque that is held for a period, evaluated ahead of its reading, is not covered by the velocity and effort
    margins.

    Args:
        certificate: Of the law, for the exact model of an arm.
        acceleration: Largest |a_d| of the reference, one number or one per joint [rad/s²].
        velocity: Largest |v_d| [rad/s]; None takes the velocity limits of the arm.

    Returns:
        Margins for `tool_motion`. That the motion is no faster than `velocity` and `acceleration` say is for the caller
        to see to: `fastest` takes the same acceleration, and limits of the arm bound the velocity.

    Raises:
        ArgumentError: If the bounds of the certificate are not those of every such reference (a model that is not the
            arm's, held torques, viscous friction counted for a slower one), nothing bounds a joint, or the arm states
            no velocity limit and none is given.

    Example:
        >>> import nbs_pin as nbs
        >>> law = nbs.NeuralBackstepping.for_robot(nbs.load_robot("two_link"), bandwidth=20.0)
        >>> margins = nbs.certified_margins(nbs.certify(law, 1.0), acceleration=2.0, velocity=1.0)
        >>> bool((margins.position < 0.01).all() and (margins.effort < 50.0).all())
        True
    """
    robot, law, constants = certificate.robot, certificate.controller, certificate.constants
    why_not = why_no_arm_bounds(law, robot) or _why_not(certificate)
    if why_not or robot is None:
        raise ArgumentError(f"certified_margins bounds no motion of the arm: {why_not}.")
    fastest = _fastest(certificate, robot, velocity)
    arm = CoriolisBounds.of(robot, constants)
    motion = _within(arm, constants.floor, fastest, _one_each(robot, "acceleration", acceleration))
    level = max(certificate.storage, 0.0 if certificate.start is None else certificate.start.storage)
    t, alpha = certificate.comparison.t, certificate.comparison.alpha
    loop = SampledLaw(law, constants, arm, motion, t, alpha, np.zeros(robot.nv), 0.0, 0.0)
    asked = Asked(law, constants, *Curvature.with_diagonal(loop, level), level)
    position = certificate.joint_errors if certificate.overshoot is None else certificate.overshoot[1]
    effort, speed = torque_bound(asked, arm, motion, half=0.0), speed_bound(asked, arm)
    if law.friction is not None:
        effort = effort + law.friction.viscous * fastest + law.friction.coulomb
    if not np.isfinite([position, speed, effort]).all():
        raise ArgumentError(
            f"nothing bounds the velocities or torques of {robot.name} in every pose; lock joints that slide behind "
            "others, or take a law with bounded stiffness (potential 'smooth')."
        )
    return Margins(position, speed, effort)


def _why_not(certificate: Certificate) -> str:
    """Why the bounds of a certificate are not those of every reference of an arm; empty if they are."""
    if certificate.bodies is not None or certificate.mismatch is not None or certificate.model_error.lines:
        return "the model differs from the arm; certify a law with the model of the arm"
    if certificate.held is not None and certificate.held.is_proved:
        return "its bounds with held torques are those of one reference; certify without a period"
    if not certificate.storage > 0.0:
        return "the certificate allows no disturbance; certify for one above 0"
    return ""


def _fastest(certificate: Certificate, robot: Robot, velocity: JointArray | None) -> JointArray:
    """Largest |v_d| of the references [rad/s]; raises ArgumentError without one, or if bounds are of slower ones."""
    fastest = _one_each(robot, "velocity", robot.velocity_limit if velocity is None else velocity)
    if not np.isfinite(fastest).all():
        joint = robot.joint_names[int(np.argmin(np.isfinite(fastest)))]
        raise ArgumentError(f"joint '{joint}' of {robot.name} has no velocity limit; give velocity=… too.")
    friction = certificate.friction
    if friction.gap.viscous.any() and (fastest > friction.speed).any():
        joint = robot.joint_names[int(np.argmax(fastest > friction.speed))]
        raise ArgumentError(
            f"the certificate counts the viscous friction of joint '{joint}' for a slower reference than the velocity "
            "given; certify without a reference, or give a lower velocity."
        )
    return fastest


def _one_each(robot: Robot, what: str, values: JointArray) -> JointArray:
    if values.size not in (1, robot.nv):
        raise ArgumentError(
            f"{what} has {values.size} numbers for the {robot.nv} joints of {robot.name}; give one, or one each."
        )
    return np.full(robot.nv, values)


def _within(arm: CoriolisBounds, floor: np.ndarray, v: JointArray, a: JointArray) -> MotionBounds:
    """The bounds of all references with |v_d,i| ≤ v_i and |a_d,i| ≤ a_i."""
    turning = np.abs(arm.links) @ v
    turn, turn_d = min(arm.relative @ v, arm.link_relative @ turning), min(arm.by_floor @ v, arm.link_floor @ turning)
    speed, acceleration = (math.sqrt(x @ np.abs(floor) @ x) for x in (v, a))
    return MotionBounds(v, float(turn), float(turn_d), float(v.sum()), speed, acceleration, 0.0)
