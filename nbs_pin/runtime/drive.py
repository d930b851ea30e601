"""The loop at a fixed rate: read, guard and law, write; recorded as a Run, with its times."""

import contextlib
import gc
import math
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from nbs_pin.base.arguments import DURATION, a, checked, flag, function, maybe
from nbs_pin.base.checks import PerJoint, told, whole
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.records import Reference, Run
from nbs_pin.base.shown import joints_told
from nbs_pin.certificates.certificate import Certificate
from nbs_pin.controllers.controller import CONTROLLER, Controller
from nbs_pin.dynamics.momentum_observer import OBSERVER, MomentumObserver
from nbs_pin.motions.approach import Approach
from nbs_pin.motions.references import MOTION, DesiredMotion, at_times, check_reference
from nbs_pin.robots.robot import ARM, Robot
from nbs_pin.runtime.arms import ArmInterface
from nbs_pin.runtime.guard import Counters, Guard, Mode
from nbs_pin.runtime.guarded import FaultReport, Guarded, Sample, Seen

BRAKING = 0.5
"""How long a stopped arm is braked before control is given up [s]."""
_PRIORITY, _REHEARSED = 50, 5
_STUCK = 2.0  # after the first Ctrl-C, when one ends an arm that does not answer [s]; braking takes 0.5 s
_CHECKED = 20_000  # instants at most at which the motion is compared with the limits


class Times(NamedTuple):
    """Times of a loop."""

    period: float
    """Control period [s]."""
    work: Float[np.ndarray, " instants"]
    """From a sample to its torque [s]."""
    missed: int
    """Periods that passed without a torque of their own."""
    priority: bool
    """Whether the system gave the loop a real-time priority."""

    @property
    def missed_share(self) -> float:
        """Share of the periods that were missed."""
        return self.missed / max(len(self.work) + self.missed, 1)


@dataclass(frozen=True, eq=False)
class Driven:
    """What came of a motion on an arm.

    Example:
        >>> import nbs_pin as nbs
        >>> robot = nbs.load_robot("two_link")
        >>> arm = nbs.PlantArm(nbs.MujocoPlant(robot), [0.0, 0.0], real_time=False)
        >>> still = nbs.Hold([0.0, 0.0])
        >>> driven = nbs.drive(arm, nbs.PD.for_robot(robot), robot, still, duration=0.1)
        >>> driven.run.q.shape, driven.report is None, driven.times.missed
        ((100, 2), True, 0)
    """

    run: Run
    """States, references and torques; gravity is in `tau` even where the arm adds it."""
    report: FaultReport | None
    """Why it stopped early, or None."""
    mode: Mode
    counters: Counters
    times: Times


class Live(NamedTuple):
    """What a watcher sees at an instant."""

    sample: Sample
    aim: Reference
    tau: np.ndarray
    mode: Mode
    counters: Counters


