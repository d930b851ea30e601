"""Residuals of a Lagrangian network on measured motions, and their derivatives with respect to its parameters."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias, cast

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import nn
from torch.func import functional_call, jacrev, vmap

from nbs_pin.base.arrays import JointArray, constant_like
from nbs_pin.base.doors import option
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.dynamics.friction import DriveFriction, JointFriction
from nbs_pin.dynamics.lagrangian_network import LagrangianNetwork
from nbs_pin.dynamics.residual import ResidualNetwork, Terms, nominal_terms
from nbs_pin.identification.coupling import Coupling, in_motors, matrix_of
from nbs_pin.identification.datasets import Dataset
from nbs_pin.identification.drive_terms import DriveTerms

Loss: TypeAlias = Literal["torque", "acceleration"]
"""τ̂ − τ, cheap and well conditioned; or predicted minus measured v̇, as in the paper, which needs M̂⁻¹."""
Theta: TypeAlias = Float[torch.Tensor, " parameters"]
_LARGEST_BLOCK = 2**22  # entries of a Jacobian block, 32 MiB
_STRIPS = 6  # of JᵀJ, each computed from the diagonal to the right
_FLAT = 1e-6


class Equation(nn.Module):
    """The residual of one sample: a network, and the terms of the drives, which are linear in their numbers.

    Torques are those of the motors; `coupled` tells how they turn with the joints, None is one for each.
    """

    def __init__(
        self, network: LagrangianNetwork, loss: Loss, terms: DriveTerms | None, coupled: Coupling | None = None
    ) -> None:
        super().__init__()
        if loss == "acceleration" and isinstance(network, ResidualNetwork):
            raise ArgumentError(
                f"loss 'acceleration' needs derivatives that a nominal model lacks; use {option('loss', 'torque')}."
            )
        self.network, self.loss, self.terms = network, loss, terms
        self.coupled = coupled
        kinds = 0 if terms is None else len(terms.kinds)
        self.numbers = nn.Parameter(torch.zeros(kinds, network.nv, dtype=torch.float64)) if kinds else None

    @classmethod
    def fitted(cls, network: LagrangianNetwork, friction: JointFriction | None, loss: Loss) -> "Equation":
        """The equation of a fitted network and its friction."""
        if friction is None:
            return cls(network, loss, None)
        terms, numbers = DriveTerms.of_friction(friction)
        turns = friction.coupling if isinstance(friction, DriveFriction) else None
        equation = cls(network, loss, terms, None if turns is None else Coupling(turns, at_motors=False))
        equation.write_numbers(numbers)
        return equation

    def forward(
        self,
        q: torch.Tensor,
        v: torch.Tensor,
        a: torch.Tensor,
        tau: torch.Tensor,
        factors: torch.Tensor,
        *nominal: torch.Tensor,
    ) -> torch.Tensor:
        """Residual of the torque [N·m] or acceleration [rad/s²], predicted minus measured."""
        net = tau if self.numbers is None else tau - (self.numbers * factors).sum(-2)
        if self.loss == "acceleration":
            of_joints = net if self.coupled is None else net @ constant_like(net, self.coupled.matrix)
            return self.network.acceleration(q, v, of_joints) - a
        return self.of_motors(self.needed(q, v, a, *nominal)) - net

    def of_motors(self, tau: torch.Tensor) -> torch.Tensor:
        """N⁻ᵀ τ, for torques of the joints."""
        return tau if self.coupled is None else tau @ constant_like(tau, np.linalg.inv(self.coupled.matrix))

    def needed(self, q: torch.Tensor, v: torch.Tensor, a: torch.Tensor, *nominal: torch.Tensor) -> torch.Tensor:
        """The network's torque of the joints [N·m]."""
        if nominal:
            return cast(ResidualNetwork, self.network).torque(q, v, v, a, Terms(*nominal))
        return self.network.torque(q, v, v, a)

    def write_numbers(self, numbers: Float[np.ndarray, "kinds n"]) -> None:
        """Set the numbers of the drives."""
        if self.numbers is not None:
            with torch.no_grad():
                self.numbers.copy_(torch.from_numpy(numbers))

    def friction(self) -> JointFriction | None:
        """The fitted friction, None without."""
        if self.terms is None or self.numbers is None:
            return None
        return self.terms.friction(self.numbers.detach().numpy(force=True), matrix_of(self.coupled))


