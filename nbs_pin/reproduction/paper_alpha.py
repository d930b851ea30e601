"""The paper's sweep over α: as it prints it, where nothing is swept, and with a Φ that α does change."""

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from nbs_pin.base.progress import tracked
from nbs_pin.controllers.damping import Damping
from nbs_pin.controllers.neural_backstepping import NeuralBackstepping, paper_controller
from nbs_pin.controllers.potential import Potential
from nbs_pin.dynamics.analytic import AnalyticDynamics
from nbs_pin.reproduction.authors import PERIOD
from nbs_pin.reproduction.paper_table import DISTURBANCE, follow, trained
from nbs_pin.simulation import metrics

FLOOR = 0.5
"""d_min: D ⪰ ½I, which the paper asks for [N·m·s/rad]."""
SQUARE_WAVES = np.geomspace(0.2, 6.0, 6)
"""Frequencies tried [rad/s]."""
_DIRECTIONS = np.array([[1.0, 1.0], [1.0, -1.0], [1.0, 0.0], [0.0, 1.0]])
WAVES = len(SQUARE_WAVES) * len(_DIRECTIONS)
"""Square waves tried: every frequency in every direction."""
SQUARE_DURATION = 60.0
"""[s]; the second half counts."""
LARGEST_INERTIA = 3.0 + 2.0 * np.sqrt(2.0)
"""a₂ with M(q) ⪯ a₂I for the paper's arm, exact [kg·m²].

With c = cos β₂, M = [[3 + 2c, 1 + c], [1 + c, 1]] has the eigenvalues 2 + c ± √2(1 + c): the largest at c = 1.
"""


def printed_bound(alpha: Any) -> Any:
    """‖z1‖² ≤ d/(2α²) with d = ‖τ_d‖² (paper, Theorem 3); true at rest on a fixed reference, not for every τ_d."""
    return float(DISTURBANCE @ DISTURBANCE) / (2.0 * alpha**2)


def corrected_bound(alpha: float) -> float:
    """What ‖z1‖² comes to at most, for every τ_d with ‖τ_d‖² ≤ d, S = α/2·I, Λ = I, D ⪰ d_min I [rad²].

    Source: docs/theory.md §5 with D₀ = d_min I.

    ρ = α, κ = d_min/a₂, Δ = d/d_min, V∞ = Δ/(2εc), c = min(2ρ, (2 − ε)κ), ε = 1 if κ ≤ 2ρ else 2 − 2ρ/κ, its best;
    ‖z1‖² ≤ V∞/λ_min(S).
    """
    delta, rho, kappa = float(DISTURBANCE @ DISTURBANCE) / FLOOR, alpha, FLOOR / LARGEST_INERTIA
    epsilon = 1.0 if kappa <= 2.0 * rho else 2.0 - 2.0 * rho / kappa
    limit = delta / (2.0 * epsilon * min(2.0 * rho, (2.0 - epsilon) * kappa))
    return limit / (0.5 * alpha)


def swept_controller(alpha: float, seed: int) -> NeuralBackstepping:
    """The paper's networks with S = α/2·I, so that ∇²Φ ⪰ αI, and D = ½I + TᵀT, so that D ⪰ ½I."""
    potential = Potential(0.5 * alpha * np.eye(2), form="paper", seed=seed)
    return NeuralBackstepping(AnalyticDynamics(), potential, Damping(2, floor=FLOOR * np.eye(2), seed=seed + 1))


def regulariser(controller: NeuralBackstepping, alpha: float) -> torch.Tensor:
    """relu(λ_max(αI − ∇²Φ(0))), differentiable in the controller's parameters (paper, remark after Theorem 3)."""
    identity = torch.eye(controller.nv, dtype=torch.float64)
    hessian = controller.potential.terms(0.0 * identity, identity)[2]
    return torch.relu(torch.linalg.eigvalsh(alpha * identity - hessian)[-1])


