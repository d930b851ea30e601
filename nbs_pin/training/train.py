"""Training of a controller through the closed loop; every parameter value is stable."""

import copy
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from nbs_pin.base.arguments import (
    DURATION,
    PERIOD,
    SEED,
    checked,
    choice,
    count,
    either,
    flag,
    function,
    many,
    maybe,
    number,
    writable,
)
from nbs_pin.base.checks import integral, real
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.torch_threads import one_thread
from nbs_pin.controllers.controller import CONTROLLER, Controller
from nbs_pin.motions.references import MOTION, DesiredMotion
from nbs_pin.simulation.costs import StageCost, TorqueAware
from nbs_pin.simulation.loop import Loop
from nbs_pin.simulation.plant import PLANT, Plant
from nbs_pin.simulation.rollout import Batch, Engine, check_plant, engine_for
from nbs_pin.training.optimisers import LEARNING_RATES
from nbs_pin.training.trainer import Regulariser, Task, Trainer, Training

__all__ = ["Regulariser", "Training", "train"]


@checked(
    controller=CONTROLLER,
    plant=either(many(PLANT, 1, 1000, "plants"), PLANT),
    references=many(MOTION, 1, 100_000, "motions"),
    start_error=number(least=0.0, unit="rad"),
    duration=DURATION,
    period=PERIOD,
    plant_step=maybe(PERIOD),
    lookahead=maybe(number(least=0.0, most=1000.0, unit="s")),
    encoder=number(least=0.0, below=0.5, unit="of a turn"),
    cost=maybe(function(3, "a cost, a function of error, its rate and torque, such as TorqueAware.for_robot(robot)")),
    regulariser=maybe(function(1, "a regulariser, a function of the controller, or None")),
    gains=flag,
    epochs=count(1, 1_000_000, "epochs"),
    optimiser=choice(*LEARNING_RATES),
    learning_rate=maybe(number(above=0.0)),
    patience=maybe(count(1, 1_000_000, "epochs")),
    seed=SEED,
    checkpoint=maybe(writable),
    resume=flag,
    engine=maybe(choice("kernels", "torch")),
    progress=flag,
)
def train(
    controller: Controller,
    plant: Plant | Sequence[Plant],
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
    encoder: float = 0.0,
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
    """Minimise the mean of ∫ l(z1, v − v_d, τ) dt over many motions, plus the regulariser, over the parameters.

    The loop is that of `simulate`, with its `duration`, `period`, `effort_limit` and `lookahead`; the gradient is exact
    (paper eq. (13), docs/theory.md §7). Ctrl-C ends the training and keeps the best epoch.

    Args:
        plant: A `DynamicsPlant`, or several, such as one arm with other loads and friction: the law is trained for all
            of them at once, and every motion is drawn for each.
        references: Desired motions, each followed from every start.
        starts: Configurations (starts, n) at rest, a pair (q0, v0), or the number of random starts per reference.
        held_out: As starts, only to choose the best epoch; None draws a quarter as many, or none if starts are given.
        start_error: Random starts are within ±start_error [rad] of the reference in each joint.
        plant_step: Plant step [s]; None is the period, unlike in `simulate`.
        disturbance: Constant torque [N·m], a number or (n,).
        encoder: Step of the encoders as a share of a turn, such as 2**-18, with velocities as differences of their
            readings; 0 for exact ones. Errors are drawn once (docs/theory.md §7).
        cost: l; None takes `TorqueAware` with the effort limits.
        regulariser: Cost of the parameters themselves, a function of the controller.
        gains: Whether gains, such as S, Λ and D₀, are trained as well, never below their least_share.
        optimiser: "adam-backtracking", "adam" or "lbfgs" (`training/optimisers.py`).
        patience: Epochs without a lower held-out cost after which to stop; None runs all epochs.
        seed: Seed of the random starts.
        checkpoint: File kept up to date, from which `resume` continues bit for bit.
        engine: "kernels" or "torch"; None takes the faster one that applies.

    Raises:
        ArgumentError: If arguments do not match, plant has no derivatives, or checkpoint is of another training.
        SimulationDiverged: If the motions diverge before the first step.

    Example:
        >>> import nbs_pin as nbs
        >>> law = nbs.SlotineLi.for_robot(nbs.load_robot("two_link"), period=0.01)
        >>> task = {"starts": 2, "duration": 0.1, "epochs": 2}
        >>> len(nbs.train(law, nbs.DynamicsPlant(law.dynamics), [nbs.Hold([0.3, 0.2])], **task).history)
        3
    """
    if not isinstance(controller, nn.Module):
        raise ArgumentError(f"{type(controller).__name__} has no parameters to train; give one of the package's laws.")
    step = period if plant_step is None else plant_step
    settings = {"plant_step": step, "effort_limit": effort_limit, "lookahead": lookahead}
    plants = [plant] if isinstance(plant, Plant) else plant
    loops = [Loop.of(x, controller.nv, duration, period, **settings) for x in plants]
    training, checking = _batches(loops, references, starts, held_out, start_error, disturbance, encoder, seed)
    task = Task(
        controller=copy.deepcopy(controller),
        training=training,
        held_out=checking,
        cost=TorqueAware(torch.as_tensor(loops[0].limit)) if cost is None else cost,
        regulariser=regulariser,
        gains=gains,
        epochs=epochs,
        optimiser=optimiser,
        learning_rate=LEARNING_RATES.get(optimiser, 1.0) if learning_rate is None else learning_rate,
        patience=patience,
        seed=seed,
        engine=_engine(controller, loops) if engine is None else engine,
        checkpoint=None if checkpoint is None else Path(checkpoint),
    )
    with one_thread():  # steps of a loop are small: threads of torch wait for each other longer than these take
        return Trainer(task, resume, progress).run(progress)


def _engine(controller: Controller, loops: Sequence[Loop]) -> Engine:
    """The fastest engine that runs all loops."""
    return "kernels" if all(engine_for(controller, loop) == "kernels" for loop in loops) else "torch"


def _batches(
    loops: Sequence[Loop],
    references: Sequence[DesiredMotion],
    starts: Any,
    held_out: Any,
    error: float,
    tau_d: Any,
    encoder: float,
    seed: int,
) -> tuple[list[Batch], list[Batch]]:
    """The training and the held-out motions of every plant."""
    draw, training, checking = np.random.default_rng(seed), [], []
    number_of_starts = _count_of(starts)
    if held_out is None:
        held_out = 0 if number_of_starts is None else math.ceil(number_of_starts / 4)
    for loop in loops:
        check_plant(loop)
        training.append(_motions(loop, references, starts, error, tau_d, draw))
        if _count_of(held_out) != 0:
            checking.append(_motions(loop, references, held_out, error, tau_d, draw))
    if encoder:
        training, checking = ([x.misread(encoder, draw) for x in batches] for batches in (training, checking))
    return training, checking


def _motions(
    loop: Loop,
    references: Sequence[DesiredMotion],
    starts: Any,
    start_error: float,
    disturbance: Any,
    draw: np.random.Generator,
) -> Batch:
    """Motions along every reference from every start; random starts differ between references."""
    batches = []
    for reference in references:
        q0, v0 = starts if isinstance(starts, tuple) and len(starts) == 2 else (starts, None)
        number_of_starts = _count_of(starts)
        if number_of_starts is not None:
            count(1, 100_000)("the number of starts", number_of_starts)
            begin = loop.schedule(reference, 0, 0).desired.q[0]
            q0 = begin + draw.uniform(-start_error, start_error, (number_of_starts, loop.plant.nv))
        batches.append(Batch.of(loop, reference, q0, v0, disturbance))
    return Batch.joined(batches)


def _count_of(starts: Any) -> int | None:
    """The number of random starts, if one number was given; raises ArgumentError unless it is whole."""
    number_given = real(starts)
    if number_given is None:
        return None
    return count(0, 100_000)("the number of starts", integral(starts) if integral(starts) is not None else starts)
