"""Faults that a loop goes on with: what is unknown to the law, noisy, late, lost for a moment or far off."""

from dataclasses import replace
from typing import Any

import numpy as np
import pinocchio as pin

from nbs_pin.base.arrays import JointArray
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.benchmarks.fault_rows import Verdict, below, case, rows
from nbs_pin.benchmarks.fault_trial import PERIOD, STRIKE, Arm, Trial, in_gravity
from nbs_pin.controllers.neural_backstepping import NeuralBackstepping
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.motions.references import at_times, check_reference
from nbs_pin.runtime.guard import Guard
from nbs_pin.runtime.guarded import Sample
from nbs_pin.simulation.mujoco_plant import MujocoPlant

TURN = 2.0 * np.pi
RATED = {"two_link": 1.0, "ur5": 5.0, "panda": 3.0}
"""Rated load [kg]; two_link has none, and as much as each of its links."""
_DRAWS = 20


@rows("F1 payload unknown", "RMS ≤ {}", ("a third of the rated", (1.0 / 3.0, 0.02)), ("rated", (1.0, 0.06)))
def payload(arm: Arm, rng: np.random.Generator, size: tuple[float, float]) -> Verdict:
    """The arm carries a mass that the law does not know."""
    model = arm.robot.model
    ends = [frame.name for frame in model.frames if frame.parentJoint == model.njoints - 1 and frame.type == pin.BODY]
    loaded = arm.robot.with_payload(ends[0], size[0] * RATED.get(arm.robot.name, 3.0), (0.0, 0.0, 0.05))
    return below(Trial(arm, plant=MujocoPlant(loaded)).run(), size[1])


@rows("F2 masses and inertias", "mean RMS of 20 ≤ {}, no stop", ("±10 %", (0.1, 0.003)), ("±25 %", (0.25, 0.0075)))
def inertias(arm: Arm, rng: np.random.Generator, size: tuple[float, float]) -> Verdict:
    """The law believes in other bodies."""
    outcomes = [Trial(arm, law=_of_other_bodies(arm, rng, size[0])).run() for _ in range(_DRAWS)]
    found = float(np.mean([outcome.rms for outcome in outcomes]))
    stopped = next((outcome.code for outcome in outcomes if outcome.code), "")
    went_on = all(below(outcome, np.inf).passed for outcome in outcomes)
    return Verdict(went_on and found <= size[1], found, stopped)


def _of_other_bodies(arm: Arm, rng: np.random.Generator, most: float) -> NeuralBackstepping:
    model = arm.robot.model.copy()
    for i in range(1, model.njoints):
        share = 1.0 + rng.uniform(-most, most)
        body = model.inertias[i]
        body.mass, body.inertia = body.mass * share, body.inertia * share
    return NeuralBackstepping.for_robot(replace(arm.robot, model=model))


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


@case("F7 impulse", "50 ms at 58 % of effort", "peak ≤ 0.5, < 0.01 in 2 s; JUMP beyond 3 × the velocity limit")
def impulse(arm: Arm, rng: np.random.Generator) -> Verdict:
    """A blow on one joint. One that drives a joint beyond any velocity of an arm that works is to stop the guard."""
    blow = np.zeros(arm.robot.nv)
    i = int(rng.integers(arm.robot.nv))
    blow[i] = 0.58 * arm.robot.effort_limit[i] * rng.choice([-1.0, 1.0])
    outcome = Trial(arm, seconds=3.0, push=lambda k, t: blow if STRIKE <= k < STRIKE + 50 else 0.0).run()
    verdict = below(outcome, 0.5, outcome.peak)
    if outcome.report is None:
        return verdict._replace(passed=verdict.passed and outcome.norm[-1] < 0.01)
    until = outcome.stopped + 1
    q = outcome.error[:until] + at_times(arm.motion, PERIOD * np.arange(until), arm.robot.nv).q
    driven = bool((np.abs(np.diff(q, axis=0)).max(axis=0) > 3.0 * PERIOD * arm.robot.velocity_limit).any())
    legal = outcome.is_legal and not outcome.diverged and outcome.peak <= 0.5
    return Verdict(driven and legal and outcome.stops("JUMP", within=0.05), outcome.peak, outcome.code)


@rows(
    "F8 gravity of the law",
    "RMS ≤ {}",
    ("9.0 m/s²", (lambda g: 9.0 / 9.81 * g, 0.0075)),
    ("5° tilted", (lambda g: np.linalg.norm(g) * np.array([np.sin(0.0873), 0.0, -np.cos(0.0873)]), 0.01)),
)
def wrong_gravity(arm: Arm, rng: np.random.Generator, size: tuple[Any, float]) -> Verdict:
    """The law believes in another gravity."""
    return below(Trial(arm, law=in_gravity(arm, size[0](arm.robot.gravity_vector))).run(), size[1])


