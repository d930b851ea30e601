"""The protocol of every dynamics model: four ingredients, from which every equation follows."""

from abc import ABC, abstractmethod

from nbs_pin.base.arrays import Matrices, Scalars, Vectors, array_namespace, matvec
from nbs_pin.dynamics.structure import ModelClaims
from nbs_pin.kernels.layout import Packed
from nbs_pin.robots.robot import Robot, configuration_difference


class DynamicsProvider(ABC):
    """M(q) v̇ + C(q, v) v + G(q) = τ with M ≻ 0, G = +∂V/∂q and C the Christoffel matrix of M (docs/theory.md §1).

    Implementations give the abstract methods; arrays may have leading batch axes, and numpy in gives numpy out,
    torch in gives differentiable torch out. `reference_torque` and `forward_dynamics` follow from them; an
    implementation overrides one only when it has a faster route to the same numbers.
    """

    @property
    @abstractmethod
    def nv(self) -> int:
        """Number of joints n = nq = nv."""

    @property
    def robot(self) -> Robot | None:
        """The arm this model describes, or None for a model without a URDF."""
        return None

    @abstractmethod
    def mass_matrix(self, q: Vectors) -> Matrices:
        """M(q) [kg·m²], symmetric positive definite."""

    @abstractmethod
    def coriolis_matrix(self, q: Vectors, v: Vectors) -> Matrices:
        """Christoffel C(q, v) [N·m·s]: Ṁ − 2C is skew and C(q, v) w = C(q, w) v."""

    @abstractmethod
    def gravity(self, q: Vectors) -> Vectors:
        """G(q) = ∂V/∂q [N·m]: the torque that holds the arm still."""

    @abstractmethod
    def potential_energy(self, q: Vectors) -> Scalars:
        """V(q) [J], up to a constant."""

    def difference(self, q: Vectors, q_ref: Vectors) -> Vectors:
        """z1 = q ⊖ q_ref [rad], wrapped to (−π, π] on the continuous joints of `robot`."""
        return configuration_difference(q, q_ref, None if self.robot is None else self.robot.continuous)

    def reference_torque(self, q: Vectors, v: Vectors, v_r: Vectors, a_r: Vectors) -> Vectors:
        """M(q) a_r + C(q, v) v_r + G(q) [N·m], the one quantity a passivity-based law needs (docs/theory.md §1)."""
        return matvec(self.mass_matrix(q), a_r) + matvec(self.coriolis_matrix(q, v), v_r) + self.gravity(q)

    def packed_tree(self) -> Packed | None:
        """The model as a rigid tree for the kernels of `kernels/trees.py`, or None when it is none."""
        return None

    def suits(self, robot: Robot) -> bool:
        """Whether the model's joints are those of the arm, as far as the model knows its joints."""
        return True

    def structure_claims(self) -> ModelClaims | None:
        """What the structure of this very class proves of M and C; None where samples alone can tell.

        Certificates ask it of objects whose code is known (`base/known_code.py`), so a subclass must state its own.
        Raises CertificateRefused for numbers that give a proof no ground.
        """
        return None

    def forward_dynamics(self, q: Vectors, v: Vectors, tau: Vectors) -> Vectors:
        """v̇ = M⁻¹(τ − C v − G) [rad/s²]."""
        net = tau - matvec(self.coriolis_matrix(q, v), v) - self.gravity(q)
        return array_namespace(net).linalg.solve(self.mass_matrix(q), net[..., None])[..., 0]