@dataclass(frozen=True, eq=False)
class AsPrinted:
    """S = I: the regulariser is zero for every α ≤ 2, and training cannot see α."""

    regulariser: Float[np.ndarray, " alphas"]
    """Its largest value over the seeds, before and after training."""
    steady_error: Float[np.ndarray, " ends"]
    """‖z1‖² after training with the least and the greatest α: the same number."""
    weights_differ: float
    """Largest difference of any weight between those two trainings."""


def as_printed(alphas: Float[np.ndarray, " alphas"], seeds: range, epochs: int, duration: float) -> AsPrinted:
    """The sweep of the paper: S = I, m = 1, trained under τ_d with the regulariser in the loss."""
    dynamics = AnalyticDynamics()
    laws = [paper_controller(dynamics, m=1.0, seed=seed) for seed in seeds]
    ends = [
        trained(laws[0], epochs, DISTURBANCE, partial(regulariser, alpha=alpha))
        for alpha in (float(alphas[0]), float(alphas[-1]))
    ]
    with torch.no_grad():
        values = [max(float(regulariser(law, alpha)) for law in (*laws, *ends)) for alpha in alphas.tolist()]
        pairs = zip(ends[0].parameters(), ends[1].parameters(), strict=True)
        differ = max(float((a - b).abs().max()) for a, b in pairs)
    errors = [float(np.max(metrics.steady_error(follow(law, duration, DISTURBANCE)))) for law in ends]
    return AsPrinted(np.array(values), np.array(errors), differ)


@dataclass(frozen=True, eq=False)
class Sweep:
    """S = α/2·I: ‖z1‖² [rad²], one number per α, and the bounds on it."""

    alpha: Float[np.ndarray, " alphas"]
    untrained: Float[np.ndarray, " alphas"]
    """Steady, under the constant τ_d."""
    trained: Float[np.ndarray, " alphas"]
    """The same after training."""
    square_untrained: Float[np.ndarray, " alphas"]
    """Under the worst of square waves of the same norm."""
    square_trained: Float[np.ndarray, " alphas"]
    printed: Float[np.ndarray, " alphas"]
    corrected: Float[np.ndarray, " alphas"]


def sweep(alphas: Float[np.ndarray, " alphas"], seed: int, epochs: int, duration: float, progress: bool) -> Sweep:
    """Every α: the networks of one seed, untrained and trained."""
    found = []
    for alpha in tracked(alphas.tolist(), "α sweep", progress):
        before = swept_controller(alpha, seed)
        after = trained(before, epochs, DISTURBANCE)
        errors = [float(np.max(metrics.steady_error(follow(law, duration, DISTURBANCE)))) for law in (before, after)]
        found.append([*errors, worst_square_wave(before), worst_square_wave(after)])
    bounds = [[printed_bound(alpha), corrected_bound(alpha)] for alpha in alphas.tolist()]
    return Sweep(alphas, *np.array(found).T, *np.array(bounds).T)


def worst_square_wave(controller: NeuralBackstepping) -> float:
    """Largest ‖z1‖² that square waves with ‖τ_d‖ = √2 reach in the second half of a minute [rad²].

    Both joints together, against each other, or one alone, at each of `SQUARE_WAVES`.
    """
    directions = _DIRECTIONS * np.linalg.norm(DISTURBANCE) / np.linalg.norm(_DIRECTIONS, axis=1, keepdims=True)
    steps = round(SQUARE_DURATION / PERIOD)
    waves = np.where(np.sin(np.outer(SQUARE_WAVES, PERIOD * np.arange(steps))) >= 0.0, 1.0, -1.0)
    tau_d = (directions[:, None, None] * waves[..., None]).reshape(WAVES, steps, 2)
    run = follow(controller, SQUARE_DURATION, tau_d, np.zeros((WAVES, 2)))
    return float(np.max(metrics.steady_error(run, last=0.5)))
