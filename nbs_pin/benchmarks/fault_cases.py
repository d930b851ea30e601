"""The fault matrix: what goes wrong, how much, and what must come of it (docs/runtime.md)."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from nbs_pin.base.arrays import JointArray
from nbs_pin.base.exceptions import ArgumentError, SimulationDiverged
from nbs_pin.base.records import Reference
from nbs_pin.benchmarks.fault_trial import PERIOD, STRIKE, Arm, Outcome, Trial
from nbs_pin.controllers.controller import MemorylessController
from nbs_pin.controllers.neural_backstepping import NeuralBackstepping
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.motions.references import Hold, check_reference
from nbs_pin.robots.robot import Robot
from nbs_pin.runtime.guard import Guard
from nbs_pin.runtime.guarded import Sample
from nbs_pin.simulation.mujoco_plant import MujocoPlant
from nbs_pin.simulation.simulate import simulate

TURN = 2.0 * np.pi
RATED = {"two_link": 1.0, "ur5": 5.0, "panda": 3.0}
"""Rated load [kg]; two_link has none, and as much as each of its links."""


class Verdict(NamedTuple):
    """What one trial gave."""

    passed: bool
    value: float
    """The figure that is compared [rad or s], or NaN where none is."""
    said: str = ""
    """A stop, in a word."""


class Case(NamedTuple):
    """A row of the matrix."""

    fault: str
    level: str
    wanted: str
    judge: Callable[[Arm, np.random.Generator], Verdict]


CASES: list[Case] = []
"""All rows, in order."""


def case(fault: str, level: str, wanted: str) -> Callable[[Any], Any]:
    """Decorator: add a row."""

    def add(judge: Callable[[Arm, np.random.Generator], Verdict]) -> Any:
        CASES.append(Case(fault, level, wanted, judge))
        return judge

    return add


def rows(fault: str, wanted: str, *levels: tuple[str, Any]) -> Callable[[Any], Any]:
    """Decorator: add a row for each level, whose number the function takes last."""

    def add(judge: Callable[[Arm, np.random.Generator, Any], Verdict]) -> Any:
        for level, size in levels:
            limit = size[-1] if isinstance(size, tuple) else size
            told = wanted.format(limit)
            made = Case(fault, level, told, lambda arm, rng, size=size: judge(arm, rng, size))  # type: ignore[misc]
            CASES.append(made)
        return judge

    return add


def below(outcome: Outcome, limit: float, value: float | None = None) -> Verdict:
    """Passed if it went on, legally, with the RMS error or another figure within the limit."""
    found = outcome.rms if value is None else value
    goes_on = outcome.report is None and not outcome.diverged and outcome.is_legal
    return Verdict(goes_on and found <= limit, found, outcome.code)


def stopped(outcome: Outcome, *codes: str, within: float, after: int = STRIKE) -> Verdict:
    """Passed if it stopped for one of these faults in time, legally."""
    found = (outcome.stopped - after) * outcome.period
    done = outcome.stops(*codes, within=within, after=after) and outcome.is_legal and not outcome.diverged
    return Verdict(done, found, outcome.code)


def fixed(arm: Arm, robot: Robot) -> NeuralBackstepping:
    """A law for another arm than the true one, with the gains of the true one's law."""
    return NeuralBackstepping.for_robot(robot)


@rows("F1 payload unknown", "RMS ≤ {}", ("a third of the rated", (1.0 / 3.0, 0.02)), ("rated", (1.0, 0.06)))
def payload(arm: Arm, rng: np.random.Generator, size: tuple[float, float]) -> Verdict:
    """The arm carries a mass that the law does not know."""
    model = arm.robot.model
    ends = [frame.name for frame in model.frames if frame.parentJoint == model.njoints - 1 and frame.type == pin.BODY]
    loaded = arm.robot.with_payload(ends[0], size[0] * RATED.get(arm.robot.name, 3.0), (0.0, 0.0, 0.05))
    return below(Trial(arm, plant=MujocoPlant(loaded)).run(), size[1])


