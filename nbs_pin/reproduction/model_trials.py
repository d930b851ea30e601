"""A model of an arm, judged on states and motions that it has not seen: one trial of the studies of models."""

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from nbs_pin.accuracy.relative_errors import Box
from nbs_pin.base.csv_files import write_csv
from nbs_pin.base.plain import plain
from nbs_pin.dynamics.equations import inverse_dynamics
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.dynamics.provider import DynamicsProvider
from nbs_pin.identification.collect import collect
from nbs_pin.identification.datasets import Dataset
from nbs_pin.identification.fit import fit
from nbs_pin.reproduction.inverse_mlp import fit_mlp
from nbs_pin.robots.robot import Robot

SPEED, FAST = 2.0, 6.0
"""Uniform states move up to this [rad/s]; those that move faster than any uniform data."""
FRESH_SAMPLES, FRESH_SEED = 2_000, 900_000
"""What models are judged on is drawn once per arm, from a seed that no model's data have."""
MLP = "mlp"
"""The name of the plain network; every other one is a model that `fit` knows."""

Torque: TypeAlias = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


class Motion(NamedTuple):
    """States with accelerations and the torques that the motors need for them, (rows, n) each."""

    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    tau: np.ndarray


@dataclass(frozen=True)
class Trial:
    """One model of one dataset; NaN where a model has no such thing."""

    arm: str
    data: str
    """The recipe of the data."""
    samples: int
    seed: int
    model: str
    seconds: float
    """Of the fit [s]."""
    starts: int
    """Descents of a chain, 1 for other models."""
    torque_uniform: float
    """Root of the torque nMSE on fresh uniform states: mean over joints of mean squared error ÷ variance."""
    torque_fast: float
    """The same on uniform states at up to `FAST`."""
    torque_excited: float
    """The same on fresh excited trajectories."""
    mass_matrix: float
    """Relative Frobenius error of M over the uniform states."""
    coriolis: float
    """The same of C v."""
    gravity: float
    """The same of G."""
    indefinite: float
    """Share of the uniform states at which M̂ is not positive definite."""


@dataclass(frozen=True, eq=False)
class Judge:
    """The truth about an arm on uniform states and on excited trajectories, without any noise."""

    truth: PinocchioDynamics
    uniform: Motion
    fast: Motion
    excited: Motion

    @classmethod
    def of(cls, robot: Robot, friction: JointFriction | None = None, samples: int = FRESH_SAMPLES) -> "Judge":
        """Of that arm with that friction: its joint ranges, a whole turn at most, and `SPEED`; MuJoCo's trajectories.

        At rest a joint sticks in MuJoCo, with any torque up to its Coulomb friction: no model can know which.
        """
        truth = PinocchioDynamics(robot)
        q, v, a = Box.of_robot(robot, robot.nv, SPEED).states(np.random.default_rng(FRESH_SEED), samples)
        uniform, fast = (
            Motion(q, x, a, inverse_dynamics(truth, q, x, a) + (0.0 if friction is None else friction.torque(x)))
            for x in (v, FAST / SPEED * v)
        )
        data = collect(robot, "excited", samples, FRESH_SEED, friction=friction or False)
        return cls(truth, uniform, fast, Motion(data.q, data.v, data.a, data.tau))

    def torque_errors(self, torque: Torque) -> dict[str, Any]:
        """The errors of the torque in a `Trial`."""
        motions = {"uniform": self.uniform, "fast": self.fast, "excited": self.excited}
        return {f"torque_{name}": _torque_error(torque, motion) for name, motion in motions.items()}

    def floor(self, friction: JointFriction) -> float:
        """`Trial.torque_excited` of the truth itself with that friction."""
        motion = self.excited
        tau = inverse_dynamics(self.truth, motion.q, motion.v, motion.a) + friction.torque(motion.v)
        return _torque_error(lambda *_: tau, motion)

    def model_errors(self, model: DynamicsProvider) -> dict[str, Any]:
        """The other errors of a `Trial`; C v as what velocity adds to the torque, which is quick for every model."""
        q, v, rest = self.uniform.q, self.uniform.v, np.zeros_like(self.uniform.v)
        found, true = (
            {
                "mass_matrix": d.mass_matrix(q),
                "coriolis": inverse_dynamics(d, q, v, rest) - inverse_dynamics(d, q, rest, rest),
                "gravity": d.gravity(q),
            }
            for d in (model, self.truth)
        )
        errors = {name: float(np.linalg.norm(found[name] - x) / np.linalg.norm(x)) for name, x in true.items()}
        mass = found["mass_matrix"]
        least = np.linalg.eigvalsh(0.5 * (mass + np.swapaxes(mass, -1, -2)))[:, 0]
        return errors | {"indefinite": float(np.mean(least <= 0.0))}


def attempt(
    model: str, data: Dataset, seed: int, robot: Robot, judge: Judge, *, friction: bool = False, **settings: Any
) -> Trial:
    """The model fitted to the data and judged; settings of `fit`, or of `fit_mlp` for `MLP`.

    friction: viscous and Coulomb friction are learned with it. Raises KeyboardInterrupt when the fit was interrupted.
    """
    began = time.perf_counter()
    trial = Trial(robot.name, str(data.about["recipe"]), len(data), seed, model, 0.0, 1, *[np.nan] * 7)
    if model == MLP:
        mlp = fit_mlp(data, seed, transition=0.01 if friction else None, **settings)
        return replace(trial, seconds=time.perf_counter() - began, **judge.torque_errors(mlp.torque))
    found: Any = fit(data, model, seed, robot=robot, friction=friction, **settings)
    if found.report.stopped == "interrupted":
        raise KeyboardInterrupt
    drag: JointFriction | None = found.friction

    def torque(q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        return inverse_dynamics(found, q, v, a) + (0.0 if drag is None else drag.torque(v))

    return replace(
        trial,
        seconds=found.report.seconds,
        starts=found.report.details.get("starts", 1),
        **judge.torque_errors(torque),
        **judge.model_errors(found),
    )


def chosen(trials: Iterable[Trial], **wanted: Any) -> list[Trial]:
    """The trials with these entries."""
    return [t for t in trials if all(getattr(t, name) == value for name, value in wanted.items())]


def column(trials: Sequence[Trial], name: str) -> np.ndarray:
    """One entry of every trial."""
    return np.array([getattr(trial, name) for trial in trials], dtype=float)


def write_trials(trials: Sequence[Trial], path: Path) -> list[dict[str, Any]]:
    """The trials as a CSV file; returns them as JSON can store them."""
    rows = [asdict(trial) for trial in trials]
    write_csv(path, list(rows[0]), [list(row.values()) for row in rows])
    return [plain(row) for row in rows]


def _torque_error(torque: Torque, motion: Motion) -> float:
    squares = np.square(torque(motion.q, motion.v, motion.a) - motion.tau).mean(axis=0)
    return float(np.sqrt((squares / motion.tau.var(axis=0)).mean()))
