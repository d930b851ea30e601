"""Laws with a Lyapunov function, in the form that certificates, monitors and attacks use."""

import math
from abc import abstractmethod
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from nbs_pin.base.arguments import a
from nbs_pin.base.arrays import (
    Array,
    JointArray,
    Matrices,
    Scalars,
    Vectors,
    array_namespace,
    as_vectors,
    finite_result,
    matvec,
)
from nbs_pin.base.claims import Claim
from nbs_pin.base.intervals import Interval
from nbs_pin.controllers.model_law import ModelLaw


class Errors(NamedTuple):
    """Error signals of a backstepping or sliding law, each (..., nv) except the value."""

    z1: Array
    """q ⊖ q_d [rad]."""
    z2: Array
    """v − v_r [rad/s]."""
    v_r: Array
    """Reference velocity φ = v_d − Λ∇Φ(z1) [rad/s]."""
    a_r: Array
    """Reference acceleration φ̇ = a_d − Λ∇²Φ(z1)(v − v_d) [rad/s²]."""
    gradient: Array
    """∇Φ(z1) [N·m]."""
    value: Array
    """Φ(z1) [J], shape (...)."""


class Lyapunov(NamedTuple):
    """Constants of V and of its decay for the present parameters, and the claims that support them."""

    stiffness: Float[np.ndarray, "n n"]
    """S, with Φ(z1) ≥ z1ᵀSz1 and zᵀ∇²Φz ≥ 2zᵀSz [J/rad²]."""
    rate: JointArray
    """Diagonal of Λ [rad/s per N·m]."""
    floor: Float[np.ndarray, "n n"]
    """D₀, with D(z2) ⪰ D₀ [N·m·s/rad]."""
    inertial_rate: float
    """ω [1/s]."""
    coupling: float
    """ζ: 1 if the law feeds back −∇Φ, 0 if it does not."""
    claims: tuple[Claim, ...]
    """How each of these is known, and everything else on which V̇ depends."""