@rows("F2 masses and inertias", "RMS ≤ {}", ("±10 %", (0.1, 0.004)), ("±25 %", (0.25, 0.01)))
def inertias(arm: Arm, rng: np.random.Generator, size: tuple[float, float]) -> Verdict:
    """The law believes in other bodies."""
    model = arm.robot.model.copy()
    for i in range(1, model.njoints):
        share = 1.0 + rng.uniform(-size[0], size[0])
        body = model.inertias[i]
        body.mass, body.inertia = body.mass * share, body.inertia * share
    return below(Trial(arm, law=NeuralBackstepping.for_robot(replace(arm.robot, model=model))).run(), size[1])


@rows("F3 joint friction", "RMS ≤ {}", ("1 N·m + 0.5", ((0.5, 1.0), 0.045)), ("3 N·m", ((0.0, 3.0), 0.1)))
def friction(arm: Arm, rng: np.random.Generator, size: tuple[tuple[float, float], float]) -> Verdict:
    """Friction that the law does not know, at most a quarter of a joint's effort limit."""
    most = 0.25 * arm.robot.effort_limit
    viscous, coulomb = (np.minimum(np.full(arm.robot.nv, x), most) for x in size[0])
    plant = MujocoPlant(arm.robot, joint_friction=JointFriction(viscous=viscous, coulomb=coulomb))
    return below(Trial(arm, plant=plant).run(), size[1])


@rows("F4 torque noise", "RMS ≤ {}", ("0.5 N·m", (0.5, 0.003)), ("2 N·m", (2.0, 0.012)))
def torque_noise(arm: Arm, rng: np.random.Generator, size: tuple[float, float]) -> Verdict:
    """White noise on every joint."""
    noise = rng.normal(0.0, size[0], (3000, arm.robot.nv))
    return below(Trial(arm, push=lambda k, t: noise[k]).run(), size[1])


@case("F5 constant torque", "5 N·m, ≤ 10 % of effort", "‖z1‖ ≤ certificate")
def constant(arm: Arm, rng: np.random.Generator) -> Verdict:
    """A step on every joint, of either sign."""
    torque = arm.push * rng.choice([-1.0, 1.0], arm.robot.nv)
    outcome = Trial(arm, push=lambda k, t: torque).run()
    return below(outcome, arm.certificate.error, float(outcome.norm.max()))


@case("F6 square wave", "the same at 8 rad/s", "‖z1‖ ≤ certificate")
def square_wave(arm: Arm, rng: np.random.Generator) -> Verdict:
    """A square wave on every joint, of any phase, at the rate of the error's decay."""
    frequency, phase = arm.law.inertial_rate, rng.uniform(0.0, TURN, arm.robot.nv)
    outcome = Trial(arm, push=lambda k, t: arm.push * np.sign(np.sin(frequency * t + phase))).run()
    return below(outcome, arm.certificate.error, float(outcome.norm.max()))


@case("F7 impulse", "50 ms at 58 % of effort", "peak ≤ 0.5, < 0.01 in 2 s")
def impulse(arm: Arm, rng: np.random.Generator) -> Verdict:
    """A blow on one joint."""
    blow = np.zeros(arm.robot.nv)
    i = int(rng.integers(arm.robot.nv))
    blow[i] = 0.58 * arm.robot.effort_limit[i] * rng.choice([-1.0, 1.0])
    outcome = Trial(arm, seconds=3.0, push=lambda k, t: blow if STRIKE <= k < STRIKE + 50 else 0.0).run()
    verdict = below(outcome, 0.5, outcome.peak)
    return verdict._replace(passed=verdict.passed and outcome.norm[-1] < 0.01)


@rows(
    "F8 gravity of the law",
    "RMS ≤ {}",
    ("9.0 m/s²", (lambda g: 9.0 / 9.81 * g, 0.0075)),
    ("5° tilted", (lambda g: np.linalg.norm(g) * np.array([np.sin(0.0873), 0.0, -np.cos(0.0873)]), 0.01)),
)
def wrong_gravity(arm: Arm, rng: np.random.Generator, size: tuple[Any, float]) -> Verdict:
    """The law believes in another gravity."""
    return below(Trial(arm, law=_in_gravity(arm, size[0](arm.robot.gravity_vector))).run(), size[1])


