"""Proportional-derivative control with a model: gravity compensation, or the full PD+ feedforward."""

from jaxtyping import Float

from nbs_pin.arrays import Array, as_vectors, constant_like
from nbs_pin.controllers.compiled import CompiledController, is_packable
from nbs_pin.controllers.controller import Controller, MemorylessController
from nbs_pin.controllers.gains import PerJoint, pd_gains, positive_gains
from nbs_pin.dynamics.friction import JointFriction, friction_of_size
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.dynamics.provider import DynamicsProvider
from nbs_pin.exceptions import ArgumentError
from nbs_pin.robot import Robot
from nbs_pin.runtime.layout import PD_GRAVITY, PD_REFERENCE

FEEDFORWARDS = ("gravity", "reference")


class PD(MemorylessController):
    """τ = feedforward − K_p z1 − K_d ż1.

    feedforward "gravity": G(q), asymptotically stable at a set point (Takegaki and Arimoto 1981).
    feedforward "reference": M(q)a_d + C(q, v)v_d + G(q), the PD+ law, which tracks (Paden and Panja 1988).
    kp [N·m/rad], kd [N·m·s/rad]: (n,). friction: fed forward at v_d, or None.
    Raises ArgumentError for an unknown feedforward or gains that are not positive.
    """

    def __init__(
        self,
        dynamics: DynamicsProvider,
        *,
        feedforward: str,
        kp: PerJoint,
        kd: PerJoint,
        friction: JointFriction | None = None,
    ) -> None:
        if feedforward not in FEEDFORWARDS:
            raise ArgumentError(f"feedforward '{feedforward}' is unknown; choose one of {', '.join(FEEDFORWARDS)}.")
        self.dynamics, self.feedforward, self.friction = dynamics, feedforward, friction_of_size(friction, dynamics.nv)
        self.kp, self.kd = positive_gains(dynamics.nv, kp=kp, kd=kd)

    @classmethod
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
        """The gains of `pd_gains`: as stiff as the arm's effort allows, critically damped."""
        dynamics = PinocchioDynamics(robot) if dynamics is None else dynamics
        kp, kd = pd_gains(robot, dynamics, bandwidth=bandwidth, period=period)
        return cls(dynamics, feedforward=feedforward, kp=kp, kd=kd, friction=friction)

    @property
    def nv(self) -> int:
        """Number of joints."""
        return self.dynamics.nv

    def torque(self, q: Array, v: Array, q_ref: Array, v_ref: Array, a_ref: Array) -> Float[Array, "*batch n"]:
        """τ [N·m]; arguments (..., nv). Raises ArgumentError when shapes or kinds do not fit."""
        q, v, q_ref, v_ref, a_ref = as_vectors(self.nv, q=q, v=v, q_ref=q_ref, v_ref=v_ref, a_ref=a_ref)
        z1, dz1 = self.dynamics.difference(q, q_ref), v - v_ref
        tau = -constant_like(q, self.kp) * z1 - constant_like(q, self.kd) * dz1
        if self.feedforward == "gravity":
            tau = tau + self.dynamics.gravity(q)
        else:
            tau = tau + self.dynamics.reference_torque(q, v, v_ref, a_ref)
        return tau if self.friction is None else tau + self.friction.torque(v_ref)

    def compile(self) -> Controller:
        """The law as machine code (`Controller.compile`)."""
        if type(self) is not PD or not is_packable(self.dynamics, self.friction):
            return self
        law = PD_GRAVITY if self.feedforward == "gravity" else PD_REFERENCE
        return CompiledController.of(law, self.dynamics, (self.kp, self.kd), self.friction)
