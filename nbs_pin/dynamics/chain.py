"""The chain network: a parameterisation of all rigid trees whose joints have a given order and type."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import nn

from nbs_pin.base.arrays import Matrices, Scalars, Vectors
from nbs_pin.base.claims import Claim, Label, refuse
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.known_code import known_code
from nbs_pin.base.storable import storable
from nbs_pin.dynamics.lagrangian_network import CompiledTorque, LagrangianNetwork, Tensor
from nbs_pin.dynamics.structure import POSITIVE, ModelClaims, quadratic
from nbs_pin.kernels.layout import Packed
from nbs_pin.kernels.tree_layout import tree_workspace
from nbs_pin.kernels.trees import tree_torques


@known_code
@storable(("parents", "prismatic", "epsilon"), sequence=list)
class Chain(LagrangianNetwork):
    """T̂ = ½ Σ_j ‖Ṫ_j L_j‖² + ½ Σ_j (r_j² + ε) v_j², V̂ = −Σ_j g·T_j L_j(L_jᵀ)₄, T_j = T_parent(j) A_j E(q_j).

    T_j is the 4×4 homogeneous transform of body j, A_j that of its joint at q = 0, and E a rotation about z or a
    translation along z. L_jL_jᵀ is the pseudo-inertia [[Σ m xxᵀ, Σ m x], [·, Σ m]] of the body. So for all parameter
    values the bodies are physically consistent, T̂ is quadratic in v, and M̂ = Σ_j B_jᵀB_j + diag(r² + ε) ⪰ εI with the
    flattened ∂_iT_j L_j as column i of B_j. r_j² is the rotor inertia, initially zero. Source: docs/theory.md §6.

    Args:
        parents: Per joint, 0 for the base and i + 1 for joint i.
        epsilon: ε [kg·m², kg].
        seed: Seed of the initial links of about 0.3 m and 1 kg, and of the direction of gravity, 9.81 m/s².

    Raises:
        ArgumentError: If a parent does not come before its child, or ε is not positive and finite.
    """

    turns: Tensor
    """(n, 3) rotation vector of A_j [rad]."""
    positions: Tensor
    """(n, 3) translation of A_j [m]."""
    factors: Tensor
    """(n, 4, 4) L_j; only the lower triangle is used."""
    field: Tensor
    """(3,) gravity g in the base frame [m/s²]."""
    rotors: Tensor
    """(n,) r, square roots of the rotor inertias."""

    def __init__(
        self,
        parents: Sequence[int] | np.ndarray,
        prismatic: Sequence[bool] | np.ndarray,
        epsilon: float = 1e-12,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.parents, self.prismatic = [int(i) for i in parents], [bool(slides) for slides in prismatic]
        if len(self.parents) != len(self.prismatic) or any(not 0 <= p <= i for i, p in enumerate(self.parents)):
            raise ArgumentError(
                f"parents {self.parents} and prismatic {self.prismatic} do not form a tree; give one entry per joint,"
                " parents before children, 0 for the base and i + 1 for joint i."
            )
        if not 0.0 < epsilon < np.inf:
            raise ArgumentError(f"epsilon is {epsilon} kg·m², expected a small finite inertia > 0; 1e-12 is usual.")
        self.nv, self.epsilon = len(self.parents), epsilon
        for name, value in random_tree(self.nv, np.random.default_rng(seed))._asdict().items():
            setattr(self, name, nn.Parameter(torch.from_numpy(value)))
        self.rotors = nn.Parameter(torch.zeros(self.nv, dtype=torch.float64))

    def mass_matrix(self, q: Vectors) -> Matrices:
        """M̂(q) = Σ_j B_jᵀB_j + diag(r² + ε) [kg·m²], with the flattened ∂_iT_j L_j as column i of B_j."""
        frames = self._frames(q)
        rates = self._rates(frames)  # (…, n joints, n bodies, 4, 4)
        columns = (rates @ self.factors.tril()).flatten(-2).flatten(-2)
        return columns @ columns.mT + torch.diag(self.rotors.square() + self.epsilon)

    def potential(self, q: Vectors) -> Scalars:
        """V̂(q) [J]."""
        return -(self._frames(q) @ self._moments())[..., :3, 0].sum(-2) @ self.field

    def gravity(self, q: Vectors) -> Vectors:
        """Ĝ_i = −Σ_j g·∂_iT_j L_j(L_jᵀ)₄ [N·m]."""
        rates = self._rates(self._frames(q))
        return -torch.einsum("...ijk,k->...i", (rates @ self._moments())[..., :3, 0], self.field)

    def suits(self, parents: Int[np.ndarray, " n"], prismatic: Bool[np.ndarray, " n"]) -> bool:
        """Whether these are the joints of the chain."""
        return self.parents == parents.tolist() and self.prismatic == prismatic.tolist()

    def packed_tree(self) -> Packed:
        """The tree for the kernels (`kernels/trees.py`), with r² + ε as armature."""
        with torch.no_grad():
            rotations, factors = rotation_matrices(self.turns), self.factors.tril()
            inertia = (factors @ factors.mT).numpy(force=True)
            armature = (self.rotors.square() + self.epsilon).numpy(force=True)
        layout, upper = [self.nv], np.triu_indices(3)
        weights = [-self.field.numpy(force=True)]
        for i, (parent, slides) in enumerate(zip(self.parents, self.prismatic, strict=True)):
            layout += [parent, int(slides)]
            body = inertia[i]
            place = [rotations[i].numpy(force=True).ravel(), self.positions[i].numpy(force=True)]
            weights += [*place, body[3, 3:], body[:3, 3], body[:3, :3][upper], armature[i : i + 1]]
        return Packed(np.array(layout, dtype=np.int64), np.concatenate(weights))

    def structure_claims(self) -> ModelClaims:
        """M̂ ⪰ min(r² + ε) I; raises CertificateRefused if the parents do not form a tree or ε is not positive."""
        parents, n = list(self.parents), self.nv
        if len(parents) != n or len(self.prismatic) != n or any(not 0 <= p <= i for i, p in enumerate(parents)):
            refuse(f"the chain's parents {parents} do not form a tree of {n} joints", "put parents before children")
        if not 0.0 < self.epsilon < np.inf:
            refuse(f"the model's M̂ has ε = {self.epsilon:g}", "εI must be positive definite: give a finite ε > 0")
        least = self.epsilon + float(np.min(self.rotors.numpy(force=True) ** 2))
        because = "M̂ = Σ_j B_jᵀB_j + diag(r² + ε) ⪰ min(r² + ε)I"
        return quadratic(Claim(POSITIVE, least, "kg·m²", Label.PROVED, because))

    def compiled(self) -> CompiledTorque:
        """`torque` as machine code, by one Newton–Euler pass per row."""
        return TreeTorque(*self.packed_tree())

    def _frames(self, q: Tensor) -> Tensor:
        """T_j(q), (…, n, 4, 4)."""
        rotations = rotation_matrices(self.turns)
        base = torch.eye(4, dtype=q.dtype, device=q.device).expand(*q.shape[:-1], 4, 4)
        frames: list[Tensor] = []
        for i, (parent, slides) in enumerate(zip(self.parents, self.prismatic, strict=True)):
            before = frames[parent - 1] if parent else base
            place = torch.cat(
                [torch.cat([rotations[i], self.positions[i, :, None]], -1), base.new_tensor([[0, 0, 0, 1]])]
            )
            frames.append(before @ place @ _joint(q[..., i], slides))
        return torch.stack(frames, -3)

    def _rates(self, frames: Tensor) -> Tensor:
        """∂_iT_j = T_i S_i T_i⁻¹ T_j for joints i on the path from the base to body j, else 0: (…, n, n, 4, 4)."""
        n, twists = self.nv, frames.new_zeros(self.nv, 4, 4)
        for i, slides in enumerate(self.prismatic):
            if slides:
                twists[i, 2, 3] = 1.0
            else:
                twists[i, 0, 1], twists[i, 1, 0] = -1.0, 1.0
        carries = torch.zeros(n, n, dtype=frames.dtype, device=frames.device)
        for j in range(n):
            i = j
            while i >= 0:
                carries[i, j] = 1.0
                i = self.parents[i] - 1
        spins = frames @ twists @ _inverse(frames)
        return spins[..., :, None, :, :] @ frames[..., None, :, :, :] * carries[..., None, None]

    def _moments(self) -> Tensor:
        """(n, 4, 1) L_j(L_jᵀ)₄ = (Σ m x, m)."""
        factors = self.factors.tril()
        return factors @ factors[:, 3, :, None]


@dataclass(frozen=True, eq=False)
class TreeTorque:
    """M(q) a + C(q, v) w + G(q) of a packed tree, for rows of q, v, w, a."""

    layout: Int[np.ndarray, " layout"]
    weights: Float[np.ndarray, " weights"]

    def __call__(
        self,
        q: Float[np.ndarray, "rows n"],
        v: Float[np.ndarray, "rows n"],
        w: Float[np.ndarray, "rows n"],
        a: Float[np.ndarray, "rows n"],
    ) -> Float[np.ndarray, "rows n"]:
        """One Newton–Euler pass per row."""
        tau, work = np.empty(q.shape), np.empty(tree_workspace(Packed(self.layout, self.weights)))
        tree_torques(q, v, w, a, self.layout, self.weights, work, tau)
        return tau


class Tree(NamedTuple):
    """The parameters of a `Chain` as arrays."""

    turns: Float[np.ndarray, "n 3"]
    positions: Float[np.ndarray, "n 3"]
    factors: Float[np.ndarray, "n 4 4"]
    field: Float[np.ndarray, "3"]


def random_tree(n: int, rng: np.random.Generator) -> Tree:
    """Random axes, about 0.3 m between joints, bodies of about 1 kg with a radius of about 0.15 m."""
    turns = rng.normal(size=(n, 4))
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)  # uniform unit quaternions
    angle = 2.0 * np.arctan2(np.linalg.norm(turns[:, 1:], axis=1), turns[:, 0])
    axes = turns[:, 1:] / np.linalg.norm(turns[:, 1:], axis=1, keepdims=True)
    factors = np.tile(np.diag([0.15, 0.15, 0.15, 1.0]), (n, 1, 1))
    factors[:, 3, :3] = 0.2 * rng.normal(size=(n, 3))
    down = rng.normal(size=3)
    return Tree(angle[:, None] * axes, 0.3 * rng.normal(size=(n, 3)), factors, 9.81 * down / np.linalg.norm(down))


def rotation_matrices(turns: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3 3"]:
    """Rotation matrices exp([δ]×) of the rotation vectors δ in the rows [rad]."""
    x, y, z = turns.unbind(-1)
    o = torch.zeros_like(x)
    return torch.linalg.matrix_exp(torch.stack([o, -z, y, z, o, -x, -y, x, o], -1).reshape(-1, 3, 3))


def _joint(q: Tensor, slides: bool) -> Tensor:
    """E(q), the translation by q along z or rotation by q about z, (…, 4, 4)."""
    o, one = torch.zeros_like(q), torch.ones_like(q)
    c, s, z = (one, o, q) if slides else (q.cos(), q.sin(), o)
    rows = [c, -s, o, o, s, c, o, o, o, o, one, z, o, o, o, one]
    return torch.stack(rows, -1).reshape(*q.shape, 4, 4)


def _inverse(frames: Tensor) -> Tensor:
    """The inverse of homogeneous transforms."""
    rotation = frames[..., :3, :3].mT
    top = torch.cat([rotation, -rotation @ frames[..., :3, 3:]], -1)
    return torch.cat([top, frames[..., 3:, :]], -2)
