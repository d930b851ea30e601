"""Data to learn from, collected in MuJoCo: motions that excite an arm, motions that do not, and states at random."""

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, Literal, NamedTuple, TypeAlias, get_args

import numpy as np
from jaxtyping import Bool, Float, Int

from nbs_pin.arrays import Array
from nbs_pin.checks import positive, whole
from nbs_pin.controllers.controller import Controller, MemorylessController
from nbs_pin.controllers.gains import effective_inertia, largest_inertia, sample_configurations
from nbs_pin.controllers.pd import PD
from nbs_pin.dynamics.equations import inverse_dynamics
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.exceptions import ArgumentError
from nbs_pin.learning.datasets import Dataset
from nbs_pin.learning.measuring import CLEAN_WINDOW, QUANTISED_WINDOW, Noise, derivative, quantised
from nbs_pin.plants.mujoco_plant import MujocoPlant
from nbs_pin.progress import tracked
from nbs_pin.references import DesiredMotion, Hold, Sinusoid
from nbs_pin.robot import Robot
from nbs_pin.simulation import simulate
from nbs_pin.state import Reference

Recipe: TypeAlias = Literal["excited", "passive", "reference", "uniform"]
"""What `collect` knows."""
Acceleration: TypeAlias = Literal["simulator", "differentiated"]
"""Where v̇ comes from."""
RECORD_STEP = 1e-3
"""Control period, plant step and distance of the samples that derivatives are taken from [s]."""
_BAND = (0.2, 1.5)  # Hz; what the window of a quantised record lets through without loss
_TONES = 6
_LOOP = 6.0  # rad/s; soft, so that the excitation moves the arm and the arm moves itself


