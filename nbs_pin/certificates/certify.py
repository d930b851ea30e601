"""`certify`: bounds of the tracking error under bounded disturbances, for laws with a storage function."""

import math
from dataclasses import replace
from typing import Any

import numpy as np

from nbs_pin.accuracy.mismatch import Mismatch
from nbs_pin.base.arguments import DURATION, PERIOD, a, checked, maybe, number
from nbs_pin.base.arrays import JointArray
from nbs_pin.base.checks import PerJoint, floats
from nbs_pin.base.claims import Claim, Group, Label
from nbs_pin.base.exceptions import ArgumentError, CertificateRefused
from nbs_pin.certificates.admissible import Admissible
from nbs_pin.certificates.bodies import bounds_for_all
from nbs_pin.certificates.body_error import BodyError
from nbs_pin.certificates.certificate import Certificate, Start
from nbs_pin.certificates.comparison_system import ComparisonSystem, decay, level, reach
from nbs_pin.certificates.conditions import with_conditions
from nbs_pin.certificates.constants import Constants, constants_of
from nbs_pin.certificates.encoders import Encoders
from nbs_pin.certificates.error_bounds import errors, radians
from nbs_pin.certificates.friction_error import FrictionError, FrictionGap, friction_error
from nbs_pin.certificates.held_torque import Readings, held_torque, unknown_before, unproved
from nbs_pin.certificates.model_error import ModelError, model_error
from nbs_pin.certificates.model_structure import is_exact
from nbs_pin.certificates.sampled_motion import SampledMotion
from nbs_pin.certificates.structure import lyapunov_law
from nbs_pin.certificates.uncertainty import Uncertainty
from nbs_pin.controllers.controller import CONTROLLER, Controller
from nbs_pin.controllers.lyapunov_law import LyapunovLaw
from nbs_pin.dynamics.friction import FRICTION, JointFriction
from nbs_pin.motions.references import MOTION, DesiredMotion
from nbs_pin.robots.robot import ARM, Robot

_NO_ERROR = ModelError(0.0, 0.0, 0.0, (), ())
_UNBOUNDED = "taken as 0, but nothing bounds it: give mismatch=compare(…).mismatch"
_UNKNOWN = Claim("error of the model", math.inf, "N·m", Label.EMPIRICAL, _UNBOUNDED, Group.MODEL_ERROR)
_UNKNOWN_ERROR = ModelError(0.0, 0.0, 0.0, (_UNKNOWN,), ())


