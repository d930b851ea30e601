"""`certify`: bounds of the tracking error under bounded disturbances, for laws with a storage function."""

import math
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
from jaxtyping import Float

from nbs_pin.accuracy.mismatch import Mismatch
from nbs_pin.base.arrays import JointArray
from nbs_pin.base.checks import PerJoint, floats, positive
from nbs_pin.base.claims import Claim, Group, Label, weakest
from nbs_pin.base.exceptions import ArgumentError, CertificateRefused
from nbs_pin.certificates.admissible import Admissible
from nbs_pin.certificates.claims import Assumption, Condition
from nbs_pin.certificates.comparison_system import ComparisonSystem, Level, decay, level, reach
from nbs_pin.certificates.constants import Constants, constants_of
from nbs_pin.certificates.error_bounds import errors, radians
from nbs_pin.certificates.margins import effort_margin, position_margin, sampled_control, units
from nbs_pin.certificates.model_error import ModelError, model_error
from nbs_pin.certificates.model_structure import is_exact
from nbs_pin.controllers.controller import Controller
from nbs_pin.controllers.lyapunov_law import LyapunovLaw
from nbs_pin.motions.references import DesiredMotion
from nbs_pin.robots.robot import Robot

_NO_ERROR = ModelError(0.0, 0.0, 0.0, (), ())
_UNBOUNDED = "taken as 0, but nothing bounds it: give mismatch=compare(…).mismatch, or --against ARM"
_UNKNOWN = Claim("error of the model", math.inf, "N·m", Label.EMPIRICAL, _UNBOUNDED, Group.MODEL_ERROR)
_UNKNOWN_ERROR = ModelError(0.0, 0.0, 0.0, (_UNKNOWN,), ())
_PRINTED = "printed ‖z1‖"
_FALSE = "as printed in Theorem 3 of the paper: true for constant torques, false for others (docs/theory.md §5)"
_TRUE = "as printed in Theorem 3 of the paper: here no tighter than the proved bound"


