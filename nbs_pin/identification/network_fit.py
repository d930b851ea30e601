"""Fit of Lagrangian networks: Levenberg–Marquardt for small ones, Adam and L-BFGS for large ones."""

import copy
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Literal, TypeAlias, cast, get_args

import numpy as np
import torch
from jaxtyping import Int

from nbs_pin.base.doors import option
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.progress import tracked
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.dynamics.lagrangian_network import LagrangianNetwork
from nbs_pin.identification.coupling import Coupling, in_motors, matrix_of
from nbs_pin.identification.datasets import Dataset
from nbs_pin.identification.drive_choice import Wanted, terms_of_rest
from nbs_pin.identification.drive_terms import DriveTerms
from nbs_pin.identification.fit_report import is_far_worse
from nbs_pin.identification.network_equations import Equation, Equations, Loss, Theta

FitOptimiser: TypeAlias = Literal["lm", "adam", "lbfgs"]
"""Levenberg–Marquardt, first on a random subset of the samples, then on all; Adam on minibatches with cosine decay of
the step; or L-BFGS on all samples after a quarter of the iterations with Adam. While the normal equations are small,
one iteration of "lm" gains as much as hundreds of the others (docs/theory.md §6)."""
ITERATIONS: dict[str, int] = {"lm": 30, "adam": 300, "lbfgs": 400}
"""Default number of iterations: steps of LM and L-BFGS, passes over the data of Adam."""
LARGEST_FOR_LM = 3500
"""Largest number of parameters for which "lm" is the default: its work per sample grows with their square."""
_COARSE_EQUATIONS, _COARSE_STEPS, _COARSE_ENOUGH = 5, 25, 3e-3  # residuals per parameter, steps, sufficient nMSE
_STARTS, _STUCK = 3, 0.05  # most starts; nMSE after the coarse part above which another is tried
_PATIENCE, _SLOW = 0.2, 0.03  # share of the iterations, and the least relative decrease in them
_BATCH, _BATCHES, _RATE, _LBFGS_SHARE = 256, 16, 3e-3, 0.75  # largest batch, fewest batches, learning rate, share
_AS_GOOD = 1.01  # ratio of costs up to which fewer or more terms of friction are as good
_LEAST_DAMPING, _MOST_DAMPING = 1e-14, 1e8


@dataclass(frozen=True, eq=False)
class NetworkFit:
    """A fitted network and the record of its fit."""

    network: LagrangianNetwork
    friction: JointFriction | None
    parameters: int
    """Number of fitted parameters."""
    history: list[float]
    """Normalised mean squared residual of the training data, before training and after every iteration."""
    held_out: list[float]
    """The same of the held-out data, empty without; the network is that of its minimum."""
    evaluations: int
    """How often the residuals of a sample were computed or differentiated, divided by the number of samples."""
    stopped: str
    """"converged", "iterations", "held out" (no improvement there), "interrupted" or "no better than the start": no
    iterate predicts the held-out data, or the training data without these, better than the untrained network."""

    @property
    def is_too_large(self) -> bool:
        """Whether held-out data are predicted so much worse than fitted ones that a smaller network may do better."""
        if not self.held_out or self.stopped == "interrupted":
            return False
        return is_far_worse(min(self.held_out), min(self.history))


@dataclass(eq=False)
class _Search:
    """One start: the best parameters so far, and the costs by which they are chosen."""

    equations: Equations
    held_out: Equations | None
    best: Theta
    train: list[float] = field(default_factory=list)
    checked: list[float] = field(default_factory=list)
    least: float = math.inf
    since: int = 0
    work: float = 0.0

    def record(self, theta: Theta) -> float:
        """Record an iterate, with the numbers of the drives solved beside it; returns its training cost."""
        theta = self.equations.solved(theta)
        self.train.append(self.equations.cost(theta))
        self.work += 1.0
        judged = self.train[-1]
        if self.held_out is not None:
            judged = self.held_out.cost(theta)
            self.checked.append(judged)
        self.since += 1
        if judged < self.least:
            self.best, self.least, self.since = theta, judged, 0
        return self.train[-1]

    @property
    def is_untrained(self) -> bool:
        """Whether no iterate is better than the first one."""
        judged = self.checked or self.train
        return self.least >= judged[0]

    def label(self) -> str:
        """Text of the progress bar."""
        return f"fitting, nMSE {self.train[-1]:.2e}"

    def run(self, steps: Iterator[Theta], count: int, progress: bool, enough: float = 0.0) -> str:
        """Take up to `count` steps, until the cost is at most `enough`; returns why it ended."""
        patience = max(3, round(_PATIENCE * count))
        try:
            for _ in tracked(range(count), self.label, progress):
                theta = next(steps, None)
                if theta is None:
                    return "converged"
                cost = self.record(theta)
                before = self.train[-1 - patience] if len(self.train) > patience else math.inf
                if cost <= enough or cost > (1.0 - _SLOW) * before:
                    return "converged"
                if self.checked and self.since >= patience:
                    return "held out"
        except KeyboardInterrupt:
            return "interrupted"
        return "iterations"


