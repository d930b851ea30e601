"""The epochs of a training: optimiser steps, backtracking, checkpoints and the best controller so far."""

import copy
import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
import torch
from jaxtyping import Float

from nbs_pin.base.arguments import called
from nbs_pin.base.checks import told
from nbs_pin.base.exceptions import ArgumentError, SimulationDiverged
from nbs_pin.base.progress import tracked, waiting
from nbs_pin.base.shown import Shown
from nbs_pin.controllers.gain import Gain
from nbs_pin.controllers.model_law import ModelLaw
from nbs_pin.controllers.update_rates import TrainedRates
from nbs_pin.simulation.costs import StageCost
from nbs_pin.simulation.rollout import Batch, Engine, motions, running_cost
from nbs_pin.storage.checkpoints import TrainingState, read_checkpoint, write_checkpoint
from nbs_pin.training.optimisers import RISE, optimiser, packed_state, scheduled_rate, unpacked_state
from nbs_pin.training.same_training import difference, statement

Regulariser: TypeAlias = Callable[[Any], torch.Tensor]
"""Cost of the controller itself, added to the mean cost of the motions: controller -> scalar tensor."""
Stop: TypeAlias = Literal["epochs", "patience", "interrupted"]
"""Why training ended: all epochs done, no progress on the held-out motions, or Ctrl-C."""
SAVE_EVERY = 10
"""Epochs between two checkpoints."""


@dataclass(frozen=True, eq=False, repr=False)
class Training(Shown):
    """Result of a training.

    Example:
        >>> import nbs_pin as nbs
        >>> robot = nbs.load_robot("two_link")
        >>> law, plant = nbs.NeuralBackstepping.for_robot(robot, period=0.01), nbs.DynamicsPlant.for_robot(robot)
        >>> motion = nbs.Sinusoid.for_robot(robot)
        >>> training = nbs.train(law, plant, [motion], starts=4, duration=0.2, period=0.01, epochs=2)
        >>> len(training.history)  # before each of the two steps, and after the last
        3
    """

    controller: Any
    """The controller of the best epoch; the one given to `train` is unchanged."""
    history: Float[np.ndarray, " epochs"]
    """Mean cost of the training motions, regulariser included, before each epoch's step and after the last."""
    held_out: Float[np.ndarray, " checked"]
    """Mean cost of the held-out motions without regulariser, at the same epochs; empty without any."""
    best_epoch: int
    """Row of `controller`: that of the lowest held-out cost, or of the lowest cost without held-out motions."""
    stopped: Stop
    """Why the training ended."""
    seconds: float
    """Wall time, including that before a resume [s]."""

    def _facts(self) -> Iterable[str]:
        cost = self.held_out if len(self.held_out) else self.history
        lowered = f"cost {cost[0]:.3g} to {cost[self.best_epoch]:.3g}" if len(cost) > self.best_epoch else "no epoch"
        return type(self.controller).__name__, lowered, f"best epoch {self.best_epoch}", f"{self.seconds:.3g} s"


@dataclass(frozen=True, eq=False)
class Task:
    """Cost to minimise, and settings of the optimiser."""

    controller: Any
    training: Sequence[Batch]
    """The motions of training, one batch for every plant."""
    held_out: Sequence[Batch]
    """Likewise; empty without any."""
    cost: StageCost
    regulariser: Regulariser | None
    gains: bool
    epochs: int
    optimiser: str
    learning_rate: float
    patience: int | None
    seed: int
    engine: Engine
    checkpoint: Path | None

    def value(self, batches: Sequence[Batch]) -> torch.Tensor:
        """Mean cost of all motions."""
        try:
            costs = [running_cost(motions(self.controller, x, self.engine), x, self.cost) for x in batches]
        except SimulationDiverged:  # raised by the torch engine's plant; the kernels give NaN
            return torch.tensor(math.nan, dtype=torch.float64)
        return torch.cat(costs).mean()

    def loss(self) -> torch.Tensor:
        """Cost to minimise: mean cost of the training motions plus regulariser."""
        value = self.value(self.training)
        if self.regulariser is None:
            return value
        price = called("the regulariser", self.regulariser, self.controller)
        if not isinstance(price, torch.Tensor) or price.numel() != 1:
            raise ArgumentError(f"the regulariser gave {told(price)}, expected a scalar tensor; correct it.")
        return value + price.reshape(())

    def warm_up(self) -> None:
        """Compile everything: run one period of one motion, and its gradient."""
        if self.engine == "kernels":
            first = self.training[0].beginning()
            motions(self.controller, first, self.engine).command.sum().backward()  # type: ignore[no-untyped-call]

    def statement(self) -> dict[str, Any]:
        """What a resumed training must share with the one that wrote the checkpoint (`same_training.py`)."""
        with torch.no_grad():
            costs = [float(self.loss()), *([float(self.value(self.held_out))] if self.held_out else [])]
        names = ("epochs", "optimiser", "learning_rate", "gains", "engine", "seed")
        settings = {name: getattr(self, name) for name in names}
        stated: dict[str, Any] = statement(self.controller, self.training, self.held_out, costs, **settings)
        return stated


@dataclass(eq=False)
class _Progress:
    """State of a training between two epochs."""

    epoch: int = 0
    rate_scale: float = 1.0
    history: list[float | None] = field(default_factory=list)
    held_out: list[float | None] = field(default_factory=list)
    best: dict[str, torch.Tensor] = field(default_factory=dict)
    best_epoch: int = 0
    best_score: float = math.inf
    seconds: float = 0.0


