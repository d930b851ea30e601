"""The neural backstepping (NBS) law: tracking that is stable for every value of its network weights."""

import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from nbs_pin.base.arguments import BANDWIDTH, PERIOD, SEED, SHARE, a, checked, choice, maybe, number
from nbs_pin.base.arrays import Array, JointArray, Matrices, Vectors, as_vectors, finite_result
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.intervals import Interval
from nbs_pin.base.known_code import first_foreign, known_code
from nbs_pin.base.shown import spread
from nbs_pin.base.storable import Tensors, storable
from nbs_pin.base.tensors import positive_scale
from nbs_pin.controllers.damping import Damping
from nbs_pin.controllers.gain import Gain
from nbs_pin.controllers.gains import GAINS, Gains, gains_for_robot, warn_if_too_fast
from nbs_pin.controllers.lyapunov_law import Lyapunov, LyapunovLaw
from nbs_pin.controllers.part_claims import (
    check_kind,
    check_parts,
    damping_claims,
    friction_claims,
    potential_claims,
    rate_claims,
)
from nbs_pin.controllers.potential import POTENTIALS, Potential
from nbs_pin.dynamics.friction import FRICTION, JointFriction
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.dynamics.provider import MODEL, DynamicsProvider
from nbs_pin.kernels.layout import LawCode, Packed
from nbs_pin.robots.robot import ARM, Robot

DAMPINGS = ("inertial", "bounded", "paper")


def _stored(t: Tensors) -> Mapping[str, Any]:
    return {"rate": t["rate.nominal"], "least_share": float(t["rate.least_share"])}


