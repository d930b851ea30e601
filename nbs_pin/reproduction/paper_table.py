"""The paper's Table I, row by row: what it prints, its own program re-created, and this package's laws."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from nbs_pin.base.progress import tracked
from nbs_pin.base.records import Run
from nbs_pin.controllers.neural_backstepping import paper_controller
from nbs_pin.controllers.pid import PID
from nbs_pin.dynamics.analytic import AnalyticDynamics
from nbs_pin.motions.references import paper_reference
from nbs_pin.reproduction.authors import PERIOD, AuthorsLaw, follow_authors, task, train_authors
from nbs_pin.simulation import metrics
from nbs_pin.simulation.costs import squared_error
from nbs_pin.simulation.rollout import Batch, motions, recorded
from nbs_pin.training.train import Regulariser, train

DISTURBANCE = np.array([1.0, 1.0])
"""The paper's τ_d [N·m]."""
COLUMNS = (
    "steady_error_shifted_rad2",
    "convergence_time_shifted_s",
    "steady_error_rad2",
    "convergence_time_s",
    "peak_torque_Nm",
)
"""Figures of every run: as the authors count, then aligned in time, then what the paper leaves out."""
PRINTED = {
    "PID": (2.06e-3, 15.54),
    "NBS without training": (1.30e-6, 5.72),
    "NBS after training": (1.22e-6, 0.13),
    "NBS under τ_d = [1, 1], α = 1": (1.25e-3, 0.13),
}
"""The rows of Table I: steady error [rad²] and convergence time [s]."""
PIDS = {"nearest to the paper's": (400.0, 5.0, 5.0), "best of a grid": (400.0, 100.0, 30.0)}
"""Gains K_p, K_i, K_d, the same for both joints; the paper names none.

Of 6 × 7 × 5 combinations tried on this task, the ones nearest to the printed row and fastest to converge.
"""


@dataclass(frozen=True, eq=False)
class Row:
    """One way to make one row of Table I."""

    printed: str
    """The row, a key of `PRINTED`."""
    how: str
    seeds: tuple[int, ...]
    """Of the networks; empty where nothing is drawn."""
    figures: dict[str, Float[np.ndarray, " runs"]]
    """Per seed, or one number, by the names of `COLUMNS`."""

    @classmethod
    def of(cls, printed: str, how: str, seeds: Sequence[int], runs: Sequence[Run]) -> "Row":
        """The row that runs make, one run per seed or all seeds in one run."""
        found = [
            [
                metrics.steady_error(run, shift=1),
                metrics.convergence_time(run, shift=1),
                metrics.steady_error(run),
                metrics.convergence_time(run),
                metrics.peak_torque(run),
            ]
            for run in runs
        ]
        columns = (np.concatenate([np.atleast_1d(x) for x in column]) for column in zip(*found, strict=True))
        return cls(printed, how, tuple(seeds), dict(zip(COLUMNS, columns, strict=True)))

    def holds(self, column: str, printed: float) -> bool:
        """Whether the printed number lies within the spread over the seeds, as far as its three digits say."""
        values = self.figures[column]
        return bool(values.min() <= 1.004 * printed and values.max() >= 0.996 * printed)


def follow(controller: Any, duration: float, torque: Any = None, q0: Any = None) -> Run:
    """The paper's task: q_d = [sin 0.1t, cos 0.1t], explicit Euler at 10 ms, no torque limit, no look-ahead.

    torque: disturbance [N·m], constant (2,) or held over every period, (starts, periods, 2). q0: starts at rest
    (starts, 2) [rad]; None is zero. The run is `simulate`'s, made by the kernels of training.
    """
    loop = task(duration)
    batch = Batch.of(loop, paper_reference(2), np.zeros((1, 2)) if q0 is None else q0)
    if torque is not None:
        batch = replace(batch, tau_d=np.zeros_like(batch.tau_d) + torque)
    with torch.no_grad():
        return recorded(motions(controller, batch), batch, type(controller).__name__)


def trained(controller: Any, epochs: int, torque: Any = None, regulariser: Regulariser | None = None) -> Any:
    """The controller after the paper's training, with the exact gradient and its gains left alone.

    ∫ z1ᵀz1 over 1 s from rest at zero, Adam at 1e-3. Raises KeyboardInterrupt when Ctrl-C ended it.
    """
    training = train(
        controller,
        task(PERIOD).plant,
        [paper_reference(2)],
        starts=np.zeros((1, 2)),
        duration=1.0,
        period=PERIOD,
        lookahead=0.0,
        disturbance=torque,
        cost=squared_error,
        regulariser=regulariser,
        gains=False,
        epochs=epochs,
        optimiser="adam",
        learning_rate=1e-3,
    )
    if training.stopped == "interrupted":
        raise KeyboardInterrupt
    return training.controller


def pid_rows(duration: float) -> tuple[list[Row], dict[str, Run]]:
    """Table I's first row, and the runs."""
    runs = {}
    for name, (kp, ki, kd) in PIDS.items():
        law = PID(kp=np.full(2, kp), ki=ki, kd=kd, effort_limit=np.inf)
        runs[f"PID {kp:g}, {ki:g}, {kd:g}: {name}"] = follow(law, duration)
    return [Row.of("PID", how, (), [run]) for how, run in runs.items()], runs


def authors_rows(seeds: Sequence[int], epochs: int, duration: float, progress: bool) -> tuple[list[Row], Run]:
    """What the paper's program makes of rows 2 to 4, all seeds side by side, and its runs after training."""
    law = AuthorsLaw(seeds)
    rows = [Row.of("NBS without training", "the paper's program", seeds, [follow_authors(law, duration)])]
    train_authors(law, epochs=epochs, progress=progress)
    after = follow_authors(law, duration)
    disturbed = follow_authors(law, duration, DISTURBANCE)
    stated = AuthorsLaw(seeds, m=1.0)
    train_authors(stated, epochs=epochs, torque=DISTURBANCE, progress=progress)
    row = "NBS under τ_d = [1, 1], α = 1"
    return [
        *rows,
        Row.of("NBS after training", "the paper's program", seeds, [after]),
        Row.of(row, "the paper's program, networks of the row above", seeds, [disturbed]),
        Row.of(
            row, "the paper's program, m = 1, trained under τ_d", seeds, [follow_authors(stated, duration, DISTURBANCE)]
        ),
    ], after


def package_rows(seeds: Sequence[int], epochs: int, duration: float, progress: bool) -> tuple[list[Row], list[Run]]:
    """What this package makes of rows 2 to 4 with the paper's networks, and its runs after training."""
    dynamics = AnalyticDynamics()
    makers: dict[str, tuple[str, Callable[[int], Run]]] = {
        "NBS without training": ("this package", lambda seed: follow(paper_controller(dynamics, seed=seed), duration)),
        "NBS after training": (
            "this package, exact gradient",
            lambda seed: follow(trained(paper_controller(dynamics, seed=seed), epochs), duration),
        ),
        "NBS under τ_d = [1, 1], α = 1": (
            "this package, m = 1, trained under τ_d",
            lambda seed: follow(
                trained(paper_controller(dynamics, m=1.0, seed=seed), epochs, DISTURBANCE), duration, DISTURBANCE
            ),
        ),
    }
    rows: list[Row] = []
    after: list[Run] = []
    for printed, (how, run) in makers.items():
        runs = [run(seed) for seed in tracked(tuple(seeds), f"{printed}, {how}", progress)]
        rows.append(Row.of(printed, how, seeds, runs))
        after = runs if printed == "NBS after training" else after
    return rows, after
