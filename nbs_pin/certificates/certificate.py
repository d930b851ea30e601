"""`certify`: what an NBS law promises under disturbances, before the arm moves."""

import math
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
from jaxtyping import Float

from nbs_pin.certificates import one_joint
from nbs_pin.certificates.admissible import Admissible
from nbs_pin.certificates.claims import Claim, Condition, Label, weakest
from nbs_pin.certificates.comparison import Comparison, Level, decay, level, reach
from nbs_pin.certificates.constants import Constants, constants_of
from nbs_pin.certificates.learned import ModelError, model_error
from nbs_pin.certificates.margins import headroom, sampled_control
from nbs_pin.certificates.rounding import least_eigenvalue
from nbs_pin.checks import PerJoint, positive
from nbs_pin.controllers.controller import Controller
from nbs_pin.controllers.neural_backstepping import NeuralBackstepping
from nbs_pin.dynamics.analytic import AnalyticDynamics
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.exceptions import ArgumentError, CertificateRefused
from nbs_pin.mismatch import Mismatch
from nbs_pin.references import DesiredMotion

_EXACT = (PinocchioDynamics, AnalyticDynamics)
_NO_ERROR = ModelError(0.0, 0.0, 0.0, (), ())
_FALSE = "what Theorem 3 of the paper prints: true for constant torques, false for others (docs/theory.md §5)"
_TRUE = "what Theorem 3 of the paper prints: here no tighter than what is proved"


@dataclass(frozen=True, eq=False)
class Certificate:
    """Bounds of the closed loop of an NBS law, each with the way it is known (docs/certificates.md).

    They hold for every admissible disturbance and every reference, under `assumptions`.
    """

    controller: NeuralBackstepping
    admissible: Admissible
    rate: float
    """Without disturbance errors decay at least like e^{−rate·t} and V like e^{−2 rate·t} [1/s]."""
    level: Level
    """Under disturbances V(t) ≤ e^{−ct}V(0) + V∞."""
    potential: float
    """Φ∞ [J]: Φ(z1) ≤ Φ∞ at all times from z1 = z2 = 0, and in the limit from anywhere."""
    error: float
    """Bound of ‖z1‖ [rad], at all times from z1 = z2 = 0, and in the limit from anywhere."""
    joint_errors: Float[np.ndarray, " n"]
    """The same of each |z1_i| [rad]."""
    printed_error: float
    """What the paper's Theorem 3 would print for ‖z1‖ [rad]; false for torques that vary (docs/theory.md §5)."""
    label: Label
    """How the bounds are known."""
    lines: tuple[Claim, ...]
    """Every constant and every bound."""
    conditions: tuple[Condition, ...]
    """What the theorems ask for, with both sides' numbers."""
    assumptions: tuple[str, ...]
    """What the bounds assume beside the conditions."""

    @property
    def storage(self) -> float:
        """V∞ [J]."""
        return self.level.storage

    def storage_bound(self, t: Float[np.ndarray, "*rows"], initial: float) -> Float[np.ndarray, "*rows"]:
        """What V(t) never exceeds from V(0) = `initial` [J]: e^{−ct}V(0) + V∞, nor max(V(0), V∞). t [s]."""
        return np.minimum(initial * np.exp(-self.level.c * t) + self.storage, max(initial, self.storage))

    def from_start(self, initial: float) -> tuple[float, Float[np.ndarray, " n"]]:
        """Bounds of ‖z1‖ and of each |z1_i| at all times from V(0) = `initial` [J]: the overshoot [rad]."""
        if initial <= 0.0:
            return self.error, self.joint_errors
        return _radians(self.controller, max(initial, self.storage))

    def summary(self) -> dict[str, Any]:
        """Everything that a reader is shown, as JSON can store it."""
        return {
            "disturbance": str(self.admissible),
            "rate_per_s": self.rate,
            "error_rad": self.error,
            "joint_errors_rad": self.joint_errors.tolist(),
            "printed_error_rad": self.printed_error,
            "label": str(self.label),
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
    q0: Float[np.ndarray, " n"] | None = None,
    v0: Float[np.ndarray, " n"] | None = None,
    mismatch: Mismatch | None = None,
    period: float | None = None,
) -> Certificate:
    """How far the arm can stray from its reference under a bounded disturbance, and why that is so.

    disturbance: one bound per joint on |τ_d,i|, or one number, the bound on ‖τ_d‖ [N·m]; or an `Admissible`.
    reference: the motion over `duration` [s], for what depends on it: its torque, a start, the error of a model.
    q0, v0: a start [rad], [rad/s] (at rest without v0), for the overshoot from there; needs the reference.
    mismatch: δ of a learned model along closed loops (`compare(…).mismatch`), for Theorem 4; needs the reference.
    period: control period [s], held against the rule of sampled control.
    Raises CertificateRefused when law or model give no ground for a bound, ArgumentError for arguments that do not fit.
    """
    constants = constants_of(controller)
    controller = cast(NeuralBackstepping, controller)  # any other law was refused
    admissible = Admissible.of(disturbance, controller.nv)
    _check_arguments(reference, duration, q0, v0, mismatch, period)
    error = _NO_ERROR
    if mismatch is not None and reference is not None:
        error = model_error(constants, mismatch, reference, duration)
    comparison = _comparison(constants, admissible, error)
    least = level(comparison)
    if not math.isfinite(least.storage):
        raise CertificateRefused(_why_not(comparison))
    potential = reach(comparison, least.storage)
    size, joints, source = _errors(controller, comparison, least.storage, potential)
    known = (constants.label, *(line.label for line in error.lines), *_unproved(controller, joints, mismatch))
    rate, printed = 0.5 * decay(comparison), math.sqrt(constants.largest_rate) * comparison.t / (2.0 * constants.rho)
    margins, sampled = sampled_control(controller, period)
    decays = Condition("Theorem 1: min(ρ, ω + κ) > 0", rate, 0.0, "1/s", constants.label, "docs/certificates.md §2")
    certificate = Certificate(
        controller=controller,
        admissible=admissible,
        rate=rate,
        level=least,
        potential=potential,
        error=size,
        joint_errors=joints,
        printed_error=printed,
        label=weakest(*known),
        lines=(*constants.lines, *error.lines, *margins),
        conditions=(decays, *error.conditions, *_no_wrap(controller, joints, weakest(*known)), *sampled),
        assumptions=_assumptions(controller, mismatch),
    )
    certificate = replace(certificate, lines=(*certificate.lines, *_bounds(certificate, source)))
    return certificate if reference is None else _along(certificate, reference, duration, q0, v0)


