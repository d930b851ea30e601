"""The passivity-based law of Slotine and Li with a known model."""

from collections.abc import Iterable

import numpy as np
from jaxtyping import Float

from nbs_pin.base.arguments import BANDWIDTH, PERIOD, checked, maybe
from nbs_pin.base.arrays import Array, JointArray, Matrices, Vectors, array_namespace, as_vectors, finite_result
from nbs_pin.base.claims import Claim, known
from nbs_pin.base.intervals import Interval
from nbs_pin.base.known_code import foreign_code, known_code
from nbs_pin.base.shown import spread
from nbs_pin.base.storable import storable
from nbs_pin.controllers.gains import (
    PerJoint,
    PositiveGains,
    effective_inertia,
    gains_for_robot,
    stored_gains,
    warn_if_too_fast,
)
from nbs_pin.controllers.lyapunov_law import Lyapunov, LyapunovLaw
from nbs_pin.controllers.part_claims import check_parts, friction_claims, positive_gain
from nbs_pin.dynamics.friction import FRICTION, JointFriction
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.dynamics.provider import MODEL, DynamicsProvider
from nbs_pin.kernels.layout import LawCode, Packed
from nbs_pin.robots.robot import ARM, Robot


@known_code
@storable(parts=("dynamics", "friction"), arrays=stored_gains("rate", "gain"))
class SlotineLi(LyapunovLaw):
    """τ = M a_r + C(q, v) v_r + G − K s,  v_r = v_d − λ z1,  a_r = a_d − λ ż1,  s = v − v_r.

    With V = z1ᵀλKz1 + ½sᵀM s:  V̇ = −ż1ᵀKż1 − z1ᵀλKλz1 + sᵀτ_d. In the terms of `LyapunovLaw`, Φ = z1ᵀλKz1, Λ = ½K⁻¹,
    D = K, ω = ζ = 0. Source: Slotine and Li 1987, "On the adaptive control of robot manipulators", without adaptation.

    Args:
        rate: λ [1/s], (n,) or one number.
        gain: K [N·m·s/rad], (n,) or one number.
        friction: Joint friction fed forward at v_r, or None.

    Raises:
        ArgumentError: If a gain is not positive.

    Example:
        >>> import nbs_pin as nbs
        >>> nbs.SlotineLi.for_robot(nbs.load_robot("two_link"), bandwidth=8.0).gain.round(1)
        array([41.7, 41.7])
    """

    coupling = 0.0

    def __init__(
        self, dynamics: DynamicsProvider, *, rate: PerJoint, gain: PerJoint, friction: JointFriction | None = None
    ) -> None:
        super().__init__(dynamics, friction)
        self.gains = PositiveGains(dynamics.nv, rate=rate, gain=gain)

    @classmethod
    @checked(robot=ARM, dynamics=maybe(MODEL), bandwidth=BANDWIDTH, period=PERIOD, friction=maybe(FRICTION))
    def for_robot(
        cls,
        robot: Robot,
        dynamics: DynamicsProvider | None = None,
        *,
        bandwidth: float = 8.0,
        period: float = 0.001,
        friction: JointFriction | None = None,
    ) -> "SlotineLi":
        """λ = ω, and K from the stiffness λK of `gains_for_robot`, at most ½M_e/h to avoid chatter."""
        dynamics = PinocchioDynamics(robot) if dynamics is None else dynamics
        gains = gains_for_robot(robot, dynamics, bandwidth=bandwidth, period=period)
        warn_if_too_fast(robot, dynamics, bandwidth)
        gain = np.minimum(gains.stiffness / bandwidth, 0.5 * effective_inertia(robot, dynamics) / period)
        return cls(dynamics, rate=np.full(robot.nv, bandwidth), gain=gain, friction=friction)

    def _gains_told(self) -> Iterable[str]:
        return spread("λ", self.rate, "1/s"), spread("K", self.gain, "N·m·s/rad")

    @property
    def rate(self) -> JointArray:
        """λ [1/s]."""
        return self.gains.numpy("rate")

    @property
    def gain(self) -> JointArray:
        """K [N·m·s/rad]."""
        return self.gains.numpy("gain")

    def torque(self, q: Array, v: Array, q_ref: Array, v_ref: Array, a_ref: Array) -> Vectors:
        """τ [N·m]; arguments (..., nv). Raises ArgumentError if shapes or array types do not match."""
        q, v, q_ref, v_ref, a_ref = as_vectors(self.nv, q=q, v=v, q_ref=q_ref, v_ref=v_ref, a_ref=a_ref)
        rate, gain = self.gains.like(q)
        v_r = v_ref - rate * self.dynamics.difference(q, q_ref)
        a_r = a_ref - rate * (v - v_ref)
        tau = self.dynamics.reference_torque(q, v, v_r, a_r) - gain * (v - v_r)
        tau = tau if self.friction is None else tau + self.friction.feedforward(v_r, tau)
        return finite_result("the torque", tau, q, v, q_ref, v_ref, a_ref)

    def potential_terms(self, z1: Array, dz: Array) -> tuple[Array, Array, Array]:
        """z1ᵀλKz1 [J], 2λKz1 [N·m] and 2λK dz."""
        z1, dz = as_vectors(self.nv, z1=z1, dz=dz)
        rate, gain = self.gains.like(z1)
        gradient = 2.0 * rate * gain * z1
        value = finite_result("Φ", 0.5 * array_namespace(z1).sum(gradient * z1, axis=-1), z1)
        return value, gradient, finite_result("∇²Φ dz", 2.0 * rate * gain * dz, dz)

    def damping_force(self, z2: Array) -> Vectors:
        """K z2 [N·m]."""
        (z2,) = as_vectors(self.nv, z2=z2)
        return finite_result("K z2", self.gains.like(z2)[1] * z2, z2)

    def damping_matrix(self, z2: Array) -> Matrices:
        """K [N·m·s/rad]."""
        (z2,) = as_vectors(self.nv, z2=z2)
        xp, gain = array_namespace(z2), self.gains.like(z2)[1]
        return xp.eye(self.nv, dtype=z2.dtype) * gain + 0.0 * z2[..., None]

    def rate_like(self, x: Array) -> Float[Array, " n"]:
        """Λ = ½K⁻¹ [rad/s per N·m] with the array type of x, so that Λ∇Φ = λz1."""
        return 0.5 / self.gains.like(x)[1]

    def extra_stiffness(self, radius: float) -> Interval:
        """0: Φ is quadratic."""
        return Interval.of(np.float64(0.0))

    def stiffness_range(self, radii: JointArray) -> tuple[Float[np.ndarray, "n n"], Float[np.ndarray, "n n"]]:
        """2λK twice: Φ is quadratic."""
        hessian = np.diag(2.0 * self.rate * self.gain)
        return hessian, hessian

    def damping_slope(self) -> float:
        """0: D is constant."""
        return 0.0

    def stiffness_rate(self, radii: JointArray, weights: JointArray) -> float:
        """0: Φ is quadratic."""
        return 0.0

    def extra_damping(self, radius: float) -> Interval:
        """0: D is constant."""
        return Interval.of(np.float64(0.0))

    def damping_share(self, radius: float) -> float:
        """0: D is constant, D₀ = K."""
        return 0.0

    def lyapunov(self) -> Lyapunov:
        """S = λK, Λ = ½K⁻¹, D₀ = K, with claims for both gains and the friction feed-forward."""
        check_parts(self.nv, {name: len(self.gains.named(name).nominal) for name in ("rate", "gain")}, self.friction)
        rate, odd_rate = positive_gain("λ", self.gains.named("rate"), self.nv, 1)
        gain, odd_gain = positive_gain("K", self.gains.named("gain"), self.nv, 1)
        how = known(odd_rate or odd_gain or foreign_code(self.gains), "constant and diagonal")
        claims = (
            Claim("Φ = z1ᵀλKz1 strongly convex, μ", 2.0 * float((rate * gain).min()), "J/rad²", *how),
            Claim("ρ = least of λ", float(rate.min()), "1/s", *how),
            Claim("D = K, least", float(gain.min()), "N·m·s/rad", *how),
            *friction_claims(self.friction),
        )
        return Lyapunov(np.diag(rate * gain), 0.5 / gain, np.diag(gain), 0.0, self.coupling, claims)

    def _packed(self, numpy: bool) -> Packed:
        rate, gain = self.gains.value(numpy=numpy)
        return self._pack(LawCode.SLOTINE_LI, (rate, gain))
