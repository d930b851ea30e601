"""Runs of an adaptive law with loads, starts and disturbances that its transient bound is for, made of vectors."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import brentq

from nbs_pin.base.arrays import JointArray
from nbs_pin.base.exceptions import ArgumentError, SimulationDiverged
from nbs_pin.base.records import Run
from nbs_pin.certificates.adaptive_bound import TransientBound
from nbs_pin.certificates.fixed_beside import loaded_model
from nbs_pin.certificates.torque_waves import FASTEST
from nbs_pin.controllers.lyapunov_law import LyapunovLaw
from nbs_pin.kernels.adaptation import add_body
from nbs_pin.kernels.adaptive_rollouts import adaptive_rollout, adaptive_rollout_workspace
from nbs_pin.kernels.layout import Packed
from nbs_pin.kernels.rollouts import Course as Steps, Rollout
from nbs_pin.kernels.threads import over_cores
from nbs_pin.kernels.tree_layout import BASE, BODY, tree_workspace
from nbs_pin.kernels.trees import tree_torques
from nbs_pin.motions.references import DesiredMotion
from nbs_pin.simulation.dynamics_plant import DynamicsPlant
from nbs_pin.simulation.loop import Loop
from nbs_pin.simulation.plant_steps import stable_step
from nbs_pin.simulation.rollout import Batch, scene_of
from nbs_pin.simulation.simulate import simulate

_REACH = 1.5  # a coordinate beyond 1 of it counts as 1, so that the edge of a box is a third of what is tried
_SLOWEST = 0.1  # a wave of this rate is a constant [rad/s]
ROUNDING = 1.0 + 1e-9
"""A value beyond this multiple of its bound exceeds it."""


class Load(NamedTuple):
    """A point mass at the frame that carries the load."""

    mass: float
    """[kg]"""
    centre: Float[np.ndarray, "3"]
    """Where it is in that frame [m]."""

    def told(self, frame: str) -> str:
        """In words."""
        centre = ", ".join(f"{1e3 * x:z.0f}" for x in self.centre)
        return f"{self.mass:.3g} kg at ({centre}) mm of {frame}"


class Reached(NamedTuple):
    """The largest values along one run or several."""

    storage: float
    """V with the inertia of the loaded arm [J]."""
    joint_errors: JointArray
    """|z1_i| [rad, m]."""

    def exceeds(self, bound: TransientBound) -> bool:
        """Whether a bound is exceeded, or a value is no number."""
        kept = (self.joint_errors <= bound.joint_errors * ROUNDING).all()
        return not (kept and self.storage <= bound.storage_within * ROUNDING)


class Trial(NamedTuple):
    """What a run is made of."""

    motion: int
    load: Load
    q0: JointArray
    v0: JointArray
    tau_d: Float[np.ndarray, "steps n"]
    """Held over each period [N·m]."""


class Course(NamedTuple):
    """One motion at the control instants, as `simulation.rollout.Batch` has it."""

    aims: Float[np.ndarray, "steps 4 n"]
    leads: Float[np.ndarray, " steps"]
    desired: Float[np.ndarray, "rows 3 n"]


@dataclass(eq=False)
class TransientSearch:
    """Runs of one loop, each made of a vector of numbers from 0 to 1, and the worst of them so far."""

    bound: TransientBound
    motions: Sequence[DesiredMotion]
    steps: int
    period: float
    runs: int = 0
    cut: int = 0
    """How many of them had a torque that was cut off."""
    worst: float = 0.0
    """The largest |z1_i| as a share of its bound."""
    storage: float = 0.0
    joint_errors: JointArray = field(default_factory=lambda: np.zeros(0))
    best: Trial | None = None
    beyond: tuple[float, Trial] | None = None
    """The trial that exceeds a bound by most, and by how much."""

    def __post_init__(self) -> None:
        law = self.bound.law
        inner = law.law
        assert isinstance(inner, LyapunovLaw)  # as no other law adapts a load
        if law.compile() is law:
            raise ArgumentError(
                f"the search needs machine code, and a {type(law).__name__} around a {type(inner).__name__} has none; "
                "give an AdaptiveLaw around a law of the package."
            )
        self.inner, self.parts = inner, law.parts_in_c()
        self.carried = next(body for body in law.unknowns.bodies if body.is_load)
        n, waves = inner.nv, 2 if self.bound.admissible.radius is None else 3
        self.sizes = {
            "motion": 1,
            "mass": 1,
            "centre": 3 if self.bound.load_radius > 0.0 else 0,
            "start": 1 + 2 * n if self.bound.start > 0.0 else 0,
            "waves": 0 if self.bound.admissible.is_zero else waves * n,
        }
        self.joint_errors = np.zeros(n)
        self.courses = [self._course(motion, self.period) for motion in self.motions]

    @property
    def size(self) -> int:
        """Numbers of a vector."""
        return sum(self.sizes.values())

    def told(self) -> str:
        """How far it is, for a progress bar."""
        return f"attack: {100.0 * self.worst:.3g} % of a joint's bound so far"

    def expected(self, motion: int, x: Float[np.ndarray, " size"]) -> Float[np.ndarray, " size"]:
        """The vector with that motion and the load that is farthest from the first estimate."""
        x, worst = x.copy(), self.bound.worst
        x[0], x[1] = (motion + 0.5) / len(self.motions), worst.mass / (self.bound.load_mass * _REACH)
        if self.sizes["centre"]:
            x[2:5] = 0.5 + 0.5 * worst.centre / (self.bound.load_radius * _REACH)
        return x

    def shares(self, vectors: Float[np.ndarray, "runs size"]) -> Float[np.ndarray, " runs"]:
        """The largest |z1_i| of each run as a share of its bound; 0 where a torque was cut off."""
        trials = [self.trial(x) for x in vectors]
        found = self.reached(trials, self.period, self.courses)
        self.runs += len(trials)
        shares = np.zeros(len(trials))
        for k, (trial, reached) in enumerate(zip(trials, found, strict=True)):
            if reached is None:
                self.cut += 1
                continue
            shares[k] = (reached.joint_errors / self.bound.joint_errors).max()
            self.storage = max(self.storage, reached.storage)
            self.joint_errors = np.maximum(self.joint_errors, reached.joint_errors)
            if self.best is None or shares[k] > self.worst:
                self.worst, self.best = float(shares[k]), trial
            most = max(float(shares[k]), math.sqrt(reached.storage / self.bound.storage_within))
            if reached.exceeds(self.bound) and (self.beyond is None or most > self.beyond[0]):
                self.beyond = most, trial
        return shares

    def repeated(self, trial: Trial, finer: int) -> Reached | None:
        """What the same trial reaches with a period so many times shorter; None if a torque is cut off."""
        period = self.period / finer
        course = self._course(self.motions[trial.motion], period)
        again = trial._replace(motion=0, tau_d=np.repeat(trial.tau_d, finer, axis=0))
        return self.reached([again], period, [course])[0]

    def run(self, trial: Trial) -> Run:
        """The run of a trial, recorded with its estimates."""
        truth = loaded_model(self.bound.law, self.bound.frame, trial.load.mass, trial.load.centre)

        def disturbance(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
            return trial.tau_d[min(int(t / self.period + 1e-6), self.steps - 1)]

        return simulate(
            DynamicsPlant(truth, friction=self.bound.friction), self.bound.law, self.motions[trial.motion],
            self.steps * self.period, self.period, q0=trial.q0, v0=trial.v0, disturbance=disturbance, check=False,
            plant_step=self._loop(self.period).step,
        )  # fmt: skip

    def trial(self, x: Float[np.ndarray, " size"]) -> Trial:
        """What a vector stands for."""
        ends = np.cumsum(list(self.sizes.values()))[:-1]
        parts = dict(zip(self.sizes, np.split(x, ends), strict=True))
        motion = min(int(parts["motion"][0] * len(self.motions)), len(self.motions) - 1)
        load = Load(self.bound.load_mass * _edged(parts["mass"][0]), self._centre(parts["centre"]))
        q, v = self.courses[motion].desired[0, :2]
        q0, v0 = self._start(parts["start"], load, q, v) if self.sizes["start"] else (q, v)
        waves = self._waves(parts["waves"].reshape(-1, self.inner.nv)) if self.sizes["waves"] else None
        return Trial(motion, load, q0, v0, np.zeros((self.steps, len(q))) if waves is None else waves)

    def reached(self, trials: Sequence[Trial], period: float, courses: Sequence[Course]) -> list[Reached | None]:
        """What every trial reaches with this control period [s]; None where a torque is cut off.

        Raises SimulationDiverged for a motion that diverges without it.
        """
        found: list[Reached | None] = [None] * len(trials)
        loop, (law, tree, _, adapting) = self._loop(period), self.parts
        scene = scene_of(self.inner, loop)
        assert scene is not None
        assert tree is not None
        assert adapting is not None  # as the law has machine code
        size = adaptive_rollout_workspace(law, tree, scene)

        def run(part: slice) -> None:
            work = np.zeros(size)
            for k in range(len(trials))[part]:
                found[k] = one(trials[k], work)

        def one(trial: Trial, work: np.ndarray) -> Reached | None:
            course, truth = courses[trial.motion], self.loaded(trial.load)
            steps, n = trial.tau_d.shape
            q, v = np.empty((2, steps + 1, n))
            q[0], v[0] = trial.q0, trial.v0
            motion = Rollout(q, v, np.empty((steps, n)), np.empty((steps + 1, 2, n)))
            aims = Steps(course.aims, course.leads, trial.tau_d)
            finite = adaptive_rollout(
                aims, scene._replace(truth=truth), scene.limit, law, tree, adapting.unknown, adapting.start.copy(),
                work, motion,
            )  # fmt: skip
            if not finite:
                raise SimulationDiverged(
                    f"the closed loop diverged with {trial.load.told(self.bound.frame)}; take a shorter control "
                    f"period than {period:g} s."
                )
            if (np.abs(motion.command) > scene.limit).any():
                return None
            q_ref, v_ref, _ = course.desired.swapaxes(0, 1)
            values = loaded_storage(self.inner, truth, motion.q, motion.v, q_ref, v_ref)
            errors = np.abs(self.inner.dynamics.difference(motion.q, q_ref)).max(axis=0)
            return Reached(float(values.max()), errors)

        over_cores(run, len(trials), fewest=1)
        return found

    def loaded(self, load: Load) -> Packed:
        """The tree of the arm with that load."""
        tree = self.parts.tree
        assert tree is not None
        weights = tree.weights.copy()
        point = self.carried.place @ np.append(load.centre, 1.0)
        begin = BASE + BODY * self.carried.joint
        add_body((load.mass * np.outer(point, point)).ravel(), np.zeros(10), weights[begin : begin + BODY])
        return Packed(tree.layout, weights)

    def _loop(self, period: float) -> Loop:
        plant = DynamicsPlant(self.inner.dynamics, friction=self.bound.friction)
        steps, robot = round(self.steps * self.period / period), self.bound.law.robot
        given = {"plant_step": stable_step(plant, robot, period), "effort_limit": None, "lookahead": None}
        return Loop.of(plant, self.inner.nv, steps * period, period, **given)

    def _course(self, motion: DesiredMotion, period: float) -> Course:
        batch = Batch.of(self._loop(period), motion)
        return Course(batch.aims[0], batch.leads, batch.desired[0])

    def _centre(self, x: Float[np.ndarray, " k"]) -> Float[np.ndarray, "3"]:
        """A place within the radius of the load, often at its edge."""
        if not len(x):
            return np.zeros(3)
        y = _REACH * (2.0 * x - 1.0)
        return np.asarray(self.bound.load_radius * y / max(1.0, float(np.linalg.norm(y))))

    def _start(
        self, x: Float[np.ndarray, " k"], load: Load, q: JointArray, v: JointArray
    ) -> tuple[JointArray, JointArray]:
        """The state in a direction from the reference with a share of the V(0) of the bound."""
        target, away, tree = self.bound.start * _edged(x[0]), np.split(2.0 * x[1:] - 1.0, 2), self.loaded(load)
        unit = self.bound.joint_errors
        dq, dv = unit * away[0], max(self.inner.inertial_rate, 1.0) * unit * away[1]

        def beyond(scale: float) -> float:
            at = (q + scale * dq)[None], (v + scale * dv)[None]
            return float(loaded_storage(self.inner, tree, *at, q[None], v[None])[0]) - target

        if target == 0.0 or not np.any(x[1:] != 0.5):
            return q, v
        most = 1.0
        while beyond(most) < 0.0:
            most *= 2.0
        scale = brentq(beyond, 0.0, most) * (1.0 - 1e-6)
        return q + scale * dq, v + scale * dv

    def _waves(self, x: Float[np.ndarray, "rows n"]) -> Float[np.ndarray, "steps n"]:
        """Square waves on the boundary of the disturbances, of rate, phase and, in a ball, weight of every joint."""
        rate, phase = _SLOWEST * (FASTEST / _SLOWEST) ** x[0], 2.0 * np.pi * x[1]
        t = self.period * np.arange(self.steps)[:, None]
        signs = np.where(np.sin(rate * t + phase) >= 0.0, 1.0, -1.0)
        return self.bound.admissible.towards(signs * (x[2] + 1e-3) if len(x) > 2 else signs)


def loaded_storage(
    law: LyapunovLaw,
    tree: Packed,
    q: Float[np.ndarray, "rows n"],
    v: Float[np.ndarray, "rows n"],
    q_ref: Float[np.ndarray, "rows n"],
    v_ref: Float[np.ndarray, "rows n"],
) -> Float[np.ndarray, " rows"]:
    """V with the inertia of the arm as it is, a packed tree [J]."""
    e = law.errors(q, v, q_ref, v_ref, np.zeros_like(v_ref))
    work, still, torques = np.empty(tree_workspace(tree)), np.zeros_like(q), []
    for a in (e.z2, still):  # M z2 + G, and G
        torques.append(np.empty_like(q))
        tree_torques(np.ascontiguousarray(q), still, still, np.ascontiguousarray(a), *tree, work, torques[-1])
    return np.asarray(e.value + 0.5 * (e.z2 * (torques[0] - torques[1])).sum(axis=-1))


def _edged(x: float) -> float:
    """From 0 to 1, 1 for a third of all x."""
    return min(1.0, _REACH * x)