def _check_arguments(
    reference: DesiredMotion | None, duration: float, q0: Any, v0: Any, mismatch: Mismatch | None, period: float | None
) -> None:
    positive("duration", duration, "s")
    if period is not None:
        positive("period", period, "s")
    if reference is None and (mismatch is not None or q0 is not None or v0 is not None):
        raise ArgumentError("a start and a model's error are held against a motion; give the reference too.")
    if q0 is None and v0 is not None:
        raise ArgumentError("v0 was given without q0; give both, or q0 alone for a start at rest.")


def _comparison(constants: Constants, admissible: Admissible, error: ModelError) -> Comparison:
    return Comparison(
        rho=constants.rho,
        delta=constants.delta,
        kappa=constants.kappa,
        nu=constants.nu,
        omega=constants.omega,
        t=math.sqrt(admissible.energy(constants.metric)) + error.t,
        alpha=error.alpha,
        beta=error.beta,
    )


def _why_not(k: Comparison) -> str:
    if not k.is_dissipative:
        return (
            f"Theorem 4 asks for 1 − β > α²/4 and the model's error gives 1 − β = {1.0 - k.beta:.3g} and α²/4 = "
            f"{0.25 * k.alpha**2:.3g}; learn a better model or take a larger D₀."
        )
    return (
        f"no bound follows from ρ = {k.rho:.3g}, ω = {k.omega:.3g} and κ = {k.kappa:.3g} 1/s: D must outweigh M, which "
        "an inertial rate ω > 0 does for every arm; take damping='inertial'."
    )


def _errors(
    controller: NeuralBackstepping, comparison: Comparison, storage: float, potential: float
) -> tuple[float, Float[np.ndarray, " n"], str]:
    """Bounds of ‖z1‖ and each |z1_i| [rad], and where they come from."""
    size, joints = _radians(controller, potential)
    exact = math.inf
    # Friction fed forward leaves a term that is not linear, a model's error another.
    if controller.nv == 1 and controller.friction is None and comparison.alpha == comparison.beta == 0.0:
        exact = _of_one_joint(controller, comparison, storage, size)
    if exact < size:
        return exact, np.array([exact]), "the loop of one joint is linear up to ψ and T, docs/certificates.md §4"
    return size, joints, "Φ ≥ z1ᵀSz1 and Φ∞, docs/certificates.md §3"


def _of_one_joint(controller: NeuralBackstepping, comparison: Comparison, storage: float, size: float) -> float:
    """The bound of |z1| that linear theory gives, inf where it does not apply; `size` [rad] is one already."""
    if type(controller.dynamics) is not PinocchioDynamics or controller.damping.floor is None:
        return math.inf
    loop = one_joint.Loop(
        inertia=float(controller.dynamics.mass_matrix(np.zeros(1))[0, 0]),
        rate=float(controller.rate.numpy()[0]),
        omega=float(controller.inertial_rate),
        stiffness=2.0 * float(controller.potential.stiffness.numpy()[0, 0]),
        damping=float(controller.damping.floor.numpy()[0, 0]),
    )
    within = one_joint.Worst(size, math.sqrt(2.0 * storage / loop.inertia) * (1.0 + 1e-12))
    torque = comparison.t * math.sqrt(loop.damping)
    return one_joint.worst_error(loop, torque, controller.potential, controller.damping, within)


