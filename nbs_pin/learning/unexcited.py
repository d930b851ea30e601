"""What data leave open of a learned model: how much less certain its torque is elsewhere than where it was measured."""

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float

from nbs_pin.learning.datasets import Dataset
from nbs_pin.learning.network_equations import Equation, Equations, Theta

MOST_ROWS = 3000
"""Samples that speak for the data, evenly picked."""
_STATES, _PRIOR = 100, 1e-9
_WORTH_SAYING = 100.0
_TERMS = ("inertia", "Coriolis torque", "gravity")


def unexcited(equations: Equations, data: Dataset, names: Sequence[str] = (), seed: int = 0) -> tuple[str, ...]:
    """Sentences on terms of the torque, joint by joint, that the data leave open, the least certain first.

    With Σ = (JᵀJ + prior)⁻¹ of the fit's residuals, J_e Σ J_eᵀ is the covariance of a term at other states, where its
    Jacobian is J_e: directions of small singular values of J count as far as the torque depends on them, and those that
    change no torque do not. A term is named where, root mean square over all configurations at the data's speeds
    and accelerations, it is more than 100 times as uncertain as the residuals at the data. Source: Gauss–Newton's
    covariance, docs/theory.md §6. names: of the joints; numbers when there are none.
    """
    theta = equations.theta
    rows = torch.from_numpy(np.unique(np.linspace(0, len(equations) - 1, MOST_ROWS).astype(int)))
    matrix, _ = equations.normal(theta, rows)
    matrix.diagonal().add_(_PRIOR * float(matrix.diagonal().mean()))
    factor = torch.linalg.cholesky(matrix)
    here = _spread(factor, equations.jacobian(theta, rows[:: max(1, len(rows) // _STATES)]))
    n, told = data.nv, []
    for term, J in zip(_TERMS, _terms(equations, data, theta, seed), strict=True):
        certain = max(float(here.square().mean().sqrt()), 1e-300)
        ratio = _spread(factor, J).reshape(-1, n).square().mean(0).sqrt() / certain
        told += [(float(ratio[i]), term, names[i] if names else f"joint {i + 1}") for i in range(n)]
    open_ones = sorted((x for x in told if x[0] > _WORTH_SAYING), reverse=True)
    scale = () if data.tau.any() else ("the torque's scale: without torque, M, C and G have one common factor unknown",)
    return scale + tuple(f"{term} of {name}: {_rounded(x)} times less certain elsewhere" for x, term, name in open_ones)


def _terms(equations: Equations, data: Dataset, theta: Theta, seed: int) -> list[Float[torch.Tensor, "rows p"]]:
    """Jacobians of M̂a, Ĉv and Ĝ at random states, in units of the torque's deviation or, without torque, of one."""
    rng, size = np.random.default_rng(seed), (_STATES, data.nv)
    low, high = data.q.min(axis=0), data.q.max(axis=0)
    q = np.where(data.prismatic, rng.uniform(low, high, size), rng.uniform(-np.pi, np.pi, size))
    v, a = (x.std(axis=0) * rng.standard_normal(size) for x in (data.v, data.a))
    still = np.zeros(size)
    every = _torque_of(equations, data, theta, q, v, a)
    rest, moving = _torque_of(equations, data, theta, q, still, still), _torque_of(equations, data, theta, q, v, still)
    return [every - moving, moving - rest, rest]


def _torque_of(
    equations: Equations, data: Dataset, theta: Theta, q: np.ndarray, v: np.ndarray, a: np.ndarray
) -> Float[torch.Tensor, "rows p"]:
    """Jacobian of the model's torque without friction, with respect to all parameters."""
    fitted = equations.equation
    order = np.arange(len(q))
    states = Dataset(q, v, a, 0.0 * q, 1.0 * order, order, data.parents, data.prismatic)
    bare = Equation(fitted.network, "torque", None, fitted.transition)
    unit = torch.from_numpy(np.where(data.tau.std(axis=0) > 0.0, data.tau.std(axis=0), 1.0))
    own = Equations.of(bare, states, unit)
    J = own.jacobian(own.theta, torch.arange(len(q)))
    return torch.cat([theta.new_zeros(len(J), len(theta) - J.shape[1]), J], dim=1)


def _spread(factor: torch.Tensor, J: torch.Tensor) -> Float[torch.Tensor, " rows"]:
    """Standard deviation of every row: the diagonal of JΣJᵀ."""
    return torch.linalg.solve_triangular(factor, J.T, upper=False).square().sum(0).sqrt()


def _rounded(x: float) -> str:
    return f"{10.0 ** math.floor(math.log10(x)):,.0f}"
