"""The conditions of a certificate: what is at hand is compared with every assumption that it can contradict."""

import math
from dataclasses import replace

import numpy as np

from nbs_pin.base.arrays import JointArray
from nbs_pin.base.claims import Label, weakest
from nbs_pin.certificates.certificate import Certificate
from nbs_pin.certificates.claims import Assumption, Condition
from nbs_pin.certificates.margins import (
    effort_margin,
    hold_margin,
    position_margin,
    sampled_control,
    smoothness,
    start_margin,
    unsaturated,
    velocity_margin,
)
from nbs_pin.certificates.model_error import coverage
from nbs_pin.certificates.model_structure import EXACT, torque_difference
from nbs_pin.certificates.sampled_motion import SampledMotion
from nbs_pin.certificates.tried_motions import TriedMotions
from nbs_pin.certificates.uncertainty import Payload
from nbs_pin.dynamics.analytic import AnalyticDynamics
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.motions.references import DesiredMotion
from nbs_pin.robots.robot import Robot


def with_conditions(
    certificate: Certificate,
    reference: DesiredMotion | None,
    motion: SampledMotion | None,
    period: float | None,
    payload: Payload | None = None,
) -> Certificate:
    """The certificate with the conditions of its assumptions, for an arm that may carry that payload."""
    law, robot, start = certificate.controller, certificate.robot, certificate.start
    joints, reached, potential = certificate.joint_errors, certificate.storage, certificate.potential
    if start is not None and certificate.overshoot is not None:
        joints = np.maximum(joints, certificate.overshoot[1])
        reached, potential = max(reached, start.storage), max(potential, start.storage)
    margins, found = sampled_control(law, period, reached, potential)
    is_held = certificate.held is not None and certificate.held.is_proved
    if certificate.held is not None and (is_held or not certificate.held.readings.is_plain):
        found = (certificate.held.condition,)
    known = certificate.constants.label
    conditions = [
        Condition("Theorem 1: min(ρ, ω + κ) > 0", certificate.rate, 0.0, "1/s", known, "docs/certificates.md §2"),
        *certificate.model_error.conditions,
        *_dissipation(certificate),
        *certificate.friction.conditions,
        *_exactness(certificate),
        *found,
        *_no_wrap(robot, joints),
    ]
    if motion is not None:
        conditions += smoothness(motion)
    if motion is not None and period is not None and not is_held:
        metric = certificate.constants.metric
        bodies = 0.0 if certificate.bodies is None else certificate.bodies.torque
        conditions += hold_margin(law, metric, motion, period, certificate.admissible.energy(metric) + bodies**2)
    if motion is not None and reference is not None and certificate.mismatch is not None:
        errors = np.zeros(law.nv) if start is None else np.abs(law.dynamics.difference(start.q, start.begin.q))
        speeds = np.zeros(law.nv) if start is None else np.abs(start.v - start.begin.v)
        box, length = certificate.admissible.largest(law.nv), float(motion.t[-1])
        conditions += coverage(certificate.mismatch, reference, length, box, errors, speeds)
    if motion is not None and robot is not None:
        frictions = (law.friction, certificate.friction.gap.arm)
        conditions += effort_margin(robot, law.dynamics, certificate.admissible, motion, frictions)
        if certificate.held is not None:
            conditions += unsaturated(robot, law, motion, certificate.held.room)
        conditions += velocity_margin(robot, motion, 0.0 if start is None else start.v)
        conditions += position_margin(robot, joints, motion)
    if start is not None and robot is not None:
        conditions += start_margin(robot, law, (start.q, start.v), start.begin)
    if reference is not None and motion is not None and period is not None:
        arm = robot if robot is None or payload is None else payload.on(robot)
        conditions += _tried(certificate, arm, reference, motion, period, joints)
    return replace(certificate, margins=margins, conditions=tuple(conditions))


def _tried(
    certificate: Certificate,
    arm: Robot | None,
    reference: DesiredMotion,
    motion: SampledMotion,
    period: float,
    joints: JointArray,
) -> tuple[Condition, ...]:
    """What motions of the loop with that arm say of the bounds and of the effort limits."""
    start = certificate.start
    loop = certificate.controller, arm, certificate.friction.gap.arm, certificate.admissible
    begin = None if start is None else (start.q, start.v)
    readings = None if certificate.held is None else certificate.held.readings
    if readings is not None and not readings.is_plain:
        return ()  # late torques and encoders are not simulated
    lookahead = None if readings is None else readings.lookahead
    tried = TriedMotions.of(*loop, reference, float(motion.t[-1]), period, begin, lookahead)
    return () if tried is None else tried.conditions(arm, joints)


def _exactness(certificate: Certificate) -> tuple[Condition, ...]:
    """Whether a model that should be exact is that of the URDF, edits of its numbers included."""
    law, robot = certificate.controller, certificate.robot
    if robot is None or certificate.mismatch is not None or certificate.bodies is not None:
        return ()
    if type(law.dynamics) not in (PinocchioDynamics, AnalyticDynamics):
        return ()
    name = f"{EXACT:g} > difference of the model's torques from the URDF's, over these"
    because = "at generic states: both are linear in the parameters of the bodies"
    difference = torque_difference(law.dynamics, robot)
    return (Condition(name, EXACT, difference, "", Label.PROVED, because, checks=Assumption.MODEL),)


def _dissipation(certificate: Certificate) -> tuple[Condition, ...]:
    """The condition of Theorem 4, with what model error and friction add, if there are any."""
    bodies = () if certificate.bodies is None else certificate.bodies.lines
    lines = (*certificate.model_error.lines, *certificate.friction.lines, *bodies)
    if not lines:
        return ()
    k, label = certificate.comparison, weakest(*(line.label for line in lines))
    sides = 1.0 - k.beta, 0.25 * k.cross**2
    return (Condition("Theorem 4: 1 − β > α²/4", *sides, "", label, "docs/certificates.md §5, §8"),)


def _no_wrap(robot: Robot | None, joints: JointArray) -> tuple[Condition, ...]:
    if robot is None or not robot.continuous.any():
        return ()
    largest = float(joints[robot.continuous].max())
    name, because = "π > |z1_i| of every continuous joint", "its error jumps at ±π (docs/theory.md §1)"
    return (Condition(name, math.pi, largest, "rad", Label.PROVED, because, checks=Assumption.WRAP),)
