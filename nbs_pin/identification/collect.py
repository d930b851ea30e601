"""Collection of identification data in MuJoCo: exciting motions, typical motions, a free swing and random states."""

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any, Literal, NamedTuple, TypeAlias, get_args

import numpy as np

from nbs_pin.base.arguments import SEED, a, checked, choice, count, either, flag, maybe, number
from nbs_pin.base.arrays import Array, Vectors
from nbs_pin.base.checks import whole
from nbs_pin.base.doors import option
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.progress import tracked
from nbs_pin.controllers.controller import Controller, MemorylessController
from nbs_pin.controllers.pd import PD
from nbs_pin.dynamics.equations import inverse_dynamics
from nbs_pin.dynamics.friction import FRICTION, JointFriction
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.identification.datasets import Dataset
from nbs_pin.identification.excitation import configuration_box, excitation, soft_pd, torque_limits, work
from nbs_pin.identification.measurement import CLEAN_WINDOW, QUANTISED_WINDOW, Noise, derivative, quantised
from nbs_pin.motions.references import MOTION, DesiredMotion, Hold
from nbs_pin.robots.robot import ARM, Robot
from nbs_pin.simulation.mujoco_plant import MujocoPlant
from nbs_pin.simulation.simulate import simulate

Recipe: TypeAlias = Literal["excited", "reference", "passive", "uniform"]
"""Recipes of `collect`."""
Acceleration: TypeAlias = Literal["simulator", "differentiated"]
"""Sources of v̇."""
RECORD_STEP = 1e-3
"""Control period, plant step and spacing of the samples that are differentiated [s]."""
_TIMED = ("excited", "reference")
_TRAJECTORIES = 20
_DURATION = 3.0  # [s]


@checked(
    robot=ARM,
    recipe=choice(*get_args(Recipe)),
    samples=count(1, 10_000_000),
    seed=SEED,
    noise=maybe(a(Noise, "Noise, such as Noise(encoder=2**-16)")),
    acceleration=maybe(choice(*get_args(Acceleration))),
    friction=either(FRICTION, flag),
    sampling=maybe(number(least=RECORD_STEP, most=10.0, unit="s")),
    duration=maybe(number(above=0.0, most=1000.0, unit="s")),
    reference=maybe(MOTION),
    speed=number(above=0.0, most=1000.0, unit="rad/s"),
    progress=flag,
)
def collect(
    robot: Robot,
    recipe: str = "excited",
    samples: int = 10_000,
    seed: int = 0,
    *,
    noise: Noise | None = None,
    acceleration: str | None = None,
    friction: bool | JointFriction = False,
    sampling: float | None = None,
    duration: float | None = None,
    reference: DesiredMotion | None = None,
    speed: float = 2.0,
    progress: bool = False,
) -> Dataset:
    """Collect samples of the arm's motion in MuJoCo, as they would be recorded in an experiment.

    - "excited": random multisine torques, 0.2 to 1.5 Hz, about a soft PD, from anywhere in the joint ranges
    - "reference": PD+ along `reference`, or `Sinusoid.for_robot` of random frequency and phase, as in typical use
    - "passive": one swing from rest at q = 0 without torque, a sample every 1 ms: the paper's data, which cannot
      distinguish M, G from c·M, c·G (docs/theory.md §6)
    - "uniform": independent random q (one turn at most), v and τ within limits; not measurable, but fully identifiable

    Args:
        robot: The arm. A joint without torque limit gets one: its largest gravity torque plus that of 20 rad/s².
        recipe: One of the above.
        samples: Number of samples.
        seed: Random seed; the same seed gives the same data.
        noise: Errors of encoders and torque sensors. None takes exact ones.
        acceleration: Source of v̇, "simulator" or "differentiated" from v (Savitzky–Golay); τ is then the mean of the
            torques held before and after. None takes "simulator"; quantised encoders give v and v̇ as derivatives of q.
        friction: True simulates that of the URDF, a `JointFriction` another (MuJoCo has no transition); τ includes it.
        sampling: Sampling time [s], whole ms. None takes 0.001 for "passive", else 0.01 to 0.05, for 20 trajectories;
            0.001 to 0.05, for one, along a given reference.
        duration: Longest "excited" or "reference" trajectory [s]. None takes the `reference.duration`, else 3.
        reference: A motion for the recipe of that name, such as an `ExcitingMotion`; every trajectory begins with it.
        speed: Bound of |v| in "uniform" [rad/s]; typical |v| in "excited", with peaks near the velocity limit.
        progress: Show a progress bar at a terminal if the collection takes longer than 2 s.

    Raises:
        ArgumentError: If the recipe is unknown or a setting does not fit it.
        RobotError: If MuJoCo cannot build the arm.
        SimulationDiverged: If the simulated state is no longer finite.
        KeyboardInterrupt: On Ctrl-C in the first trajectory; later, whole ones are returned (`about["interrupted"]`).

    Example:
        >>> import nbs_pin as nbs
        >>> nbs.collect(nbs.load_robot("two_link"), "uniform", samples=100)
        Dataset(100 samples of two_link, 100 trajectories, 2 joints)
    """
    noise = noise or Noise()
    _check(recipe, noise, acceleration, reference)
    acting = JointFriction.of(robot) if friction is True else friction or None
    counts, interval, stride = _parts(recipe, samples, sampling, duration, reference)
    generator, differentiated = np.random.default_rng(seed), acceleration == "differentiated" or noise.encoder > 0.0
    bench, interrupted = _bench(recipe, robot, acting, speed, reference), False
    if recipe == "uniform":
        counts, columns = [1] * samples, _states(bench, samples, speed, generator)
    else:
        read = partial(_Instruments(stride, noise, differentiated).read, bench, generator)
        columns, counts, interrupted = _readings(read, counts, progress)
    about: dict[str, Any] = {
        "recipe": recipe,
        "seed": seed,
        "noise": asdict(noise),
        "acceleration": "differentiated" if differentiated else "simulator",
        "friction": acting and {"viscous": acting.viscous.tolist(), "coulomb": acting.coulomb.tolist()},
        "sampling": None if recipe == "uniform" else interval,
        "speed": speed,
        "interrupted": interrupted,
        "robot": {"source": robot.source, "sha256": robot.sha256, "options": robot.options},
    }
    t, q, v, a, tau = columns
    tau, of = tau + noise.torque * generator.standard_normal(tau.shape), np.repeat(np.arange(len(counts)), counts)
    return Dataset(q, v, a, tau, t, of, robot.parents, robot.prismatic, robot.name, about)


