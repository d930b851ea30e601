"""One arm, one law, trained through its closed loop: the study behind `nbs-pin train`."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeAlias, get_args

import numpy as np
import torch

from nbs_pin.base.exceptions import ArgumentError, SimulationDiverged
from nbs_pin.base.files import write_whole
from nbs_pin.base.pages import plain
from nbs_pin.base.records import Run
from nbs_pin.cli.tracking import build_controller
from nbs_pin.controllers.controller import Controller
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.motions.references import DesiredMotion, Sinusoid, check_reference
from nbs_pin.robots.robot import Robot
from nbs_pin.simulation.costs import StageCost, TimeOutside, TorqueAware, squared_error
from nbs_pin.simulation.dynamics_plant import DynamicsPlant
from nbs_pin.simulation.loop import Loop
from nbs_pin.simulation.rollout import Batch, Motions, motions, recorded
from nbs_pin.simulation import metrics
from nbs_pin.storage.checkpoints import save
from nbs_pin.training.train import Training, train

CostName: TypeAlias = Literal["torque-aware", "squared-error", "time-outside"]
"""What `stage_cost` knows."""
CHECKPOINT = "training.ckpt"
"""What `train_robot` keeps up to date in its folder."""
FILES = ("controller.nbs", "learning.png", "summary.json")
"""What `write_results` writes, the summary last."""
FRESH_STARTS = 20
"""Starts per reference on which the controller is compared with what it was before."""
_LONGER = 3.0  # fresh motions last this many times longer than those trained on


class Trained(NamedTuple):
    """A training, and the same fresh motions under the controller before and after it."""

    training: Training
    before: Run
    after: Run


def train_robot(
    robot: Robot,
    *,
    controller: Controller | str = "nbs",
    bandwidth: float = 8.0,
    frequencies: tuple[float, ...] = (0.5, 1.0, 2.0),
    starts: int = 32,
    start_error: float = 0.3,
    duration: float = 1.0,
    period: float = 0.005,
    cost: str = "torque-aware",
    seed: int = 0,
    folder: Path | None = None,
    **settings: Any,
) -> Trained:
    """A law for the arm, trained on sinusoids of these frequencies [rad/s] within the arm's effort limits.

    controller: a law by name, a .nbs file (`build_controller`), or one that is built. starts: in all, shared out over
    the frequencies. cost: by name (`stage_cost`). folder: where `CHECKPOINT` is kept, None for nowhere. duration,
    period [s], start_error [rad], and settings (epochs, optimiser, resume, …): as `train` has them.
    The fresh motions last three times longer, from `FRESH_STARTS` starts per frequency that training never saw.
    Raises ArgumentError for settings that do not fit and a motion outside the arm's limits, KeyboardInterrupt when
    Ctrl-C comes before the first epoch is over; errors of `train` else.
    """
    references = [Sinusoid.for_robot(robot, frequency) for frequency in frequencies]
    for reference in references:
        check_reference(reference, robot, _LONGER * duration)
    if not isinstance(controller, Controller):
        controller = build_controller(controller, robot, bandwidth=bandwidth, period=period, seed=seed)
    plant = DynamicsPlant(PinocchioDynamics(robot))
    training = train(
        controller,
        plant,
        references,
        starts=max(1, round(starts / len(references))),
        start_error=start_error,
        duration=duration,
        period=period,
        effort_limit=robot.effort_limit,
        cost=stage_cost(cost, robot),
        seed=seed,
        checkpoint=None if folder is None else folder / CHECKPOINT,
        **settings,
    )
    if not training.history.size:
        raise KeyboardInterrupt
    steps = _LONGER * round(duration / period)
    loop = Loop.of(plant, robot.nv, steps * period, period, plant_step=period, effort_limit=None, lookahead=None)
    fresh = fresh_batch(loop, references, start_error, seed)
    return Trained(training, compared(controller, fresh), compared(training.controller, fresh))


def stage_cost(name: str, robot: Robot) -> StageCost:
    """The stage cost of that name, with the arm's effort limits; raises ArgumentError for an unknown name."""
    known: dict[str, StageCost] = {
        "torque-aware": TorqueAware.for_robot(robot),
        "squared-error": squared_error,
        "time-outside": TimeOutside(),
    }
    if name not in known:
        raise ArgumentError(f"cost '{name}' is unknown; choose one of {', '.join(get_args(CostName))}.")
    return known[name]