@dataclass(frozen=True, eq=False)
class Certificate:
    """Bounds of the closed loop of a `LyapunovLaw`, each labelled by how it is known (docs/certificates.md).

    They hold for every admissible disturbance and every reference, under `assumptions`.
    """

    controller: LyapunovLaw
    admissible: Admissible
    rate: float
    """Without disturbance, errors decay at least like e^{−rate·t}, and V like e^{−2 rate·t} [1/s]."""
    level: Level
    """c and V∞ of V(t) ≤ e^{−ct}V(0) + V∞ under disturbances."""
    potential: float
    """Φ∞ [J]: Φ(z1) ≤ max(V(0), Φ∞) at all times, and ≤ Φ∞ in the limit."""
    error: float
    """Bound of ‖z1‖ [rad], at all times from z1 = z2 = 0, and in the limit from any other start."""
    joint_errors: JointArray
    """The same for each |z1_i| [rad]."""
    printed_error: float
    """Bound of ‖z1‖ by the paper's Theorem 3 as printed [rad]; false for torques that vary (docs/theory.md §5)."""
    label: Label
    """How the bounds are known."""
    lines: tuple[Claim, ...]
    """Every constant and every bound, with its label and reason."""
    conditions: tuple[Condition, ...]
    """The conditions of the theorems, with the numbers of both sides."""
    assumptions: tuple[str, ...]
    """What the bounds assume besides the conditions, mostly in the words of `Assumption`."""
    stiffness: Float[np.ndarray, "n n"]
    """S at the time of certification [J/rad²]; training the controller changes its own."""
    robot: Robot | None = None
    """The true arm; None if none is known."""
    mismatch: Mismatch | None = None
    """The model error that the bounds include."""
    overshoot: tuple[float, JointArray] | None = None
    """Bounds of ‖z1‖ and each |z1_i| at all times from the given start [rad]."""

    @property
    def void(self) -> tuple[str, ...]:
        """Conditions that the bounds rest on and that do not hold; `label` is then EMPIRICAL."""
        return tuple(condition.name for condition in self.conditions if condition.assumed and not condition.holds)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints."""
        n = self.controller.nv
        return tuple(f"joint {i + 1}" for i in range(n)) if self.robot is None else self.robot.joint_names

    @property
    def joint_units(self) -> tuple[str, ...]:
        """Unit of the error of each joint: rad, or m for a prismatic joint."""
        return units(self.robot, self.controller.nv)

    @property
    def storage(self) -> float:
        """V∞ [J]."""
        return self.level.storage

    def storage_bound(self, t: Float[np.ndarray, "*rows"], initial: float) -> Float[np.ndarray, "*rows"]:
        """Bound of V(t) from V(0) = `initial` [J]: the lesser of e^{−ct}V(0) + V∞ and max(V(0), V∞), t in [s]."""
        return np.minimum(initial * np.exp(-self.level.c * t) + self.storage, max(initial, self.storage))

    def from_start(self, initial: float) -> tuple[float, JointArray]:
        """Bounds of ‖z1‖ and each |z1_i| at all times [rad] from V(0) = `initial` [J], as Φ ≤ max(V(0), Φ∞)."""
        if initial <= 0.0:
            return self.error, self.joint_errors
        return radians(self.stiffness, max(initial, self.potential))

    def summary(self) -> dict[str, Any]:
        """The certificate as JSON can store it."""
        return {
            "disturbance": str(self.admissible),
            "rate_per_s": self.rate,
            "error_rad": self.error,
            "joint_errors_rad": self.joint_errors.tolist(),
            "printed_error_rad": self.printed_error,
            "overshoot_rad": None if self.overshoot is None else self.overshoot[0],
            "joint_overshoots_rad": None if self.overshoot is None else self.overshoot[1].tolist(),
            "joints": list(self.joint_names),
            "units": list(self.joint_units),
            "label": str(self.label),
            "void": list(self.void),
            "lines": [line.plain() for line in self.lines],
            "conditions": [condition.plain() for condition in self.conditions],
            "assumptions": list(self.assumptions),
        }


def certify(
    controller: Controller,
    disturbance: PerJoint | Admissible,
    *,
    reference: DesiredMotion | None = None,
    duration: float = 10.0,
    q0: Any = None,
    v0: Any = None,
    mismatch: Mismatch | None = None,
    period: float | None = None,
    robot: Robot | None = None,
) -> Certificate:
    """Bound the tracking error of the closed loop under a bounded disturbance (docs/certificates.md).

    Args:
        controller: A law with a storage function (`LyapunovLaw`).
        disturbance: One bound per joint on |τ_d,i|, one number that bounds ‖τ_d‖ [N·m], or an `Admissible`.
        reference: The motion, for the arm's limits, a start and a model error. All other bounds hold for any motion.
        duration: Length of the reference that is used [s].
        q0: Start from which the overshoot is bounded [rad]. Needs the reference.
        v0: Velocity at the start [rad/s]. None starts at rest.
        mismatch: Error δ of a learned model along closed loops (`compare(…).mismatch`). Needs the reference.
        period: Control period to compare with the rule of sampled control [s].
        robot: The true arm. None takes the model's.

    Raises:
        CertificateRefused: If law, model or reference do not admit a bound.
        ArgumentError: If arguments do not fit each other.

    Example:
        >>> import nbs_pin as nbs
        >>> certificate = nbs.certify(nbs.NeuralBackstepping.for_robot(nbs.load_robot("two_link")), [5.0, 5.0])
        >>> print(f"{certificate.label}: ‖z1‖ ≤ {certificate.error:.2f} rad")
        PROVED: ‖z1‖ ≤ 0.02 rad
    """
    constants = constants_of(controller)
    law = cast(LyapunovLaw, controller)  # any other was refused
    arm = law.dynamics.robot if robot is None else robot
    admissible = Admissible.of(disturbance, law.nv)
    start = _check_arguments(law, arm, reference, duration, q0, v0, mismatch, period)
    error = _NO_ERROR
    if mismatch is not None and reference is not None:
        error = model_error(constants, mismatch, reference, duration)
    elif not is_exact(law.dynamics, arm):
        error = _UNKNOWN_ERROR
    comparison = _comparison(constants, admissible, error)
    least = level(comparison)
    if not math.isfinite(least.storage):
        raise CertificateRefused(_why_not(comparison))
    potential = reach(comparison, least.storage)
    size, joints, source = errors(law, constants, comparison, least.storage, potential)
    rate, printed = 0.5 * decay(comparison), math.sqrt(constants.largest_rate) * comparison.t / (2.0 * constants.rho)
    margins, sampled = sampled_control(law, period)
    decays = Condition("Theorem 1: min(ρ, ω + κ) > 0", rate, 0.0, "1/s", constants.label, "docs/certificates.md §2")
    certificate = Certificate(
        controller=law,
        admissible=admissible,
        rate=rate,
        level=least,
        potential=potential,
        error=size,
        joint_errors=joints,
        printed_error=printed,
        label=weakest(constants.label, *(line.label for line in error.lines)),
        lines=(*constants.lines, *error.lines, *margins),
        conditions=(decays, *error.conditions, *sampled),
        assumptions=_assumptions(arm, mismatch),
        stiffness=constants.stiffness,
        robot=arm,
        mismatch=mismatch,
    )
    return _with_bounds(_along(certificate, reference, duration, start), source)


def _check_arguments(
    law: LyapunovLaw,
    robot: Robot | None,
    reference: DesiredMotion | None,
    duration: float,
    q0: Any,
    v0: Any,
    mismatch: Mismatch | None,
    period: float | None,
) -> tuple[JointArray, JointArray] | None:
    """The start (q, v), None without one."""
    positive("duration", duration, "s")
    if period is not None:
        positive("period", period, "s")
    if robot is not None and robot.nv != law.nv:
        raise ArgumentError(f"the controller has {law.nv} joints and {robot.name} {robot.nv}; give its own arm.")
    if reference is not None and not callable(reference):
        raise ArgumentError(f"reference is {reference!s:.100}, expected a motion such as nbs.Sinusoid; correct it.")
    if reference is None and (mismatch is not None or q0 is not None or v0 is not None):
        raise ArgumentError("q0, v0 and mismatch refer to a motion; give the reference too.")
    if q0 is None and v0 is not None:
        raise ArgumentError("v0 was given without q0; give both, or q0 alone for a start at rest.")
    if q0 is None:
        return None
    start = floats("q0", q0), np.zeros(law.nv) if v0 is None else floats("v0", v0)
    for name, x in zip(("q0", "v0"), start, strict=True):
        if x.shape != (law.nv,) or not np.isfinite(x).all():
            raise ArgumentError(f"{name} is {x!s:.200}, expected {law.nv} finite numbers, one per joint; correct it.")
    return start


def _comparison(constants: Constants, admissible: Admissible, error: ModelError) -> ComparisonSystem:
    return ComparisonSystem(
        rho=constants.rho,
        delta=constants.delta,
        kappa=constants.kappa,
        nu=constants.nu,
        omega=constants.omega,
        t=math.sqrt(admissible.energy(constants.metric)) + error.t,
        alpha=error.alpha,
        beta=error.beta,
        coupling=constants.coupling,
    )


def _why_not(k: ComparisonSystem) -> str:
    if not k.is_dissipative:
        return (
            f"Theorem 4 requires 1 − β > α²/4 and the model's error gives 1 − β = {1.0 - k.beta:.3g} and α²/4 = "
            f"{0.25 * k.alpha**2:.3g}; learn a better model or take a larger D₀."
        )
    return (
        f"no bound follows from ρ = {k.rho:.3g}, ω = {k.omega:.3g} and κ = {k.kappa:.3g} 1/s: D must dominate M, "
        "which an inertial rate ω > 0 ensures for every arm; take damping='inertial'."
    )


def _along(
    certificate: Certificate,
    reference: DesiredMotion | None,
    duration: float,
    start: tuple[JointArray, JointArray] | None,
) -> Certificate:
    """The certificate with the overshoot from a start and the conditions that follow from the arm's limits."""
    law, robot, joints = certificate.controller, certificate.robot, certificate.joint_errors
    overshoot, lines = None, certificate.lines
    if start is not None and reference is not None:
        begin = reference(np.zeros(1))
        initial = float(law.storage(*start, begin.q[0], begin.v[0]))
        overshoot = certificate.from_start(initial)
        joints = np.maximum(joints, overshoot[1])
        because = "storage function at the start"
        lines = (*lines, Claim("V(0) of the start", initial, "J", certificate.label, because, Group.BOUNDS))
    conditions = [*certificate.conditions, *_no_wrap(robot, joints, certificate.label)]
    if reference is not None and robot is not None:
        conditions += effort_margin(robot, law.dynamics, certificate.admissible, reference, duration)
        conditions += position_margin(robot, joints, reference, duration)
    certificate = replace(certificate, conditions=tuple(conditions), lines=lines, overshoot=overshoot)
    return replace(certificate, label=Label.EMPIRICAL) if certificate.void else certificate


