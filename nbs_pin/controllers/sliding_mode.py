"""Slotine and Li's law with a switching term against disturbances, smoothed in a boundary layer."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from nbs_pin.base.arguments import BANDWIDTH, PERIOD, checked, joints, maybe
from nbs_pin.base.arrays import Array, Matrices, Vectors, array_namespace, as_vectors, constant_like
from nbs_pin.base.claims import Claim, known, refuse
from nbs_pin.base.intervals import Interval
from nbs_pin.base.known_code import foreign_code, known_code
from nbs_pin.base.rounding import up
from nbs_pin.base.storable import Tensors, storable
from nbs_pin.controllers.gains import PerJoint, PositiveGains, effective_inertia, positive_gains, stored_gains
from nbs_pin.controllers.lyapunov_law import Lyapunov
from nbs_pin.controllers.slotine_li import SlotineLi
from nbs_pin.dynamics.friction import FRICTION, JointFriction
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.dynamics.provider import MODEL, DynamicsProvider
from nbs_pin.robots.robot import ARM, Robot


def _stored(t: Tensors) -> Mapping[str, Any]:
    return {**stored_gains("rate", "gain")(t), "switching": t["switching.switching.nominal"].numpy(force=True)}


@known_code
@storable(("boundary",), parts=("dynamics", "friction"), arrays=_stored)
class SlidingMode(SlotineLi):
    """τ = M a_r + C(q, v) v_r + G − K s − η tanh(s/ε), with s, v_r and a_r of `SlotineLi`.

    The Lyapunov function is that of `SlotineLi`; the switching term is damping: D(s) = K + diag(η tanh(s/ε)/s) ⪰ K.
    Source: Slotine and Li 1991, "Applied Nonlinear Control", sections 7.2 and 9.1.

    Args:
        rate: λ [1/s], (n,) or one number.
        gain: K [N·m·s/rad], (n,) or one number.
        switching: η [N·m], (n,) or one number: the disturbance to reject.
        boundary: ε [rad/s], (n,) or one number: width of the boundary layer.
        friction: Joint friction fed forward at v_r, or None.

    Raises:
        ArgumentError: If a gain is not positive.

    Example:
        >>> import nbs_pin as nbs
        >>> nbs.SlidingMode.for_robot(nbs.load_robot("two_link"), switching=5.0).boundary.round(3)
        array([0.02, 0.1 ])
    """

    def __init__(
        self,
        dynamics: DynamicsProvider,
        *,
        rate: PerJoint,
        gain: PerJoint,
        switching: PerJoint,
        boundary: PerJoint,
        friction: JointFriction | None = None,
    ) -> None:
        super().__init__(dynamics, rate=rate, gain=gain, friction=friction)
        self.switching = PositiveGains(dynamics.nv, switching=switching)
        (self.boundary,) = positive_gains(dynamics.nv, boundary=boundary)

    @classmethod
    @checked(
        robot=ARM,
        dynamics=maybe(MODEL),
        bandwidth=BANDWIDTH,
        period=PERIOD,
        friction=maybe(FRICTION),
        switching=joints(above=0.0, unit="N·m"),
    )
    def for_robot(
        cls,
        robot: Robot,
        dynamics: DynamicsProvider | None = None,
        *,
        bandwidth: float = 8.0,
        period: float = 0.001,
        switching: PerJoint = 1.0,
        friction: JointFriction | None = None,
    ) -> "SlidingMode":
        """λ and K of `SlotineLi.for_robot`, and a boundary layer with η/ε = ¼M_e/h, wide enough to avoid chatter."""
        model = PinocchioDynamics(robot) if dynamics is None else dynamics
        law = SlotineLi.for_robot(robot, model, bandwidth=bandwidth, period=period)
        boundary = 4.0 * period * switching / effective_inertia(robot, model)
        gains = {"rate": law.rate, "gain": law.gain, "switching": switching, "boundary": boundary}
        return cls(model, **gains, friction=friction)

    def torque(self, q: Array, v: Array, q_ref: Array, v_ref: Array, a_ref: Array) -> Vectors:
        """τ [N·m]; arguments (..., nv). Raises ArgumentError if shapes or array types do not match."""
        q, v, q_ref, v_ref, a_ref = as_vectors(self.nv, q=q, v=v, q_ref=q_ref, v_ref=v_ref, a_ref=a_ref)
        rate, _ = self.gains.like(q)
        s = v - v_ref + rate * self.dynamics.difference(q, q_ref)
        return super().torque(q, v, q_ref, v_ref, a_ref) - self._switched(s)

    def damping_force(self, z2: Array) -> Vectors:
        """K z2 + η tanh(z2/ε) [N·m]."""
        (z2,) = as_vectors(self.nv, z2=z2)
        return super().damping_force(z2) + self._switched(z2)

    def damping_matrix(self, z2: Array) -> Matrices:
        """K + diag(η tanh(z2/ε)/z2) [N·m·s/rad]."""
        (z2,) = as_vectors(self.nv, z2=z2)
        xp, (steepest,) = array_namespace(z2), self.switching.like(z2)
        x = z2 / constant_like(z2, self.boundary)
        small = abs(x) < 1e-6
        ratio = xp.where(small, 1.0 + 0.0 * x, xp.tanh(x) / xp.where(small, 1.0 + 0.0 * x, x))
        extra = steepest / constant_like(z2, self.boundary) * ratio
        return super().damping_matrix(z2) + xp.eye(self.nv, dtype=z2.dtype) * extra[..., None]

    def damping_slope(self) -> float:
        """Not known: the switching term is as large at rest as elsewhere."""
        return math.inf

    def extra_damping(self, radius: float) -> Interval:
        """Bounds of η tanh(z2/ε)/z2 for one joint; the largest value is η/ε, at 0."""
        return Interval(np.float64(0.0), np.float64(self.switching.numpy("switching")[0] / self.boundary[0]))

    def damping_share(self, radius: float) -> float:
        """The largest η/(εK): η tanh(x/ε)/x ≤ η/ε, with equality at 0, whatever the radius."""
        gain = np.asarray(self.gains.named("gain").numpy())
        return up(float((self.switching.numpy("switching") / (self.boundary * gain)).max()))

    def lyapunov(self) -> Lyapunov:
        """Constants and claims of `SlotineLi`, with a claim for the switching term."""
        found = super().lyapunov()
        switching, boundary = self.switching.numpy("switching"), self.boundary
        if not (np.isfinite([*switching, *boundary]).all() and switching.min() > 0.0 and boundary.min() > 0.0):
            refuse(f"η is {switching.tolist()} and ε {boundary.tolist()}", "all must be positive and finite")
        how = known(foreign_code(self.switching), "η tanh(s/ε) has the sign of s, so D ⪰ K")
        return found._replace(claims=(*found.claims, Claim("η, least", float(switching.min()), "N·m", *how)))

    def _switched(self, s: Array) -> Vectors:
        (size,) = self.switching.like(s)
        return size * array_namespace(s).tanh(s / constant_like(s, self.boundary))
