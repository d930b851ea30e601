"""How every law of the fair comparison is tuned: trained on the training trials, then scaled in them."""

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.optimize import minimize

from nbs_pin.base.arrays import JointArray, Scalars, Vectors
from nbs_pin.benchmarks.real_arms import AWAY, ENCODER, PERIOD, Figures, Trial, attempt
from nbs_pin.controllers.controller import Controller
from nbs_pin.controllers.gain import Gain
from nbs_pin.controllers.neural_backstepping import NeuralBackstepping
from nbs_pin.training.train import Training, train

ROUGH = 0.01
"""Roughness up to which none is charged: 1 % of the effort limit a millisecond, RMS, on the worst joint."""
CHARGE = 3.0
"""Weight of what is above it; an error e times as large costs 1."""
_NORM = 4  # p-norm, for a derivative of the worst joint
_LOST = 20.0  # cost of a law that diverges
_FIRST = -0.7  # first step of the search, in ln of a factor


class Budget(NamedTuple):
    """What every law gets."""

    trials: int = 3
    """Trials of tuning."""
    rates: tuple[float, ...] = (0.2,)
    """Learning rates tried."""
    epochs: int = 60
    """Epochs with each."""
    trained: float = 1.2
    """Duration of a motion of training [s]."""
    evaluations: int = 20
    """Evaluations of the search for factors, each all trials."""
    searched: float = 4.0
    """Duration of their motions [s]."""


class Tuned(NamedTuple):
    """A law that was tuned."""

    law: Any
    cost: float
    """Mean cost over the trials of tuning, in MuJoCo."""
    factors: tuple[float, ...]
    """What the gains of every group were multiplied with at last."""


def cost(figures: Figures) -> float:
    """ln of the RMS error in mrad, and three times ln of the roughness over `ROUGH` where it is above."""
    if not math.isfinite(figures.error) or figures.error <= 0.0:
        return _LOST
    return math.log(1e3 * figures.error) + CHARGE * max(0.0, math.log(max(figures.roughness, 1e-12) / ROUGH))


@dataclass(frozen=True, eq=False)
class LateCost:
    """`cost` of the second half of a motion as a stage cost for `train`, with norms in place of the worst joint."""

    limit: JointArray
    """Effort limits [N·m]."""

    def __call__(self, z1: Vectors, dz1: Vectors, tau: Vectors) -> Scalars:
        """The cost of every motion, spread evenly over its instants; arguments (motions, instants, n)."""
        rows = z1.shape[-2]
        late = slice(rows // 2, None)
        error = _worst(z1[:, late])
        change = _worst(torch.diff(tau[:, late], dim=-2) / torch.as_tensor(self.limit))
        price = torch.log(1e3 * error) + CHARGE * torch.relu(torch.log(change / ROUGH))
        return (price / (rows * PERIOD))[:, None].expand(z1.shape[:-1])


def _worst(x: torch.Tensor) -> torch.Tensor:
    """About the RMS over time of the worst joint, (motions,)."""
    return (x.square().mean(dim=-2) ** _NORM).sum(dim=-1) ** (0.5 / _NORM)


def trained(law: Controller, trials: Sequence[Trial], budget: Budget, seed: int) -> Any:
    """The law trained on all trials at once, by the learning rate of the lowest cost from starts of checking."""
    plants = [trial.differentiable for trial in trials]
    motions = [trial.motion for trial in trials[:2]]

    def at(rate: float) -> Training:
        found = train(
            law,
            plants,
            motions,
            starts=1,
            held_out=1,
            start_error=AWAY,
            duration=budget.trained,
            period=PERIOD,
            lookahead=0.0,
            encoder=ENCODER,
            cost=LateCost(trials[0].arm.told.effort_limit),
            epochs=budget.epochs,
            learning_rate=rate,
            seed=seed,
        )
        if found.stopped == "interrupted":  # every law gets the whole budget
            raise KeyboardInterrupt
        return found

    return min(map(at, budget.rates), key=lambda found: float(found.held_out[found.best_epoch])).controller


def scaled(law: Any, factors: Sequence[float]) -> Any:
    """A copy of the law whose gains are multiplied, every group by one factor for all joints.

    The groups of NBS are S, Λ (and with both ω, since ΛK = ωI) and D₀; those of the others their gains in order. NBS
    keeps its floors.
    """
    law = copy.deepcopy(law)
    with torch.no_grad():
        for gain, factor in zip(gain_groups(law), factors, strict=True):
            gain.change.add_(0.5 * math.log(factor))
    if isinstance(law, NeuralBackstepping):
        law.inertial_rate *= factors[0] * factors[1]
    return law


def gain_groups(law: Any) -> list[Gain]:
    """The gains of a law."""
    if isinstance(law, NeuralBackstepping):
        return [gain for gain in (law.potential.stiffness, law.rate, law.damping.floor) if gain is not None]
    return [module for module in law.modules() if isinstance(module, Gain)]


def searched(make: Callable[[np.ndarray], Controller], count: int, trials: Sequence[Trial], budget: Budget) -> Tuned:
    """The law `make(factors)` of the lowest mean cost over the trials: `count` factors by Nelder and Mead's method."""
    best: list[Any] = [None, math.inf, ()]

    def value(logs: np.ndarray) -> float:
        factors = np.exp(np.clip(logs, -4.0, 4.0))
        law = make(factors)
        found = float(np.mean([cost(attempt(law, trial, budget.searched)) for trial in trials]))
        if found < best[1]:
            best[:] = law, found, tuple(factors.tolist())
        return found

    first = np.vstack([np.zeros(count), _FIRST * np.eye(count)])
    settings = {"maxfev": budget.evaluations, "initial_simplex": first}
    minimize(value, np.zeros(count), method="Nelder-Mead", options=settings)
    return Tuned(*best)
