"""Design of gains and control period that certify a wanted error under a given disturbance.

For the inertia-shaped law with K = s²K̂, D₀ = sD̂₀ and ω = sω̂, every constant of the proof scales with the speed s: V∞
and Φ∞ scale with s⁻², hence the errors √(2Φ∞/K_i) with s⁻². So one bound per shape (K̂, D̂₀, ω̂) gives the slowest loop
of that shape that certifies the wanted error (docs/certificates.md §10).
"""

import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import product

import numpy as np

from nbs_pin.base.arguments import DURATION, PERIOD, SEED, checked, many, maybe
from nbs_pin.base.arrays import JointArray
from nbs_pin.base.checks import PerJoint, floats, told
from nbs_pin.base.exceptions import ArgumentError, CertificateRefused
from nbs_pin.base.shown import Shown
from nbs_pin.base.units import measured, percent, several, units
from nbs_pin.certificates.admissible import Admissible
from nbs_pin.certificates.certify import certify
from nbs_pin.certificates.comparison_system import ComparisonSystem, level, reach
from nbs_pin.certificates.margins import STIFF, sampled_control
from nbs_pin.certificates.sampled_motion import SampledMotion
from nbs_pin.controllers.gains import Gains, effective_inertia, largest_inertia
from nbs_pin.controllers.neural_backstepping import NeuralBackstepping
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.dynamics.provider import MODEL, DynamicsProvider
from nbs_pin.motions.references import MOTION, DesiredMotion, Sinusoid
from nbs_pin.robots.robot import ARM, Robot

PERIODS = (0.01, 0.005, 0.002, 0.001, 0.0005, 0.00025)
"""Default control periods to choose from, the longest first [s]."""
FAST = 0.25
"""Largest ωh at which sampled loops without delay stay calm (measured, docs/theory.md §2)."""
_ALIKE = (0.0, 0.5, 1.0)
"""Exponents of M_e in K̂: 0 shapes the stiffness by the wanted errors, 1 gives all joints the same frequency."""
_SLOWNESS = (1.0, 1.6, 2.5, 4.0)
"""√(K/M_e) of the lightest joint in units of ω."""
_DAMPING = (0.5, 0.7, 1.0)
"""ζ of D₀ = 2ζ√(K M_e)."""
_TRIES = 4
"""How often a design is made faster because held torques enlarge its errors."""
_SPARE = 1.0 - 1e-6
"""Share of the wanted error that the design aims at, to leave room for the rounding of its certificate."""


@dataclass(frozen=True, eq=False, repr=False)
class Proposal(Shown):
    """An inertia-shaped law that certifies the wanted error; made by `propose`, with its example."""

    gains: Gains
    """ω, K = 2S and D₀; their `rate` is Λ = ωK⁻¹."""
    period: float
    """The longest control period found for it [s]."""
    controller: NeuralBackstepping
    """The law with these gains and untrained networks; the bound holds for all their weights."""
    error: float
    """Bound of ‖z1‖ [rad]; `certify` gives at most this."""
    joint_errors: JointArray
    """Bound of every |z1_i| [rad]."""
    torque: JointArray
    """|τ_ref| + disturbance + K_i·(bound of |z1_i|), per joint [N·m]."""
    share: float
    """Largest ratio of `torque` to the effort limit; 0 without limits."""
    stiff: float
    """Largest √(K_i/M_e,i)·h, at most `STIFF`."""
    fast: float
    """ωh, at most `FAST`."""

    def _facts(self) -> Iterable[str]:
        robot = self.controller.dynamics.robot
        unit = "rad" if robot is None else several(units("position", robot.prismatic))
        error, rate = f"‖z1‖ ≤ {measured(self.error, unit)}", f"ω = {self.gains.bandwidth:.3g} rad/s"
        return error, rate, f"period {1e3 * self.period:.4g} ms", f"{percent(self.share)} of a torque limit"