@known_code
@storable(("inertial_rate",), parts=("dynamics", "friction", "potential", "damping"), arrays=_stored)
class NeuralBackstepping(LyapunovLaw):
    """τ = M(φ̇ − ωz2) + C(q, v)φ + G − ∇Φ(z1) − D(z2)z2 with φ = v_d − Λ∇Φ(z1), z1 = q ⊖ q_d, z2 = v − φ.

    With V = Φ + ½z2ᵀM z2:  V̇ = −∇ΦᵀΛ∇Φ − z2ᵀ(ωM + D)z2 + z2ᵀτ_d for all weights of Φ and D (docs/theory.md §2).
    `paper_controller` gives the paper's law, its eq. (9), with Λ = I, which has the wrong units, and ω = 0.

    Args:
        dynamics: Model of the arm that the law uses.
        potential: Φ.
        damping: D, without its ωM part.
        rate: Diagonal of Λ [rad/s per N·m], (nv,), positive; None is 1.
        inertial_rate: ω ≥ 0 [1/s].
        friction: Joint friction fed forward at φ, or None; monotone in v, it only adds dissipation.
        least_share: Training keeps Λ at or above this share of its initial value (`Gain`).

    Raises:
        ArgumentError: If the numbers of joints differ, or Λ or ω is out of range.
    """

    @checked(
        dynamics=MODEL,
        potential=a(Potential, "a Potential"),
        damping=a(Damping, "a Damping"),
        inertial_rate=number(least=0.0, unit="1/s"),
    )
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
        self.potential, self.damping = potential, damping
        self.inertial_rate = inertial_rate
        self.rate = Gain(positive_scale("the rate Λ", rate, nv), least_share=least_share, name="the rate Λ")

    @classmethod
    @checked(
        robot=ARM,
        dynamics=maybe(MODEL),
        bandwidth=BANDWIDTH,
        period=PERIOD,
        friction=maybe(FRICTION),
        potential=choice(*POTENTIALS),
        damping=choice(*DAMPINGS),
        gains=maybe(GAINS),
        damping_ceiling=maybe(number(above=0.0)),
        least_share=SHARE,
        seed=SEED,
    )
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
        damping_ceiling: float | None = 1.0,
        least_share: float = 0.5,
        seed: int = 0,
    ) -> "NeuralBackstepping":
        """A controller with gains from the arm's inertia, effort limits and control period, without tuning.

        Args:
            robot: The arm.
            dynamics: Model of the arm that the law uses; None takes Pinocchio's.
            bandwidth: ω [rad/s], the rate at which errors decay; warns if it is too fast for the effort limits.
            period: Control period h [s].
            potential: "smooth" or "paper".
            damping: "inertial" (ωM + D₀ + TᵀT), "bounded" (D₀ + TᵀT) or "paper" (TᵀT).
            friction: Joint friction to feed forward, or None.
            gains: K, Λ and D₀; None computes them (`gains_for_robot`).
            damping_ceiling: b, with TᵀT ≺ bD₀ for all weights of T and the initial D₀; None is without, as is "paper".
            least_share: Training keeps S, Λ and D₀ at or above this share of their initial values (`Gain`).
            seed: Seed of the initial network weights.

        Raises:
            ArgumentError: For an unknown name or a number out of range.

        Example:
            >>> import nbs_pin as nbs
            >>> law = nbs.NeuralBackstepping.for_robot(nbs.load_robot("panda"), bandwidth=8.0, period=0.001)
            >>> law.nv, law.inertial_rate
            (7, 8.0)
        """
        dynamics = PinocchioDynamics(robot) if dynamics is None else dynamics
        chosen = gains_for_robot(robot, dynamics, bandwidth=bandwidth, period=period) if gains is None else gains
        warn_if_too_fast(robot, dynamics, chosen.bandwidth)
        root = np.sqrt(chosen.stiffness)
        phi = Potential(np.diag(0.5 * chosen.stiffness), form=potential, scale=root, least_share=least_share, seed=seed)
        if damping == "paper":
            d = Damping(robot.nv, form="paper", m=1.0, scale=np.sqrt(chosen.damping), seed=seed + 1)
        else:
            d = Damping(
                robot.nv,
                floor=np.diag(chosen.damping),
                scale=np.sqrt(chosen.damping),
                ceiling=damping_ceiling,
                least_share=least_share,
                seed=seed + 1,
            )
        omega = chosen.bandwidth if damping == "inertial" else 0.0
        return cls(dynamics, phi, d, rate=chosen.rate, inertial_rate=omega, friction=friction, least_share=least_share)

    def torque(self, q: Array, v: Array, q_ref: Array, v_ref: Array, a_ref: Array) -> Vectors:
        """τ [N·m]; arguments (..., nv), numpy arrays or torch tensors (differentiable).

        Raises:
            ArgumentError: If shapes or array types do not match.

        Example:
            >>> import nbs_pin as nbs
            >>> law, zero = nbs.NeuralBackstepping.for_robot(nbs.load_robot("two_link")), [0.0, 0.0]
            >>> law.torque(zero, zero, [0.1, 0.1], zero, zero).round(1)
            array([141.8,  79.6])
        """
        q, v, q_ref, v_ref, a_ref = as_vectors(self.nv, q=q, v=v, q_ref=q_ref, v_ref=v_ref, a_ref=a_ref)
        e = self._errors(q, v, q_ref, v_ref, a_ref)
        feedforward = self.dynamics.reference_torque(q, v, e.v_r, e.a_r - self.inertial_rate * e.z2)
        tau = feedforward - e.gradient - self.damping.force(e.z2)
        tau = tau if self.friction is None else tau + self.friction.feedforward(e.v_r, tau)
        return finite_result("the torque", tau, q, v, q_ref, v_ref, a_ref)

    def _gains_told(self) -> Iterable[str]:
        stiffness, rate = 2.0 * np.diagonal(self.potential.stiffness.numpy()), self.rate.numpy()
        told = spread("Λ", rate, "rad/s per N·m"), spread("K", stiffness, "N·m/rad")
        return f"ω = {self.inertial_rate:.3g} rad/s", *told

    def potential_terms(self, z1: Array, dz: Array) -> tuple[Array, Array, Array]:
        """Φ(z1) [J], ∇Φ(z1) [N·m] and ∇²Φ(z1) dz of the potential network."""
        return self.potential.terms(z1, dz)

    def damping_force(self, z2: Array) -> Vectors:
        """D(z2)z2 [N·m] of the damping network."""
        return self.damping.force(z2)

    def damping_matrix(self, z2: Array) -> Matrices:
        """D(z2) [N·m·s/rad] of the damping network."""
        return self.damping.matrix(z2)

    def rate_like(self, x: Array) -> Float[Array, " n"]:
        """The diagonal of Λ [rad/s per N·m] with the array type of x."""
        return self.rate.like(x)

    def extra_stiffness(self, radius: float) -> Interval:
        """Bounds of ψ'' for one joint [N·m/rad]."""
        return self.potential.curvature(radius)

    def stiffness_range(self, radii: JointArray) -> tuple[Float[np.ndarray, "n n"], Float[np.ndarray, "n n"]]:
        """2S and bounds of ∇²ψ."""
        low, high = self.potential.curvature_range(radii)
        hessian = 2.0 * self.potential.stiffness.numpy()
        return hessian + low, hessian + high

    def damping_slope(self) -> float:
        """From the Lipschitz constants of the networks of T, which are zero at 0 if they have no biases."""
        return math.inf if self.damping.floor is None else self.damping.slope()

    def stiffness_rate(self, radii: JointArray, weights: JointArray) -> float:
        """That of ∇²ψ."""
        return self.potential.curvature_rate(radii, weights)

    def extra_damping(self, radius: float) -> Interval:
        """Bounds of T² for one joint [N·m·s/rad]."""
        return super().extra_damping(radius) if self.damping.floor is None else self.damping.excess(radius)

    def damping_share(self, radius: float) -> float:
        """`Damping.share`, below the ceiling if it has one; inf if D has no floor, or its code is not known."""
        d = self.damping
        foreign = first_foreign((d, d.diagonal, d.lower, d.floor))
        return super().damping_share(radius) if foreign else d.share(radius)

    def lyapunov(self) -> Lyapunov:
        """S, Λ, D₀ and ω, with claims for ψ, Φ, D, Λ, ω and the friction feed-forward."""
        phi, d, n = self.potential, self.damping, self.nv
        for name, part, kind in (("Φ", phi, Potential), ("D", d, Damping), ("Λ", self.rate, Gain)):
            check_kind(name, part, kind)
        check_kind("S", phi.stiffness, Gain)
        check_kind("D₀", d.floor, Gain | None)
        check_parts(n, {"Φ": phi.nv, "D": d.nv, "Λ": len(self.rate.nominal)}, self.friction)
        damping = damping_claims(d)
        claims = (*potential_claims(phi, self.rate), *damping, *rate_claims(self.rate, self.inertial_rate, n))
        claims += friction_claims(self.friction)
        floor = damping[0].value * np.eye(n) if d.floor is None else np.asarray(d.floor.numpy())
        stiffness, rate = np.asarray(phi.stiffness.numpy()), np.asarray(self.rate.numpy())
        return Lyapunov(stiffness, rate, floor, float(self.inertial_rate), self.coupling, claims)

    @property
    def _has_kernel(self) -> bool:
        return self.potential.is_packable and self.damping.is_packable

    def _packed(self, numpy: bool) -> Packed:
        rate = self.rate.value(numpy=numpy)
        parts = {"potential": self.potential.packed(numpy=numpy), "damping": self.damping.packed(numpy=numpy)}
        return self._pack(LawCode.BACKSTEPPING, (rate, 0.0 * rate), inertial_rate=self.inertial_rate, **parts)