@dataclass(frozen=True, eq=False)
class Equations:
    """Residuals of all samples in units of each joint's standard deviation, as functions of one parameter vector."""

    equation: Equation
    columns: tuple[torch.Tensor, ...]
    """q, v, a of the joints, τ and factors (kinds, n) of the motors and the terms of a nominal model, if any; one row
    per sample."""
    unit: Float[torch.Tensor, " n"]
    """Standard deviation of the measured torque or acceleration [N·m or rad/s²]."""

    @classmethod
    def of(cls, equation: Equation, data: Dataset, unit: Float[torch.Tensor, " n"] | None = None) -> "Equations":
        """The equations of data with the torques of the joints; `unit` of others makes the costs of both comparable."""
        moved = in_motors(data, equation.coupled)
        q, v, a, tau = (torch.from_numpy(x) for x in (data.q, data.v, data.a, moved.tau))
        network, terms = equation.network, equation.terms
        kinds = np.zeros((0, *data.v.shape)) if terms is None else terms.factors(moved)
        factors = torch.from_numpy(np.ascontiguousarray(kinds.swapaxes(0, 1)))
        nominal = nominal_terms(network.nominal, q) if isinstance(network, ResidualNetwork) else ()
        return cls(
            equation, (q, v, a, tau, factors, *nominal), deviation(tau if equation.loss == "torque" else a, unit)
        )

    def __len__(self) -> int:
        return len(self.columns[0])

    @property
    def theta(self) -> Theta:
        """The current parameters of the module."""
        return torch.cat([p.detach().reshape(-1) for p in self.equation.parameters()])

    def write(self, theta: Theta) -> None:
        """Set the parameters of the module."""
        with torch.no_grad():
            for p, part in zip(self.equation.parameters(), self._parts(theta).values(), strict=True):
                p.copy_(part)

    def torque_left(self, theta: Theta) -> Float[np.ndarray, "m n"]:
        """The torque of the motors that the network leaves to the drives [N·m]."""
        self.write(theta)
        q, v, a, tau, _, *nominal = self.columns
        with torch.no_grad():
            needed = self.equation.needed(q, v, a, *nominal)
            return np.asarray((tau - self.equation.of_motors(needed)).numpy(force=True))

    def solved(self, theta: Theta) -> Theta:
        """The parameters with the numbers of the drives by least squares beside the network."""
        equation = self.equation
        if equation.terms is None or equation.numbers is None:
            return theta
        left, factors = self.torque_left(theta), self.columns[4].numpy(force=True).swapaxes(0, 1)
        if not np.isfinite(left).all():
            return theta
        equation.write_numbers(equation.terms.solved(factors, left))
        return self.theta

    def torque_cost(self, friction: JointFriction | None) -> float:
        """Mean square of the torque residual in units of its deviation, with the network as it is and this friction."""
        q, v, a, tau, _, *nominal = self.columns
        with torch.no_grad():
            needed = self.equation.needed(q, v, a, *nominal)
            whole = needed if friction is None else needed + friction.feedforward(v, needed)
            left = self.equation.of_motors(whole) - tau
        return float((left / deviation(tau)).square().mean())

    def residual(self, theta: Theta, rows: Int[torch.Tensor, " m"] | None = None) -> Float[torch.Tensor, "m n"]:
        """Residuals of the samples `rows`, of all for None; differentiable in theta."""
        chosen = self.columns if rows is None else tuple(x[rows] for x in self.columns)
        value: torch.Tensor = functional_call(self.equation, self._parts(theta), chosen)
        return value / self.unit

    def cost(self, theta: Theta, rows: Int[torch.Tensor, " m"] | None = None) -> float:
        """Mean square of the residuals, the normalised mean squared error; inf if it is not finite."""
        with torch.no_grad():
            value = float(self.residual(theta, rows).square().mean())
        return value if math.isfinite(value) else math.inf

    def jacobian(self, theta: Theta, rows: Int[torch.Tensor, " m"]) -> Float[torch.Tensor, "mn parameters"]:
        """∂ residual/∂ theta, a row per sample and joint."""

        def one(parts: dict[str, torch.Tensor], *columns: torch.Tensor) -> torch.Tensor:
            value: torch.Tensor = functional_call(self.equation, parts, columns)
            return value / self.unit

        parts, columns = self._parts(theta), [x[rows] for x in self.columns]
        slopes: Any = vmap(jacrev(one), in_dims=(None, *[0] * len(columns)))(parts, *columns)
        size = len(rows) * len(self.unit)
        return torch.cat([slope.detach().reshape(size, -1) for slope in slopes.values()], dim=1)

    def normal(
        self, theta: Theta, rows: Int[torch.Tensor, " m"]
    ) -> tuple[Float[torch.Tensor, "parameters parameters"], Theta]:
        """JᵀJ and Jᵀr, each divided by the number of residuals."""
        count, n = len(rows) * len(self.unit), len(self.unit)
        matrix, slope = theta.new_zeros(len(theta), len(theta)), torch.zeros_like(theta)
        for block in _blocks(rows, max(1, _LARGEST_BLOCK // (n * len(theta)))):
            J = self.jacobian(theta, block)
            with torch.no_grad():
                slope += J.T @ self.residual(theta, block).reshape(-1) / count
                for rows_of in _blocks(torch.arange(len(theta)), -(-len(theta) // _STRIPS)):
                    strip = slice(int(rows_of[0]), int(rows_of[-1]) + 1)
                    matrix[strip, strip.start :].addmm_(J[:, strip].T, J[:, strip.start :], alpha=1.0 / count)
        return matrix.triu() + matrix.triu(1).T, slope

    def _parts(self, theta: Theta) -> dict[str, torch.Tensor]:
        """The parameter vector split into named parameters."""
        named = dict(self.equation.named_parameters())
        pieces = torch.split(theta, [p.numel() for p in named.values()])
        return {name: x.reshape(p.shape) for (name, p), x in zip(named.items(), pieces, strict=True)}


def deviation(x: Float[torch.Tensor, "m n"], given: torch.Tensor | None = None) -> Float[torch.Tensor, " n"]:
    """Standard deviation of every column; the largest one for columns that hardly vary, 1 if none varies."""
    if given is not None:
        return given
    spread = (x - x.mean(0)).square().mean(0).sqrt()
    largest = float(spread.max()) or 1.0
    return torch.where(spread > _FLAT * largest, spread, largest)


def deviation_of(x: Float[np.ndarray, "m n"]) -> JointArray:
    """`deviation` of an array."""
    return deviation(torch.from_numpy(x)).numpy()


def _blocks(rows: Int[torch.Tensor, " m"], size: int) -> Iterator[Int[torch.Tensor, " k"]]:
    yield from torch.split(rows, size)
