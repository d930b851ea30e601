"""What motion without torque does not determine: networks learned from the paper's own data, and their torque scale."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from nbs_pin.accuracy.compare import best_scale
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.dynamics.equations import inverse_dynamics
from nbs_pin.dynamics.lagrangian import LagrangianDynamics
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.dynamics.provider import DynamicsProvider
from nbs_pin.identification.collect import collect
from nbs_pin.identification.datasets import Dataset
from nbs_pin.identification.fit import fit
from nbs_pin.reports.markdown import Section, markdown_table
from nbs_pin.reproduction.study import spread, write_records
from nbs_pin.robots.robot import Robot
from nbs_pin.simulation.mujoco_plant import MujocoPlant
from nbs_pin.simulation.processes import on_all_cores

FILE = "passive.csv"
ACTUATED = 10
"""Samples with torque from which the last columns take the factor."""
_FEW = 500


@dataclass(frozen=True)
class Learner:
    """A network, the data without torque from which it learns, and the iterations of the fit."""

    network: str
    data: str
    """"one swing", the paper's, 1 ms apart, `_FEW` of its samples, or "states everywhere", three times as many."""
    widths: tuple[int, ...]
    iterations: int


LEARNERS = (
    Learner("picnn", "one swing", (12, 12), 30),
    Learner("cholesky", "one swing", (20, 20), 40),
    Learner("cholesky", "states everywhere", (20, 20), 30),
)


class Row(NamedTuple):
    """What one seed learned."""

    network: str
    data: str
    seed: int
    acceleration_error: float
    """Relative error of v̇ at the data, motors off."""
    torque_error: float
    """Relative error of the torque there, for accelerations of the same size."""
    scale: float
    """c with τ ≈ c τ̂ there."""
    scaled_torque_error: float
    """Of c τ̂."""
    actuated_scale: float
    """c from `ACTUATED` samples with torque."""
    actuated_torque_error: float
    """Of that c τ̂."""


class Passive(NamedTuple):
    """What was learned, and the message with which `chain` refuses such data."""

    rows: list[Row]
    models: dict[tuple[str, str, int], LagrangianDynamics]
    """By network, data and seed."""
    refusal: str


def learn_passively(
    robot: Robot, seeds: Sequence[int], learners: Sequence[Learner], samples: int, progress: bool
) -> Passive:
    """Every learner with every seed on motions of the arm with its motors off; samples: those of the swing."""
    swing = collect(robot, "passive", samples)
    data = {"one swing": swing.take(np.linspace(0, samples - 1, min(_FEW, samples)).astype(int)),
            "states everywhere": coasting(collect(robot, "uniform", 3 * _FEW, seed=seeds[0]), robot)}  # fmt: skip
    truth, actuated = PinocchioDynamics(robot), collect(robot, "uniform", ACTUATED, seed=seeds[0] + 1)
    tasks = [(learner, data[learner.data], seed) for learner in learners for seed in seeds]
    rows, models = [], {}
    learned = on_all_cores(_learn, tasks, "learning without torque", progress)
    for (learner, own, seed), model in zip(tasks, learned, strict=True):
        models[learner.network, learner.data, seed] = model
        rows.append(Row(learner.network, learner.data, seed, *_judged(model, truth, own, actuated)))
    return Passive(rows, models, _refusal(swing))


def coasting(data: Dataset, robot: Robot) -> Dataset:
    """The same states with the motors off."""
    rest = np.zeros_like(data.tau)
    return replace(data, a=MujocoPlant(robot).acceleration(data.q, data.v, rest), tau=rest)


def section(found: Passive, folder: Path) -> Section:
    """The table and its text, with the file in the folder."""
    head = ["network, data", "v̇ error, motors off", "torque error", "c with τ ≈ c τ̂", "torque error of c τ̂",
            f"c from {ACTUATED} samples with torque", "torque error of that"]  # fmt: skip
    lines = []
    for group in dict.fromkeys((row.network, row.data) for row in found.rows):
        figures = zip(*(row[3:] for row in found.rows if (row.network, row.data) == group), strict=True)
        lines.append([", ".join(group), *map(spread, figures)])
    text = f"""
The paper learns from one swing of 10 s from rest with the motors off. With τ = 0, L and c·L have the same motions
(docs/theory.md §6): no such data determine the scale of the torque. A torque loss has the solution M = 0, so these
networks learn the acceleration. Relative errors where each was learned, least – **median** – greatest of seeds
{found.rows[0].seed} to {found.rows[-1].seed}; the torque is the one that the accelerations of the data, assigned to its
states in random order, need.

{markdown_table(head, lines)}

c should be 1. What is found instead depends on the first parameters of each network, also with states from everywhere,
however well the motions are explained: such a model is of no use for control (see Figure 5). Where they are explained
well, a few samples with torque determine c; what is left then is what the network did not learn. The networks are
smaller than the paper's, and learn from at most {_FEW} samples of the swing, evenly spread, or {3 * _FEW} states.

`fit(data, "chain")` refuses: "{found.refusal}\""""
    return Section("Data without torque", text, {"passive": write_records(folder / FILE, found.rows)})


def _learn(learner: Learner, data: Dataset, seed: int) -> DynamicsProvider:
    size: dict[str, Any] = {"widths": learner.widths, "iterations": learner.iterations}
    return fit(data, learner.network, seed, loss="acceleration", held_out=0.0, **size)


def _judged(model: Any, truth: DynamicsProvider, data: Dataset, actuated: Dataset) -> tuple[float, ...]:
    """The figures of a `Row` behind its seed."""
    a = data.a[np.random.default_rng(0).permutation(len(data))]
    true, modelled = (inverse_dynamics(d, data.q, data.v, a) for d in (truth, model))
    free = model.forward_dynamics(data.q, data.v, np.zeros_like(data.q))
    some = best_scale(actuated.tau, inverse_dynamics(model, actuated.q, actuated.v, actuated.a)).factor
    scale = best_scale(true, modelled)
    return (_relative(free, data.a), _relative(modelled, true), *scale, some, _relative(some * modelled, true))


def _relative(found: np.ndarray, true: np.ndarray) -> float:
    return float(np.linalg.norm(found - true) / np.linalg.norm(true))


def _refusal(data: Dataset) -> str:
    """The message with which fitting a chain refuses the data."""
    try:
        fit(data, "chain")
    except ArgumentError as error:
        return str(error)
    raise RuntimeError("a chain was fitted to data without torque; its scale means nothing.")