@rows("F9 gravity of the law", "MODEL ≤ 0.5 s", ("none", 0.0), ("upside down", -1.0))
def no_gravity(arm: Arm, rng: np.random.Generator, size: float) -> Verdict:
    """The law does not carry the arm, or pulls it down."""
    law = _in_gravity(arm, size * arm.robot.gravity_vector)
    return stopped(Trial(arm, law=law, seconds=1.0).run(), "MODEL", within=0.5, after=0)


def _in_gravity(arm: Arm, gravity: JointArray) -> NeuralBackstepping:
    model = arm.robot.model.copy()
    model.gravity.linear = gravity
    return NeuralBackstepping.for_robot(replace(arm.robot, model=model, gravity_vector=gravity))


@rows(
    "F10 encoder steps, v by differences",
    "RMS ≤ {}",
    ("2^-16 turn, 1 ms", (2.0**-16, 1, 0.002)),
    ("2^-12 turn, 8 ms", (2.0**-12, 8, 0.01)),
    ("2^-12 turn, 1 ms", (2.0**-12, 1, np.inf)),
)
def encoders(arm: Arm, rng: np.random.Generator, size: tuple[float, int, float]) -> Verdict:
    """Positions are rounded, velocities are their differences over some periods."""
    step, over = size[0] * TURN, size[1]
    offset = rng.uniform(0.0, step, arm.robot.nv)
    seen = [np.round((arm.motion(-k * PERIOD).q + offset) / step) * step - offset for k in range(over, 0, -1)]

    def sense(k: int, sample: Sample) -> Sample:
        q = np.round((sample.q + offset) / step) * step - offset
        seen.append(q)
        return sample._replace(q=q, v=(q - seen.pop(0)) / (over * PERIOD))

    outcome = Trial(arm, sense=sense).run()
    if size[2] == np.inf:
        return Verdict(outcome.is_legal and not outcome.diverged, outcome.rms, outcome.code)
    return below(outcome, size[2])


@case("F11 encoder bias", "5 mrad", "RMS ≤ 0.02")
def bias(arm: Arm, rng: np.random.Generator) -> Verdict:
    """Positions are off by a constant."""
    off = 0.005 * rng.choice([-1.0, 1.0], arm.robot.nv)
    return below(Trial(arm, sense=lambda k, sample: sample._replace(q=sample.q + off)).run(), 0.02)


@case("F12 state noise", "q 1e-4, v 1e-2", "RMS ≤ 0.001")
def state_noise(arm: Arm, rng: np.random.Generator) -> Verdict:
    """White noise on readings."""
    noise = rng.normal(size=(2, 3000, arm.robot.nv)) * np.array([1e-4, 1e-2])[:, None, None]
    outcome = Trial(arm, sense=lambda k, s: s._replace(q=s.q + noise[0, k], v=s.v + noise[1, k])).run()
    return below(outcome, 0.001)


@rows("F13 torque acts late", "RMS ≤ {}", ("1 ms", (1, 5e-4)), ("2 ms", (2, 5e-4)), ("5 ms", (5, 2e-3)))
def delay(arm: Arm, rng: np.random.Generator, size: tuple[int, float]) -> Verdict:
    """Torques wait for some periods."""
    return below(Trial(arm, delay=size[0]).run(), size[1])


@rows(
    "F14 rate, gains for it", "RMS ≤ {}", ("500 Hz", (0.002, 5e-4)), ("250 Hz", (0.004, 1e-3)), ("100 Hz", (0.01, 5e-3))
)
def rate(arm: Arm, rng: np.random.Generator, size: tuple[float, float]) -> Verdict:
    """Loop and law both have a longer period."""
    law = NeuralBackstepping.for_robot(arm.robot, period=size[0])
    return below(Trial(arm, law=law, period=size[0]).run(), size[1])


@rows("F14 rate, gains for 1 kHz", "PERIOD ≤ 0.5 s", ("500 Hz", 2), ("250 Hz", 4), ("100 Hz", 10))
def wrong_rate(arm: Arm, rng: np.random.Generator, every: int) -> Verdict:
    """The law is called less often than it was designed for."""
    outcome = Trial(arm, calls=lambda k: k % every == 0).run()
    return stopped(outcome, "PERIOD", within=0.5, after=0)