@rows(
    "F10 encoder steps, v by differences",
    "{}",
    ("2^-16 turn, 1 ms", (2.0**-16, 1, 0.002, "RMS ≤ 0.002")),
    ("2^-12 turn, 8 ms", (2.0**-12, 8, 0.005, "RMS ≤ 0.005, or stops before 0.3")),
    ("2^-12 turn, 1 ms", (2.0**-12, 1, 0.1, "RMS ≤ 0.1, or stops before 0.3")),
)
def encoders(arm: Arm, rng: np.random.Generator, size: tuple[float, int, float, str]) -> Verdict:
    """Positions are rounded, velocities are their differences over some periods."""
    step, over = size[0] * TURN, size[1]
    offset = rng.uniform(0.0, step, arm.robot.nv)
    seen = [np.round((arm.motion(-k * PERIOD).q + offset) / step) * step - offset for k in range(over, 0, -1)]

    def sense(k: int, sample: Sample) -> Sample:
        q = np.round((sample.q + offset) / step) * step - offset
        seen.append(q)
        return sample._replace(q=q, v=(q - seen.pop(0)) / (over * PERIOD))

    guard = replace(arm.guard(), resolution=np.full(arm.robot.nv, 4.0 * step))
    outcome = Trial(arm, sense=sense, guard=guard).run()
    if outcome.report is None or size[0] < 2.0**-12:
        return below(outcome, size[2])
    return Verdict(outcome.is_legal and not outcome.diverged and outcome.peak <= 0.3, outcome.peak, outcome.code)


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


@rows("F15 samples lost at random", "RMS ≤ {}, DEGRADED", ("10 %", (0.1, 4e-4)), ("50 %", (0.5, 1e-3)))
def lost(arm: Arm, rng: np.random.Generator, size: tuple[float, float]) -> Verdict:
    """Samples do not arrive."""
    gone = rng.random(3000) < size[0]
    outcome = Trial(arm, sense=lambda k, sample: sample._replace(fresh=not gone[k])).run()
    verdict = below(outcome, size[1])
    return verdict._replace(passed=verdict.passed and outcome.degraded)


@rows(
    "F17 weaker arm", "RMS ≤ 1e-4 where it is strong enough, else refused", ("50 %", 0.5), ("30 %", 0.3), ("5 %", 0.05)
)
def weak(arm: Arm, rng: np.random.Generator, share: float) -> Verdict:
    """Where the motion needs no more than the effort limits, nothing changes; else it is refused before the start."""
    robot = arm.robot.with_effort_limit(share * arm.robot.effort_limit)
    desired, model = at_times(arm.motion, np.linspace(0.0, 2.0, 4001), robot.nv), arm.law.dynamics
    needed = model.reference_torque(desired.q, desired.v, desired.v, desired.a)
    strong = bool((np.abs(needed) <= robot.effort_limit).all())
    try:
        check_reference(arm.motion, robot, 2.0)
    except ArgumentError:
        return Verdict(not strong, np.nan, "refused")
    outcome = below(Trial(arm, guard=arm.guard(robot=robot)).run(), 1e-4)
    return outcome._replace(passed=outcome.passed and strong)


@case("F18 torque rate", "1000 N·m/s against none", "RMS within 10 %")
def torque_rate(arm: Arm, rng: np.random.Generator) -> Verdict:
    """The limit of the rate does not change the motion."""
    free, limited = (Trial(arm, guard=Guard.for_robot(arm.robot, torque_rate=x)).run() for x in (np.inf, 1000.0))
    return below(limited, 1.1 * free.rms + 1e-9)


@rows(
    "F24 start 1 rad off, at speed",
    "{}",
    ("approach", (True, "peak ≤ 0.01")),
    ("none", (False, "peak ≤ 2, and settles or stops ≤ 1 s")),
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
    ends = settles or outcome.stops("JUMP", "DIVERGED", "CHATTER", within=1.0, after=0)
    return Verdict(outcome.is_legal and outcome.peak <= 2.0 and ends, outcome.peak, outcome.code)


@case("F27 overrun", "10 ms, every 100th", "RMS ≤ 0.001, counted, DEGRADED")
def overrun(arm: Arm, rng: np.random.Generator) -> Verdict:
    """A call comes back after ten periods: until then the torque before it acts, and no instant is its own."""
    acting: list[JointArray] = []

    def act(k: int, tau: JointArray) -> JointArray:
        if k < 100 or k % 100 >= 10:
            acting[:] = [tau]
        return acting[0]

    late = [k for k in range(2000) if k >= 100 and 0 < k % 100 < 10]
    outcome = Trial(
        arm, act=act, calls=lambda k: k not in late, overruns=lambda k: k > 100 and k % 100 == 10, seconds=2.0
    ).run()
    verdict, counted = below(outcome, 0.001), outcome.counters
    told = outcome.degraded and (counted.late, counted.overruns) == (len(late), len(late) // 9)
    return verdict._replace(passed=verdict.passed and told)