@checked(
    arm=a(ArmInterface, "an arm, such as PlantArm or FrankaArm"),
    law=CONTROLLER,
    robot=ARM,
    motion=MOTION,
    duration=DURATION,
    guard=maybe(a(Guard, "a Guard, such as Guard.for_robot(robot)")),
    approach=flag,
    watch=maybe(function(1, "a function of what is seen at an instant, or None")),
    priority=flag,
    observer=maybe(OBSERVER),
)
def drive(
    arm: ArmInterface,
    law: Controller,
    robot: Robot,
    motion: DesiredMotion,
    duration: float,
    *,
    guard: Guard | None = None,
    approach: bool = True,
    watch: Callable[[Live], Any] | None = None,
    priority: bool = False,
    observer: MomentumObserver | None = None,
) -> Driven:
    """Move an arm along a motion behind a guard, and stop it when the guard does, or on Ctrl-C.

    Called in the main thread it takes Ctrl-C (SIGINT) for itself until the arm has stopped: the arm is braked and the
    report says REQUESTED. In another thread, end it by what `watch` raises.

    Args:
        arm: The arm.
        law: The control law.
        robot: Its description.
        motion: The desired motion; its time 0 is the time of the arm's first sample.
        duration: How long [s], a whole number of periods; if the motion waits for the arm, so much longer.
        guard: Limits; None takes those of `Guard.for_robot` for this arm, its period and its torque rate.
        approach: Whether to lead from where the arm is to the motion (`Approach`), which may have to wait for that.
        watch: Called at every instant, with what must not take long; an exception of it stops the arm and is
            told in the run's `info`.
        priority: Ask the system for a real-time priority, which needs the right to have one.
        observer: What estimates the torque from outside where the arm does not tell it, as in `Guarded`.

    Raises:
        ArgumentError: If arm, law and robot do not fit, the motion with its approach leaves the limits of the robot
            (`check_reference`), or the arm does not start.

    Example:
        >>> import nbs_pin as nbs
        >>> robot = nbs.load_robot("two_link")
        >>> arm = nbs.PlantArm(nbs.MujocoPlant(robot), [0.0, 0.0], real_time=False)
        >>> law = nbs.NeuralBackstepping.for_robot(robot)
        >>> driven = nbs.drive(arm, law, robot, nbs.Hold([0.3, 0.2]), duration=2.0)
        >>> driven.report is None, bool(abs(driven.run.q[-1] - [0.3, 0.2]).max() < 1e-6)
        (True, True)
    """
    if arm.nv != robot.nv:
        raise ArgumentError(f"the arm has {joints_told(arm.nv)} and {robot.name} {robot.nv}; give its own description.")
    guard = guard_for(arm, robot) if guard is None else guard
    if guard.compensated != arm.compensated or abs(guard.period - arm.period) > 1e-9:
        raise ArgumentError("the guard is for another period, or another treatment of gravity; build it for the arm.")
    if arm.torque_rate is not None and (guard.torque_rate > arm.torque_rate).any():
        raise ArgumentError(
            f"the guard's torque_rate is {told(guard.torque_rate.tolist())}, beyond the arm's {told(arm.torque_rate)}"
            " N·m/s; give Guard.for_robot the arm's torque_rate."
        )
    steps = whole(duration, arm.period, "duration", "period", 10**7)
    here, guarded, led = arm.look(), Guarded(law, robot, guard, observer=observer), motion
    if approach:
        led = Approach.from_state(motion, robot, here.q)
        steps += math.ceil(led.lag / arm.period)
    check_reference(led, robot, steps * arm.period, samples=min(steps, _CHECKED) + 1)
    loop = _Loop(arm, guarded, led, watch, steps)
    loop.rehearse(here)
    with _undisturbed(priority) as granted, _interrupts(loop.ask):
        try:
            loop.run(here)
        finally:
            arm.stop()
    return loop.driven(robot, law.law_name, granted)


def _tells(sample: Sample) -> bool:
    return sample.fresh and bool(np.isfinite(sample.q).all() and np.isfinite(sample.v).all())


def guard_for(
    arm: ArmInterface, robot: Robot, certificate: Certificate | None = None, external_limit: PerJoint = np.inf
) -> Guard:
    """The guard of `Guard.for_robot` with the period, the torque rate and the gravity of a driver."""
    settings = {"torque_rate": arm.torque_rate, "external_limit": external_limit, "compensated": arm.compensated}
    return Guard.for_robot(robot, arm.period, certificate=certificate, **settings)