def _radians(controller: NeuralBackstepping, potential: float) -> tuple[float, Float[np.ndarray, " n"]]:
    """√(Φ/λ_min(S)) and √(Φ (S⁻¹)_ii), which bound ‖z1‖ and |z1_i| where Φ ≥ z1ᵀSz1 is at most `potential`."""
    stiffness = np.asarray(controller.potential.stiffness.numpy())
    slack = 1.0 + 16.0 * len(stiffness) * np.finfo(float).eps * float(np.linalg.cond(stiffness))
    joints = np.sqrt(potential * np.diag(np.linalg.inv(stiffness)) * slack)
    # The joints together are never further than the ellipsoid is long, nor than the corner of their own bounds.
    total = min(math.sqrt(potential / least_eigenvalue(stiffness)), float(np.linalg.norm(joints)))
    return total, np.minimum(joints, total)


def _bounds(certificate: Certificate, source: str) -> tuple[Claim, ...]:
    label, here = certificate.label, "docs/certificates.md §2"
    harmless = certificate.printed_error >= certificate.error * (1.0 - 1e-6)
    joints = zip(_names(certificate.controller), certificate.joint_errors.tolist(), strict=True)
    return (
        Claim("rate of decay without disturbance", certificate.rate, "1/s", label, here),
        Claim("c of V(t) ≤ e^{−ct}V(0) + V∞", certificate.level.c, "1/s", label, here),
        Claim("V∞", certificate.storage, "J", label, here),
        Claim("Φ∞", certificate.potential, "J", label, "docs/certificates.md §3"),
        Claim("‖z1‖", certificate.error, "rad", label, source),
        *(Claim(f"|z1| of {name}", x, "rad", label, source) for name, x in joints),
        Claim("printed ‖z1‖", certificate.printed_error, "rad", Label.EMPIRICAL, _TRUE if harmless else _FALSE),
    )


def _along(certificate: Certificate, reference: DesiredMotion, duration: float, q0: Any, v0: Any) -> Certificate:
    """The certificate with what depends on the reference: effort limits, and the overshoot from a start."""
    controller = certificate.controller
    conditions = (*certificate.conditions, *headroom(controller, certificate.admissible, reference, duration))
    if q0 is None:
        return replace(certificate, conditions=conditions)
    begin = reference(np.zeros(1))
    q, v = np.asarray(q0, dtype=float), np.zeros(controller.nv) if v0 is None else np.asarray(v0, dtype=float)
    initial = float(controller.storage(q, v, begin.q[0], begin.v[0]))
    overshoot, _ = certificate.from_start(initial)
    lines = (
        Claim("V(0) of the start", initial, "J", certificate.label, "the storage function there"),
        Claim("‖z1‖ from the start", overshoot, "rad", certificate.label, "V never exceeds max(V(0), V∞)"),
    )
    return replace(certificate, conditions=conditions, lines=(*certificate.lines, *lines))


def _names(controller: NeuralBackstepping) -> tuple[str, ...]:
    robot = controller.dynamics.robot
    return tuple(f"joint {i + 1}" for i in range(controller.nv)) if robot is None else robot.joint_names


def _unproved(
    controller: NeuralBackstepping, joints: Float[np.ndarray, " n"], mismatch: Mismatch | None
) -> list[Label]:
    """EMPIRICAL for a learned model whose error nobody bounded, and for continuous joints that may pass ±π."""
    learned = mismatch is None and type(controller.dynamics) not in _EXACT
    wraps = any(not condition.holds for condition in _no_wrap(controller, joints, Label.EMPIRICAL))
    return [Label.EMPIRICAL] if learned or wraps else []


def _no_wrap(controller: NeuralBackstepping, joints: Float[np.ndarray, " n"], label: Label) -> tuple[Condition, ...]:
    robot = controller.dynamics.robot
    if robot is None or not robot.continuous.any():
        return ()
    largest = float(joints[robot.continuous].max())
    name = "π > |z1_i| of every continuous joint"
    return (Condition(name, math.pi, largest, "rad", label, "its error jumps at ±π (docs/theory.md §1)"),)


def _assumptions(controller: NeuralBackstepping, mismatch: Mismatch | None) -> tuple[str, ...]:
    model = "the arm is the model"
    if mismatch is not None:
        model = (
            f"the model errs as it did on {mismatch.trajectories} closed-loop trajectories, with a chance of at most "
            f"{mismatch.violation:.2g} that a further one does not, at a confidence of 1 − {mismatch.doubt:g}"
        )
    friction = "joint friction counts as disturbance"
    if controller.friction is not None:
        friction = "the joints have the friction that is fed forward, or less; what differs counts as disturbance"
    return (model, friction, "torques stay inside the effort limits", "continuous time, no delay")
