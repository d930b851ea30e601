"""A learned Lagrangian of an arm some of whose motors turn several joints: its rotors beside any network."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import nn

from nbs_pin.base.arrays import Array, Matrices, Scalars, Vectors, constant_like, matvec
from nbs_pin.base.known_code import foreign_code, known_code
from nbs_pin.base.storable import storable
from nbs_pin.dynamics.friction import coupling_of
from nbs_pin.dynamics.lagrangian_network import CompiledTorque, LagrangianNetwork, Tensor
from nbs_pin.dynamics.structure import ModelClaims


@known_code
@storable(("coupling",), parts=("inner",))
class CoupledNetwork(LagrangianNetwork):
    """M̂ = M̂₀ + Nᵀ diag(r²) N with M̂₀ and V̂ of another network, for motors that turn by φ = N q.

    r_k² is the rotor inertia of motor k as its own joint feels it, initially zero. N is constant, so that Ĉ and Ĝ are
    those of the other network. It is for networks that cannot represent such rotors themselves, as the chain.

    Args:
        inner: The network of M̂₀ and V̂.
        coupling: N (n, n), invertible.

    Raises:
        ArgumentError: If N is not an invertible n×n matrix.
    """

    rotors: Tensor
    """(n,) r, square roots of the rotor inertias."""

    def __init__(self, inner: LagrangianNetwork, coupling: Float[Array, "n n"]) -> None:
        super().__init__()
        self.inner, self.nv, self.quadratic = inner, inner.nv, inner.quadratic
        self.coupling = coupling_of(coupling, inner.nv)
        self.rotors = nn.Parameter(torch.zeros(inner.nv, dtype=torch.float64))

    def mass_matrix(self, q: Vectors) -> Matrices:
        """M̂(q) [kg·m²]."""
        return self.inner.mass_matrix(q) + self._inertia()

    def potential(self, q: Vectors) -> Scalars:
        """V̂(q) [J]."""
        return self.inner.potential(q)

    def kinetic(self, q: Vectors, v: Vectors) -> Scalars:
        """T̂(q, v) [J]."""
        return self.inner.kinetic(q, v) + 0.5 * (v * matvec(self._inertia(), v)).sum(-1)

    def inertia(self, q: Vectors, v: Vectors) -> Matrices:
        """∂²T̂/∂v² at (q, v) [kg·m²]."""
        return self.inner.inertia(q, v) + self._inertia()

    def gravity(self, q: Vectors) -> Vectors:
        """Ĝ(q) [N·m]."""
        return self.inner.gravity(q)

    def mass_rates(self, q: Vectors) -> Float[Tensor, "n *batch n n"]:
        """∂M̂/∂q_k, with k as the first axis."""
        return self.inner.mass_rates(q)

    def torque(self, q: Vectors, v: Vectors, w: Vectors, a: Vectors) -> Vectors:
        """M̂(q) a + Ĉ(q, v) w + Ĝ(q) [N·m]."""
        return self.inner.torque(q, v, w, a) + matvec(self._inertia(), a)

    def suits(self, parents: Int[np.ndarray, " n"], prismatic: Bool[np.ndarray, " n"]) -> bool:
        """Whether the other network fits an arm with these joints."""
        return self.inner.suits(parents, prismatic)

    def structure_claims(self) -> ModelClaims | None:
        """Those of the other network, as Nᵀ diag(r²) N ⪰ 0 is constant."""
        return None if foreign_code(self.inner) else self.inner.structure_claims()

    def compiled(self) -> CompiledTorque | None:
        """`torque` as machine code where the other network has it."""
        bare = self.inner.compiled()
        return None if bare is None else _WithRotors(bare, self._inertia().numpy(force=True))

    def _inertia(self) -> Tensor:
        """Nᵀ diag(r²) N, symmetric."""
        turns = constant_like(self.rotors, self.coupling)
        return turns.mT @ (self.rotors.square()[:, None] * turns)


@dataclass(frozen=True, eq=False)
class _WithRotors:
    """The machine code of a torque, and the torque of constant inertia."""

    bare: CompiledTorque
    inertia: Float[np.ndarray, "n n"]

    def __call__(self, q: np.ndarray, v: np.ndarray, w: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Rows of M a + C w + G."""
        return self.bare(q, v, w, a) + a @ self.inertia
