"""The loop at a fixed rate: read, guard and law, write; recorded as a Run, with its times."""

import contextlib
import gc
import math
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from nbs_pin.base.arguments import DURATION, a, checked, flag, function, maybe
from nbs_pin.base.checks import whole
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.records import Reference, Run
from nbs_pin.controllers.controller import CONTROLLER, Controller
from nbs_pin.motions.approach import Approach
from nbs_pin.motions.references import MOTION, DesiredMotion, at_times, check_reference
from nbs_pin.robots.robot import ARM, Robot
from nbs_pin.runtime.arms import ArmInterface
from nbs_pin.runtime.guard import Counters, Guard, Mode
from nbs_pin.runtime.guarded import FaultReport, Guarded, Sample

BRAKING = 0.5
"""How long a stopped arm is braked before control is given up [s]."""
_PRIORITY, _REHEARSED = 50, 5
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
) -> Driven:
    """Move an arm along a motion behind a guard, and stop it when the guard does, or on Ctrl-C.

    Args:
        arm: The arm.
        law: The control law.
        robot: Its description.
        motion: The desired motion; its time 0 is the time of the arm's first sample.
        duration: How long [s], a whole number of periods; if the motion waits for the arm, so much longer.
        guard: Limits; None takes those of `Guard.for_robot` for this arm and period.
        approach: Whether to lead from where the arm is to the motion (`Approach`), which may have to wait for that.
        watch: Called at every instant, with what must not take long; an exception of it stops the arm and is
            told in the run's `info`.
        priority: Ask the system for a real-time priority, which needs the right to have one.

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
        raise ArgumentError(f"the arm has {arm.nv} joints and {robot.name} {robot.nv}; give its own description.")
    guard = Guard.for_robot(robot, arm.period, compensated=arm.compensated) if guard is None else guard
    if guard.compensated != arm.compensated or abs(guard.period - arm.period) > 1e-9:
        raise ArgumentError("the guard is for another period, or another treatment of gravity; build it for the arm.")
    steps = whole(duration, arm.period, "duration", "period", 10**7)
    here, guarded, led = arm.look(), Guarded(law, robot, guard), motion
    if approach:
        led = Approach.from_state(motion, robot, here.q)
        steps += math.ceil(led.lag / arm.period)
    check_reference(led, robot, steps * arm.period, samples=min(steps, _CHECKED) + 1)
    loop = _Loop(arm, guarded, led, watch, steps)
    loop.rehearse(here)
    with _undisturbed(priority) as granted:
        try:
            loop.run(here)
        finally:
            arm.stop()
    return loop.driven(robot, type(law).__name__, granted)


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
        times = arm.period * np.arange(steps + 2.0)
        self.desired = at_times(motion, times, arm.nv)
        self.target = at_times(motion, times + guarded.lead, arm.nv)
        self.rows: list[tuple[int, Sample, np.ndarray]] = []
        self.work = np.zeros(steps + 1)
        self.missed, self.trouble = 0, ""

    def aim(self, row: int) -> Reference:
        """The reference for which the law is evaluated in a row."""
        return Reference(*(x[row] for x in self.target))

    def rehearse(self, here: Sample) -> None:
        """A few steps that are not sent, so that nothing is done for the first time when it counts."""
        self.guarded.begin(here.q, self.aim(0))
        for row in range(_REHEARSED):
            self.guarded.step(here._replace(t=row * self.arm.period, v=np.zeros(self.arm.nv)), self.aim(0))

    def run(self, here: Sample) -> None:
        """Until the end, or a while after a stop."""
        arm, guarded, h = self.arm, self.guarded, self.arm.period
        guarded.begin(here.q, self.aim(0))
        self.first = sample = arm.start()
        row, stop, overrun, left = 0, False, False, round(BRAKING / h)
        while row < self.steps and left > 0 and len(self.rows) <= self.steps:
            begun = time.perf_counter()
            aim = self.aim(row)
            tau = guarded.step(sample, aim, overrun=overrun, stop=stop)
            arm.write(tau)
            self.work[len(self.rows)] = spent = time.perf_counter() - begun
            self.rows.append((row, sample, tau))
            overrun = spent > h
            if guarded.report is not None:
                left = 0 if sample.fault else left - 1  # an arm with a fault takes no torque
            stop = self.watched(Live(sample, aim, tau, guarded.mode, guarded.counters)) or stop
            try:
                sample = arm.read()
            except KeyboardInterrupt:
                stop, sample = True, sample._replace(fresh=False)
            except Exception as error:  # a plant may raise anything: nothing more is sent to it
                sample = sample._replace(fresh=False, fault=f"{type(error).__name__}: {error}")
            passed = round((sample.t - self.first.t) / h) - row if sample.fresh else 1
            self.missed += max(passed - 1, 0)
            row += max(passed, 0 if sample.fresh else 1)

    def watched(self, seen: Live) -> bool:
        """Show an instant to the watcher; whether the arm is to stop for what it raises, which ends its watch."""
        try:
            if self.watch is not None:
                self.watch(seen)
        except KeyboardInterrupt:
            return True
        except Exception as error:  # a watcher may raise anything: the arm is braked, and the run says why
            self.watch, self.trouble = None, f"{type(error).__name__}: {error}"
            return True
        return False

    def driven(self, robot: Robot, law: str, granted: bool) -> Driven:
        """What was recorded, on the raster of the periods."""
        rows = {row: (sample, tau) for row, sample, tau in self.rows if sample.fresh}
        at = np.array(sorted(rows))
        lift = self.guarded.gravity(np.array([rows[k][0].q for k in at.tolist()])) if self.arm.compensated else 0.0
        tau = np.array([rows[k][1] for k in at.tolist()]) + lift
        desired = Reference(*(x[at] for x in self.desired))
        run = Run(
            t=self.arm.period * at,
            q=np.array([rows[k][0].q for k in at.tolist()]),
            v=np.array([rows[k][0].v for k in at.tolist()]),
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
