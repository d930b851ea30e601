"""Base classes of networks for a Lagrangian L = T − V, with the Euler–Lagrange equation."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import TypeAlias, cast

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import nn
from torch.func import grad, jvp

from nbs_pin.base.arrays import Matrices, Scalars, Vectors, matvec
from nbs_pin.dynamics.features import JointFeatures
from nbs_pin.dynamics.structure import ModelClaims
from nbs_pin.kernels.layout import Packed

Tensor: TypeAlias = torch.Tensor
CompiledTorque: TypeAlias = Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray], np.ndarray]
"""Function from rows (m, n) of q, v, w, a to rows of M(q) a + C(q, v) w + G(q)."""


class LagrangianNetwork(nn.Module, ABC):
    """T̂(q, v) and V̂(q) with learned parameters; float64 tensors with leading batch axes (docs/theory.md §6).

    Subclasses implement `mass_matrix` and `potential`. All else follows by automatic differentiation, is differentiable
    in parameters and arguments, and is overridden only with a faster way to compute the same values.
    """

    nv: int
    """Number of joints n."""
    fit_widths: tuple[int, ...] = (24, 24)
    """Default hidden layer sizes of `fit`, small enough for Levenberg–Marquardt."""
    few_widths: tuple[int, ...] = ()
    """Those that `fit` tries too where held-out data are predicted far worse than fitted ones; none if empty."""
    quadratic: bool = True
    """Whether T̂ is exactly ½ vᵀM̂(q)v, so that Ṁ − 2C is skew and the stability theory holds."""

    @abstractmethod
    def mass_matrix(self, q: Vectors) -> Matrices:
        """M̂(q) [kg·m²]; ∂²T̂/∂v² at v = 0 where T̂ is not quadratic."""

    @abstractmethod
    def potential(self, q: Vectors) -> Scalars:
        """V̂(q) [J], up to a constant."""

    def kinetic(self, q: Vectors, v: Vectors) -> Scalars:
        """T̂(q, v) [J], zero at v = 0."""
        return 0.5 * (v * matvec(self.mass_matrix(q), v)).sum(-1)

    def inertia(self, q: Vectors, v: Vectors) -> Matrices:
        """∂²T̂/∂v² at (q, v) [kg·m²], which is M̂(q) where T̂ is quadratic."""
        return self.mass_matrix(q)

    def gravity(self, q: Vectors) -> Vectors:
        """Ĝ(q) = ∂V̂/∂q [N·m]."""
        return grad(lambda x: self.potential(x).sum())(q)

    def mass_rates(self, q: Vectors) -> Float[Tensor, "n *batch n n"]:
        """∂M̂/∂q_k, with k as the first axis."""
        return along_every_joint(self.mass_matrix, q)

    def coriolis_matrix(self, q: Vectors, v: Vectors) -> Matrices:
        """Christoffel Ĉ(q, v) [N·m·s] of `mass_matrix`: C_ij = ½ Σ_k (∂_k M_ij + ∂_j M_ik − ∂_i M_jk) v_k."""
        rates = self.mass_rates(q)
        along = torch.einsum("k...ij,...k->...ij", rates, v)
        turned = torch.einsum("j...ik,...k->...ij", rates, v)
        return 0.5 * (along + turned - turned.mT)

    def torque(self, q: Vectors, v: Vectors, w: Vectors, a: Vectors) -> Vectors:
        """M̂(q) a + Ĉ(q, v) w + Ĝ(q) [N·m]; cheaper when w is the same object as v.

        Ĉ(q, v) w = ½(∂_v M̂ w + ∂_w M̂ v − ∇_q vᵀM̂w): two directional derivatives of M̂ and one gradient.
        """
        mass, along_v = with_tangent(self.mass_matrix, (q,), (v,))
        along_w = along_v if w is v else derivative(self.mass_matrix, (q,), (w,))

        def lagrangian(x: Tensor) -> Tensor:
            return (0.5 * (v * matvec(self.mass_matrix(x), w)).sum(-1) - self.potential(x)).sum()

        return matvec(mass, a) + 0.5 * (matvec(along_v, w) + matvec(along_w, v)) - grad(lagrangian)(q)

    def acceleration(self, q: Vectors, v: Vectors, tau: Vectors) -> Vectors:
        """v̇ [rad/s²] under the torque τ [N·m]; raises torch.linalg.LinAlgError if the inertia is singular."""
        bias = self.torque(q, v, v, torch.zeros_like(v))
        return torch.linalg.solve(self.inertia(q, v), (tau - bias)[..., None])[..., 0]

    def suits(self, parents: Int[np.ndarray, " n"], prismatic: Bool[np.ndarray, " n"]) -> bool:
        """Whether the network fits an arm with these joints (`Robot.parents`, `Robot.prismatic`)."""
        seen = [part for part in self.children() if isinstance(part, JointFeatures)]
        return all(features.prismatic.tolist() == prismatic.tolist() for features in seen)

    def packed_tree(self) -> Packed | None:
        """The network as a rigid tree for the kernels (`kernels/trees.py`), or None if it is not a rigid tree."""
        return None

    def structure_claims(self) -> ModelClaims | None:
        """What the structure of exactly this class proves about M̂ and Ĉ (`DynamicsProvider.structure_claims`)."""
        return None

    def compiled(self) -> CompiledTorque | None:
        """`torque` as picklable machine code with the present parameters, or None if there is none."""
        return None


class GeneralLagrangianNetwork(LagrangianNetwork):
    """A Lagrangian L(q, v) that need not be quadratic in v.

    T̂ = L(q, v) − L(q, 0) and V̂ = −L(q, 0), so that L = T̂ − V̂. `mass_matrix`, `coriolis_matrix` and `gravity` are taken
    at v = 0. `torque` and `acceleration` are exact: the torque is M̂(q, v) a + Ĉ w + ĝ(q, v), with Ĉ the Christoffel
    matrix of ∂²L/∂v² at frozen v and ĝ the rest of the Euler–Lagrange equation (docs/theory.md §6).
    """

    quadratic = False

    @abstractmethod
    def lagrangian(self, q: Vectors, v: Vectors) -> Scalars:
        """L(q, v) [J]."""

    def mass_matrix(self, q: Vectors) -> Matrices:
        """∂²L/∂v² at v = 0 [kg·m²]."""
        return self.inertia(q, torch.zeros_like(q))

    def potential(self, q: Vectors) -> Scalars:
        """−L(q, 0) [J]."""
        return -self.lagrangian(q, torch.zeros_like(q))

    def kinetic(self, q: Vectors, v: Vectors) -> Scalars:
        """L(q, v) − L(q, 0) [J]."""
        return self.lagrangian(q, v) + self.potential(q)

    def momentum(self, q: Vectors, v: Vectors) -> Vectors:
        """∂L/∂v [N·m·s]."""
        return grad(lambda x: self.lagrangian(q, x).sum())(v)

    def inertia(self, q: Vectors, v: Vectors) -> Matrices:
        """∂²L/∂v² at (q, v) [kg·m²]."""
        columns = along_every_joint(lambda x: self.momentum(q.expand(x.shape), x), v)
        return columns.movedim(0, -1)

    def torque(self, q: Vectors, v: Vectors, w: Vectors, a: Vectors) -> Vectors:
        """d/dt ∂L/∂v − ∂L/∂q + Ĉ (w − v) [N·m]; much cheaper when w is the same object as v."""
        rate = derivative(self.momentum, (q, v), (v, a))
        exact = rate - grad(lambda x: self.lagrangian(x, v).sum())(q)
        return exact if w is v else exact + self._frozen_coriolis(q, v, w - v)

    def _frozen_coriolis(self, q: Tensor, v: Tensor, u: Tensor) -> Tensor:
        """Ĉ u with the Christoffel matrix of q ↦ ∂²L/∂v²(q, v) at frozen v."""

        def times(x: Tensor, direction: Tensor) -> Tensor:
            return derivative(lambda s: self.momentum(x, s), (v,), (direction,))

        along_v = derivative(lambda x: times(x, u), (q,), (v,))
        along_u = derivative(lambda x: times(x, v), (q,), (u,))
        return 0.5 * (along_v + along_u - grad(lambda x: (v * times(x, u)).sum())(q))


def with_tangent(
    function: Callable[..., Tensor], at: tuple[Tensor, ...], along: tuple[Tensor, ...]
) -> tuple[Tensor, Tensor]:
    """Value and directional derivative, differentiable again in forward and reverse mode."""
    dense = (tuple(x.contiguous() for x in vectors) for vectors in (at, along))  # dual numbers need equal layouts
    value, tangent = cast(tuple[Tensor, Tensor], jvp(function, *dense))
    return value, tangent


def derivative(function: Callable[..., Tensor], at: tuple[Tensor, ...], along: tuple[Tensor, ...]) -> Tensor:
    """The directional derivative."""
    return with_tangent(function, at, along)[1]


def along_every_joint(function: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
    """Partial derivatives of the function in the n coordinates of x (..., n), along a new first axis."""
    n = x.shape[-1]
    unit = torch.eye(n, dtype=x.dtype, device=x.device).reshape(n, *(1,) * (x.ndim - 1), n)
    many = x.expand(n, *x.shape)
    return derivative(function, (many,), (unit.expand(many.shape),))
