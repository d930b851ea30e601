"""One faulty loop: an arm in MuJoCo, its law behind the guard, and something that goes wrong between them."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from nbs_pin.base.arrays import JointArray
from nbs_pin.base.exceptions import SimulationDiverged
from nbs_pin.base.records import Reference
from nbs_pin.certificates.certificate import Certificate
from nbs_pin.certificates.certify import certify
from nbs_pin.controllers.controller import Controller
from nbs_pin.controllers.neural_backstepping import NeuralBackstepping
from nbs_pin.motions.approach import Approach
from nbs_pin.motions.references import Sinusoid, at_times
from nbs_pin.robots.robot import Robot, configuration_difference, load_robot
from nbs_pin.runtime.franka_arm import FrankaArm
from nbs_pin.runtime.guard import Counters, Guard
from nbs_pin.runtime.guarded import FaultReport, Guarded, Sample
from nbs_pin.simulation.mujoco_plant import MujocoPlant
from nbs_pin.simulation.plant import Plant

PERIOD = 0.001
"""Control period of all trials but those of other rates [s]."""
STRIKE = 1000
"""Instant at which faults that begin in the motion begin."""
LATE = 0.5
"""RMS errors are over the time from here on [s]."""
RATES = {"panda": FrankaArm.torque_rate}
"""Torque rates that the drivers of arms state [N·m/s]."""
_AFTER_STOP = 300  # instants that a trial goes on after a stop


class Arm(NamedTuple):
    """An arm with its law and its motion, all by default."""

    robot: Robot
    law: NeuralBackstepping
    plant: MujocoPlant
    motion: Sinusoid

    def guard(self, period: float = PERIOD, robot: Robot | None = None) -> Guard:
        """With the torque rate of its driver, for the arm or for another with its name."""
        return Guard.for_robot(robot or self.robot, period, torque_rate=RATES.get(self.robot.name))

    @property
    def certificate(self) -> Certificate:
        """For torques up to `push`."""
        return _certificate(self.robot.name)

    @property
    def push(self) -> JointArray:
        """5 N·m on every joint, or a tenth of its effort limit where that is less [N·m]."""
        return np.asarray(np.minimum(5.0, 0.1 * self.robot.effort_limit))


@lru_cache(maxsize=8)
def arm_named(name: str) -> Arm:
    """The arm of that name; built once in a process."""
    robot = load_robot(name)
    return Arm(robot, NeuralBackstepping.for_robot(robot), MujocoPlant(robot), Sinusoid.for_robot(robot))


@lru_cache(maxsize=8)
def _certificate(name: str) -> Certificate:
    arm = arm_named(name)
    return certify(arm.law, arm.push)


def _same(k: int, x: Any) -> Any:
    return x


@dataclass(frozen=True, eq=False)
class Trial:
    """A loop and what goes wrong in it; by default nothing does."""

    arm: Arm
    seconds: float = 2.0
    plant: Plant | None = None
    law: Controller | None = None
    guard: Guard | None = None
    period: float = PERIOD
    """Period of the loop [s]; the law and the guard have their own."""
    start: tuple[JointArray, JointArray] | None = None
    """Start (q, v); None is on the motion."""
    approach: bool = False
    """Whether the motion begins with an approach from the start."""
    sense: Callable[[int, Sample], Sample] = _same
    """What becomes of the sample at an instant."""
    aim: Callable[[int, Reference], Reference] = _same
    """What becomes of the reference."""
    act: Callable[[int, JointArray], JointArray] = _same
    """What becomes of the torque."""
    push: Callable[[int, float], Any] = field(default=lambda k, t: 0.0)
    """Torque from outside [N·m], at an instant and a time."""
    calls: Callable[[int], bool] = field(default=lambda k: True)
    """Whether the law is called at an instant."""
    overruns: Callable[[int], bool] = field(default=lambda k: False)
    """Whether it is told at an instant that the last call came back late."""
    delay: int = 0
    """Instants between a torque and its action."""

    def run(self) -> "Outcome":
        """Simulate until the end, a while after a stop, or the divergence of the plant."""
        return _run(self)


@dataclass(frozen=True, eq=False)
class Outcome:
    """What a trial came to."""

    error: Float[np.ndarray, "rows n"]
    """True z1 at every instant [rad]."""
    tau: Float[np.ndarray, "rows n"]
    """Torque that left the guard [N·m]."""
    period: float
    guard: Guard
    report: FaultReport | None
    stopped: int
    """Instant of the stop; the number of instants if there was none."""
    degraded: bool
    counters: Counters
    diverged: str = ""
    """What the plant said when it diverged."""

    @cached_property
    def norm(self) -> Float[np.ndarray, " rows"]:
        """‖z1‖ [rad]."""
        return np.linalg.norm(self.error, axis=-1)

    @property
    def rms(self) -> float:
        """Root mean square of ‖z1‖ from `LATE` on [rad]."""
        return float(np.sqrt(np.mean(self.norm[min(round(LATE / self.period), len(self.norm) - 1) :] ** 2)))

    @property
    def peak(self) -> float:
        """Largest |z1_i| until the stop [rad]."""
        return float(np.abs(self.error[: self.stopped + 1]).max())

    @property
    def code(self) -> str:
        """Name of the fault that stopped it, or empty."""
        return "" if self.report is None else self.report.code.name

    def stops(self, *codes: str, within: float, after: int = STRIKE) -> bool:
        """Whether it stopped for one of these faults, at most `within` [s] after an instant."""
        passed = (self.stopped - after) * self.period
        return self.code in codes and -1e-9 <= passed <= within + 1e-9

    @property
    def is_legal(self) -> bool:
        """Whether every torque was finite, within the effort limits and within the torque rate."""
        most, step = self.guard.effort_limit, self.guard.torque_rate * self.guard.period
        changes = np.abs(np.diff(self.tau, axis=0))
        return bool(np.isfinite(self.tau).all() and (np.abs(self.tau) <= most).all() and (changes <= step).all())


def _run(trial: Trial) -> Outcome:
    arm, h = trial.arm, trial.period
    guard = arm.guard(h) if trial.guard is None else trial.guard
    plant = trial.plant or arm.plant
    guarded = Guarded(trial.law or arm.law, arm.robot, guard)
    steps = round(trial.seconds / h)
    times = h * np.arange(steps + 1.0)
    begin = arm.motion(0.0)
    q, v = (begin.q, begin.v) if trial.start is None else trial.start
    motion = Approach.from_state(arm.motion, arm.robot, q, v) if trial.approach else arm.motion
    desired, target = (at_times(motion, times + lead, arm.robot.nv) for lead in (0.0, guarded.lead))
    guarded.begin(q, desired_at(desired, 0))
    errors, torques = [], []
    degraded, stopped, diverged, tau = False, steps, "", guarded.tau
    waiting = [tau] * trial.delay
    for k in range(steps):
        t = float(times[k])
        errors.append(configuration_difference(q, desired.q[k], arm.robot.continuous))
        if trial.calls(k):
            sample, aim = trial.sense(k, Sample(t, q, v)), trial.aim(k, desired_at(target, k))
            tau = guarded.step(sample, aim, overrun=trial.overruns(k))
            torques.append(tau)
            degraded = degraded or guarded.mode.name == "DEGRADED"
        if guarded.report is not None and stopped == steps:
            stopped = k
        if k >= stopped + _AFTER_STOP:
            break
        waiting.append(tau)
        try:
            q, v = plant.step(q, v, trial.act(k, waiting.pop(0)) + trial.push(k, t), h)
        except SimulationDiverged as error:
            diverged = str(error)
            break
    return Outcome(
        error=np.array(errors),
        tau=np.array(torques),
        period=h,
        guard=guard,
        report=guarded.report,
        stopped=stopped,
        degraded=degraded,
        counters=guarded.counters,
        diverged=diverged,
    )


def desired_at(rows: Reference, k: int) -> Reference:
    """Row k of a reference."""
    return Reference(rows.q[k], rows.v[k], rows.a[k])


def burst(length: int) -> Callable[[int, Sample], Sample]:
    """Samples that do not arrive from `STRIKE` on, so many in a row."""
    return lambda k, sample: sample._replace(fresh=not STRIKE <= k < STRIKE + length)


def frozen(length: int) -> Callable[[int, Sample], Sample]:
    """Readings that stay while time goes on, from `STRIKE` on, for so many instants."""
    last: list[Sample] = []

    def sense(k: int, sample: Sample) -> Sample:
        if not STRIKE <= k < STRIKE + length:
            last[:] = [sample]
            return sample
        return last[0]._replace(t=sample.t)

    return sense


def spoilt(length: int, value: float, i: int) -> Callable[[int, Sample], Sample]:
    """A position of joint i that is no number, from `STRIKE` on, for so many instants."""

    def sense(k: int, sample: Sample) -> Sample:
        if not STRIKE <= k < STRIKE + length:
            return sample
        q = sample.q.copy()
        q[i] = value
        return sample._replace(q=q)

    return sense


def in_gravity(arm: Arm, gravity: JointArray) -> NeuralBackstepping:
    """A law that believes in another gravity [m/s²]."""
    model = arm.robot.model.copy()
    model.gravity.linear = gravity
    return NeuralBackstepping.for_robot(replace(arm.robot, model=model, gravity_vector=gravity))
