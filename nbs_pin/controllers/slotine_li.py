"""The passivity-based law of Slotine and Li with a known model."""

import numpy as np
from jaxtyping import Float

from nbs_pin.base.arrays import Array, as_vectors
from nbs_pin.controllers.gains import PerJoint, PositiveGains, effective_inertia, gains_for_robot, warn_if_too_fast
from nbs_pin.controllers.model_law import ModelLaw
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.dynamics.provider import DynamicsProvider
from nbs_pin.kernels.layout import LawCode, Packed
from nbs_pin.robots.robot import Robot


class SlotineLi(ModelLaw):
    """τ = M a_r + C(q, v) v_r + G − K s,  v_r = v_d − λ z1,  a_r = a_d − λ ż1,  s = v − v_r.

    rate: λ [1/s], (n,). gain: K [N·m·s/rad], (n,). friction: fed forward at v_r, or None.
    Source: Slotine and Li 1987, "On the adaptive control of robot manipulators", without adaptation.
    Raises ArgumentError unless all gains are positive.
    """

    def __init__(
        self,
        dynamics: DynamicsProvider,
        *,
        rate: PerJoint,
        gain: PerJoint,
        friction: JointFriction | None = None,
    ) -> None:
        super().__init__(dynamics, friction)
        self.gains = PositiveGains(dynamics.nv, rate=rate, gain=gain)

    @classmethod
    def for_robot(
        cls,
        robot: Robot,
        dynamics: DynamicsProvider | None = None,
        *,
        bandwidth: float = 8.0,
        period: float = 0.001,
        friction: JointFriction | None = None,
    ) -> "SlotineLi":
        """λ = ω, and K such that a static error meets the stiffness λK of `gains_for_robot`, short of chatter."""
        dynamics = PinocchioDynamics(robot) if dynamics is None else dynamics
        gains = gains_for_robot(robot, dynamics, bandwidth=bandwidth, period=period)
        warn_if_too_fast(robot, dynamics, bandwidth)
        gain = np.minimum(gains.stiffness / bandwidth, 0.5 * effective_inertia(robot, dynamics) / period)
        return cls(dynamics, rate=np.full(robot.nv, bandwidth), gain=gain, friction=friction)

    @property
    def rate(self) -> Float[np.ndarray, " n"]:
        """λ [1/s]."""
        return self.gains.numpy("rate")

    @property
    def gain(self) -> Float[np.ndarray, " n"]:
        """K [N·m·s/rad]."""
        return self.gains.numpy("gain")

    def torque(self, q: Array, v: Array, q_ref: Array, v_ref: Array, a_ref: Array) -> Float[Array, "*batch n"]:
        """τ [N·m]; arguments (..., nv). Raises ArgumentError when shapes or kinds do not fit."""
        q, v, q_ref, v_ref, a_ref = as_vectors(self.nv, q=q, v=v, q_ref=q_ref, v_ref=v_ref, a_ref=a_ref)
        rate, gain = self.gains.like(q)
        v_r = v_ref - rate * self.dynamics.difference(q, q_ref)
        a_r = a_ref - rate * (v - v_ref)
        tau = self.dynamics.reference_torque(q, v, v_r, a_r) - gain * (v - v_r)
        return tau if self.friction is None else tau + self.friction.torque(v_r)

    @property
    def _is_known(self) -> bool:
        return type(self) is SlotineLi

    def _packed(self, numpy: bool) -> Packed:
        rate, gain = self.gains.value(numpy=numpy)
        return self._pack(LawCode.SLOTINE_LI, (rate, gain))