@checked(
    controller=CONTROLLER,
    reference=maybe(MOTION),
    duration=maybe(DURATION),
    mismatch=maybe(a(Mismatch, "compare(…).mismatch")),
    period=maybe(PERIOD),
    lookahead=maybe(number(least=0.0, most=1000.0, unit="s")),
    delay=number(least=0.0, most=1000.0, unit="s"),
    encoders=maybe(a(Encoders, "Encoders, such as Encoders.of_bits(16)")),
    robot=maybe(ARM),
    friction=maybe(FRICTION),
    uncertainty=maybe(a(Uncertainty, "an Uncertainty, such as Uncertainty(inertia=0.05)")),
)
def certify(
    controller: Controller,
    disturbance: PerJoint | Admissible,
    *,
    reference: DesiredMotion | None = None,
    duration: float | None = None,
    q0: Any = None,
    v0: Any = None,
    mismatch: Mismatch | None = None,
    period: float | None = None,
    lookahead: float | None = None,
    delay: float = 0.0,
    encoders: Encoders | None = None,
    robot: Robot | None = None,
    friction: JointFriction | None = None,
    uncertainty: Uncertainty | None = None,
) -> Certificate:
    """Bound the tracking error of the closed loop under a bounded disturbance (docs/certificates.md).

    Friction that the law does not feed forward counts, with |v_d| from the reference or else the velocity limits.

    Args:
        controller: A law with a storage function (`LyapunovLaw`).
        disturbance: One bound per joint on |τ_d,i|, one number that bounds ‖τ_d‖ [N·m], or an `Admissible`.
        reference: The motion, for the arm's limits, friction, a start and a model error. All other bounds hold for any
            motion.
        duration: Length of the reference that is used [s]. None takes its own `duration`, or 10 s if it has none.
        q0: Start from which the overshoot is bounded [rad]. Needs the reference.
        v0: Velocity at the start [rad/s]. None starts at rest.
        mismatch: Error δ of a learned model along closed loops (`compare(…).mismatch`). Needs the reference.
        period: Control period, over which every torque is held [s]. With the reference, the bounds are those of the
            loop as it runs wherever that can be proved; else the period is compared with the rules of sampled control.
        lookahead: How far ahead of a reading the law is evaluated [s]; None takes the delay and half a period.
        delay: From the reading of a state to the beginning of the hold of its torque [s], 0 to a period.
        encoders: Positions are rounded to their steps, and velocities are differences over a period; None is exact.
        robot: The true arm. None takes the model's.
        friction: Joint friction of the arm. None takes the URDF's; without an arm, that which is fed forward.
        uncertainty: How far bodies and friction of the arm may differ from the law's model and from the friction
            stated; the bounds hold for every such arm (docs/certificates.md §14). Bodies need the reference.

    Raises:
        CertificateRefused: If law, model or reference do not admit a bound.
        ArgumentError: If arguments do not fit each other.

    Example:
        >>> import nbs_pin as nbs
        >>> certificate = nbs.certify(nbs.NeuralBackstepping.for_robot(nbs.load_robot("two_link")), [5.0, 5.0])
        >>> print(f"{certificate.label}: ‖z1‖ ≤ {certificate.error:.2f} rad")
        PROVED: ‖z1‖ ≤ 0.02 rad
    """
    law = lyapunov_law(controller)
    arm = law.dynamics.robot if robot is None else robot
    start = _check_arguments(law, arm, reference, duration, q0, v0, mismatch, period)
    bodies = _uncertain_bodies(uncertainty, reference, mismatch)
    _check_readings(period, bodies, delay, encoders)
    gap = _friction(law, arm, friction, uncertainty)
    constants, admissible = constants_of(law, gap.damping), Admissible.of(disturbance, law.nv)
    motion = _sampled(law.nv, reference, duration)
    error = _NO_ERROR if bodies is not None else _model_error(law, arm, constants, mismatch, motion)
    rest = _friction_error(gap, constants, arm, motion)
    comparison = _comparison(constants, admissible, error, rest)
    if bodies is not None and reference is not None and motion is not None:
        found = bounds_for_all(law, bodies, constants, comparison, rest, reference, motion, start)
        read = None if period is None else Readings.of(period, lookahead, delay, None)
        certificate = _for_all(found, law, admissible, constants, rest, arm, start, read)
        return with_conditions(certificate, reference, motion, period, bodies.payload)
    least = level(comparison)
    if not math.isfinite(least.storage):
        raise CertificateRefused(_why_not(comparison, mismatch is not None, bool(rest.lines)))
    potential = reach(comparison, least.storage)
    size, joints, source = errors(law, constants, comparison, least.storage, potential)
    known = (law, admissible, constants, error, rest, comparison, 0.5 * decay(comparison), least, potential)
    certificate = Certificate(*known, size, joints, source, robot=arm, mismatch=mismatch, start=start)
    if period is not None:
        steps = None if encoders is None else encoders.resolution(certificate)
        certificate = _held(certificate, reference, motion, Readings.of(period, lookahead, delay, steps))
    return with_conditions(certificate, reference, motion, period)


