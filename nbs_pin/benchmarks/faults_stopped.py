"""Faults that the guard must see: it bears as much as is stated, then stops for a reason that it names, in time."""

import re
from typing import Any

import numpy as np

from nbs_pin.base.arrays import JointArray
from nbs_pin.base.exceptions import SimulationDiverged
from nbs_pin.base.records import Reference
from nbs_pin.benchmarks.fault_rows import Verdict, below, case, rows, stopped
from nbs_pin.benchmarks.fault_trial import PERIOD, STRIKE, Arm, Trial, burst, frozen, in_gravity, spoilt
from nbs_pin.controllers.controller import MemorylessController
from nbs_pin.controllers.neural_backstepping import NeuralBackstepping
from nbs_pin.motions.references import Hold, at_times
from nbs_pin.runtime.guarded import Sample
from nbs_pin.simulation.simulate import simulate


@rows("F9 gravity of the law", "MODEL ≤ 0.5 s", ("none", 0.0), ("upside down", -1.0))
def no_gravity(arm: Arm, rng: np.random.Generator, size: float) -> Verdict:
    """The law does not carry the arm, or pulls it down."""
    law = in_gravity(arm, size * arm.robot.gravity_vector)
    return stopped(Trial(arm, law=law, seconds=1.0).run(), "MODEL", within=0.5, after=0)


@rows("F14 rate, gains for 1 kHz", "PERIOD ≤ 0.5 s", ("500 Hz", 2), ("250 Hz", 4), ("100 Hz", 10))
def wrong_rate(arm: Arm, rng: np.random.Generator, every: int) -> Verdict:
    """The law is called less often than it was designed for."""
    outcome = Trial(arm, calls=lambda k: k % every == 0).run()
    return stopped(outcome, "PERIOD", within=0.5, after=0)


@case("F16 samples lost in a row", "19 ms", "RMS ≤ 0.002, no stop")
def short_burst(arm: Arm, rng: np.random.Generator) -> Verdict:
    """Fewer than the guard's patience."""
    return below(Trial(arm, sense=burst(19)).run(), 0.002)


@rows("F16 samples lost in a row", "MISSED at the 20th", ("20 ms", 20), ("100 ms", 100))
def long_burst(arm: Arm, rng: np.random.Generator, length: int) -> Verdict:
    """As many as the guard's patience, or more."""
    outcome = Trial(arm, sense=burst(length)).run()
    verdict = stopped(outcome, "MISSED", within=19 * PERIOD)
    return verdict._replace(passed=verdict.passed and outcome.stopped == STRIKE + 19)


@case("F19 frozen readings", "10 ms", "peak ≤ 0.15, no stop")
def short_freeze(arm: Arm, rng: np.random.Generator) -> Verdict:
    """Time goes on, readings do not."""
    outcome = Trial(arm, sense=frozen(10)).run()
    return below(outcome, 0.15, outcome.peak)


@case("F19 frozen readings", "50 ms", "FROZEN ≤ 20 samples")
def freeze(arm: Arm, rng: np.random.Generator) -> Verdict:
    """Longer than the guard's patience."""
    return stopped(Trial(arm, sense=frozen(50)).run(), "FROZEN", within=20 * PERIOD)


@rows("F20 readings not finite", "RMS ≤ 5e-4, no stop", ("one NaN", np.nan), ("one inf", np.inf))
def onespoilt(arm: Arm, rng: np.random.Generator, value: float) -> Verdict:
    """One sample is not a number."""
    return below(Trial(arm, sense=spoilt(1, value, int(rng.integers(arm.robot.nv)))).run(), 5e-4)


@rows("F20 readings not finite", "NOT_FINITE at the 20th", ("20 NaN", np.nan), ("20 inf", np.inf))
def manyspoilt(arm: Arm, rng: np.random.Generator, value: float) -> Verdict:
    """As many as the guard's patience."""
    outcome = Trial(arm, sense=spoilt(20, value, int(rng.integers(arm.robot.nv)))).run()
    return stopped(outcome, "NOT_FINITE", within=19 * PERIOD)


@rows("F21 actuator", "{}", ("dead", (0.0, "DIVERGED, peak ≤ 1")), ("sign flipped", (-1.0, "stop ≤ 0.3 s")))
def actuator(arm: Arm, rng: np.random.Generator, size: tuple[float, str]) -> Verdict:
    """One joint gives no torque, or the wrong one."""
    share = np.ones(arm.robot.nv)
    share[int(rng.integers(arm.robot.nv))] = size[0]
    outcome = Trial(arm, seconds=6.0, act=lambda k, tau: tau * share if k >= STRIKE else tau).run()
    if size[0] < 0.0:
        return stopped(outcome, "DIVERGED", "CHATTER", "JUMP", "SIGN", within=0.3)
    verdict = stopped(outcome, "DIVERGED", "JUMP", within=5.0)
    return verdict._replace(passed=verdict.passed and float(outcome.norm[: outcome.stopped].max()) <= 1.0)


