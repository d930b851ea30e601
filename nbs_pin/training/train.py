"""Training a controller through the closed loop: any parameters are stable, so take the best."""

import copy
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.controllers.controller import Controller
from nbs_pin.motions.references import DesiredMotion
from nbs_pin.simulation.costs import StageCost, TorqueAware
from nbs_pin.simulation.loop import Loop
from nbs_pin.simulation.plant import Plant
from nbs_pin.simulation.rollout import Batch, Engine, check_plant, engine_for
from nbs_pin.training.optimisers import LEARNING_RATES
from nbs_pin.training.trainer import Regulariser, Task, Trainer, Training

__all__ = ["Regulariser", "Training", "train"]


def train(
    controller: Controller,
    plant: Plant,
    references: Sequence[DesiredMotion],
    *,
    starts: Any = 32,
    held_out: Any = None,
    start_error: float = 0.5,
    duration: float = 1.0,
    period: float = 0.01,
    plant_step: float | None = None,
    effort_limit: Any = None,
    lookahead: float | None = None,
    disturbance: Any = None,
    cost: StageCost | None = None,
    regulariser: Regulariser | None = None,
    gains: bool = True,
    epochs: int = 200,
    optimiser: str = "adam-backtracking",
    learning_rate: float | None = None,
    patience: int | None = None,
    seed: int = 0,
    checkpoint: str | Path | None = None,
    resume: bool = False,
    engine: Engine | None = None,
    progress: bool = False,
) -> Training:
    """The controller whose parameters make the mean of ∫ l(z1, v − v_d, τ) dt + regulariser smallest over many motions.

    The loop is that of `simulate`, with its arguments `duration`, `period`, `effort_limit` and `lookahead`, and the
    gradient is the exact one, through law, model, torque limits and integrator. Source: paper eq. (13), theory.md §7.

    plant: a `DynamicsPlant`. references: each is followed from every start. starts: configurations (starts, n) at rest,
    a pair (q0, v0), or how many to draw, each joint within ±start_error [rad] of the reference's start. held_out: the
    same for motions that are never trained on and that choose the best epoch; None draws a quarter as many (none when
    starts are given). plant_step [s]: None takes one step per period, unlike `simulate`. disturbance: constant torque.
    cost: l; None takes `TorqueAware` with the effort limits. gains: whether S, Λ and D₀ are trained too, never below
    their `least_share`. optimiser: "adam-backtracking", "adam" or "lbfgs" (`training/optimisers.py`). patience: epochs without a
    better held-out cost after which to stop. seed: of the starts drawn. checkpoint: a file kept up to date, from which
    `resume` goes on bit for bit. engine: None takes the fastest (`closed_loop.engine_for`).
    Ctrl-C ends training early and keeps the best, from the first epoch on.

    Raises ArgumentError for arguments that do not fit, a checkpoint of another training or a plant without
    derivatives, and SimulationDiverged when the first motions leave the finite numbers.
    """
    if not isinstance(controller, nn.Module):
        raise ArgumentError(f"{type(controller).__name__} has no parameters to train; give one of the package's laws.")
    if epochs < 1 or epochs != int(epochs):
        raise ArgumentError(f"epochs is {epochs}, expected a whole number ≥ 1; the paper takes 200.")
    if patience is not None and patience < 1:
        raise ArgumentError(f"patience is {patience} epochs, expected at least one; None takes all epochs.")
    loop = Loop.of(
        plant,
        controller.nv,
        duration,
        period,
        plant_step=period if plant_step is None else plant_step,
        effort_limit=effort_limit,
        lookahead=lookahead,
    )
    check_plant(loop)
    if not references:
        raise ArgumentError("references is empty; give at least one motion to follow.")
    if not 0.0 <= start_error < math.inf:
        raise ArgumentError(f"start_error is {start_error} rad, expected a finite angle ≥ 0; 0.5 is usual.")
    draw = np.random.default_rng(seed)
    training = _motions(loop, references, starts, start_error, disturbance, draw)
    if held_out is None:
        held_out = math.ceil(starts / 4) if isinstance(starts, int | np.integer) else 0
    kept = None if isinstance(held_out, int | np.integer) and held_out == 0 else held_out
    checking = None if kept is None else _motions(loop, references, kept, start_error, disturbance, draw)
    task = Task(
        controller=copy.deepcopy(controller),
        training=training,
        held_out=checking,
        cost=TorqueAware(torch.as_tensor(loop.limit)) if cost is None else cost,
        regulariser=regulariser,
        gains=gains,
        epochs=int(epochs),
        optimiser=optimiser,
        learning_rate=LEARNING_RATES.get(optimiser, 1.0) if learning_rate is None else learning_rate,
        patience=patience,
        seed=seed,
        engine=engine_for(controller, loop) if engine is None else engine,
        checkpoint=None if checkpoint is None else Path(checkpoint),
    )
    return Trainer(task, resume, progress).run(progress)


def _motions(
    loop: Loop,
    references: Sequence[DesiredMotion],
    starts: Any,
    start_error: float,
    disturbance: Any,
    draw: np.random.Generator,
) -> Batch:
    """Every reference from every start; drawn starts differ from reference to reference."""
    batches = []
    for reference in references:
        q0, v0 = starts if isinstance(starts, tuple) else (starts, None)
        if isinstance(starts, int | np.integer):
            if starts < 1:
                raise ArgumentError(f"{starts} starts were asked for, expected at least one; 32 is usual.")
            begin = loop.schedule(reference, 0, 0).desired.q[0]
            q0 = begin + draw.uniform(-start_error, start_error, (starts, loop.plant.nv))
        batches.append(Batch.of(loop, reference, q0, v0, disturbance))
    return Batch.joined(batches)