@checked(dynamics=MODEL, m=number(above=0.0), seed=SEED)
def paper_controller(dynamics: DynamicsProvider, *, m: float = 0.001, seed: int = 0) -> NeuralBackstepping:
    """The paper's controller as set up in its section V-A: S = I, Λ = I, three layers of 32 in ψ, D = TᵀT.

    Source: paper eqs. (9), (10); initial weights U(−0.1, 0.2) and U(−0.2, 0.2) as in docs/theory.md §8.

    Example:
        >>> import nbs_pin as nbs
        >>> dynamics = nbs.AnalyticDynamics()  # the paper's arm
        >>> nbs.paper_controller(dynamics).torque([0.0, 0.0], [0.0, 0.0], *nbs.paper_reference(2)(0.0)).shape
        (2,)
    """
    potential = Potential(np.eye(dynamics.nv), form="paper", seed=seed)
    return NeuralBackstepping(dynamics, potential, Damping(dynamics.nv, form="paper", m=m, seed=seed + 1))


def paper_controller_for(
    robot: Robot, *, bandwidth: float = 8.0, period: float = 0.001, friction: JointFriction | None = None, seed: int = 0
) -> NeuralBackstepping:
    """`paper_controller` for the bundled two_link; for any other arm the paper's networks with `gains_for_robot`."""
    if robot.source == "two_link":
        return paper_controller(PinocchioDynamics(robot), seed=seed)
    return NeuralBackstepping.for_robot(
        robot, bandwidth=bandwidth, period=period, friction=friction, seed=seed, potential="paper", damping="paper"
    )