def _with_bounds(certificate: Certificate, source: str) -> Certificate:
    """The certificate with a claim for each bound."""
    label, here = certificate.label, "docs/certificates.md §2"
    harmless = certificate.printed_error >= certificate.error * (1.0 - 1e-6)
    nothing = "disturbance" if certificate.mismatch is None else "disturbance and constant model error"
    joints = zip(certificate.joint_names, certificate.joint_errors.tolist(), certificate.joint_units, strict=True)
    whole = "rad" if set(certificate.joint_units) == {"rad"} else "rad, m"
    lines = [
        Claim("‖z1‖", certificate.error, whole, label, source, Group.BOUNDS),
        *(Claim(f"|z1| of {name}", x, unit, label, source, Group.BOUNDS) for name, x, unit in joints),
        Claim(_PRINTED, certificate.printed_error, whole, Label.EMPIRICAL, _TRUE if harmless else _FALSE, Group.BOUNDS),
        Claim(f"rate of decay without {nothing}", certificate.rate, "1/s", label, here, Group.BOUNDS),
        Claim("c of V(t) ≤ e^{−ct}V(0) + V∞", certificate.level.c, "1/s", label, here, Group.BOUNDS),
        Claim("V∞", certificate.storage, "J", label, here, Group.BOUNDS),
        Claim("Φ∞", certificate.potential, "J", label, "docs/certificates.md §3", Group.BOUNDS),
    ]
    if certificate.overshoot is not None:
        because = "Φ never exceeds max(V(0), Φ∞), docs/certificates.md §3"
        lines.insert(1, Claim("‖z1‖ from the start", certificate.overshoot[0], whole, label, because, Group.BOUNDS))
    return replace(certificate, lines=(*lines, *certificate.lines))


def _no_wrap(robot: Robot | None, joints: JointArray, label: Label) -> tuple[Condition, ...]:
    if robot is None or not robot.continuous.any():
        return ()
    largest = float(joints[robot.continuous].max())
    name = "π > |z1_i| of every continuous joint"
    return (Condition(name, math.pi, largest, "rad", label, "its error jumps at ±π (docs/theory.md §1)"),)


def _assumptions(robot: Robot | None, mismatch: Mismatch | None) -> tuple[str, ...]:
    model = str(Assumption.MODEL)
    if mismatch is not None:
        model = (
            f"the model error is bounded as on {mismatch.trajectories} closed loops of {mismatch.t[-1]:.3g} s, which a "
            f"further one, drawn alike, exceeds with a chance of at most {mismatch.violation:.2g} at a confidence of "
            f"1 − {mismatch.doubt:g}"
        )
    wraps = [Assumption.WRAP] if robot is not None and robot.continuous.any() else []
    others = (Assumption.REFERENCE, Assumption.FRICTION, Assumption.STOPS, Assumption.EFFORT, *wraps, Assumption.TIME)
    return (model, *(str(assumption) for assumption in others))