def joint_tree(robot: Robot) -> tuple[Int[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Parents (0 for the base, i + 1 for joint i) and which joints slide: all that a `Dataset` says of an arm."""
    parents = np.array(list(robot.model.parents)[1:], dtype=np.int64)
    return parents, np.array([joint.prismatic for joint in robot.joints])


@dataclass(frozen=True, eq=False)
class Multisine:
    """q = offset + Σ_k amplitude_k sin(frequency_k t + phase_k), per joint; arrays of shape (tones, n)."""

    amplitude: Float[np.ndarray, "tones n"]
    """[rad]."""
    frequency: Float[np.ndarray, "tones n"]
    """[rad/s]."""
    phase: Float[np.ndarray, "tones n"]
    """[rad]."""
    offset: Float[np.ndarray, " n"]
    """[rad]."""

    def __call__(self, t: Any) -> Reference:
        """Motion at t [s]."""
        A, w = self.amplitude, self.frequency
        angle = w * np.asarray(t, dtype=float)[..., None, None] + self.phase
        sine, cosine = np.sin(angle), np.cos(angle)
        terms = A * sine, A * w * cosine, -A * w**2 * sine
        q, v, a = (term.sum(axis=-2) for term in terms)
        return Reference(self.offset + q, v, a)


class _Idle(MemorylessController):
    """No torque at all."""

    def __init__(self, nv: int) -> None:
        self._nv = nv

    @property
    def nv(self) -> int:
        """Number of joints."""
        return self._nv

    def torque(self, q: Array, v: Array, q_ref: Array, v_ref: Array, a_ref: Array) -> Float[Array, "*batch n"]:
        """τ = 0 [N·m]."""
        return 0.0 * q


class _Record(NamedTuple):
    """States and torques `RECORD_STEP` apart, and the simulator's acceleration of each."""

    t: np.ndarray
    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    tau: np.ndarray


@dataclass(frozen=True, eq=False)
class _Bench:
    """The arm on the bench: what every trajectory of a collection shares."""

    robot: Robot
    plant: MujocoPlant
    law: Controller
    motion: Callable[[np.random.Generator], DesiredMotion]
    """Draws what the law aims at in one trajectory."""
    limit: np.ndarray
    """Largest torques (n,) [N·m]."""

    def record(self, generator: np.random.Generator, rows: int) -> _Record:
        """One trajectory from the start of its motion."""
        duration = max(rows - 1, 1) * RECORD_STEP
        run = simulate(
            self.plant, self.law, self.motion(generator), duration, RECORD_STEP, effort_limit=self.limit, lookahead=0.0
        )
        t, q, v, tau = (x[:rows] for x in (run.t, run.q, run.v, run.tau))
        return _Record(t, q, v, self.plant.acceleration(q, v, tau), tau)


def collect(
    robot: Robot,
    recipe: Recipe = "excited",
    samples: int = 10_000,
    seed: int = 0,
    *,
    noise: Noise | None = None,
    acceleration: Acceleration | None = None,
    friction: bool = False,
    sampling: float | None = None,
    duration: float = 3.0,
    speed: float = 2.0,
    progress: bool = False,
) -> Dataset:
    """Samples of the arm in MuJoCo, as an experimenter would record them.

    recipe:
      "excited"    random sums of sines in torque, 0.2 to 1.5 Hz, about a soft PD with gravity compensation; many
                   trajectories of `duration` [s] that start anywhere in the joint ranges, torques inside the limits
      "reference"  PD+ along `Sinusoid.for_robot` of random frequency and phase: data of an arm at its work
      "passive"    one swing from rest at zero with no torque, a sample every 1 ms: the paper's data, which cannot tell
                   M, G from c·M, c·G (docs/theory.md §6)
      "uniform"    independent states: q uniform in the ranges, a turn at most, |v| ≤ `speed`, random torques inside the
                   limits; no arm can be measured so, but nothing is left unexcited
    samples: how many. seed: of everything random; the same seed gives the same data.
    noise: what encoders and torque sensors do to the record. acceleration: v̇ as the "simulator" knows it or
    "differentiated" from v (Savitzky–Golay); rounded encoders give both v and v̇ by differentiation, and are the only
    ones whose default it is. friction: True lets the friction of the URDF act; τ is then what the motors applied.
    sampling: time between samples [s], a whole number of ms; None is 0.01, and 0.001 for "passive". speed: about how
    fast an excited joint moves [rad/s]; its peaks stay near the velocity limit.
    progress: show a progress bar when it takes longer than 2 s at a terminal.
    Torque limits are the arm's; a joint without one is given what its heaviest posture needs, and 20 rad/s² on top.
    Raises ArgumentError for an unknown recipe or settings that do not fit it, RobotError for an arm that MuJoCo cannot
    build, and SimulationDiverged when the arm leaves the finite numbers.
    """
    noise = noise or Noise()
    _check(recipe, samples, speed, noise, acceleration)
    differentiated = acceleration == "differentiated" or noise.encoder > 0.0
    sampling = (RECORD_STEP if recipe == "passive" else 10 * RECORD_STEP) if sampling is None else sampling
    stride = whole(sampling, RECORD_STEP, "sampling", "step of the record")
    generator = np.random.default_rng(seed)
    plant = MujocoPlant(robot, joint_friction="keep" if friction else "drop")
    parents, prismatic = joint_tree(robot)
    if recipe == "uniform":
        q, v, a, tau = _uniform(robot, plant, samples, speed, generator)
        t, trajectory = np.zeros(samples), np.arange(samples)
    else:
        bench = _bench(recipe, robot, plant, speed, friction, duration)
        counts = (
            [samples] if recipe == "passive" else _shares(samples, whole(duration, sampling, "duration", "sampling"))
        )
        seen = [
            _measured(bench, generator, count, stride, noise, differentiated, prismatic)
            for count in tracked(counts, f"collecting data of {robot.name}", progress)
        ]
        t, q, v, a, tau = (np.concatenate(parts) for parts in zip(*seen, strict=True))
        trajectory = np.repeat(np.arange(len(counts)), counts)
    tau = tau + noise.torque * generator.standard_normal(tau.shape)
    about = {
        "recipe": recipe,
        "seed": seed,
        "noise": asdict(noise),
        "acceleration": "differentiated" if differentiated else "simulator",
        "friction": friction,
        "speed": speed,
        "robot": {"source": robot.source, "sha256": robot.sha256, "options": robot.options},
    }
    if recipe != "uniform":
        about |= {"sampling": sampling}
    return Dataset(q, v, a, tau, t, trajectory, parents, prismatic, robot.name, about)


def _check(recipe: str, samples: int, speed: float, noise: Noise, acceleration: str | None) -> None:
    if recipe not in get_args(Recipe):
        raise ArgumentError(f"recipe '{recipe}' is unknown; give one of {', '.join(get_args(Recipe))}.")
    if acceleration is not None and acceleration not in get_args(Acceleration):
        raise ArgumentError(f"acceleration '{acceleration}' is unknown; give 'simulator' or 'differentiated'.")
    if samples < 1 or samples != int(samples):
        raise ArgumentError(f"samples is {samples}, expected a whole number ≥ 1; correct it.")
    positive("speed", speed, "rad/s")
    if noise.encoder > 0.0 and acceleration == "simulator":
        raise ArgumentError(
            "rounded encoders were asked for with the simulator's acceleration, which no arm with such encoders knows; "
            "leave acceleration out."
        )
    if recipe == "uniform" and (noise.encoder > 0.0 or acceleration == "differentiated"):
        raise ArgumentError(
            "the recipe 'uniform' has single states and nothing to differentiate; give another recipe, or torque noise "
            "alone."
        )


def _shares(samples: int, longest: int) -> list[int]:
    """How many samples each trajectory gives: nearly equal shares of at most `longest`, two or more if possible."""
    count = min(max(math.ceil(samples / longest), 2), samples)
    return np.diff(np.linspace(0, samples, count + 1).astype(int)).tolist()


def _bench(recipe: str, robot: Robot, plant: MujocoPlant, speed: float, friction: bool, duration: float) -> _Bench:
    model = PinocchioDynamics(robot)
    limit = torque_limits(robot)
    if recipe == "passive":
        return _Bench(robot, plant, _Idle(robot.nv), lambda _: Hold(np.zeros(robot.nv)), limit)
    if recipe == "reference":
        law: Controller = PD.for_robot(robot, model, friction=JointFriction.of(robot) if friction else None)
        return _Bench(robot, plant, law, lambda generator: _work(robot, generator), limit)
    # A light joint is thrown about by its neighbours' accelerations: it gets gains for all the inertia in its row of M.
    inertia = np.abs(model.mass_matrix(sample_configurations(robot))).sum(axis=-1).max(axis=0)
    kd = np.minimum(1.4 * _LOOP * inertia, 0.25 * effective_inertia(robot, model) / RECORD_STEP)
    kp = _LOOP * kd / 1.4
    law = PD(model, feedforward="gravity", kp=kp, kd=kd)
    return _Bench(robot, plant, law, lambda generator: _excitation(robot, generator, speed), limit)


def _work(robot: Robot, generator: np.random.Generator) -> Sinusoid:
    """A motion of an arm at its work: frequency from 0.5 to 4 rad/s, any phase."""
    frequency = float(np.exp(generator.uniform(np.log(0.5), np.log(4.0))))
    usual = Sinusoid.for_robot(robot, frequency)
    return Sinusoid(usual.amplitude, usual.frequency, generator.uniform(-np.pi, np.pi, robot.nv), usual.offset)


def _excitation(robot: Robot, generator: np.random.Generator, speed: float) -> Multisine:
    """What the PD is made to aim at: its gains turn it into a torque of the same frequencies.

    The sum of the amplitudes keeps the aim inside the joint's range, wherever the trajectory begins in it.
    """
    n = robot.nv
    lower, upper = _box(robot)
    fastest, room = np.minimum(0.6 * speed, 0.35 * robot.velocity_limit), 0.35 * (upper - lower)
    low, high = np.log(_BAND)
    frequency = 2.0 * np.pi * np.exp(generator.uniform(low, high, (_TONES, n)))
    amplitude = generator.uniform(0.3, 1.0, (_TONES, n)) / frequency  # about equal speeds
    amplitude *= fastest / np.sqrt(0.5 * ((amplitude * frequency) ** 2).sum(axis=0))
    amplitude *= np.minimum(1.0, room / amplitude.sum(axis=0))
    swing = amplitude.sum(axis=0)
    offset = generator.uniform(lower + swing, upper - swing)
    return Multisine(amplitude, frequency, generator.uniform(-np.pi, np.pi, (_TONES, n)), offset)


def _measured(
    bench: _Bench,
    generator: np.random.Generator,
    count: int,
    stride: int,
    noise: Noise,
    differentiated: bool,
    prismatic: np.ndarray,
) -> tuple[np.ndarray, ...]:
    """t, q, v, v̇, τ of `count` samples of one trajectory, `stride` records apart.

    A derivative at the end of a record is a poor one: half a window more is recorded there, and left out.
    """
    window = QUANTISED_WINDOW if noise.encoder else CLEAN_WINDOW
    margin = window // 2 if differentiated else 0
    record = bench.record(generator, (count - 1) * stride + 1 + 2 * margin)
    q = quantised(record.q, noise.encoder, prismatic)
    v, a = record.v, record.a
    if noise.encoder:
        v, a = (derivative(q, RECORD_STEP, window, order) for order in (1, 2))
    elif differentiated:
        a = derivative(v, RECORD_STEP, window)
    rows = margin + stride * np.arange(count)
    return tuple(x[rows] for x in (record.t, q, v, a, record.tau))


def _uniform(
    robot: Robot, plant: MujocoPlant, samples: int, speed: float, generator: np.random.Generator
) -> tuple[np.ndarray, ...]:
    """q, v, v̇ and τ of independent states; torques are drawn as accelerations, which suit heavy and light joints."""
    shape = samples, robot.nv
    q = generator.uniform(*_box(robot), shape)
    v = np.minimum(speed, robot.velocity_limit) * generator.uniform(-1.0, 1.0, shape)
    limit = torque_limits(robot)
    wanted = 2.0 * speed * generator.standard_normal(shape)
    tau = np.clip(inverse_dynamics(PinocchioDynamics(robot), q, v, wanted), -limit, limit)
    return q, v, plant.acceleration(q, v, tau), tau


def torque_limits(robot: Robot) -> Float[np.ndarray, " n"]:
    """Largest torques of an experiment [N·m]: the arm's own, else what gravity asks at most and 20 rad/s² on top."""
    if np.isfinite(robot.effort_limit).all():
        return robot.effort_limit
    model = PinocchioDynamics(robot)
    heaviest = np.abs(model.gravity(sample_configurations(robot))).max(axis=0)
    return np.where(
        np.isfinite(robot.effort_limit), robot.effort_limit, heaviest + 20.0 * largest_inertia(robot, model)
    )


def _box(robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    """Where configurations are drawn from: the joint ranges, of which a turning joint needs one turn at most."""
    lower, upper = robot.sampling_range
    _, prismatic = joint_tree(robot)
    middle, half = 0.5 * (lower + upper), 0.5 * (upper - lower)
    half = np.where(prismatic, half, np.minimum(half, np.pi))
    return middle - half, middle + half
