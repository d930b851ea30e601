"""What data do not determine of a fitted model: terms of its torque that are uncertain away from the data."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float

from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.dynamics.lagrangian_network import LagrangianNetwork
from nbs_pin.identification.datasets import Dataset
from nbs_pin.identification.network_equations import Equation, Equations, Loss

MOST_ROWS = 3000
"""Most samples that represent the data, evenly spaced."""
_STATES, _PRIOR = 100, 1e-9
_WORTH_SAYING = 100.0  # ratio of standard deviations above which a term is named
_STILL = 0.1  # [rad/s, rad/s²]; least standard deviation of the other states
_TERMS = ("inertia", "Coriolis torque", "gravity")


def unidentifiable(
    network: LagrangianNetwork,
    data: Dataset,
    *,
    friction: JointFriction | None = None,
    loss: Loss = "torque",
    names: Sequence[str] = (),
    seed: int = 0,
) -> tuple[str, ...]:
    """Terms of the torque of each joint that the data do not determine, in words, the least certain first.

    With Σ = (JᵀJ + prior)⁻¹ of the fit's residuals, J_e Σ J_eᵀ is the covariance of a term at other states, where its
    Jacobian is J_e: directions of small singular values of J count as far as the torque depends on them. A term is
    named if its standard deviation, RMS over all configurations at the data's speeds and accelerations, exceeds 100
    times that of the residuals at the data. Source: the Gauss–Newton covariance, docs/theory.md §6. Joints without
    `names` are numbered; the seed draws the other states.
    """
    equations = Equations.of(Equation.fitted(network, friction, loss), data.thinned(MOST_ROWS))
    theta, rows, n = equations.theta, torch.arange(len(equations)), data.nv
    matrix, _ = equations.normal(theta, rows)
    matrix.diagonal().add_(_PRIOR * float(matrix.diagonal().mean()))
    factor = torch.linalg.cholesky(matrix)
    here = _spread(factor, equations.jacobian(theta, rows[:: max(1, len(rows) // _STATES)]))
    certain = max(float(here.square().mean().sqrt()), 1e-300)
    found = []
    for term, J in zip(_TERMS, _terms(equations, data, seed), strict=True):
        ratio = _spread(factor, J).reshape(-1, n).square().mean(0).sqrt() / certain
        found += [(float(ratio[i]), f"{term} of {names[i] if names else f'joint {i + 1}'}") for i in range(n)]
    scale = () if data.tau.any() else ("the torque's scale: without torque, a common factor of M, C and G is unknown",)
    left = sorted((x for x in found if x[0] > _WORTH_SAYING), reverse=True)
    return scale + tuple(f"{what}: {float(f'{x:.1g}'):,.0f} times less certain away from the data" for x, what in left)


def _terms(equations: Equations, data: Dataset, seed: int) -> list[Float[torch.Tensor, "rows p"]]:
    """Jacobians of M̂a, Ĉv and Ĝ at random states, in units of the torque's deviation or, without torque, of one."""
    rng, size = np.random.default_rng(seed), (_STATES, data.nv)
    low, high = data.q.min(axis=0), data.q.max(axis=0)
    q = np.where(data.prismatic, rng.uniform(low, high, size), rng.uniform(-np.pi, np.pi, size))
    v, a = (np.maximum(x.std(axis=0), _STILL) * rng.standard_normal(size) for x in (data.v, data.a))
    still = np.zeros(size)
    every = _torque_of(equations, data, q, v, a)
    rest, moving = _torque_of(equations, data, q, still, still), _torque_of(equations, data, q, v, still)
    return [every - moving, moving - rest, rest]


def _torque_of(
    equations: Equations, data: Dataset, q: np.ndarray, v: np.ndarray, a: np.ndarray
) -> Float[torch.Tensor, "rows p"]:
    """Jacobian of the model's torque without friction, with respect to all parameters."""
    network, parameters = equations.equation.network, len(equations.theta)
    order = np.arange(len(q))
    states = Dataset(q, v, a, 0.0 * q, 1.0 * order, order, data.parents, data.prismatic)
    unit = torch.from_numpy(np.where(data.tau.std(axis=0) > 0.0, data.tau.std(axis=0), 1.0))
    own = Equations.of(Equation.fitted(network, None, "torque"), states, unit)
    J = own.jacobian(own.theta, torch.arange(len(q)))
    return torch.cat([J.new_zeros(len(J), parameters - J.shape[1]), J], dim=1)  # friction comes first


def _spread(factor: torch.Tensor, J: torch.Tensor) -> Float[torch.Tensor, " rows"]:
    """Standard deviation of every row: the diagonal of JΣJᵀ."""
    return torch.linalg.solve_triangular(factor, J.T, upper=False).square().sum(0).sqrt()