def _held(
    certificate: Certificate, reference: DesiredMotion | None, motion: SampledMotion | None, readings: Readings
) -> Certificate:
    """The certificate with the bounds of the held torque in place of those in continuous time, if they are proved."""
    law, constants = certificate.controller, certificate.constants
    inexact = certificate.mismatch is not None or bool(certificate.model_error.lines)
    other = "an inexact model is not part of the proof" if inexact else ""
    if certificate.start is not None and not readings.is_plain:
        other = other or "a start away from the reference is not part of the proof with a delay or encoders"
    jerk = _jerk(reference, motion)
    if not readings.is_plain and reference is not None and motion is not None and jerk is not None:
        other = other or unknown_before(reference, law.nv, jerk, readings.oldest)
        # The first readings are of the time before t = 0.
        motion = SampledMotion.of(lambda t: reference(t - readings.oldest), law.nv, motion.t[-1] + readings.oldest)
    gap = certificate.friction.gap
    # Of friction known to a share, the least is in D₀, and the most acts.
    friction = 2.0 * gap.arm.viscous - gap.damping, np.abs(gap.viscous)
    loop = law, certificate.robot, constants, certificate.comparison, *friction
    begin = 0.0 if certificate.start is None else certificate.start.storage
    held = held_torque(*loop, motion, jerk, certificate.storage, begin, readings, other)
    if not held.is_proved:
        return replace(certificate, held=held)
    size, joints = radians(constants.stiffness, held.potential)
    source = f"Φ ≥ z1ᵀSz1, every {readings} along the reference, docs/certificates.md §13"
    return replace(certificate, held=held, potential=held.potential, error=size, joint_errors=joints, source=source)


def _jerk(reference: DesiredMotion | None, motion: SampledMotion | None) -> JointArray | None:
    """The bound of |ȧ_d| that a reference states for as long as it lasts; None without one."""
    stated = getattr(reference, "largest_jerk", None)
    if stated is None or motion is None or motion.t[-1] > getattr(reference, "duration", math.inf) * (1.0 + 1e-12):
        return None
    jerk = floats("largest_jerk of the reference", stated)
    if jerk.shape != motion.q.shape[1:] or not (jerk >= 0.0).all():
        raise ArgumentError(f"largest_jerk of the reference is {stated!s:.80}, expected one number ≥ 0 per joint.")
    return jerk if np.isfinite(jerk).all() else None


def _check_arguments(
    law: LyapunovLaw,
    robot: Robot | None,
    reference: DesiredMotion | None,
    duration: float | None,
    q0: Any,
    v0: Any,
    mismatch: Mismatch | None,
    period: float | None,
) -> Start | None:
    """The start, None without one."""
    if robot is not None and robot.nv != law.nv:
        raise ArgumentError(f"the controller has {law.nv} joints and {robot.name} {robot.nv}; give its own arm.")
    if reference is None and mismatch is not None:
        raise ArgumentError("mismatch refers to a motion; give the reference too.")
    return Start.of(law, reference, q0, v0)


def _check_readings(period: float | None, bodies: Uncertainty | None, delay: float, encoders: Encoders | None) -> None:
    if (period is None or bodies is not None) and (delay or encoders is not None):
        raise ArgumentError("delay and encoders need the control period and certain bodies; give period, omit inertia.")


def _uncertain_bodies(
    uncertainty: Uncertainty | None, reference: DesiredMotion | None, mismatch: Mismatch | None
) -> Uncertainty | None:
    """The uncertainty if it is one of bodies; raises ArgumentError if it does not fit the other arguments."""
    if uncertainty is None or not uncertainty.of_bodies:
        return None
    if reference is None:
        raise ArgumentError("uncertain bodies are bounded along a motion; give the reference too.")
    if mismatch is not None:
        raise ArgumentError("uncertainty and mismatch both state the error of the model; give one of them.")
    return uncertainty