@checked(
    robot=ARM,
    reference=maybe(MOTION),
    duration=DURATION,
    periods=many(PERIOD, 1, 1000, "control periods [s]"),
    dynamics=maybe(MODEL),
    seed=SEED,
)
def propose(
    robot: Robot,
    disturbance: PerJoint | Admissible,
    error: PerJoint,
    *,
    reference: DesiredMotion | None = None,
    duration: float = 10.0,
    periods: Sequence[float] = PERIODS,
    dynamics: DynamicsProvider | None = None,
    seed: int = 0,
) -> Proposal:
    """Choose S, Λ, D₀ and the control period to certify a wanted error within the arm's effort limits.

    The longest feasible period is taken, then the law with the least torque (K_i + ωD₀,i + ω²M_ii)·|z1_i| at its error
    bounds. The limits must exceed the torque of reference, disturbance and stiffness, K_i·|z1_i|, at the bounds. This
    is a margin, not a proof that no joint saturates, and the same for every wanted error: stiffer laws err less.

    Args:
        robot: The arm.
        disturbance: As in `certify`.
        error: Wanted bound of ‖z1‖, or of |z1_i| per joint [rad].
        reference: The motion whose torque the limits must allow as well. None takes `Sinusoid.for_robot`.
        duration: Length of the reference that is used [s].
        periods: Control periods to choose from [s].
        dynamics: The exact model of the arm. None takes Pinocchio's.
        seed: Seed of the network weights.

    Raises:
        ArgumentError: If no design is feasible (the message names the limiting joint or period) or an argument invalid.

    Example:
        >>> import nbs_pin as nbs
        >>> design = nbs.propose(nbs.load_robot("two_link"), [5.0, 5.0], 0.05)
        >>> design.period, design.error <= 0.05
        (0.01, True)
    """
    if dynamics is not None and dynamics.nv != robot.nv:
        raise ArgumentError(
            f"dynamics is a {type(dynamics).__name__} of {dynamics.nv} joints, expected a model of the {robot.nv} "
            f"joints of {robot.name}; leave it out for Pinocchio's."
        )
    admissible = Admissible.of(disturbance, robot.nv)
    wanted = _wanted(error, robot.nv)
    choice = sorted(periods, reverse=True)
    motion = Sinusoid.for_robot(robot) if reference is None else reference
    arm = _Arm.of(robot, dynamics, admissible, motion, duration)
    _check_limits(robot, arm)
    candidates = [c for shape in _shapes(arm, wanted) if (c := _scaled(shape, admissible, wanted))]
    light = [c for c in candidates if c.share(arm, robot) <= 1.0]
    if not light:
        raise ArgumentError(_too_weak(robot, arm, candidates, admissible))
    light.sort(key=lambda c: c.answer(arm, robot))
    allowed = cache(lambda c: _longest_period(c, arm, robot, dynamics, seed))  # of few: the first calm one may do
    why = ""
    for period in choice:
        for best in (c for c in light if c.longest(arm) > period and allowed(c) > period):
            found = _designed(best, period, arm, robot, dynamics, seed, (admissible, wanted, motion, duration))
            if isinstance(found, Proposal):
                return found
            why = found
    if why:
        raise ArgumentError(
            f"no design passes its own certificate: {why}; give a gentler motion, or want a larger error."
        )
    raise ArgumentError(
        f"a control period of {1e3 * choice[-1]:g} ms forbids it: the sampled loop might not stay calm; take a period"
        f" of at most {0.9995e3 * max(map(allowed, light)):.3g} ms, or want a larger error."
    )


@dataclass(frozen=True, eq=False)
class _Arm:
    """Data of the arm that a design needs, (n,) each."""

    effective: np.ndarray
    """M_e [kg·m²]."""
    largest: np.ndarray
    """max M_ii [kg·m²]."""
    reference_torque: np.ndarray
    """Peak |τ| of the reference [N·m]."""
    disturbance: np.ndarray
    """Largest |τ_d,i| [N·m]."""

    @classmethod
    def of(
        cls,
        robot: Robot,
        dynamics: DynamicsProvider | None,
        admissible: Admissible,
        reference: DesiredMotion,
        duration: float,
    ) -> "_Arm":
        model = PinocchioDynamics(robot) if dynamics is None else dynamics
        desired = SampledMotion.of(reference, robot.nv, duration)
        tau = model.reference_torque(desired.q, desired.v, desired.v, desired.a)
        peak = np.full(robot.nv, admissible.radius) if admissible.box is None else admissible.box
        return cls(
            effective_inertia(robot, model), largest_inertia(robot, model), np.abs(tau).max(axis=0), peak.astype(float)
        )


