"""Training a controller through the closed loop: any parameters are stable, so take the best."""

import copy
import hashlib
import json
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
import torch
from jaxtyping import Float
from torch import nn

from nbs_pin.checkpoints import TrainingState, read_checkpoint, write_checkpoint
from nbs_pin.controllers.controller import Controller
from nbs_pin.controllers.descriptions import describe
from nbs_pin.exceptions import ArgumentError, SimulationDiverged
from nbs_pin.learning.closed_loop import Batch, Engine, check_plant, engine_for, motions, running_cost
from nbs_pin.learning.costs import StageCost, TorqueAware
from nbs_pin.learning.optimisers import (
    LEARNING_RATES,
    RISE,
    optimiser,
    packed_state,
    scheduled_rate,
    unpacked_state,
)
from nbs_pin.loop import Loop
from nbs_pin.networks.gain import Gain
from nbs_pin.plants.plant import Plant
from nbs_pin.progress import tracked
from nbs_pin.references import DesiredMotion

Regulariser: TypeAlias = Callable[[Any], torch.Tensor]
"""A price on the controller itself, added to the mean cost of the motions: controller -> scalar tensor."""
Stop: TypeAlias = Literal["epochs", "patience", "interrupted"]
"""Why training ended: all epochs done, no progress on the held-out motions, or Ctrl-C."""
SAVE_EVERY = 10
"""Epochs between two checkpoints."""


