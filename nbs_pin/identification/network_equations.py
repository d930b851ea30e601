"""What a Lagrangian network leaves unexplained of measured motions, and how that changes with its parameters."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias, cast

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import nn
from torch.func import functional_call, jacrev, vmap

from nbs_pin.base.arrays import JointArray
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.dynamics.lagrangian_network import LagrangianNetwork
from nbs_pin.dynamics.residual import ResidualNetwork, Terms, nominal_terms
from nbs_pin.identification.datasets import Dataset

Loss: TypeAlias = Literal["torque", "acceleration"]
"""τ̂ − τ, cheap and well conditioned; or v̇ that τ produces less v̇ measured, the paper's, which needs M̂⁻¹."""
Theta: TypeAlias = Float[torch.Tensor, " parameters"]
_LARGEST_BLOCK = 2**22  # numbers of a Jacobian at a time, 32 MiB
_STRIPS = 6  # of a symmetric matrix, of which only what is right of the diagonal is computed
_FLAT = 1e-6
FIRST_FRICTION = 0.1
"""Friction to begin with, as a share of the torque's deviation at a speed of one deviation."""


class Equation(nn.Module):
    """The residual of one sample: network and friction as one module, so that both are learned together.

    Friction is d²v + c² tanh(v/transition), so that its coefficients are never negative.
    """

    def __init__(
        self, network: LagrangianNetwork, loss: Loss, friction: Float[torch.Tensor, "2 n"] | None, transition: float
    ) -> None:
        super().__init__()
        if loss == "acceleration" and isinstance(network, ResidualNetwork):
            raise ArgumentError("loss 'acceleration' needs derivatives that a nominal model has not; take 'torque'.")
        self.network, self.loss, self.transition = network, loss, transition
        self.roots = None if friction is None else nn.Parameter(friction.sqrt())

    @classmethod
    def fitted(cls, network: LagrangianNetwork, friction: JointFriction | None, loss: Loss) -> "Equation":
        """Of a network and a friction that are known."""
        if friction is None:
            return cls(network, loss, None, 1.0)
        coefficients = torch.from_numpy(np.stack([friction.viscous, friction.coulomb]))
        return cls(network, loss, coefficients, friction.transition)

    def forward(
        self, q: torch.Tensor, v: torch.Tensor, a: torch.Tensor, tau: torch.Tensor, *nominal: torch.Tensor
    ) -> torch.Tensor:
        """Torque [N·m] or acceleration [rad/s²] that is not explained."""
        net = tau if self.roots is None else tau - self.friction_torque(v)
        if self.loss == "acceleration":
            return self.network.acceleration(q, v, net) - a
        if nominal:
            return cast(ResidualNetwork, self.network).torque(q, v, v, a, Terms(*nominal)) - net
        return self.network.torque(q, v, v, a) - net

    def friction_torque(self, v: torch.Tensor) -> torch.Tensor:
        """What friction takes [N·m]."""
        viscous, coulomb = cast(torch.Tensor, self.roots).square()
        return viscous * v + coulomb * torch.tanh(v / self.transition)

    def friction(self) -> JointFriction | None:
        """The friction that was learned."""
        if self.roots is None:
            return None
        viscous, coulomb = self.roots.detach().square().numpy(force=True)
        return JointFriction(viscous, coulomb, self.transition)


@dataclass(frozen=True, eq=False)
class Equations:
    """Residuals of all samples, each joint's in units of its deviation, as functions of one vector of parameters."""

    equation: Equation
    columns: tuple[torch.Tensor, ...]
    """q, v, a, τ and whatever else a residual needs, one row per sample."""
    unit: Float[torch.Tensor, " n"]
    """Standard deviation of the measured torque or acceleration [N·m or rad/s²]."""

    @classmethod
    def of(cls, equation: Equation, data: Dataset, unit: Float[torch.Tensor, " n"] | None = None) -> "Equations":
        """Those of a dataset; unit: another one's, so that both can be compared."""
        q, v, a, tau = (torch.from_numpy(x) for x in (data.q, data.v, data.a, data.tau))
        network = equation.network
        nominal = nominal_terms(network.nominal, q) if isinstance(network, ResidualNetwork) else ()
        return cls(equation, (q, v, a, tau, *nominal), deviation(tau if equation.loss == "torque" else a, unit))

    def __len__(self) -> int:
        return len(self.columns[0])

    @property
    def theta(self) -> Theta:
        """The parameters that the module has now."""
        return torch.cat([p.detach().reshape(-1) for p in self.equation.parameters()])

    def write(self, theta: Theta) -> None:
        """Give the module these parameters."""
        with torch.no_grad():
            for p, part in zip(self.equation.parameters(), self._parts(theta).values(), strict=True):
                p.copy_(part)

    def residual(self, theta: Theta, rows: Int[torch.Tensor, " m"] | None = None) -> Float[torch.Tensor, "m n"]:
        """Residuals of the samples numbered `rows`, all for None; differentiable in theta."""
        chosen = self.columns if rows is None else tuple(x[rows] for x in self.columns)
        value: torch.Tensor = functional_call(self.equation, self._parts(theta), chosen)
        return value / self.unit

    def cost(self, theta: Theta, rows: Int[torch.Tensor, " m"] | None = None) -> float:
        """Mean square of the residuals, the normalised mean squared error; inf where it is no number."""
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
        """The vector as named parameters."""
        named = dict(self.equation.named_parameters())
        pieces = torch.split(theta, [p.numel() for p in named.values()])
        return {name: x.reshape(p.shape) for (name, p), x in zip(named.items(), pieces, strict=True)}


def deviation(x: Float[torch.Tensor, "m n"], given: torch.Tensor | None = None) -> Float[torch.Tensor, " n"]:
    """Standard deviation of every column, that of the largest where one hardly varies; 1 where none does."""
    if given is not None:
        return given
    spread = (x - x.mean(0)).square().mean(0).sqrt()
    largest = float(spread.max()) or 1.0
    return torch.where(spread > _FLAT * largest, spread, largest)


def deviation_of(x: Float[np.ndarray, "m n"]) -> JointArray:
    """`deviation` of an array."""
    return deviation(torch.from_numpy(x)).numpy()


def first_friction(data: Dataset) -> Float[torch.Tensor, "2 n"]:
    """Viscous and Coulomb coefficients to begin with."""
    torque, speed = (deviation(torch.from_numpy(x)) for x in (data.tau, data.v))
    return 0.5 * FIRST_FRICTION * torch.stack([torque / speed, torque])


def _blocks(rows: Int[torch.Tensor, " m"], size: int) -> Iterator[Int[torch.Tensor, " k"]]:
    yield from torch.split(rows, size)
