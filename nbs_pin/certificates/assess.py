"""Certification of a law for one task, with a search for its worst disturbance and the check of a recorded run."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from nbs_pin.accuracy.mismatch import Mismatch, mismatch
from nbs_pin.base.checks import PerJoint
from nbs_pin.base.exceptions import ArgumentError, SimulationDiverged
from nbs_pin.base.progress import waiting
from nbs_pin.base.records import Run
from nbs_pin.certificates.admissible import Admissible
from nbs_pin.certificates.attack import Attack, attack, random_disturbances
from nbs_pin.certificates.certificate import Certificate
from nbs_pin.certificates.certify import certify
from nbs_pin.certificates.encoders import Encoders
from nbs_pin.certificates.ensemble import motions_of
from nbs_pin.certificates.loads import MARGIN, gravity_error, payload, total
from nbs_pin.certificates.model_structure import is_exact
from nbs_pin.certificates.monitor import Monitored, monitor
from nbs_pin.certificates.propose import PERIODS, Proposal, propose
from nbs_pin.certificates.uncertainty import Uncertainty
from nbs_pin.controllers.lyapunov_law import LyapunovLaw
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.motions.references import DesiredMotion
from nbs_pin.robots.robot import Robot
from nbs_pin.simulation.dynamics_plant import DynamicsPlant
from nbs_pin.simulation.simulate import simulate

TRAJECTORIES = 374
"""Closed-loop trajectories from which the error of a learned model is bounded (`accuracy/mismatch.py`)."""


@dataclass(frozen=True, eq=False)
class Certified:
    """A certificate with the attack, the monitored run and the design that belong to it."""

    certificate: Certificate
    attack: Attack | None
    """The worst motion found; None without a disturbance, or if a motion diverged."""
    thorough: bool
    """Whether gradients were followed; otherwise only constants and square waves were tried."""
    diverged: str = ""
    """The error message if a motion diverged, otherwise empty."""
    exceeding: Monitored | None = None
    """The worst motion checked against the certificate, if any motion exceeded a bound."""
    watched: Monitored | None = None
    """The given run checked against the certificate."""
    proposal: Proposal | None = None
    interrupted: bool = False
    """Whether Ctrl-C ended the search for the worst motion early."""


@dataclass(frozen=True, eq=False)
class Task:
    """The motion, disturbance and true arm that a law is certified for."""

    reference: DesiredMotion
    duration: float = 10.0
    """Length of the reference that is used [s]."""
    period: float = 0.001
    """Control period [s]."""
    disturbance: Admissible | None = None
    """The disturbance given as numbers; loads are added to it."""
    payload: float | None = None
    """Payload that the model does not include [kg]."""
    link: str | None = None
    """The link that carries the payload; None takes `places.tool_frame`."""
    friction: JointFriction | None = None
    """Joint friction of the arm; None as in `certify`."""
    gravity_error: float | None = None
    """Largest ‖Δg‖ [m/s²]."""
    margin: float = MARGIN
    """Factor on the torques of the loads along the reference."""
    start_error: float = 0.0
    """Initial error of every joint, with alternating sign, for the bound of the overshoot [rad]."""
    truth: Robot | None = None
    """The true arm, if it is not the model's."""
    trajectories: int = TRAJECTORIES
    """Closed-loop trajectories from which the error of an inexact model is bounded."""
    uncertainty: Uncertainty | None = None
    """How far the true arm may differ from the law's model."""
    delay: float = 0.0
    """From a reading to the beginning of the hold of its torque [s]."""
    encoders: Encoders | None = None
    """What positions are read with; None for exact states."""
    seed: int = 0

    def loads(self, robot: Robot) -> tuple[Admissible, ...]:
        """The loads computed for the arm; raises ArgumentError if they do not fit it."""
        along: dict[str, Any] = {"duration": self.duration, "margin": self.margin}
        found = []
        if self.payload is not None:
            found.append(payload(robot, self.payload, self.reference, frame=self.link, **along))
        if self.gravity_error is not None:
            found.append(gravity_error(robot, self.gravity_error, self.reference, **along))
        return tuple(found)