@rows("F15 samples lost at random", "RMS ≤ {}, DEGRADED", ("10 %", (0.1, 4e-4)), ("50 %", (0.5, 1e-3)))
def lost(arm: Arm, rng: np.random.Generator, size: tuple[float, float]) -> Verdict:
    """Samples do not arrive."""
    gone = rng.random(3000) < size[0]
    outcome = Trial(arm, sense=lambda k, sample: sample._replace(fresh=not gone[k])).run()
    verdict = below(outcome, size[1])
    return verdict._replace(passed=verdict.passed and outcome.degraded)


def _burst(length: int) -> Callable[[int, Sample], Sample]:
    return lambda k, sample: sample._replace(fresh=not STRIKE <= k < STRIKE + length)


@case("F16 samples lost in a row", "19 ms", "RMS ≤ 0.002, no stop")
def short_burst(arm: Arm, rng: np.random.Generator) -> Verdict:
    """Fewer than the guard's patience."""
    return below(Trial(arm, sense=_burst(19)).run(), 0.002)


@rows("F16 samples lost in a row", "MISSED at the 20th", ("20 ms", 20), ("100 ms", 100))
def long_burst(arm: Arm, rng: np.random.Generator, length: int) -> Verdict:
    """As many as the guard's patience, or more."""
    outcome = Trial(arm, sense=_burst(length)).run()
    verdict = stopped(outcome, "MISSED", within=19 * PERIOD)
    return verdict._replace(passed=verdict.passed and outcome.stopped == STRIKE + 19)


@rows("F17 weaker arm", "as before, or refused", ("50 %", 0.5), ("30 %", 0.3), ("5 %", 0.05))
def weak(arm: Arm, rng: np.random.Generator, share: float) -> Verdict:
    """Either the motion is within the effort limits, and nothing changes, or it is refused before the start."""
    robot = arm.robot.with_effort_limit(share * arm.robot.effort_limit)
    try:
        check_reference(arm.motion, robot, 2.0)
    except ArgumentError:
        return Verdict(True, np.nan, "refused")
    return below(Trial(arm, guard=Guard.for_robot(robot)).run(), 1e-4)


@case("F18 torque rate", "1000 N·m/s against none", "RMS within 10 %")
def torque_rate(arm: Arm, rng: np.random.Generator) -> Verdict:
    """The limit of the rate does not change the motion."""
    free = Trial(arm, guard=Guard.for_robot(arm.robot, torque_rate=np.inf)).run()
    limited = Trial(arm).run()
    return below(limited, 1.1 * free.rms + 1e-9)


def _frozen(length: int) -> Callable[[int, Sample], Sample]:
    last: list[Sample] = []

    def sense(k: int, sample: Sample) -> Sample:
        if not STRIKE <= k < STRIKE + length:
            last[:] = [sample]
            return sample
        return last[0]._replace(t=sample.t)

    return sense


@case("F19 frozen readings", "10 ms", "peak ≤ 0.15, no stop")
def short_freeze(arm: Arm, rng: np.random.Generator) -> Verdict:
    """Time goes on, readings do not."""
    outcome = Trial(arm, sense=_frozen(10)).run()
    return below(outcome, 0.15, outcome.peak)


@case("F19 frozen readings", "50 ms", "FROZEN ≤ 20 samples")
def freeze(arm: Arm, rng: np.random.Generator) -> Verdict:
    """Longer than the guard's patience."""
    return stopped(Trial(arm, sense=_frozen(50)).run(), "FROZEN", within=20 * PERIOD)


def _spoilt(length: int, value: float, i: int) -> Callable[[int, Sample], Sample]:
    def sense(k: int, sample: Sample) -> Sample:
        if not STRIKE <= k < STRIKE + length:
            return sample
        q = sample.q.copy()
        q[i] = value
        return sample._replace(q=q)

    return sense


@rows("F20 readings not finite", "RMS ≤ 5e-4, no stop", ("one NaN", np.nan), ("one inf", np.inf))
def one_spoilt(arm: Arm, rng: np.random.Generator, value: float) -> Verdict:
    """One sample is not a number."""
    return below(Trial(arm, sense=_spoilt(1, value, int(rng.integers(arm.robot.nv)))).run(), 5e-4)