def fresh_batch(
    loop: Loop, references: Sequence[DesiredMotion], start_error: float, seed: int, starts: int = FRESH_STARTS
) -> Batch:
    """So many motions along each reference, at rest within ±start_error [rad] of its start.

    They are drawn apart from those of `train`, whose seed is the number alone.
    """
    draw, batches = np.random.default_rng((seed, 1)), []
    for reference in references:
        begin = loop.schedule(reference, 0, 0).desired.q[0]
        away = draw.uniform(-start_error, start_error, (starts, loop.plant.nv))
        batches.append(Batch.of(loop, reference, begin + away))
    return Batch.joined(batches)


def compared(controller: Controller, batch: Batch) -> Run:
    """The motions of a batch as a run; what diverges is NaN from there on, or as a whole without kernels."""
    with torch.no_grad():
        try:
            motion = motions(controller, batch)
        except SimulationDiverged:  # without kernels the plant refuses to go on, and takes every start along
            motion = Motions(*(torch.cat(parts) for parts in zip(*_one_by_one(controller, batch), strict=True)))
    return recorded(motion, batch, type(controller).__name__)


def fresh_figures(run: Run) -> dict[str, float]:
    """Figures over the starts of a run, units in the keys; inf where there is no time of convergence.

    Median and worst time of convergence; the largest ‖z1‖² of the last 30 % of the time; the largest torque, the root
    mean square over starts and time of ‖τ‖, and the fraction of the time for which some joint is at its limit: NaN for
    these four when some motion is not finite, which has not converged either.
    """
    finite = np.isfinite(run.q).all(axis=(0, -1)) & np.isfinite(run.tau_command).all(axis=(0, -1))
    with np.errstate(over="ignore", invalid="ignore"):  # of motions on their way out of the finite numbers
        times = np.where(finite, metrics.convergence_time(run), np.inf)
        steady, peak, rms, saturated = (
            np.where(finite, measure(run), np.nan)
            for measure in (metrics.steady_error, metrics.peak_torque, metrics.rms_torque, metrics.saturated_fraction)
        )
    return {
        "convergence_time_median_s": float(np.median(times)),
        "convergence_time_worst_s": float(times.max()),
        "steady_error_rad2": float(steady.max()),
        "peak_torque_Nm": float(peak.max()),
        "rms_torque_Nm": float(np.sqrt(np.mean(rms**2))),
        "saturated_fraction": float(saturated.mean()),
    }


def figures(result: Trained) -> dict[str, Any]:
    """What training changed, as JSON can store it; None for a time that never came and for what is not finite."""
    training = result.training
    held_out, best = training.held_out, training.best_epoch
    numbers: dict[str, Any] = plain(
        {
            "epochs": len(training.history) - (training.stopped != "interrupted"),
            "best_epoch": best,
            "stopped": training.stopped,
            "training_cost": [training.history[0], training.history[best]],
            "held_out_cost": [held_out[0], held_out[best]],
            "held_out_cost_lowered_by": 1.0 - held_out[best] / held_out[0],
            "seconds": training.seconds,
            "fresh_starts": result.before.q.shape[1],
            "before": fresh_figures(result.before),
            "after": fresh_figures(result.after),
        }
    )
    return numbers


def write_results(result: Trained, folder: Path, facts: dict[str, Any]) -> dict[str, Any]:
    """Writes `FILES` into the folder, the trained controller first; returns the figures.

    facts: what summary.json holds beside the figures and the cost of every epoch. Raises OSError when they cannot be
    written.
    """
    from nbs_pin.reports.charts import plot_training

    numbers, training = figures(result), result.training
    save(training.controller, folder / "controller.nbs", info={"trained": facts})
    plot_training(
        training.history, training.held_out, training.best_epoch, result.before, result.after, folder / "learning.png"
    )
    curves = plain({"history": training.history, "held_out": training.held_out})
    text = json.dumps(facts | {"figures": numbers, **curves}, indent=2, allow_nan=False, ensure_ascii=False) + "\n"
    write_whole(folder / "summary.json", text.encode())
    return numbers


def _one_by_one(controller: Controller, batch: Batch) -> list[Motions]:
    """The motions of a batch, each by itself; NaN for one that diverges."""
    names, done = ("aims", "desired", "q0", "v0", "tau_d"), []
    for k in range(len(batch)):
        one = replace(batch, **{name: getattr(batch, name)[k : k + 1] for name in names})
        try:
            done.append(motions(controller, one))
        except SimulationDiverged:
            state = torch.full((1, batch.loop.steps + 1, batch.loop.plant.nv), torch.nan, dtype=torch.float64)
            done.append(Motions(state, state, state[:, 1:]))
    return done
