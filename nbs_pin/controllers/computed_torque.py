"""Computed torque: inverse dynamics with linear error dynamics."""

from collections.abc import Iterable

import numpy as np

from nbs_pin.base.arguments import BANDWIDTH, PERIOD, checked, maybe
from nbs_pin.base.arrays import Array, JointArray, Vectors, as_vectors, finite_result
from nbs_pin.base.known_code import known_code
from nbs_pin.base.shown import spread
from nbs_pin.base.storable import storable
from nbs_pin.controllers.gains import (
    PerJoint,
    PositiveGains,
    gains_for_robot,
    largest_inertia,
    stored_gains,
    warn_if_too_fast,
)
from nbs_pin.controllers.model_law import ModelLaw
from nbs_pin.dynamics.friction import FRICTION, JointFriction
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.dynamics.provider import MODEL, DynamicsProvider
from nbs_pin.kernels.layout import LawCode, Packed
from nbs_pin.robots.robot import ARM, Robot


@known_code
@storable(parts=("dynamics", "friction"), arrays=stored_gains("kp", "kd"))
class ComputedTorque(ModelLaw):
    """τ = M(a_d − k_d ż1 − k_p z1) + C v + G, so that z̈1 + k_d ż1 + k_p z1 = M⁻¹τ_d.

    Source: Luh, Walker and Paul 1980; Siciliano et al. 2009, section 8.5.2.

    Args:
        kp: k_p [1/s²], (n,) or one number.
        kd: k_d [1/s], (n,) or one number.
        friction: Joint friction fed forward at v_d, or None.

    Raises:
        ArgumentError: If a gain is not positive.

    Example:
        >>> import nbs_pin as nbs
        >>> nbs.ComputedTorque.for_robot(nbs.load_robot("two_link"), bandwidth=8.0).kp.round(1)
        array([256. , 333.3])
    """

    def __init__(
        self, dynamics: DynamicsProvider, *, kp: PerJoint, kd: PerJoint, friction: JointFriction | None = None
    ) -> None:
        super().__init__(dynamics, friction)
        self.gains = PositiveGains(dynamics.nv, kp=kp, kd=kd)

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
    ) -> "ComputedTorque":
        """Critically damped, with poles at −2ω or, if the effort limits allow, the stiffness of `gains_for_robot`."""
        dynamics = PinocchioDynamics(robot) if dynamics is None else dynamics
        gains = gains_for_robot(robot, dynamics, bandwidth=bandwidth, period=period)
        warn_if_too_fast(robot, dynamics, 2.0 * bandwidth)
        kp = np.maximum(4.0 * bandwidth**2, gains.stiffness / largest_inertia(robot, dynamics))
        return cls(dynamics, kp=kp, kd=2.0 * np.sqrt(kp), friction=friction)

    def _gains_told(self) -> Iterable[str]:
        return spread("k_p", self.kp, "1/s²"), spread("k_d", self.kd, "1/s")

    @property
    def kp(self) -> JointArray:
        """k_p [1/s²]."""
        return self.gains.numpy("kp")

    @property
    def kd(self) -> JointArray:
        """k_d [1/s]."""
        return self.gains.numpy("kd")

    def torque(self, q: Array, v: Array, q_ref: Array, v_ref: Array, a_ref: Array) -> Vectors:
        """τ [N·m]; arguments (..., nv). Raises ArgumentError if shapes or array types do not match."""
        q, v, q_ref, v_ref, a_ref = as_vectors(self.nv, q=q, v=v, q_ref=q_ref, v_ref=v_ref, a_ref=a_ref)
        kp, kd = self.gains.like(q)
        a = a_ref - kd * (v - v_ref) - kp * self.dynamics.difference(q, q_ref)
        tau = self.dynamics.reference_torque(q, v, v, a)
        tau = tau if self.friction is None else tau + self.friction.feedforward(v_ref, tau)
        return finite_result("the torque", tau, q, v, q_ref, v_ref, a_ref)

    def _packed(self, numpy: bool) -> Packed:
        kp, kd = self.gains.value(numpy=numpy)
        return self._pack(LawCode.COMPUTED_TORQUE, (kp, kd))