@case("F21 velocity", "sign flipped", "stop ≤ 0.3 s")
def velocity_sign(arm: Arm, rng: np.random.Generator) -> Verdict:
    """The velocity of one joint has the wrong sign."""
    share = np.ones(arm.robot.nv)
    share[int(rng.integers(arm.robot.nv))] = -1.0
    trial = Trial(arm, sense=lambda k, sample: sample._replace(v=sample.v * share) if k >= STRIKE else sample)
    return stopped(trial.run(), "SIGN", "DIVERGED", "CHATTER", within=0.3)


@rows("F22 time", "TIME at once", ("repeated", 0.0), ("goes back", -0.5), ("jumps", 1.0))
def clock(arm: Arm, rng: np.random.Generator, jump: float) -> Verdict:
    """The clock of the arm is wrong."""
    off = jump - PERIOD if jump == 0.0 else jump
    outcome = Trial(arm, sense=lambda k, sample: sample._replace(t=sample.t + off) if k >= STRIKE else sample).run()
    return stopped(outcome, "TIME", within=0.0)


@rows("F23 reference", "REFERENCE at the 20th", ("jumps 0.5 rad", 0.5), ("NaN", np.nan))
def jump(arm: Arm, rng: np.random.Generator, size: float) -> Verdict:
    """The reference is not one that goes on."""

    def aim(k: int, aim: Reference) -> Reference:
        return aim._replace(q=aim.q + size) if k >= STRIKE else aim

    outcome = Trial(arm, aim=aim).run()
    return stopped(outcome, "REFERENCE", within=19 * PERIOD)


@case("F23 reference", "leaves the range", "REFERENCE at the 20th")
def beyond(arm: Arm, rng: np.random.Generator) -> Verdict:
    """The motion goes on, smoothly, beyond a limit that one joint has in the midst of it."""
    i, times = int(rng.integers(arm.robot.nv)), PERIOD * np.arange(2000)
    q = at_times(arm.motion, times + 0.5 * PERIOD, arm.robot.nv).q[:, i]
    guard, quarter = arm.guard(), 0.25 * (q.max() - q.min())
    if q[0] < q.max() - quarter:
        guard.upper[i] = q.max() - quarter
    else:
        guard.lower[i] = q.min() + quarter
    crossed = int(np.argmax((q > guard.upper[i]) | (q < guard.lower[i])))
    outcome = Trial(arm, guard=guard).run()
    verdict = stopped(outcome, "REFERENCE", within=19 * PERIOD, after=crossed)
    return verdict._replace(passed=verdict.passed and 0 < crossed == outcome.stopped - 19)


class _Raises(MemorylessController):
    """A law that raises once it is `armed`."""

    def __init__(self, law: NeuralBackstepping) -> None:
        self.inner, self.armed = law, False

    @property
    def nv(self) -> int:
        return self.inner.nv

    def torque(self, *state: Any) -> Any:
        if self.armed:
            raise ZeroDivisionError("a plug-in divides by zero")
        return self.inner.torque(*state)


@case("F25 law raises", "at 1 s", "LAW at once, traceback")
def raises(arm: Arm, rng: np.random.Generator) -> Verdict:
    """An exception in the law does not leave the loop."""
    law = _Raises(arm.law)

    def sense(k: int, sample: Sample) -> Sample:
        law.armed = k >= STRIKE
        return sample

    outcome = Trial(arm, law=law, sense=sense, seconds=1.5).run()
    verdict = stopped(outcome, "LAW", within=0.0)
    told = outcome.report is not None and "ZeroDivisionError" in outcome.report.traceback
    return verdict._replace(passed=verdict.passed and told)


@case("F26 plant diverges", "torque 1e9 N·m at 0.1 s", "SimulationDiverged ≤ 0.05 s, with t")
def diverging(arm: Arm, rng: np.random.Generator) -> Verdict:
    """The engine does not go on silently from a state that is none."""

    def push(t: float, q: JointArray, v: JointArray) -> JointArray:
        return np.full(arm.robot.nv, 1e9 if t >= 0.1 else 0.0)

    try:
        simulate(arm.plant, arm.law, Hold(arm.motion(0.0).q), 1.0, PERIOD, disturbance=push)
    except SimulationDiverged as error:
        told = re.search(r"t = ([0-9.]+) s", str(error))
        late = float(told[1]) - 0.1 if told else np.nan
        return Verdict(0.0 <= late <= 0.05, late, type(error).__name__)
    return Verdict(False, np.nan, "went on")