def assess(
    controller: LyapunovLaw,
    task: Task,
    *,
    thorough: bool = False,
    run: Run | None = None,
    proposal: Proposal | None = None,
    progress: bool = False,
) -> Certified:
    """The certificate, the worst motion found (`thorough`: by gradients, too), and the check of a given run.

    Raises:
        CertificateRefused: If no bound can be given for the controller.
        ArgumentError: If task, run and controller do not fit each other.
    """
    robot = arm_of(controller, task)
    admissible = disturbance_of(robot, task)
    error, start = None, None
    if task.uncertainty is None and not is_exact(controller.dynamics, robot):
        error = model_error(controller, robot, task, admissible, progress)
    if task.start_error:
        start = task.reference(np.zeros(1)).q[0] + task.start_error * (-1.0) ** np.arange(robot.nv)
    with waiting("certifying", progress):
        certificate = certify(
            controller,
            admissible,
            reference=task.reference,
            duration=task.duration,
            q0=start,
            mismatch=error,
            period=task.period,
            delay=task.delay,
            encoders=task.encoders,
            robot=robot,
            friction=task.friction,
            uncertainty=task.uncertainty,
        )
    watched = None if run is None else monitor(run, certificate)
    try:
        found, diverged = _attacked(certificate, task, thorough, progress)
        interrupted = found is not None and found.interrupted
    except KeyboardInterrupt:  # the certificate needs no search
        found, diverged, interrupted = None, "", True
    exceeding = None
    if found is not None and exceeds(found, certificate):
        exceeding = monitor(found.run, certificate)
    return Certified(certificate, found, thorough, diverged, exceeding, watched, proposal, interrupted)


def exceeds(found: Attack, certificate: Certificate) -> bool:
    """Whether the largest errors found exceed a bound, of ‖z1‖ or of a joint."""
    return not (found.error <= certificate.error and bool((found.joint_errors <= certificate.joint_errors).all()))


def design(robot: Robot, task: Task, error: PerJoint, *, period: float | None = None) -> Proposal:
    """`propose` for the disturbance of the task; `period` fixes the control period [s], None takes the longest one."""
    admissible = disturbance_of(robot, task)
    periods = PERIODS if period is None else (period,)
    return propose(
        robot, admissible, error, reference=task.reference, duration=task.duration, periods=periods, seed=task.seed
    )


def arm_of(controller: LyapunovLaw, task: Task) -> Robot:
    """The true arm; raises ArgumentError if none is known or its number of joints differs."""
    robot = controller.dynamics.robot if task.truth is None else task.truth
    if robot is None:
        raise ArgumentError("the controller's model does not name its arm; give the true one with --against ROBOT.")
    if robot.nv != controller.nv:
        raise ArgumentError(f"the controller has {controller.nv} joints and {robot.name} {robot.nv}; give its own arm.")
    return robot


def disturbance_of(robot: Robot, task: Task) -> Admissible:
    """The total disturbance of the task; raises ArgumentError if it has none."""
    loads = task.loads(robot)
    given = [] if task.disturbance is None else [task.disturbance]
    if not (given or loads) and task.uncertainty is not None:
        return Admissible.of(np.zeros(robot.nv), robot.nv)
    if not (given or loads):
        raise ArgumentError("no disturbance was given; give --disturbance, --unknown-payload or --gravity-error.")
    return total(*given, *loads)


def model_error(
    controller: LyapunovLaw, robot: Robot, task: Task, admissible: Admissible, progress: bool = False
) -> Mismatch:
    """δ of the controller's model along closed loops on the true arm, with independent starts and disturbances.

    The loops last as long as the task. They start at rest within ±0.1 rad of the reference, or the start error of the
    task if it is larger, under random admissible disturbances.
    """
    truth, period, rng = PinocchioDynamics(robot), max(task.period, 0.002), np.random.default_rng((task.seed, 3))
    steps = math.ceil(task.duration / period - 1e-6)
    torques = random_disturbances(admissible, steps, period, task.trajectories, rng, nv=robot.nv)

    def disturbance(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        return torques[:, min(int(t / period + 1e-6), steps - 1)]

    largest = max(0.1, 1.05 * task.start_error)
    away = rng.uniform(-largest, largest, (task.trajectories, robot.nv))
    run = simulate(
        DynamicsPlant(truth, friction=controller.friction),
        controller,
        task.reference,
        steps * period,
        period,
        q0=task.reference(np.zeros(1)).q[0] + away,
        plant_step=period,
        disturbance=disturbance,
        effort_limit=robot.effort_limit,
        progress=progress,
    )
    return mismatch(controller.dynamics, truth, run, friction=controller.friction)


def _attacked(certificate: Certificate, task: Task, thorough: bool, progress: bool) -> tuple[Attack | None, str]:
    """The worst motion found or why one diverged; at rest, too, if the disturbance is not that of the reference."""
    if certificate.admissible.is_zero or certificate.robot is None:
        return None, ""
    controller, robot = certificate.controller, certificate.robot
    exact = is_exact(controller.dynamics, robot)
    free = thorough and exact and task.payload is None and task.gravity_error is None
    others = motions_of(controller.dynamics, None, task.seed)[1:] if free else []
    waves: dict[str, Any] = {} if thorough else {"rounds": 0, "starts": 1}
    try:
        found = attack(
            controller,
            certificate.admissible,
            reference=[task.reference, *others],
            plant_dynamics=None if exact else PinocchioDynamics(robot),
            period=task.period,
            seed=task.seed,
            progress=progress,
            **waves,
        )
    except SimulationDiverged as error:
        return None, str(error)
    return found, ""
