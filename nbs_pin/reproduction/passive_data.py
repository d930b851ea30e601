"""What motion without torque leaves open: networks learned from the paper's own data, and their torque scale."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import joblib
import numpy as np

from nbs_pin.accuracy.compare import best_scale
from nbs_pin.base.csv_files import write_csv
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.plain import plain
from nbs_pin.base.progress import tracked
from nbs_pin.dynamics.equations import inverse_dynamics
from nbs_pin.dynamics.lagrangian import LagrangianDynamics
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.dynamics.provider import DynamicsProvider
from nbs_pin.identification.collect import collect
from nbs_pin.identification.datasets import Dataset
from nbs_pin.identification.fit import fit
from nbs_pin.kernels.threads import cores
from nbs_pin.reports.markdown import Section, markdown_table, short
from nbs_pin.robots.robot import Robot
from nbs_pin.simulation.mujoco_plant import MujocoPlant

FILE = "passive.csv"
"""What `write` writes."""
ACTUATED = 10
"""Samples with torque that the last columns take the factor from."""
_FEW = 500


@dataclass(frozen=True)
class Learner:
    """A network, the data without torque it learns from, and how long."""

    network: str
    data: str
    """"one swing", the paper's, or "states everywhere"."""
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
    """Relative error of v̇ where it learned, motors off."""
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
    """The rows, every model by (network, data, seed), and why `chain` learns nothing from such data."""

    rows: list[Row]
    models: dict[tuple[str, str, int], LagrangianDynamics]
    refusal: str


def learn_passively(
    robot: Robot,
    seeds: Sequence[int],
    learners: Sequence[Learner] = LEARNERS,
    samples: int = 10_000,
    progress: bool = False,
) -> Passive:
    """Every learner with every seed on motions of the arm with its motors off, and each held against the truth.

    samples: of the paper's swing, 1 ms apart; of all of them 500, evenly spread, are learned from: its speeds show
    through. The states everywhere are three times as many.
    """
    swing = collect(robot, "passive", samples)
    data = {"one swing": swing.take(np.linspace(0, samples - 1, min(_FEW, samples)).astype(int)),
            "states everywhere": coasting(collect(robot, "uniform", 3 * _FEW, seed=seeds[0]), robot)}  # fmt: skip
    truth, actuated = PinocchioDynamics(robot), collect(robot, "uniform", ACTUATED, seed=seeds[0] + 1)
    tasks = [(learner, seed) for learner in learners for seed in seeds]
    rows, models = [], {}
    learned = _learned([(learner, data[learner.data], seed) for learner, seed in tasks])
    for learner, seed in tracked(tasks, "learning without torque", progress):
        model = models[learner.network, learner.data, seed] = next(learned)
        rows.append(Row(learner.network, learner.data, seed, *_judged(model, truth, data[learner.data], actuated)))
    return Passive(rows, models, _refusal(swing))


def coasting(data: Dataset, robot: Robot) -> Dataset:
    """The same states with the motors off."""
    rest = np.zeros_like(data.tau)
    return replace(data, a=MujocoPlant(robot).acceleration(data.q, data.v, rest), tau=rest)


def write(found: Passive, folder: Path) -> Path:
    """Every row as a file."""
    return write_csv(folder / FILE, Row._fields, found.rows)


def section(found: Passive) -> Section:
    """The part of the page that tells of it."""
    head = ["network, data", "v̇ error, motors off", "torque error", "c with τ ≈ c τ̂", "torque error of c τ̂",
            f"c from {ACTUATED} samples with torque", "torque error of that"]  # fmt: skip
    groups: dict[tuple[str, str], list[Row]] = {}
    for row in found.rows:
        groups.setdefault((row.network, row.data), []).append(row)
    lines = [
        [f"{network}, {data}", *(_spread(column) for column in list(zip(*rows, strict=True))[3:])]
        for (network, data), rows in groups.items()
    ]
    seeds = sorted({row.seed for row in found.rows})
    text = f"""
The paper learns from one swing of 10 s from rest with the motors off. With τ = 0, L and c·L have the same motions
(docs/theory.md §6): no such data can tell the scale of the torque. A torque loss has the solution M = 0, so these
networks learn the acceleration. Relative errors where each was learned, least – **median** – greatest of seeds
{seeds[0]} to {seeds[-1]}; the torque is the one that the accelerations of the data, dealt anew to its states, need.

{markdown_table(head, lines)}

c should be 1. What is found instead comes from where each network began, also with states from everywhere, however
well the motions are explained: no use for control (see Figure 5). Where they are explained well, a few samples with
torque settle c; what is left then is what the network did not learn. The networks are smaller than the paper's, and
learn from at most {_FEW} samples of the swing, evenly spread, or {3 * _FEW} states.

`fit(data, "chain")` refuses: "{found.refusal}\""""
    return Section("Data without torque", text, {"passive": plain([row._asdict() for row in found.rows])})


def _learned(tasks: Sequence[tuple[Learner, Dataset, int]]) -> Iterator[Any]:
    """A model per task, in order, on all cores."""
    with joblib.parallel_config(backend="loky", inner_max_num_threads=1):
        pool = joblib.Parallel(n_jobs=min(cores(), len(tasks)), return_as="generator")
        yield from pool(joblib.delayed(_learn)(*task) for task in tasks)


def _learn(learner: Learner, data: Dataset, seed: int) -> DynamicsProvider:
    return fit(
        data, learner.network, seed, loss="acceleration", held_out=0.0, widths=learner.widths,
        iterations=learner.iterations,
    )  # fmt: skip


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
    """What fitting a chain says; raises RuntimeError when it says nothing."""
    try:
        fit(data, "chain")
    except ArgumentError as error:
        return str(error)
    raise RuntimeError("a chain was fitted to data without torque; its scale means nothing.")


def _spread(values: Sequence[float]) -> str:
    if len(values) == 1:
        return short(values[0])
    return f"{short(min(values))} – **{short(float(np.median(values)))}** – {short(max(values))}"
