"""What a certificate in continuous time leaves out: the hold, delay, and limits of the motors."""

import numpy as np

from nbs_pin.certificates.admissible import Admissible
from nbs_pin.certificates.claims import Claim, Condition, Label
from nbs_pin.certificates.constants import configurations
from nbs_pin.controllers.neural_backstepping import NeuralBackstepping
from nbs_pin.dynamics.equations import inverse_dynamics
from nbs_pin.references import DesiredMotion

_INSTANTS = 2001
_RULE = "a rule that told calm from chatter in 52 runs of a panda (docs/theory.md §5), over sampled configurations"


def sampled_control(
    controller: NeuralBackstepping, period: float | None
) -> tuple[tuple[Claim, ...], tuple[Condition, ...]]:
    """The longest hold and delay of the two rules of sampled control [s], and the period held against the first.

    h < 2/(λ_max(M⁻¹D) + λ_max(Λ∇²Φ(0))) and delay < (π/2)/λ_max(M⁻¹D), D at z2 = 0, its inertial part ωM with it.
    """
    zero = np.zeros(controller.nv)
    damping = controller.damping.matrix(zero)
    mass = controller.dynamics.mass_matrix(configurations(controller.dynamics))
    speed = controller.inertial_rate + float(np.linalg.eigvals(np.linalg.solve(mass, damping)).real.max())
    columns = np.eye(controller.nv)
    curvature = controller.potential.terms(0.0 * columns, columns)[2]
    error_speed = float(np.linalg.eigvals(controller.rate.numpy()[:, None] * curvature).real.max())
    hold, delay = 2.0 / (speed + error_speed), 0.5 * np.pi / speed
    lines = (
        Claim("longest control period", hold, "s", Label.EMPIRICAL, _RULE),
        Claim("longest delay", delay, "s", Label.EMPIRICAL, _RULE),
    )
    if period is None:
        return lines, ()
    name = "control period: 2/(λ_max(M⁻¹D) + λ_max(Λ∇²Φ(0))) > h"
    return lines, (Condition(name, hold, period, "s", Label.EMPIRICAL, _RULE),)


def headroom(
    controller: NeuralBackstepping, admissible: Admissible, reference: DesiredMotion, duration: float
) -> tuple[Condition, ...]:
    """Whether every joint's effort limit exceeds what reference and disturbance ask of it together [N·m].

    One condition, of the joint with the least left: what feedback asks for beyond that depends on the motion.
    """
    robot = controller.dynamics.robot
    if robot is None or not np.isfinite(robot.effort_limit).any():
        return ()
    desired = reference(np.linspace(0.0, duration, _INSTANTS))
    needed = np.abs(inverse_dynamics(controller.dynamics, *desired)).max(axis=0)
    bound = admissible.box if admissible.box is not None else np.full(robot.nv, admissible.radius)
    total = needed + bound
    worst = int(np.argmin(robot.effort_limit - total))
    name = f"effort limit of {robot.joint_names[worst]} > reference + disturbance"
    because = f"torque of the reference over {duration:g} s; a condition that is necessary, not sufficient"
    return (Condition(name, float(robot.effort_limit[worst]), float(total[worst]), "N·m", Label.EMPIRICAL, because),)