class _Loop:
    """A loop while it runs."""

    def __init__(
        self,
        arm: ArmInterface,
        guarded: Guarded,
        motion: DesiredMotion,
        watch: Callable[[Live], Any] | None,
        steps: int,
    ) -> None:
        self.arm, self.guarded, self.watch, self.steps = arm, guarded, watch, steps
        self.braking = round(BRAKING / arm.period)
        times = arm.period * np.arange(steps + 2.0)
        self.desired = at_times(motion, times, arm.nv)
        self.target = at_times(motion, times + guarded.lead, arm.nv)
        self.rows: list[tuple[int, Seen]] = []
        self.work = np.zeros(steps + self.braking + 1)
        self.missed, self.trouble, self.asked = 0, "", False

    def ask(self) -> None:
        """Ask for a stop at the next instant."""
        self.asked = True

    def aim(self, row: int) -> Reference:
        """The reference for which the law is evaluated in a row; after the end, that of the end."""
        return Reference(*(x[min(row, self.steps)] for x in self.target))

    def rehearse(self, here: Sample) -> None:
        """A few steps that are not sent, so that nothing is done for the first time when it counts."""
        self.guarded.begin(here.q, self.aim(0))
        for row in range(_REHEARSED):
            self.guarded.step(here._replace(t=row * self.arm.period, v=np.zeros(self.arm.nv)), self.aim(0))

    def run(self, here: Sample) -> None:
        """Until the end; after a stop for as long as it is braked, even beyond the end."""
        arm, guarded, h = self.arm, self.guarded, self.arm.period
        guarded.begin(here.q, self.aim(0))
        self.here = here
        self.first = sample = arm.start()
        row, overrun, left = 0, False, self.braking
        while left > 0 and ((row < self.steps and len(self.rows) <= self.steps) or guarded.report is not None):
            begun = time.perf_counter()
            aim = self.aim(row)
            tau = guarded.step(sample, aim, overrun=overrun, stop=self.asked)
            arm.write(tau)
            self.work[len(self.rows)] = spent = time.perf_counter() - begun
            self.rows.append((row, guarded.seen))
            overrun = spent > h
            if guarded.report is not None:
                left = 0 if sample.fault else left - 1  # an arm with a fault takes no torque
            self.show(Live(sample, aim, tau, guarded.mode, guarded.counters))
            try:
                sample = arm.read()
            except Exception as error:  # a plant may raise anything: nothing more is sent to it
                sample = sample._replace(fresh=False, fault=f"{type(error).__name__}: {error}")
            passed = self.passed(sample, row)
            self.missed += max(passed - 1, 0)
            row += passed

    def passed(self, sample: Sample, row: int) -> int:
        """Periods to the next sample: by the arm's clock where it can be; else one, and the guard judges the clock."""
        if not sample.fresh:
            return 1
        since = (sample.t - self.first.t) / self.arm.period - row
        return round(since) if -0.5 <= since <= self.guarded.guard.patience else 1

    def show(self, seen: Live) -> None:
        """Show an instant to the watcher; what it raises ends its watch and asks for a stop."""
        try:
            if self.watch is not None:
                self.watch(seen)
        except Exception as error:  # a watcher may raise anything: the arm is braked, and the run says why
            self.watch, self.trouble, self.asked = None, f"{type(error).__name__}: {error}", True

    def driven(self, robot: Robot, law: str, granted: bool) -> Driven:
        """What was recorded, on the raster of the periods."""
        rows = {row: seen for row, seen in self.rows if row <= self.steps and _tells(seen.sample)}
        rows.setdefault(0, self.rows[0][1]._replace(sample=self.here))
        at = np.array(sorted(rows))
        kept = [rows[k] for k in at.tolist()]
        q, v = np.array([seen.sample.q for seen in kept]), np.array([seen.sample.v for seen in kept])
        lift = self.guarded.gravity(q) if self.arm.compensated else 0.0
        tau = np.array([seen.tau for seen in kept]) + lift
        desired = Reference(*(x[at] for x in self.desired))
        run = Run(
            t=self.arm.period * at,
            q=q,
            v=v,
            tau=tau,
            tau_command=tau,
            disturbance=np.zeros_like(tau),
            q_ref=desired.q,
            v_ref=desired.v,
            a_ref=desired.a,
            effort_limit=robot.effort_limit,
            continuous=robot.continuous,
            joint_names=robot.joint_names,
            period=self.arm.period,
            robot=robot.source,
            robot_sha256=robot.sha256,
            robot_options=robot.options,
            prismatic=robot.prismatic,
            info={"controller": law, "arm": type(self.arm).__name__, "watcher": self.trouble},
        )
        times = Times(self.arm.period, self.work[: len(self.rows)], self.missed, granted)
        return Driven(run, self.guarded.report, self.guarded.mode, self.guarded.counters, times)


@contextlib.contextmanager
def _interrupts(ask: Callable[[], None]) -> Iterator[None]:
    """Ctrl-C asks, in place of an exception anywhere in a period, which would leave the arm with its last torque.

    One that comes `_STUCK` after the first is raised: braking has had its time, so the driver does not return.
    """
    before = signal.getsignal(signal.SIGINT)
    if before is None or threading.current_thread() is not threading.main_thread():
        yield  # signals come to the main thread alone, and a handler that is not Python's could not be restored
        return
    first = math.inf

    def interrupt(number: int, frame: Any) -> None:
        nonlocal first
        now = time.monotonic()
        if now - first >= _STUCK:
            raise KeyboardInterrupt
        first = min(first, now)
        ask()

    signal.signal(signal.SIGINT, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@contextlib.contextmanager
def _undisturbed(priority: bool) -> Iterator[bool]:
    """Without the garbage collector, and with a real-time priority if one is asked for and granted."""
    collecting, granted = gc.isenabled(), False
    gc.collect()
    gc.disable()
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    if priority:
        with contextlib.suppress(PermissionError):
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_PRIORITY))
            granted = True
    try:
        yield granted
    finally:
        if granted:
            os.sched_setscheduler(0, *before)
        if collecting:
            gc.enable()