def _for_all(
    found: BodyError,
    law: LyapunovLaw,
    admissible: Admissible,
    constants: Constants,
    friction: FrictionError,
    robot: Robot | None,
    start: Start | None,
    read: Readings | None,
) -> Certificate:
    """The certificate of a loop with uncertain bodies."""
    why_not = "bodies that are not known are not part of the proof"
    return Certificate(
        held=None if read is None else unproved(read, law.nv, why_not),
        controller=law,
        admissible=admissible,
        constants=constants,
        model_error=_NO_ERROR,
        friction=friction,
        comparison=found.comparison,
        rate=0.5 * found.level.c,
        level=found.level,
        potential=found.potential,
        error=found.error,
        joint_errors=found.joint_errors,
        source="response to every error of the bodies, and V' for the rest, docs/certificates.md §14",
        bodies=found,
        robot=robot,
        start=start,
    )


def _friction(
    law: LyapunovLaw, robot: Robot | None, friction: JointFriction | None, uncertainty: Uncertainty | None
) -> FrictionGap:
    """The gap between the arm's friction and that which is fed forward."""
    if friction is None:
        friction = law.friction if robot is None else JointFriction.of(robot)
    if friction is not None and friction.viscous.size != law.nv:
        raise ArgumentError(f"friction is for {friction.viscous.size} joints and the law has {law.nv}; give its own.")
    shares = (0.0, 0.0) if uncertainty is None else (uncertainty.viscous, uncertainty.coulomb)
    return FrictionGap.of(law.nv, friction, law.friction, shares)


def _sampled(nv: int, reference: DesiredMotion | None, duration: float | None) -> SampledMotion | None:
    """The reference over the duration, or over its own."""
    if reference is None:
        return None
    return SampledMotion.of(reference, nv, getattr(reference, "duration", 10.0) if duration is None else duration)


def _model_error(
    law: LyapunovLaw, robot: Robot | None, constants: Constants, mismatch: Mismatch | None, motion: SampledMotion | None
) -> ModelError:
    if mismatch is not None and motion is not None:
        return model_error(constants, mismatch, motion)
    return _NO_ERROR if is_exact(law.dynamics, robot) else _UNKNOWN_ERROR


def _friction_error(
    gap: FrictionGap, constants: Constants, robot: Robot | None, motion: SampledMotion | None
) -> FrictionError:
    if motion is not None:
        return friction_error(gap, constants, motion.speed, f"over {motion.t[-1]:g} s of the reference")
    speed = np.full(len(gap.viscous), np.inf) if robot is None else robot.velocity_limit
    return friction_error(gap, constants, speed, "at most the velocity limit")


def _comparison(
    constants: Constants, admissible: Admissible, error: ModelError, friction: FrictionError
) -> ComparisonSystem:
    return ComparisonSystem(
        rho=constants.rho,
        delta=constants.delta,
        kappa=constants.kappa,
        nu=constants.nu,
        omega=constants.omega,
        t=math.sqrt(admissible.energy(constants.metric)) + error.t + friction.t,
        alpha=error.alpha + friction.alpha,
        beta=error.beta,
        power=friction.gap.power,
        coupling=constants.coupling,
    )


def _why_not(k: ComparisonSystem, has_mismatch: bool, has_friction: bool) -> str:
    if not k.is_dissipative:
        causes = ["the model's error"] * has_mismatch + ["joint friction that is not fed forward"] * has_friction
        remedies = ["learn a better model"] * has_mismatch + ["feed the friction forward"] * has_friction
        return (
            f"Theorem 4 requires 1 − β > α²/4; with {' and '.join(causes)}, 1 − β = {1.0 - k.beta:.3g} and α²/4 = "
            f"{0.25 * k.cross**2:.3g}; {', '.join(remedies)} or take a larger D₀."
        )
    return (
        f"no bound follows from ρ = {k.rho:.3g}, ω = {k.omega:.3g} and κ = {k.kappa:.3g} 1/s: D must dominate M, "
        "which an inertial rate ω > 0 ensures for every arm; take the damping 'inertial', as that of nbs is."
    )