class Trainer:
    """One training, from its first epoch or from a checkpoint."""

    def __init__(self, task: Task, resume: bool, progress: bool) -> None:
        self.task, self.at = task, _Progress()
        modules = task.controller.modules()
        fixed = set() if task.gains else {id(m.change) for m in modules if isinstance(m, (Gain, TrainedRates))}
        self.parameters = [p for p in task.controller.parameters() if p.requires_grad and id(p) not in fixed]
        if not self.parameters:
            raise ArgumentError(
                f"a {type(task.controller).__name__} has nothing to train besides its gains; train them too."
            )
        self.optimiser = self._fresh()
        self.first: float | None = None
        with waiting("compiling, once on a machine", progress):
            task.warm_up()
        # Before training, so that a controller that cannot be stored raises now and not at the first save.
        self.statement = {} if task.checkpoint is None else task.statement()
        if resume:
            self._restore()

    def run(self, progress: bool) -> Training:
        """Runs the remaining epochs."""
        stopped: Stop = "epochs"
        mark = self._mark()
        began, before = time.perf_counter(), self.at.seconds
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
        try:
            self._save()
        except KeyboardInterrupt:  # the file keeps its previous epoch, and the result is returned all the same
            stopped = "interrupted"
        return self._result(stopped)

    def _label(self) -> str:
        history = self.at.history
        return f"training, cost {history[-1]:.4g} from {history[0]:.4g}" if history else "training"

    def _epoch(self) -> None:
        """One step of the optimiser, or a return to the best parameters."""
        at, task = self.at, self.task
        for group in self.optimiser.param_groups:
            group["lr"] = at.rate_scale * scheduled_rate(task.optimiser, task.learning_rate, at.epoch, task.epochs)
        before, self.first = [p.detach().clone() for p in self.parameters], None
        try:
            self.optimiser.step(self._closure)
            sound = True
        except _NotFinite:  # at these parameters, or within a line search
            sound = False
        at.epoch += 1
        stepped = [p.detach().clone() for p in self.parameters]
        self._set(before)
        value = math.nan if self.first is None else self.first
        self._note(at.epoch - 1, value)
        if not sound or self._has_risen(value):
            self._retreat()
        else:
            self._set(stepped)

    def _has_risen(self, value: float) -> bool:
        """Whether "adam-backtracking" rejects this cost."""
        lowest = self.at.history[self.at.best_epoch]
        return self.task.optimiser == "adam-backtracking" and lowest is not None and value - lowest > RISE * abs(lowest)

    def _closure(self) -> float:
        self.optimiser.zero_grad()
        loss = self.task.loss()
        if not torch.isfinite(loss):
            raise _NotFinite
        loss.backward()  # type: ignore[no-untyped-call]
        if not all(bool(p.grad.isfinite().all()) for p in self.parameters if p.grad is not None):
            raise _NotFinite
        value = float(loss.detach())
        self.first = value if self.first is None else self.first
        return value

    def _note(self, row: int, value: float) -> None:
        """Record the cost of the present parameters, and keep them if they are the best so far."""
        at, task = self.at, self.task
        del at.history[row:], at.held_out[row:]  # the final row of a training that had ended and is resumed
        at.history.append(value if math.isfinite(value) else None)
        score = value
        if task.held_out:
            with torch.no_grad():
                score = float(task.value(task.held_out))
            at.held_out.append(score if math.isfinite(score) else None)
        if not at.best and not math.isfinite(score):
            which = "training" if not task.held_out or not math.isfinite(value) else "held-out"
            raise SimulationDiverged(
                f"the {which} motions diverge before any training; take a shorter period or plant step, starts nearer"
                " to the reference, or lower gains."
            )
        if score < at.best_score:
            at.best_score, at.best_epoch = score, len(at.history) - 1
            at.best = {k: x.detach().clone() for k, x in task.controller.state_dict().items()}

    def _retreat(self) -> None:
        """Return to the best parameters with half the step."""
        self.at.rate_scale *= 0.5
        self.task.controller.load_state_dict(self.at.best)
        self.optimiser = self._fresh()

    def _mark(self) -> tuple[_Progress, list[torch.Tensor], Any, dict[str, torch.Tensor]]:
        """State of the training for `_go_back`, since Ctrl-C may come in the middle of a step."""
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
        facts["statement"] = self.statement
        state, info = TrainingState(tensors, facts), {"seed": self.task.seed}
        write_checkpoint(self.task.checkpoint, self.task.controller, state, info=info)

    def _restore(self) -> None:
        path = self.task.checkpoint
        if path is None:
            raise ArgumentError("resume was given without a checkpoint; give the file of the training to resume.")
        law = self.task.controller
        saved, state = read_checkpoint(path, law.dynamics.robot if isinstance(law, ModelLaw) else None)
        other = "it holds none" if state is None else difference(state.facts.get("statement"), self.statement)
        if state is None or other:
            raise ArgumentError(
                f"{path} is not a checkpoint of this training, as {other}; give its original settings, or start a new "
                "training."
            )
        self.task.controller.load_state_dict(saved.state_dict())
        facts = dict(state.facts)
        self.optimiser.load_state_dict(unpacked_state(facts.pop("optimiser"), state.tensors))
        del facts["statement"]
        best = {k.removeprefix("best."): x for k, x in state.tensors.items() if k.startswith("best.")}
        self.at = _Progress(**facts, best=best)


class _NotFinite(ArithmeticError):
    """A cost or gradient that is not finite, because the motions diverged."""