def fit_network(
    make: Callable[[int], LagrangianNetwork],
    data: Dataset,
    held_out: Dataset | None = None,
    *,
    seed: int = 0,
    loss: Loss | str = "torque",
    optimiser: FitOptimiser | str | None = None,
    iterations: int | None = None,
    wanted: Wanted | None = None,
    coupled: Coupling | None = None,
    progress: bool = False,
) -> NetworkFit:
    """Minimise the mean of (residual/deviation)² over samples and joints; Ctrl-C ends it and keeps the best.

    The numbers of the drives are solved by least squares beside the network, before training and at every iterate, so
    that the untrained network is judged with them too.

    Args:
        make: Returns an untrained network for a seed. "lm" tries up to two more seeds if a start makes no progress.
        data: Training samples, with the torques of the joints.
        held_out: Samples that select the iterate, so that a wide network does not fit noise. None selects by `data`.
        seed: Seed of the first network, the subset and the batches.
        loss: See `Loss`.
        optimiser: See `FitOptimiser`. None takes "lm" up to `LARGEST_FOR_LM` parameters, "lbfgs" above.
        iterations: None takes those of `ITERATIONS`.
        wanted: Friction and offsets to fit; None for none. Rotor inertias are part of M̂.
        coupled: Motors that turn several joints; friction and offsets are then theirs.
        progress: Show a progress bar.

    Raises:
        ArgumentError: If a name is unknown, a number is out of range, or a loss of torque is given data without torque.
    """
    if loss not in get_args(Loss):
        raise ArgumentError(f"loss '{loss}' is unknown; choose one of {', '.join(get_args(Loss))}.")
    if loss == "torque" and not data.tau.any():
        raise ArgumentError(
            f"the data have no torque, which M̂ = 0 explains; record some, or use {option('loss', 'acceleration')}."
        )

    wanted = replace(wanted or Wanted(False, False), rotor_inertia=False)
    first = wanted.first(data.nv) if data.tau.any() else None

    def begin(start: int) -> _Search:
        equation = Equation(copy.deepcopy(make(start)).requires_grad_(True), cast(Loss, loss), first, coupled)
        equations = Equations.of(equation, data)
        checked = None if held_out is None else Equations.of(equation, held_out, equations.unit)
        search = _Search(equations, checked, equations.theta)
        search.record(search.best)
        return search

    found = begin(seed)
    name = optimiser or ("lm" if len(found.best) <= LARGEST_FOR_LM else "lbfgs")
    if name not in ITERATIONS:
        raise ArgumentError(f"optimiser '{name}' is unknown; choose one of {', '.join(ITERATIONS)}.")
    count = ITERATIONS[name] if iterations is None else iterations
    if count < 1:
        raise ArgumentError(f"iterations is {count}, expected a whole number ≥ 1; {ITERATIONS[name]} is usual.")
    if name == "lm":
        found, stopped = _marquardt_starts(begin, found, seed, count, progress)
    else:
        steps = _adam(found, found.best, count if name == "adam" else count - round(_LBFGS_SHARE * count), seed)
        stopped = found.run(_adam_then_lbfgs(found, steps) if name == "lbfgs" else steps, count, progress)
    found.equations.write(found.best)
    equation = found.equations.equation
    equation.requires_grad_(False)
    friction = _friction(found, wanted, data) if first is not None else None
    numbers = 0 if friction is None else int(np.count_nonzero(DriveTerms.of_friction(friction)[1]))
    count, work = sum(p.numel() for p in equation.network.parameters()) + numbers, round(found.work)
    if found.is_untrained and stopped != "interrupted":
        stopped = "no better than the start"
    return NetworkFit(equation.network, friction, count, found.train, found.checked, work, stopped)


def _friction(found: _Search, wanted: Wanted, data: Dataset) -> JointFriction | None:
    """The friction beside the trained network, with the terms that the torque it leaves shows (`drive_choice`)."""
    equation = found.equations.equation
    fitted = equation.friction()
    if wanted.is_settled:
        return fitted
    left = found.equations.torque_left(found.best)
    terms, numbers = terms_of_rest(wanted, in_motors(data, equation.coupled), left)
    chosen = terms.friction(numbers, matrix_of(equation.coupled))
    judged = found.equations if found.held_out is None else found.held_out
    costs = [judged.torque_cost(friction) for friction in (chosen, fitted)]
    return chosen if costs[0] <= (1.0 if found.is_untrained else _AS_GOOD) * costs[1] else fitted


