"""A model of an arm, judged on states and motions outside its data: one trial of the studies of models."""

import time
import warnings
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from nbs_pin.accuracy.relative_errors import Box
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
"""Largest speeds of the uniform states, and of states that move faster than any uniform data [rad/s]."""
FRESH_SAMPLES, FRESH_SEED = 2_000, 900_000
"""Models are judged on states drawn once per arm, with a seed that no model's data have."""
MLP = "mlp"
"""The name of the plain network; every other one is a model that `fit` knows."""

Torque: TypeAlias = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


class Motion(NamedTuple):
    """States with accelerations and the torques that the motors need for them, (rows, n) each."""

    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    tau: np.ndarray


class Trial(NamedTuple):
    """One model of one dataset; NaN where a model has no such quantity."""

    arm: str
    data: str
    """Recipe of the data."""
    samples: int
    seed: int
    model: str
    seconds: float
    """Duration of the fit [s]."""
    starts: int = 1
    """Descents of a chain, 1 for other models."""
    torque_uniform: float = np.nan
    """Root of the torque nMSE on fresh uniform states: mean over joints of mean squared error ÷ variance."""
    torque_fast: float = np.nan
    """The same on uniform states at up to `FAST`."""
    torque_excited: float = np.nan
    """The same on fresh excited trajectories."""
    mass_matrix: float = np.nan
    """Relative Frobenius error of M over the uniform states."""
    coriolis: float = np.nan
    """The same of C v."""
    gravity: float = np.nan
    """The same of G."""
    indefinite: float = np.nan
    """Share of the uniform states at which M̂ is not positive definite."""


class Judge(NamedTuple):
    """The truth about an arm on uniform states and on excited trajectories, without any noise."""

    truth: PinocchioDynamics
    uniform: Motion
    fast: Motion
    excited: Motion
    floor: float
    """`Trial.torque_excited` of the truth itself: in MuJoCo a joint at rest sticks, which no model can predict."""

    @classmethod
    def of(cls, robot: Robot, friction: JointFriction | None = None, samples: int = FRESH_SAMPLES) -> "Judge":
        """The judge of that arm with that friction: its joint ranges, a whole turn at most, and `SPEED`."""
        truth = PinocchioDynamics(robot)
        torque = motor_torque(truth, friction)
        q, v, a = Box.of_robot(robot, robot.nv, SPEED).states(np.random.default_rng(FRESH_SEED), samples)
        uniform, fast = (Motion(q, x, a, torque(q, x, a)) for x in (v, FAST / SPEED * v))
        data = collect(robot, "excited", samples, FRESH_SEED, friction=friction or False)
        excited = Motion(data.q, data.v, data.a, data.tau)
        return cls(truth, uniform, fast, excited, _torque_error(torque, excited))

    def torque_errors(self, torque: Torque) -> dict[str, Any]:
        """The errors of the torque in a `Trial`."""
        return {f"torque_{name}": _torque_error(torque, getattr(self, name)) for name in ("uniform", "fast", "excited")}

    def model_errors(self, model: DynamicsProvider) -> dict[str, Any]:
        """The other errors of a `Trial`; C v as what velocity adds to the torque, which is fast for every model."""
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
    """The model fitted to the data, with viscous and Coulomb friction or without, and judged.

    settings: those of `fit`, or of `fit_mlp` for `MLP`.
    """
    began = time.perf_counter()
    case = (robot.name, str(data.about["recipe"]), len(data), seed, model)
    if model == MLP:
        mlp = fit_mlp(data, seed, transition=0.01 if friction else None, **settings)
        return Trial(*case, time.perf_counter() - began, **judge.torque_errors(mlp.torque))
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*leave out friction=False")  # leaving it out is what is studied
        found = fit(data, model, seed, robot=robot, friction=friction, **settings)
    if found.report.stopped == "interrupted":
        raise KeyboardInterrupt
    errors = judge.torque_errors(motor_torque(found, found.friction)) | judge.model_errors(found)
    return Trial(*case, found.report.seconds, found.report.details.get("starts", 1), **errors)


def motor_torque(model: DynamicsProvider, friction: JointFriction | None) -> Torque:
    """The torque of the motors [N·m] for a motion (q, v, v̇), friction included."""

    def torque(q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        tau = inverse_dynamics(model, q, v, a)
        return np.asarray(tau if friction is None else tau + friction.feedforward(v, tau))

    return torque


def chosen(trials: Iterable[Trial], **wanted: Any) -> list[Trial]:
    """The trials with these entries."""
    return [t for t in trials if all(getattr(t, name) == value for name, value in wanted.items())]


def column(trials: Sequence[Trial], name: str) -> np.ndarray:
    """One entry of every trial."""
    return np.array([getattr(trial, name) for trial in trials], dtype=float)


def _torque_error(torque: Torque, motion: Motion) -> float:
    squares = np.square(torque(motion.q, motion.v, motion.a) - motion.tau).mean(axis=0)
    return float(np.sqrt((squares / motion.tau.var(axis=0)).mean()))