class LyapunovLaw(ModelLaw):
    """A law with V = Φ(z1) + ½z2ᵀM(q)z2, where z2 = v − v_r and v_r = v_d − Λ∇Φ(z1).

    V̇ = −∇ΦᵀΛ∇Φ − z2ᵀ(ωM + D(z2))z2 + (1 − ζ)z2ᵀ∇Φ + z2ᵀτ_d.

    A subclass states its Φ, Λ, D, ω and ζ and how they are known; `certify`, `monitor` and `attack` need nothing else.
    Source: docs/theory.md §2, docs/certificates.md §2.

    Example:
        >>> import nbs_pin as nbs
        >>> robot = nbs.load_robot("two_link")
        >>> law = nbs.SlotineLi.for_robot(robot)
        >>> aim = nbs.Hold([0.0, 0.0])(0.0)
        >>> errors = law.errors([0.1, 0.0], [0.0, 0.0], *aim)
        >>> errors.z1, bool(law.storage([0.1, 0.0], [0.0, 0.0], aim.q, aim.v) > 0.0)
        (array([0.1, 0. ]), True)
    """

    inertial_rate: float = 0.0
    """ω [1/s]."""
    coupling: float = 1.0
    """ζ of the feedback −ζ∇Φ(z1)."""

    @abstractmethod
    def potential_terms(self, z1: Array, dz: Array) -> tuple[Array, Array, Array]:
        """Φ(z1) [J] of shape (...), ∇Φ(z1) [N·m] and ∇²Φ(z1)dz of shape (..., nv)."""

    @abstractmethod
    def damping_force(self, z2: Array) -> Vectors:
        """D(z2)z2 [N·m], without ωM z2."""

    @abstractmethod
    def damping_matrix(self, z2: Array) -> Matrices:
        """D(z2) [N·m·s/rad], without ωM."""

    @abstractmethod
    def rate_like(self, x: Array) -> Float[Array, " n"]:
        """The diagonal of Λ [rad/s per N·m] with the array type of x."""

    @abstractmethod
    def lyapunov(self) -> Lyapunov:
        """S, Λ, D₀, ω and ζ of the present parameters, with a claim for each.

        Raises:
            CertificateRefused: If the parameters violate an assumption of the proof.
        """

    def errors(self, q: Array, v: Array, q_ref: Array, v_ref: Array, a_ref: Array) -> Errors:
        """The signals z1, z2, v_r, a_r, ∇Φ and Φ for the state (q, v) and the reference, all of shape (..., nv).

        Raises:
            ArgumentError: If shapes or array types do not match.
        """
        return self._errors(*as_vectors(self.nv, q=q, v=v, q_ref=q_ref, v_ref=v_ref, a_ref=a_ref))

    def storage(self, q: Array, v: Array, q_ref: Array, v_ref: Array) -> Scalars:
        """V = Φ(z1) + ½z2ᵀM(q)z2 [J], the Lyapunov function of the closed loop."""
        q, v, q_ref, v_ref = as_vectors(self.nv, q=q, v=v, q_ref=q_ref, v_ref=v_ref)
        e = self._errors(q, v, q_ref, v_ref, 0.0 * v_ref)
        value = e.value + 0.5 * _dot(e.z2, matvec(self.dynamics.mass_matrix(q), e.z2))
        value = array_namespace(value).clip(value, 0.0, math.inf)  # V ≥ 0; Φ(z) − Φ(0) may round to less
        return finite_result("V", value, q, v, q_ref, v_ref)

    def dissipation(self, q: Array, v: Array, q_ref: Array, v_ref: Array) -> Scalars:
        """−V̇ without disturbance and friction [W]: the sum of `losses`."""
        q, v, q_ref, v_ref = as_vectors(self.nv, q=q, v=v, q_ref=q_ref, v_ref=v_ref)
        in_potential, in_damping = self.losses(q, self._errors(q, v, q_ref, v_ref, 0.0 * v_ref))
        return finite_result("−V̇", in_potential + in_damping, q, v, q_ref, v_ref)

    def losses(self, q: Array, e: Errors) -> tuple[Scalars, Scalars]:
        """∇ΦᵀΛ∇Φ and z2ᵀ(ωM + D)z2 − (1 − ζ)z2ᵀ∇Φ [W] for the signals e = `errors` of states at q."""
        a(Errors, "the signals that errors returned")("losses: e", e)
        q, _, _ = as_vectors(self.nv, q=q, z2=e.z2, gradient=e.gradient)
        force = self.inertial_rate * matvec(self.dynamics.mass_matrix(q), e.z2) + self.damping_force(e.z2)
        force = force - (1.0 - self.coupling) * e.gradient
        return _dot(e.gradient, self.rate_like(e.gradient) * e.gradient), _dot(e.z2, force)

    def extra_stiffness(self, radius: float) -> Interval:
        """For one joint: bounds of Φ'' − 2S [N·m/rad] for |z1| ≤ radius [rad]; [0, ∞) unless overridden."""
        return Interval(np.float64(0.0), np.float64(np.inf))

    def stiffness_range(self, radii: JointArray) -> tuple[Float[np.ndarray, "n n"], Float[np.ndarray, "n n"]]:
        """A and B with A ⪯ ∇²Φ(z1) ⪯ B while Σ (z1_i/radii_i)² ≤ 1 [N·m/rad]; B is inf unless overridden."""
        return 2.0 * self.lyapunov().stiffness, np.diag(np.full(self.nv, np.inf))

    def damping_slope(self) -> float:
        """ℓ with xᵀ(D(z2) − D₀)x ≤ ℓ² (z2ᵀD₀z2)(xᵀD₀x) for all z2 and x [s/J]; inf unless overridden."""
        return math.inf

    def stiffness_rate(self, radii: JointArray, weights: JointArray) -> float:
        """L with |xᵀ(∇²Φ(z) − ∇²Φ(z'))y| ≤ L‖x‖‖y‖‖z − z'‖ while Σ (z_i/radii_i)² ≤ 1, ‖x‖² = Σ weights_i x_i².

        inf unless overridden.
        """
        return math.inf

    def extra_damping(self, radius: float) -> Interval:
        """For one joint: bounds of D − D₀ [N·m·s/rad] for |z2| ≤ radius [rad/s]; [0, ∞) unless overridden."""
        return Interval(np.float64(0.0), np.float64(np.inf))

    def damping_share(self, radius: float) -> float:
        """n with D(z2) ⪯ (1 + n) D₀ while z2ᵀD₀z2 ≤ radius² [W], D₀ that of `lyapunov`; inf unless overridden."""
        return np.inf

    def _errors(self, q: Array, v: Array, q_ref: Array, v_ref: Array, a_ref: Array) -> Errors:
        rate, z1 = self.rate_like(q), self.dynamics.difference(q, q_ref)
        value, gradient, gradient_rate = self.potential_terms(z1, v - v_ref)
        v_r = v_ref - rate * gradient
        return Errors(z1, v - v_r, v_r, a_ref - rate * gradient_rate, gradient, value)


def _dot(x: Array, y: Array) -> Array:
    return array_namespace(x).sum(x * y, axis=-1)