@dataclass(frozen=True, eq=False)
class _Candidate:
    """Gains that certify the error at the least speed of their shape."""

    gains: Gains
    storage: float
    """V∞ [J]."""
    potential: float
    """Φ∞ [J]."""

    @property
    def joint_errors(self) -> np.ndarray:
        return np.sqrt(2.0 * self.potential / self.gains.stiffness)

    def faster(self, factor: float) -> "_Candidate":
        """The same shape with errors smaller by this factor."""
        g, s = self.gains, float(np.sqrt(factor))
        gains = Gains(s * g.bandwidth, factor * g.stiffness, s * g.damping)
        return _Candidate(gains, self.storage / factor, self.potential / factor)

    def controller(
        self, robot: Robot, dynamics: DynamicsProvider | None, period: float, seed: int
    ) -> NeuralBackstepping:
        friction = JointFriction.of(robot) if robot.damping.any() or robot.friction.any() else None
        return NeuralBackstepping.for_robot(
            robot, dynamics, period=period, gains=self.gains, friction=friction, seed=seed
        )

    def stiff(self, arm: _Arm, period: float) -> float:
        return float(np.sqrt(self.gains.stiffness / arm.effective).max()) * period

    def longest(self, arm: _Arm) -> float:
        """The control period that it cannot exceed, whatever its networks are [s]."""
        return min(STIFF / self.stiff(arm, 1.0), FAST / self.gains.bandwidth)

    def torque(self, arm: _Arm) -> np.ndarray:
        return arm.reference_torque + arm.disturbance + self.gains.stiffness * self.joint_errors

    def answer(self, arm: _Arm, robot: Robot) -> float:
        """Largest torque of the law at rest at its error bounds, as a share of the limits if every joint has one."""
        omega, limits = self.gains.bandwidth, robot.effort_limit
        total = self.gains.stiffness + omega * self.gains.damping + omega**2 * arm.largest
        return float((total * self.joint_errors / (limits if np.isfinite(limits).all() else 1.0)).max())

    def share(self, arm: _Arm, robot: Robot) -> float:
        return float((self.torque(arm) / robot.effort_limit).max())


def _shapes(arm: _Arm, wanted: np.ndarray) -> Iterator[Gains]:
    """Shapes of gains, with ω̂ = 1."""
    need = 1.0 / wanted**2
    for exponent, slowness, damping in product(_ALIKE, _SLOWNESS, _DAMPING):
        stiffness = need ** (1.0 - exponent) * arm.effective**exponent
        stiffness *= slowness**2 / (stiffness / arm.effective).max()
        yield Gains(1.0, stiffness, 2.0 * damping * np.sqrt(stiffness * arm.effective))


def _scaled(shape: Gains, admissible: Admissible, wanted: np.ndarray) -> "_Candidate | None":
    """The shape at the least speed that certifies the error; None without a disturbance."""
    storage, unit = _levels(shape, admissible)
    errors = np.sqrt(2.0 * unit / shape.stiffness)
    missing = float((errors / wanted).max())
    s = np.sqrt(missing / _SPARE)
    gains = Gains(float(s), s**2 * shape.stiffness, s * shape.damping)
    return _Candidate(gains, storage / s**2, unit / s**2) if s > 0.0 else None


def _longest_period(
    candidate: _Candidate, arm: _Arm, robot: Robot, dynamics: DynamicsProvider | None, seed: int
) -> float:
    """The longest control period [s] at which √(K/M)h, ωh and the rule of `certify` stay within their limits."""
    longest = candidate.longest(arm)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of a candidate that may not be chosen
        controller = candidate.controller(robot, dynamics, longest, seed)
    hold, stiff = sampled_control(controller, longest, candidate.storage, candidate.potential)[1]
    return min(longest, hold.left, longest * STIFF / stiff.right)