@dataclass(frozen=True, eq=False)
class Training:
    """What training gave."""

    controller: Any
    """The controller as it was at its best epoch; the one given to `train` is left alone."""
    history: Float[np.ndarray, " epochs"]
    """Mean cost of the training motions before each epoch's step, and after the last."""
    held_out: Float[np.ndarray, " checked"]
    """Mean cost of the held-out motions at the same instants; empty without any."""
    best_epoch: int
    """Row of the controller that is given: the lowest held-out cost, or the lowest cost without held-out motions."""
    stopped: Stop
    """Why it ended."""
    seconds: float
    """Wall time, that before a resume included [s]."""


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
    optimiser: str = "cautious",
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
    their `least_share`. optimiser: "cautious", "adam" or "lbfgs" (`learning/optimisers.py`). patience: epochs without a
    better held-out cost after which to stop. seed: of the starts drawn. checkpoint: a file kept up to date, from which
    `resume` goes on bit for bit. engine: None takes the fastest (`closed_loop.engine_for`).
    Ctrl-C ends training early and keeps the best.

    Raises ArgumentError for arguments that do not fit, a checkpoint of another training or a plant without
    derivatives, and SimulationDiverged when the first motions leave the finite numbers.
    """
    if not isinstance(controller, nn.Module):
        raise ArgumentError(f"{type(controller).__name__} has no parameters to train; give one of the package's laws.")
    if epochs < 1 or epochs != int(epochs):
        raise ArgumentError(f"epochs is {epochs}, expected a whole number ≥ 1; the paper takes 200.")
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
    draw = np.random.default_rng(seed)
    training = _motions(loop, references, starts, start_error, disturbance, draw)
    if held_out is None:
        held_out = math.ceil(starts / 4) if isinstance(starts, int) else 0
    kept = None if isinstance(held_out, int) and held_out == 0 else held_out
    checking = None if kept is None else _motions(loop, references, kept, start_error, disturbance, draw)
    task = _Task(
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
        engine=engine_for(controller, loop) if engine is None else engine,
        checkpoint=None if checkpoint is None else Path(checkpoint),
    )
    return _Trainer(task, resume).run(progress)


@dataclass(frozen=True, eq=False)
class _Task:
    """What is to be made small, and how."""

    controller: Any
    training: Batch
    held_out: Batch | None
    cost: StageCost
    regulariser: Regulariser | None
    gains: bool
    epochs: int
    optimiser: str
    learning_rate: float
    patience: int | None
    engine: Engine
    checkpoint: Path | None

    def value(self, batch: Batch) -> torch.Tensor:
        """Mean cost of the motions of a batch."""
        try:
            motion = motions(self.controller, batch, self.engine)
        except SimulationDiverged:  # the torch engine's plant; the kernels give NaN
            return torch.tensor(math.nan, dtype=torch.float64)
        return running_cost(motion, batch, self.cost).mean()

    def loss(self) -> torch.Tensor:
        """What the optimiser sees."""
        value = self.value(self.training)
        return value if self.regulariser is None else value + self.regulariser(self.controller)

    def fingerprint(self) -> str:
        """Of everything that a resumed training must have in common with the one that wrote the checkpoint."""
        digest = hashlib.sha256()
        for batch in (self.training, self.held_out):
            for array in () if batch is None else (batch.aims, batch.desired, batch.q0, batch.v0, batch.tau_d):
                digest.update(np.ascontiguousarray(array).tobytes())
        loop = self.training.loop
        digest.update(loop.limit.tobytes())
        digest.update(json.dumps(describe(self.controller)[0], sort_keys=True).encode())
        stated = (loop.period, loop.substeps, repr(loop.plant), self.gains, self.epochs, self.optimiser)
        digest.update(repr((*stated, self.learning_rate, type(self.cost).__name__, self.engine)).encode())
        return digest.hexdigest()


@dataclass(eq=False)
class _Progress:
    """Where training stands between two epochs."""

    epoch: int = 0
    rate_scale: float = 1.0
    history: list[float | None] = field(default_factory=list)
    held_out: list[float | None] = field(default_factory=list)
    best: dict[str, torch.Tensor] = field(default_factory=dict)
    best_epoch: int = 0
    best_score: float = math.inf
    seconds: float = 0.0


class _Trainer:
    """One training, from its first epoch or from a checkpoint."""

    def __init__(self, task: _Task, resume: bool) -> None:
        self.task, self.at = task, _Progress()
        modules = task.controller.modules()
        fixed = set() if task.gains else {id(m.change) for m in modules if isinstance(m, Gain)}
        self.parameters = [p for p in task.controller.parameters() if id(p) not in fixed]
        if not self.parameters:
            raise ArgumentError("nothing is left to train without the gains; give gains=True.")
        self.optimiser = self._fresh()
        self.resumed = 0.0
        if resume:
            self._restore()

    def run(self, progress: bool) -> Training:
        """The epochs that are left."""
        stopped: Stop = "epochs"
        began, before = time.perf_counter(), self.at.seconds
        mark = self._mark()
        try:
            for _ in tracked(range(self.at.epoch, self.task.epochs), self._label, progress):
                if self.task.patience is not None and self.at.epoch - self.at.best_epoch > self.task.patience:
                    stopped = "patience"
                    break
                mark = self._mark()
                self._epoch()
                self.at.seconds = before + time.perf_counter() - began
                if self.at.epoch % SAVE_EVERY == 0:
                    self._save()
            with torch.no_grad():
                self._note(self.at.epoch, float(self.task.loss()))
        except KeyboardInterrupt:
            stopped = "interrupted"
            self._go_back(mark)
        self.at.seconds = before + time.perf_counter() - began
        self._save()
        return self._result(stopped)

    def _label(self) -> str:
        history = self.at.history
        return f"training, cost {history[-1]:.4g} from {history[0]:.4g}" if history else "training"

    def _epoch(self) -> None:
        """One step of the optimiser, or a retreat to the best parameters."""
        at, task = self.at, self.task
        for group in self.optimiser.param_groups:
            group["lr"] = at.rate_scale * scheduled_rate(task.optimiser, task.learning_rate, at.epoch, task.epochs)
        before = [p.detach().clone() for p in self.parameters]
        try:
            value = float(self.optimiser.step(self._closure))
        except _NotFinite:
            value = math.nan
        at.epoch += 1
        stepped = [p.detach().clone() for p in self.parameters]
        self._set(before)
        self._note(at.epoch - 1, value)
        if self._has_risen(value):
            self._retreat()
        else:
            self._set(stepped)

    def _has_risen(self, value: float) -> bool:
        """Whether this cost calls for a retreat: always when not finite; else for "cautious" alone."""
        if not math.isfinite(value):
            return True
        lowest = self.at.history[self.at.best_epoch]
        return self.task.optimiser == "cautious" and lowest is not None and value > RISE * lowest

    def _closure(self) -> float:
        self.optimiser.zero_grad()
        loss = self.task.loss()
        if not torch.isfinite(loss):
            raise _NotFinite
        loss.backward()  # type: ignore[no-untyped-call]
        return float(loss.detach())

    def _note(self, row: int, value: float) -> None:
        """Write the cost of the present parameters down, and keep them when they are the best so far."""
        at, task = self.at, self.task
        del at.history[row:], at.held_out[row:]  # the last of a training that had ended and goes on
        at.history.append(value if math.isfinite(value) else None)
        score = value
        if task.held_out is not None:
            with torch.no_grad():
                score = float(task.value(task.held_out))
            at.held_out.append(score if math.isfinite(score) else None)
        if score < at.best_score:
            at.best_score, at.best_epoch = score, len(at.history) - 1
            at.best = {k: x.detach().clone() for k, x in task.controller.state_dict().items()}

    def _retreat(self) -> None:
        """Back to the best parameters with half the step."""
        if not self.at.best:
            raise SimulationDiverged(
                "the motions left the finite numbers before anything was trained; take a shorter period or plant step,"
                " starts nearer to the reference, or softer gains."
            )
        self.at.rate_scale *= 0.5
        self.task.controller.load_state_dict(self.at.best)
        self.optimiser = self._fresh()

    def _mark(self) -> tuple[_Progress, list[torch.Tensor], Any, dict[str, torch.Tensor]]:
        """Where training stands, as `_go_back` takes it: Ctrl-C may come in the middle of a step."""
        tensors: dict[str, torch.Tensor] = {}
        state = packed_state(self.optimiser.state_dict(), tensors)
        at = replace(self.at, history=[*self.at.history], held_out=[*self.at.held_out])
        return at, [p.detach().clone() for p in self.parameters], state, tensors

    def _go_back(self, mark: tuple[_Progress, list[torch.Tensor], Any, dict[str, torch.Tensor]]) -> None:
        self.at, values, state, tensors = mark
        self._set(values)
        self.optimiser.load_state_dict(unpacked_state(state, tensors))

    def _fresh(self) -> torch.optim.Optimizer:
        return optimiser(self.task.optimiser, self.parameters, self.task.learning_rate)

    def _set(self, values: list[torch.Tensor]) -> None:
        with torch.no_grad():
            for parameter, value in zip(self.parameters, values, strict=True):
                parameter.copy_(value)

    def _result(self, stopped: Stop) -> Training:
        at = self.at
        best = copy.deepcopy(self.task.controller)
        if at.best:
            best.load_state_dict(at.best)
        for parameter in best.parameters():
            parameter.grad = None
        history, held_out = (np.array(x, dtype=float) for x in (at.history, at.held_out))
        return Training(best, history, held_out, at.best_epoch, stopped, at.seconds)

    def _save(self) -> None:
        if self.task.checkpoint is None or not self.at.history:
            return
        tensors = {f"best.{name}": x for name, x in self.at.best.items()}
        facts = {k: v for k, v in vars(self.at).items() if k != "best"}
        facts["optimiser"] = packed_state(self.optimiser.state_dict(), tensors)
        facts["fingerprint"] = self.task.fingerprint()
        write_checkpoint(self.task.checkpoint, self.task.controller, TrainingState(tensors, facts))

    def _restore(self) -> None:
        path = self.task.checkpoint
        if path is None:
            raise ArgumentError(
                "resume was asked for without a checkpoint; give the file of the training to go on with."
            )
        saved, state = read_checkpoint(path, self.task.training.loop.plant.robot)
        if state is None or state.facts["fingerprint"] != self.task.fingerprint():
            raise ArgumentError(
                f"{path} is not a checkpoint of this training; give the settings it was begun with, or start afresh."
            )
        self.task.controller.load_state_dict(saved.state_dict())
        facts = dict(state.facts)
        self.optimiser.load_state_dict(unpacked_state(facts.pop("optimiser"), state.tensors))
        del facts["fingerprint"]
        best = {k.removeprefix("best."): x for k, x in state.tensors.items() if k.startswith("best.")}
        self.at = _Progress(**facts, best=best)


class _NotFinite(ArithmeticError):
    """A cost that is not a number: the motions left the finite numbers."""


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
        if isinstance(starts, int):
            if starts < 1:
                raise ArgumentError(f"{starts} starts were asked for, expected at least one; 32 is usual.")
            begin = loop.schedule(reference, 0, 0).desired.q[0]
            q0 = begin + draw.uniform(-start_error, start_error, (starts, loop.plant.nv))
        batches.append(Batch.of(loop, reference, q0, v0, disturbance))
    return Batch.joined(batches)