def _marquardt_starts(
    begin: Callable[[int], _Search], found: _Search, seed: int, count: int, progress: bool
) -> tuple[_Search, str]:
    """Levenberg–Marquardt from up to three starts on a subset of the samples, then from the best one on all."""
    samples, joints = len(found.equations), len(found.equations.unit)
    part = min(samples, -(-_COARSE_EQUATIONS * len(found.best) // joints))
    rows = torch.randperm(samples, generator=torch.Generator().manual_seed(seed))[:part].sort().values
    tried: list[_Search] = []
    for start in range(_STARTS):
        search = begin(seed + 7919 * start) if start else found
        tried.append(search)
        steps = _marquardt(search, search.best, rows)
        if search.run(steps, min(count, _COARSE_STEPS), progress, _COARSE_ENOUGH) == "interrupted":
            return min(tried, key=lambda s: s.least), "interrupted"
        if search.least < _STUCK:
            break
    best = min(tried, key=lambda s: s.least)
    best.work = sum(s.work for s in tried)
    best.since = 0
    left = max(1, count + 1 - len(best.train))
    return best, best.run(_marquardt(best, best.best, torch.arange(samples)), left, progress)


def _marquardt(search: _Search, theta: Theta, rows: Int[torch.Tensor, " m"], damping: float = 1e-3) -> Iterator[Theta]:
    """Steps −(JᵀJ + λI)⁻¹Jᵀr, λ in units of the mean diagonal: reduced after a decrease of the cost, else increased."""
    equations, share = search.equations, len(rows) / len(search.equations)
    cost = equations.cost(theta, rows)
    while damping < _MOST_DAMPING:
        matrix, slope = equations.normal(theta, rows)
        search.work += 2.0 * share
        level, diagonal = float(matrix.diagonal().mean()), matrix.diagonal().clone()
        while damping < _MOST_DAMPING:
            matrix.diagonal().copy_(diagonal + damping * level)
            factor, failed = torch.linalg.cholesky_ex(matrix)
            trial = theta if int(failed) else theta - torch.cholesky_solve(slope[:, None], factor)[:, 0]
            reached = math.inf if int(failed) else equations.cost(trial, rows)
            search.work += share
            if reached < cost:
                damping = max(_LEAST_DAMPING, damping / (4.0 if reached < 0.8 * cost else 2.0))
                theta, cost = trial, reached
                yield theta
                break
            damping *= 4.0


def _adam(search: _Search, theta: Theta, epochs: int, seed: int) -> Iterator[Theta]:
    """Passes of Adam over the samples in minibatches."""
    equations, generator = search.equations, torch.Generator().manual_seed(seed)
    moving, batch = theta.clone().requires_grad_(True), min(_BATCH, -(-len(equations) // _BATCHES))
    optimiser = torch.optim.Adam([moving], lr=_RATE)
    for epoch in range(epochs):
        for group in optimiser.param_groups:
            group["lr"] = _RATE * (0.01 + 0.99 * 0.5 * (1.0 + math.cos(math.pi * epoch / epochs)))
        for rows in torch.split(torch.randperm(len(equations), generator=generator), batch):
            optimiser.zero_grad()
            equations.residual(moving, rows).square().mean().backward()  # type: ignore[no-untyped-call]
            optimiser.step()
        search.work += 2.0
        yield moving.detach().clone()


def _adam_then_lbfgs(search: _Search, adam: Iterator[Theta]) -> Iterator[Theta]:
    """L-BFGS with a strong Wolfe line search from the end of Adam, as long as the parameters change."""
    theta = search.best
    for theta in adam:
        yield theta
    moving = theta.clone().requires_grad_(True)
    optimiser = torch.optim.LBFGS(
        [moving], max_iter=1, history_size=50, line_search_fn="strong_wolfe", tolerance_grad=0.0, tolerance_change=1e-16
    )

    def closure() -> torch.Tensor:
        optimiser.zero_grad()
        cost = search.equations.residual(moving).square().mean()
        cost.backward()  # type: ignore[no-untyped-call]
        search.work += 2.0
        return cost

    while True:
        before = moving.detach().clone()
        optimiser.step(closure)  # type: ignore[no-untyped-call]
        if torch.equal(moving.detach(), before) or not bool(torch.isfinite(moving).all()):
            return
        yield moving.detach().clone()
