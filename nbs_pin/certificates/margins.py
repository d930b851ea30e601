"""Conditions that a certificate in continuous time does not include: sampling, delay, torque and position limits."""

import numpy as np
from jaxtyping import Float

from nbs_pin.base.arrays import JointArray
from nbs_pin.base.claims import Claim, Group, Label, refuse
from nbs_pin.certificates.admissible import Admissible
from nbs_pin.certificates.claims import Condition
from nbs_pin.certificates.constants import configurations
from nbs_pin.controllers.lyapunov_law import LyapunovLaw
from nbs_pin.dynamics.equations import inverse_dynamics
from nbs_pin.dynamics.provider import DynamicsProvider
from nbs_pin.motions.references import DesiredMotion
from nbs_pin.robots.robot import Robot

_INSTANTS = 2001
_RULE = "a rule that separated calm from chatter in 52 runs of a panda (docs/theory.md §5), at sampled configurations"


def sampled_control(controller: LyapunovLaw, period: float | None) -> tuple[tuple[Claim, ...], tuple[Condition, ...]]:
    """The longest hold and delay by the two rules of sampled control [s], and the period compared with the first.

    h < 2/(λ_max(M⁻¹D) + λ_max(Λ∇²Φ(0))) and delay < (π/2)/λ_max(M⁻¹D), with D(0) including its inertial part ωM.
    """
    zero = np.zeros(controller.nv)
    damping = controller.damping_matrix(zero)
    mass = controller.dynamics.mass_matrix(configurations(controller.dynamics))
    speed = controller.inertial_rate + float(np.linalg.eigvals(np.linalg.solve(mass, damping)).real.max())
    columns = np.eye(controller.nv)
    curvature = controller.potential_terms(0.0 * columns, columns)[2]
    error_speed = float(np.linalg.eigvals(controller.rate_like(zero)[:, None] * curvature).real.max())
    hold, delay = 2.0 / (speed + error_speed), 0.5 * np.pi / speed
    lines = (
        Claim("longest control period", hold, "s", Label.EMPIRICAL, _RULE, Group.SAMPLED),
        Claim("longest delay", delay, "s", Label.EMPIRICAL, _RULE, Group.SAMPLED),
    )
    if period is None:
        return lines, ()
    name = "control period: 2/(λ_max(M⁻¹D) + λ_max(Λ∇²Φ(0))) > h"
    return lines, (Condition(name, hold, period, "s", Label.EMPIRICAL, _RULE),)


def effort_margin(
    robot: Robot, dynamics: DynamicsProvider, admissible: Admissible, reference: DesiredMotion, duration: float
) -> tuple[Condition, ...]:
    """Whether every effort limit exceeds the torque of the reference plus the disturbance [N·m].

    The condition is that of the joint with the least margin. Feedback adds a torque that depends on the motion.
    """
    if not np.isfinite(robot.effort_limit).any():
        return ()
    desired = reference(np.linspace(0.0, duration, _INSTANTS))
    needed = np.abs(inverse_dynamics(dynamics, *desired)).max(axis=0)
    bound = admissible.box if admissible.box is not None else np.full(robot.nv, admissible.radius)
    total = needed + bound
    worst = int(np.argmin(robot.effort_limit - total))
    name = f"effort limit of {robot.joint_names[worst]} > torque of reference and disturbance"
    because = f"reference over {duration:g} s; necessary, not sufficient: feedback comes on top"
    return (Condition(name, float(robot.effort_limit[worst]), float(total[worst]), "N·m", Label.EMPIRICAL, because),)


def position_margin(
    robot: Robot, errors: JointArray, reference: DesiredMotion, duration: float
) -> tuple[Condition, ...]:
    """Whether the reference with its errors stays inside the position limits, for the joint with the least margin.

    Raises CertificateRefused if the reference alone leaves them.
    """
    positions = np.asarray(reference(np.linspace(0.0, duration, _INSTANTS)).q)
    check_box(positions, robot.lower, robot.upper)
    left = np.minimum(positions - robot.lower, robot.upper - positions).min(axis=0)
    joint = int(np.argmin(left - errors))
    if not np.isfinite(left[joint]):
        return ()
    name, because = f"room of {robot.joint_names[joint]} to its position limits > |z1_i|", f"over {duration:g} s"
    sides, unit = (float(left[joint]), float(errors[joint])), units(robot)[joint]
    return (Condition(name, *sides, unit, Label.EMPIRICAL, because),)


def units(robot: Robot | None, nv: int = 0) -> tuple[str, ...]:
    """Unit of each joint's position."""
    return ("rad",) * nv if robot is None else tuple("m" if joint.prismatic else "rad" for joint in robot.joints)


def check_box(
    positions: Float[np.ndarray, "rows n"],
    low: JointArray,
    high: JointArray,
    *,
    error: JointArray | float = 0.0,
    box: str = "the joint limits",
) -> Claim:
    """The least distance of the reference with its error to a side of a box [rad, m], over the given rows.

    positions: of the reference. low, high: sides of the box, ∓inf for none. error: bound of |z1_i|. box: its name in
    messages. The claim is EMPIRICAL, as nothing is checked between the rows.
    Raises CertificateRefused if the reference with its error leaves the box, or a number is NaN.
    """
    inside = np.minimum(positions - low, high - positions) - error
    if not positions.size or np.isnan(inside).any():
        refuse(f"the reference or {box} is empty or contains NaN", "give finite positions and sides")
    margin, joint = float(inside.min()), int(inside.min(axis=0).argmin())
    if margin < 0.0:
        refuse(
            f"the reference with its error leaves {box} at joint {joint + 1} by {-margin:.3g}",
            "give a larger box or a smaller motion",
        )
    because = f"least over {len(positions)} instants and all joints; nothing is checked between the instants"
    return Claim(f"reference inside {box}, least margin", margin, "rad", Label.EMPIRICAL, because)