@rows("F20 readings not finite", "NOT_FINITE at the 20th", ("20 NaN", np.nan), ("20 inf", np.inf))
def many_spoilt(arm: Arm, rng: np.random.Generator, value: float) -> Verdict:
    """As many as the guard's patience."""
    outcome = Trial(arm, sense=_spoilt(20, value, int(rng.integers(arm.robot.nv)))).run()
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


@rows("F23 reference", "REFERENCE at the 20th", ("jumps 0.5 rad", 0.5), ("NaN", np.nan), ("leaves the range", 100.0))
def jump(arm: Arm, rng: np.random.Generator, size: float) -> Verdict:
    """The reference is not one that goes on."""

    def aim(k: int, aim: Reference) -> Reference:
        return aim._replace(q=aim.q + size) if k >= STRIKE else aim

    outcome = Trial(arm, aim=aim).run()
    return stopped(outcome, "REFERENCE", within=19 * PERIOD)


@rows(
    "F24 start 1 rad off, at speed", "{}", ("approach", (True, "peak ≤ 0.01")), ("none", (False, "settles, or stops"))
)
def far(arm: Arm, rng: np.random.Generator, size: tuple[bool, str]) -> Verdict:
    """The arm starts 1 rad off in every joint, at up to a quarter of its velocity limit (at most 2 rad/s)."""
    begin, n = arm.motion(0.0), arm.robot.nv
    away = np.where(begin.q > 0.5 * (arm.robot.lower + arm.robot.upper), -1.0, 1.0)  # where there is room
    v = rng.uniform(-1.0, 1.0, n) * np.minimum(0.25 * arm.robot.velocity_limit, 2.0)
    outcome = Trial(arm, seconds=4.0, start=(begin.q + away, v), approach=size[0]).run()
    if size[0]:
        return below(outcome, 0.01, outcome.peak)
    settles = outcome.report is None and bool(outcome.norm[-500:].max() < 0.01)
    return Verdict(outcome.is_legal and (settles or bool(outcome.code)), outcome.peak, outcome.code)


class _Raises(MemorylessController):
    """A law that raises after a number of calls."""

    def __init__(self, law: NeuralBackstepping, calls: int) -> None:
        self.inner, self.left = law.compile(), calls

    @property
    def nv(self) -> int:
        return self.inner.nv  # type: ignore[no-any-return]

    def torque(self, *state: Any) -> Any:
        self.left -= 1
        if self.left < 0:
            raise ZeroDivisionError("a plug-in divides by zero")
        return self.inner.torque(*state)  # type: ignore[attr-defined]


@case("F25 law raises", "at 1 s", "LAW at once, traceback")
def raises(arm: Arm, rng: np.random.Generator) -> Verdict:
    """An exception in the law does not leave the loop."""
    outcome = Trial(arm, law=_Raises(arm.law, STRIKE), seconds=1.5).run()
    verdict = stopped(outcome, "LAW", within=0.1, after=STRIKE - 100)
    told = outcome.report is not None and "ZeroDivisionError" in outcome.report.traceback
    return verdict._replace(passed=verdict.passed and told)


@case("F26 plant diverges", "torque 1e9 N·m", "SimulationDiverged with t")
def diverging(arm: Arm, rng: np.random.Generator) -> Verdict:
    """The engine does not go on silently from a state that is none."""
    try:
        simulate(arm.plant, arm.law, Hold(arm.motion(0.0).q), 1.0, PERIOD, disturbance=lambda t, q, v: 1e9 + 0.0 * q)
    except (SimulationDiverged, ArgumentError) as error:
        return Verdict("t = " in str(error), np.nan, type(error).__name__)
    return Verdict(False, np.nan, "went on")


@case("F27 overrun", "10 ms, every 100th", "RMS ≤ 0.001, counted, DEGRADED")
def overrun(arm: Arm, rng: np.random.Generator) -> Verdict:
    """The computer is late now and then."""
    outcome = Trial(arm, calls=lambda k: not 0 < k % 100 < 10).run()
    verdict = below(outcome, 0.001)
    return verdict._replace(passed=verdict.passed and outcome.degraded)
