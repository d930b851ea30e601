"""PD control with a model: gravity compensation or PD+ feedforward."""

from collections.abc import Iterable

from nbs_pin.base.arguments import BANDWIDTH, PERIOD, checked, choice, maybe
from nbs_pin.base.arrays import Array, JointArray, Vectors, as_vectors, finite_result
from nbs_pin.base.known_code import known_code
from nbs_pin.base.shown import spread
from nbs_pin.base.storable import storable
from nbs_pin.controllers.gains import PerJoint, PositiveGains, pd_gains, stored_gains
from nbs_pin.controllers.model_law import ModelLaw
from nbs_pin.dynamics.friction import FRICTION, JointFriction
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.dynamics.provider import MODEL, DynamicsProvider
from nbs_pin.kernels.layout import LawCode, Packed
from nbs_pin.robots.robot import ARM, Robot

FEEDFORWARDS = ("gravity", "reference")


@known_code
@storable(("feedforward",), parts=("dynamics", "friction"), arrays=stored_gains("kp", "kd"))
class PD(ModelLaw):
    """τ = feedforward − K_p z1 − K_d ż1.

    Args:
        feedforward: "gravity" for G(q), stable at set points (Takegaki and Arimoto 1981), or "reference" for
            M(q)a_d + C(q, v)v_d + G(q), the PD+ law, which tracks motions (Paden and Panja 1988).
        kp: K_p [N·m/rad], (n,) or one number.
        kd: K_d [N·m·s/rad], (n,) or one number.
        friction: Joint friction fed forward at v_d, or None.

    Raises:
        ArgumentError: If a gain is not positive, or feedforward is unknown.

    Example:
        >>> import nbs_pin as nbs
        >>> nbs.PD.for_robot(nbs.load_robot("two_link"), feedforward="gravity").kd.round(1)
        array([81.6, 36.5])
    """

    @checked(feedforward=choice(*FEEDFORWARDS))
    def __init__(
        self,
        dynamics: DynamicsProvider,
        *,
        feedforward: str,
        kp: PerJoint,
        kd: PerJoint,
        friction: JointFriction | None = None,
    ) -> None:
        super().__init__(dynamics, friction)
        self.feedforward = feedforward
        self.gains = PositiveGains(dynamics.nv, kp=kp, kd=kd)

    @classmethod
    @checked(
        robot=ARM,
        dynamics=maybe(MODEL),
        bandwidth=BANDWIDTH,
        period=PERIOD,
        friction=maybe(FRICTION),
        feedforward=choice(*FEEDFORWARDS),
    )
    def for_robot(
        cls,
        robot: Robot,
        dynamics: DynamicsProvider | None = None,
        *,
        feedforward: str = "reference",
        bandwidth: float = 8.0,
        period: float = 0.001,
        friction: JointFriction | None = None,
    ) -> "PD":
        """The gains of `pd_gains`: as stiff as the effort limits allow, critically damped."""
        dynamics = PinocchioDynamics(robot) if dynamics is None else dynamics
        kp, kd = pd_gains(robot, dynamics, bandwidth=bandwidth, period=period)
        return cls(dynamics, feedforward=feedforward, kp=kp, kd=kd, friction=friction)

    def _gains_told(self) -> Iterable[str]:
        return spread("K_p", self.kp, "N·m/rad"), spread("K_d", self.kd, "N·m·s/rad")

    @property
    def kp(self) -> JointArray:
        """K_p [N·m/rad]."""
        return self.gains.numpy("kp")

    @property
    def kd(self) -> JointArray:
        """K_d [N·m·s/rad]."""
        return self.gains.numpy("kd")

    def torque(self, q: Array, v: Array, q_ref: Array, v_ref: Array, a_ref: Array) -> Vectors:
        """τ [N·m]; arguments (..., nv). Raises ArgumentError if shapes or array types do not match."""
        q, v, q_ref, v_ref, a_ref = as_vectors(self.nv, q=q, v=v, q_ref=q_ref, v_ref=v_ref, a_ref=a_ref)
        z1, dz1 = self.dynamics.difference(q, q_ref), v - v_ref
        kp, kd = self.gains.like(q)
        tau = -kp * z1 - kd * dz1
        if self.feedforward == "gravity":
            tau = tau + self.dynamics.gravity(q)
        else:
            tau = tau + self.dynamics.reference_torque(q, v, v_ref, a_ref)
        tau = tau if self.friction is None else tau + self.friction.feedforward(v_ref, tau)
        return finite_result("the torque", tau, q, v, q_ref, v_ref, a_ref)

    def _packed(self, numpy: bool) -> Packed:
        kp, kd = self.gains.value(numpy=numpy)
        return self._pack(LawCode.PD_GRAVITY if self.feedforward == "gravity" else LawCode.PD_REFERENCE, (kp, kd))
