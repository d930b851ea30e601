"""The neural backstepping (NBS) law: tracking that is stable for every value of its network weights."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from nbs_pin.base.arrays import Array, array_namespace, as_vectors, matvec
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.controllers.damping import Damping
from nbs_pin.controllers.gain import Gain, positive_scale
from nbs_pin.controllers.gains import Gains, gains_for_robot, warn_if_too_fast
from nbs_pin.controllers.model_law import ModelLaw
from nbs_pin.controllers.potential import Potential
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.dynamics.provider import DynamicsProvider
from nbs_pin.kernels.layout import LawCode, Packed
from nbs_pin.robots.robot import Robot

DAMPINGS = ("inertial", "bounded", "paper")


class Errors(NamedTuple):
    """The signals of one backstepping step, each of shape (..., nv) but the value."""

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


class NeuralBackstepping(ModelLaw):
    """τ = M(φ̇ − ωz2) + C(q, v)φ + G − ∇Φ(z1) − D(z2)z2 with φ = v_d − Λ∇Φ(z1), z1 = q ⊖ q_d, z2 = v − φ.

    With V = Φ + ½z2ᵀM z2:  V̇ = −∇ΦᵀΛ∇Φ − z2ᵀ(ωM + D)z2 + z2ᵀτ_d for every weight of Φ and D (docs/theory.md §2).
    Λ = I, ω = 0 with the `paper` networks is the paper's law (its eq. (9)); the paper's Λ = I has the wrong units.

    dynamics: what the law believes of the arm. potential: Φ. damping: D without its ωM part.
    rate: Λ [rad/s per N·m], (nv,), positive, diagonal; a `Gain`, which training may change but never below least_share
    of it. inertial_rate: ω ≥ 0 [1/s].
    friction: joint friction to feed forward at φ, or None; it is monotone in v, so it only adds dissipation.
    Raises ArgumentError when sizes disagree or Λ, ω are out of range.
    """

    def __init__(
        self,
        dynamics: DynamicsProvider,
        potential: Potential,
        damping: Damping,
        *,
        rate: Float[Array, " n"] | None = None,
        inertial_rate: float = 0.0,
        friction: JointFriction | None = None,
        least_share: float = 0.5,
    ) -> None:
        super().__init__(dynamics, friction)
        nv = dynamics.nv
        if not nv == potential.nv == damping.nv:
            raise ArgumentError(
                f"dynamics, potential and damping have {nv}, {potential.nv} and {damping.nv} joints; make them equal."
            )
        if not 0.0 <= inertial_rate < np.inf:
            raise ArgumentError(f"the inertial rate ω is {inertial_rate}; give a number ≥ 0 [1/s].")
        self.potential, self.damping = potential, damping
        self.inertial_rate = inertial_rate
        self.rate = Gain(positive_scale("the rate Λ", rate, nv), least_share=least_share, name="the rate Λ")

    @classmethod
    def for_robot(
        cls,
        robot: Robot,
        dynamics: DynamicsProvider | None = None,
        *,
        bandwidth: float = 8.0,
        period: float = 0.001,
        potential: str = "smooth",
        damping: str = "inertial",
        friction: JointFriction | None = None,
        gains: Gains | None = None,
        least_share: float = 0.5,
        seed: int = 0,
    ) -> "NeuralBackstepping":
        """A controller for an arm that nobody tuned, from its inertia, effort limits and control period.

        bandwidth: ω [rad/s], the rate at which errors decay; warns when it is too fast for the effort limits.
        period: control period h [s].
        potential: "smooth" or "paper". damping: "inertial" (ωM + D₀ + TᵀT), "bounded" (D₀ + TᵀT) or "paper" (TᵀT).
        dynamics: None takes Pinocchio's model of `robot`. gains: None computes them (`gains_for_robot`).
        least_share: what training leaves at least of S, Λ and D₀ (`networks.gain.Gain`).
        The paper's networks with S = I, Λ = I are built by hand: see `paper_controller`.
        Raises ArgumentError for unknown names or numbers out of range.
        """
        from nbs_pin.dynamics.pinocchio import PinocchioDynamics

        if damping not in DAMPINGS:
            raise ArgumentError(f"damping '{damping}' is unknown; choose one of {', '.join(DAMPINGS)}.")
        dynamics = PinocchioDynamics(robot) if dynamics is None else dynamics
        chosen = gains_for_robot(robot, dynamics, bandwidth=bandwidth, period=period) if gains is None else gains
        warn_if_too_fast(robot, dynamics, chosen.bandwidth)
        root = np.sqrt(chosen.stiffness)
        phi = Potential(np.diag(0.5 * chosen.stiffness), form=potential, scale=root, least_share=least_share, seed=seed)
        if damping == "paper":
            d = Damping(robot.nv, form="paper", m=1.0, scale=np.sqrt(chosen.damping), seed=seed + 1)
        else:
            floor, scale = np.diag(chosen.damping), np.sqrt(chosen.damping)
            d = Damping(robot.nv, floor=floor, scale=scale, least_share=least_share, seed=seed + 1)
        omega = chosen.bandwidth if damping == "inertial" else 0.0
        return cls(dynamics, phi, d, rate=chosen.rate, inertial_rate=omega, friction=friction, least_share=least_share)

    def errors(self, q: Array, v: Array, q_ref: Array, v_ref: Array, a_ref: Array) -> Errors:
        """The backstepping signals for the state (q, v) and the reference, all of shape (..., nv).

        Raises ArgumentError when shapes or array kinds do not fit.
        """
        return self._errors(*as_vectors(self.nv, q=q, v=v, q_ref=q_ref, v_ref=v_ref, a_ref=a_ref))

    def torque(self, q: Array, v: Array, q_ref: Array, v_ref: Array, a_ref: Array) -> Float[Array, "*batch n"]:
        """τ [N·m]; the ωM part of the damping joins the reference acceleration and costs nothing.

        Raises ArgumentError when shapes or array kinds do not fit.
        """
        q, v, q_ref, v_ref, a_ref = as_vectors(self.nv, q=q, v=v, q_ref=q_ref, v_ref=v_ref, a_ref=a_ref)
        e = self._errors(q, v, q_ref, v_ref, a_ref)
        feedforward = self.dynamics.reference_torque(q, v, e.v_r, e.a_r - self.inertial_rate * e.z2)
        tau = feedforward - e.gradient - self.damping.force(e.z2)
        return tau if self.friction is None else tau + self.friction.torque(e.v_r)

    def storage(self, q: Array, v: Array, q_ref: Array, v_ref: Array) -> Float[Array, "*batch"]:
        """V = Φ(z1) + ½z2ᵀM(q)z2 [J], the Lyapunov function of the closed loop."""
        q, v, q_ref, v_ref = as_vectors(self.nv, q=q, v=v, q_ref=q_ref, v_ref=v_ref)
        e = self._errors(q, v, q_ref, v_ref, 0.0 * v_ref)
        return e.value + 0.5 * _dot(e.z2, matvec(self.dynamics.mass_matrix(q), e.z2))

    def dissipation(self, q: Array, v: Array, q_ref: Array, v_ref: Array) -> Float[Array, "*batch"]:
        """∇ΦᵀΛ∇Φ + z2ᵀ(ωM + D)z2 [W]: the rate at which V falls without disturbance and friction."""
        q, v, q_ref, v_ref = as_vectors(self.nv, q=q, v=v, q_ref=q_ref, v_ref=v_ref)
        e = self._errors(q, v, q_ref, v_ref, 0.0 * v_ref)
        force = self.inertial_rate * matvec(self.dynamics.mass_matrix(q), e.z2) + self.damping.force(e.z2)
        return _dot(e.gradient, self.rate.like(e.gradient) * e.gradient) + _dot(e.z2, force)

    def _errors(self, q: Array, v: Array, q_ref: Array, v_ref: Array, a_ref: Array) -> Errors:
        rate = self.rate.like(q)
        z1 = self.dynamics.difference(q, q_ref)
        value, gradient, gradient_rate = self.potential.terms(z1, v - v_ref)
        v_r = v_ref - rate * gradient
        return Errors(z1, v - v_r, v_r, a_ref - rate * gradient_rate, gradient, value)

    @property
    def _is_known(self) -> bool:
        return type(self) is NeuralBackstepping and self.potential.is_packable and self.damping.is_packable

    def _packed(self, numpy: bool) -> Packed:
        rate = self.rate.value(numpy=numpy)
        return self._pack(
            LawCode.BACKSTEPPING,
            (rate, 0.0 * rate),
            inertial_rate=self.inertial_rate,
            potential=self.potential.packed(numpy=numpy),
            damping=self.damping.packed(numpy=numpy),
        )


def _dot(x: Array, y: Array) -> Array:
    return array_namespace(x).sum(x * y, axis=-1)


def paper_controller(dynamics: DynamicsProvider, *, m: float = 0.001, seed: int = 0) -> NeuralBackstepping:
    """The paper's controller as its section V-A sets it up: S = I, Λ = I, ψ three 32-wide layers, D = TᵀT.

    Source: paper eqs. (9), (10); initial weights U(−0.1, 0.2) and U(−0.2, 0.2) as in docs/theory.md §8.
    """
    potential = Potential(np.eye(dynamics.nv), form="paper", seed=seed)
    return NeuralBackstepping(dynamics, potential, Damping(dynamics.nv, form="paper", m=m, seed=seed + 1))
