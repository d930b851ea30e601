"""The interface of all dynamics models: M, C, G and V, from which the equations of motion follow."""

from abc import ABC, abstractmethod
from collections.abc import Iterable

from nbs_pin.base.arguments import a, checked
from nbs_pin.base.arrays import Matrices, Scalars, Vectors, array_namespace, as_vectors, finite_result, matvec
from nbs_pin.base.shown import Shown, joints_told
from nbs_pin.dynamics.structure import ModelClaims
from nbs_pin.kernels.layout import Packed
from nbs_pin.robots.robot import ARM, Robot, configuration_difference


class DynamicsProvider(Shown, ABC):
    """M(q) v̇ + C(q, v) v + G(q) = τ with M ≻ 0, G = +∂V/∂q and C the Christoffel matrix of M (docs/theory.md §1).

    Subclasses implement the abstract methods. Arrays may have leading batch axes; numpy arrays give numpy arrays, and
    torch tensors give differentiable tensors. `reference_torque` and `forward_dynamics` follow from these methods; a
    subclass overrides them only with a faster way to compute the same values.

    Example:
        >>> import numpy as np
        >>> import nbs_pin as nbs
        >>> dynamics = nbs.PinocchioDynamics(nbs.load_robot("two_link"))
        >>> isinstance(dynamics, nbs.DynamicsProvider), dynamics.mass_matrix(np.zeros((50, 2))).shape
        (True, (50, 2, 2))
    """

    @property
    @abstractmethod
    def nv(self) -> int:
        """Number of joints n = nq = nv."""

    @property
    def robot(self) -> Robot | None:
        """The arm that this model describes, or None for a model without a URDF."""
        return None

    def _facts(self) -> Iterable[str]:
        arm = () if self.robot is None else (self.robot.name,)
        return *arm, joints_told(self.nv)

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
        q, q_ref = as_vectors(self.nv, q=q, q_ref=q_ref)
        return configuration_difference(q, q_ref, None if self.robot is None else self.robot.continuous)

    def reference_torque(self, q: Vectors, v: Vectors, v_r: Vectors, a_r: Vectors) -> Vectors:
        """M(q) a_r + C(q, v) v_r + G(q) [N·m], all that a passivity-based law needs (docs/theory.md §1)."""
        q, v, v_r, a_r = as_vectors(self.nv, q=q, v=v, v_r=v_r, a_r=a_r)
        tau = matvec(self.mass_matrix(q), a_r) + matvec(self.coriolis_matrix(q, v), v_r) + self.gravity(q)
        return finite_result("the torque", tau, q, v, v_r, a_r)

    def packed_tree(self) -> Packed | None:
        """The model as a rigid tree for the kernels (`kernels/trees.py`), or None if it is not a rigid tree."""
        return None

    @checked(robot=ARM)
    def suits(self, robot: Robot) -> bool:
        """Whether the joints of the model match those of the robot, as far as the model states them."""
        return True

    def structure_claims(self) -> ModelClaims | None:
        """What the structure of exactly this class proves about M and C; None if only samples can tell.

        Certificates use it only for known code (`base/known_code.py`), so a subclass must state its own claims.

        Raises:
            CertificateRefused: If the numbers of the model invalidate the proof.
        """
        return None

    def forward_dynamics(self, q: Vectors, v: Vectors, tau: Vectors) -> Vectors:
        """v̇ = M⁻¹(τ − C v − G) [rad/s²]."""
        q, v, tau = as_vectors(self.nv, q=q, v=v, tau=tau)
        net = tau - matvec(self.coriolis_matrix(q, v), v) - self.gravity(q)
        a = array_namespace(net).linalg.solve(self.mass_matrix(q), net[..., None])[..., 0]
        return finite_result("the acceleration", a, q, v, tau)


MODEL = a(DynamicsProvider, "a model of the arm, such as PinocchioDynamics(robot)")
"""The check of an argument that is a model."""