def _readings(
    read: Callable[[int], tuple[np.ndarray, ...]], counts: list[int], progress: bool
) -> tuple[tuple[np.ndarray, ...], list[int], bool]:
    """t, q, v, v̇ and τ of all trajectories, their lengths, and whether Ctrl-C came before the last of them."""
    seen: list[tuple[np.ndarray, ...]] = []
    try:
        for k in tracked(counts, "collecting data", progress):
            seen.append(read(k))
    except KeyboardInterrupt:
        if not seen:
            raise
    columns = tuple(np.concatenate(parts) for parts in zip(*seen, strict=True))
    return columns, counts[: len(seen)], len(seen) < len(counts)


class _Idle(MemorylessController):
    """Zero torque."""

    def __init__(self, nv: int) -> None:
        self._nv = nv

    @property
    def nv(self) -> int:
        """Number of joints."""
        return self._nv

    def torque(self, q: Array, v: Array, q_ref: Array, v_ref: Array, a_ref: Array) -> Vectors:
        """τ = 0 [N·m]."""
        return 0.0 * q


class _Record(NamedTuple):
    """States `RECORD_STEP` apart, the torque held from each to the next, and the acceleration at its start."""

    t: np.ndarray
    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    tau: np.ndarray


@dataclass(frozen=True, eq=False)
class _Bench:
    """The test bench: what all trajectories of a collection share."""

    robot: Robot
    plant: MujocoPlant
    law: Controller
    motion: Callable[[np.random.Generator], DesiredMotion]
    """Draws the reference of one trajectory."""
    friction: JointFriction | None
    limit: np.ndarray
    """Largest torques (n,) [N·m]."""

    def record(self, generator: np.random.Generator, rows: int) -> _Record:
        """One trajectory from the start of its motion."""
        motion, duration = self.motion(generator), max(rows - 1, 1) * RECORD_STEP
        run = simulate(
            self.plant, self.law, motion, duration, RECORD_STEP, effort_limit=self.limit, lookahead=0.0, check=False
        )
        t, q, v, tau = (x[:rows] for x in (run.t, run.q, run.v, run.tau))
        return _Record(t, q, v, self.plant.acceleration(q, v, tau), tau)


def _bench(
    recipe: str, robot: Robot, friction: JointFriction | None, speed: float, reference: DesiredMotion | None
) -> _Bench:
    aims: dict[str, Callable[[np.random.Generator], DesiredMotion]] = {
        "excited": partial(excitation, robot, speed=speed),
        "reference": partial(work, robot) if reference is None else lambda _: reference,
    }
    law: Controller = _Idle(robot.nv)
    if recipe == "excited":
        law = soft_pd(robot, friction, period=RECORD_STEP)
    elif recipe == "reference":
        law = PD.for_robot(robot, friction=friction, period=RECORD_STEP)
    plant = MujocoPlant(robot, joint_friction="drop" if friction is None else friction)
    aim = aims.get(recipe, lambda _: Hold(np.zeros(robot.nv)))
    return _Bench(robot, plant, law, aim, friction, torque_limits(robot))