def _levels(gains: Gains, admissible: Admissible) -> tuple[float, float]:
    """V∞ and Φ∞ [J] of the inertia-shaped law, whatever M is: ρ = ω because ΛK = ωI."""
    omega = gains.bandwidth
    delta = float((omega * gains.damping / gains.stiffness).min())
    t = float(np.sqrt(admissible.energy(np.diag(1.0 / gains.damping))))
    comparison = ComparisonSystem(rho=omega, delta=delta, kappa=0.0, nu=np.inf, omega=omega, t=t)
    storage = level(comparison).storage
    return storage, reach(comparison, storage)


def _proposal(
    robot: Robot, arm: _Arm, best: _Candidate, period: float, dynamics: DynamicsProvider | None, seed: int
) -> Proposal:
    return Proposal(
        gains=best.gains,
        period=period,
        controller=best.controller(robot, dynamics, period, seed),
        error=float(np.sqrt(2.0 * best.potential / best.gains.stiffness.min())),
        joint_errors=best.joint_errors,
        torque=best.torque(arm),
        share=best.share(arm, robot),
        stiff=best.stiff(arm, period),
        fast=best.gains.bandwidth * period,
    )


def _wanted(error: PerJoint, nv: int) -> np.ndarray:
    """The wanted error of every joint [rad]."""
    wanted = floats("the wanted error", error)
    if wanted.shape not in ((), (nv,)) or not ((wanted >= 1e-9).all() and (wanted <= 1e3).all()):
        raise ArgumentError(
            f"the wanted error is {told(error)}; give one number > 0, or {nv}, one per joint, from 1e-9 to 1000 "
            "[rad, m where it slides]."
        )
    return np.full(nv, wanted)


def _check_limits(robot: Robot, arm: _Arm) -> None:
    """Raises ArgumentError if a joint cannot even supply the torque of reference and disturbance."""
    spare = robot.effort_limit - arm.reference_torque - arm.disturbance
    i = int(np.argmin(spare))
    if spare[i] <= 0.0:
        unit = units("torque", robot.prismatic)[i]
        raise ArgumentError(
            f"joint '{robot.joint_names[i]}' of {robot.name} gives {robot.effort_limit[i]:g} {unit}, and reference and"
            f" disturbance alone take {arm.reference_torque[i]:.3g} + {arm.disturbance[i]:.3g} {unit}; no gains can"
            " help: give a gentler motion, less load or a stronger drive."
        )


def _designed(
    best: _Candidate,
    period: float,
    arm: _Arm,
    robot: Robot,
    dynamics: DynamicsProvider | None,
    seed: int,
    goal: tuple[Admissible, np.ndarray, DesiredMotion, float],
) -> Proposal | str:
    """The proposal that its own certificate confirms, made faster if held torques need it; or why there is none."""
    admissible, wanted, reference, duration = goal
    for _ in range(_TRIES):
        found = _proposal(robot, arm, best, period, dynamics, seed)
        try:
            certificate = certify(found.controller, admissible, reference=reference, duration=duration, period=period)
        except CertificateRefused as error:
            return str(error).rstrip(".")
        if certificate.void:
            return "; ".join(certificate.void)
        excess = float((certificate.joint_errors / wanted).max())
        is_held = certificate.held is not None and certificate.held.is_proved
        if excess <= 1.0 + 1e-6:
            return replace(found, error=certificate.error, joint_errors=certificate.joint_errors) if is_held else found
        if not is_held:
            return "friction enlarges its errors"
        best = best.faster(1.02 * excess)
        if _longest_period(best, arm, robot, dynamics, seed) <= period:
            break
    return "held torques enlarge its errors"


def _too_weak(robot: Robot, arm: _Arm, candidates: "list[_Candidate]", admissible: Admissible) -> str:
    """Why no candidate stays within the effort limits, in one sentence."""
    if not candidates:
        return f"{admissible} does not determine the gains; give a disturbance above 0."
    best = min(candidates, key=lambda c: c.share(arm, robot))
    i = int(np.argmax(best.torque(arm) / robot.effort_limit))
    unit = units("torque", robot.prismatic)[i]
    return (
        f"the torque limit of joint '{robot.joint_names[i]}' of {robot.name} forbids it: reference, disturbance and"
        f" the stiffness at its error bound take {best.torque(arm)[i]:.3g} {unit}, whatever the wanted error, and it"
        f" gives {robot.effort_limit[i]:g}; take a gentler motion, less load or a stronger drive."
    )