@dataclass(frozen=True)
class _Instruments:
    """Sampling, noise and differentiation of a record."""

    stride: int
    """Rows of the record per sample."""
    noise: Noise
    differentiated: bool

    def read(self, bench: _Bench, generator: np.random.Generator, count: int) -> tuple[np.ndarray, ...]:
        """t, q, v, v̇ and τ of `count` samples, half a window away from the ends of the record if differentiated."""
        window = QUANTISED_WINDOW if self.noise.encoder else CLEAN_WINDOW
        margin = window // 2 if self.differentiated else 0
        record = bench.record(generator, (count - 1) * self.stride + 1 + 2 * margin)
        q, v, a, tau = quantised(record.q, self.noise.encoder, bench.robot.prismatic), *record[2:]
        if self.noise.encoder:
            v, a = (derivative(q, RECORD_STEP, window, order) for order in (1, 2))
        elif self.differentiated:
            a = derivative(v, RECORD_STEP, window)
        if self.differentiated:
            tau = 0.5 * (tau + np.vstack((tau[:1], tau[:-1])))
        rows = margin + self.stride * np.arange(count)
        return tuple(x[rows] for x in (record.t, q, v, a, tau))


def _states(bench: _Bench, samples: int, speed: float, generator: np.random.Generator) -> tuple[np.ndarray, ...]:
    """t, q, v, v̇ and τ of independent states; torques follow from random v̇, which suits heavy and light joints."""
    shape = samples, bench.robot.nv
    lower, upper = configuration_box(bench.robot)
    q = lower + (upper - lower) * generator.random(shape)
    v = np.minimum(speed, bench.robot.velocity_limit) * generator.uniform(-1.0, 1.0, shape)
    wanted = 2.0 * speed * generator.standard_normal(shape)
    tau = inverse_dynamics(PinocchioDynamics(bench.robot), q, v, wanted)
    if bench.friction is not None:
        tau = tau + bench.friction.feedforward(v, tau)
    tau = np.clip(tau, -bench.limit, bench.limit)
    return np.zeros(samples), q, v, bench.plant.acceleration(q, v, tau), tau


def _interval(recipe: str, samples: int, sampling: float | None, duration: float, trajectories: int) -> float:
    """Time between samples [s]: `sampling`, or the default of the recipe, for so many trajectories."""
    if sampling is None:
        spread = round(trajectories * duration / samples / RECORD_STEP)
        sampling = RECORD_STEP * (1 if recipe == "passive" else min(max(spread, 10 if trajectories > 1 else 1), 50))
    if duration < sampling and recipe in _TIMED:
        raise ArgumentError(f"duration is {duration} s, expected at least sampling = {sampling:g} s; make it longer.")
    return sampling


def _parts(
    recipe: str, samples: int, sampling: float | None, duration: float | None, reference: DesiredMotion | None
) -> tuple[list[int], float, int]:
    """Samples of each trajectory, the time between samples [s], and how many rows of the record that is."""
    longest = float(getattr(reference, "duration", _DURATION)) if duration is None else duration
    interval = _interval(recipe, samples, sampling, longest, 1 if reference else _TRAJECTORIES)
    stride = whole(interval, RECORD_STEP, "sampling", "step of the record")
    if recipe == "passive":
        return [samples], interval, stride
    return _shares(samples, int(longest / interval + 1e-9), 1 if reference else 2), interval, stride


def _shares(samples: int, longest: int, fewest: int) -> list[int]:
    """Samples of each trajectory: nearly equal, at most `longest`, for `fewest` trajectories or more if possible."""
    count = min(max(math.ceil(samples / max(longest, 1)), fewest), samples)
    return np.diff(np.linspace(0, samples, count + 1).astype(int)).tolist()


def _check(recipe: str, noise: Noise, acceleration: str | None, reference: DesiredMotion | None) -> None:
    if reference is not None and recipe != "reference":
        remedy = option("recipe", "reference")
        raise ArgumentError(f"a reference was given, and recipe '{recipe}' follows none; give {remedy}.")
    if noise.encoder > 0.0 and acceleration == "simulator":
        raise ArgumentError("acceleration 'simulator' excludes rounded encoders; leave acceleration out.")
    if recipe == "uniform" and (noise.encoder > 0.0 or acceleration == "differentiated"):
        raise ArgumentError(
            "recipe 'uniform' has single states and nothing to differentiate; give another recipe or only torque noise."
        )
