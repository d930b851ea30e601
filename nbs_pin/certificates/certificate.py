"""A certificate: bounds of the tracking error, what they rest on, and how each is known."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from nbs_pin.accuracy.mismatch import Mismatch
from nbs_pin.base.arguments import a, checked, number, numbers_or_one
from nbs_pin.base.arrays import JointArray
from nbs_pin.base.checks import floats, is_usual, told
from nbs_pin.base.claims import Claim, Group, Label, weakest
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.records import Reference
from nbs_pin.base.shown import Cells, Shown, joints_told
from nbs_pin.base.units import measured, over_joints, several, units
from nbs_pin.certificates.admissible import Admissible
from nbs_pin.certificates.body_error import BodyError
from nbs_pin.certificates.claims import Assumed, Assumption, Condition, Role, assumed, if_without_rotors
from nbs_pin.certificates.comparison_system import ComparisonSystem, Level
from nbs_pin.certificates.constants import Constants
from nbs_pin.certificates.error_bounds import radians
from nbs_pin.certificates.friction_error import FrictionError
from nbs_pin.certificates.held_torque import HeldTorque
from nbs_pin.certificates.model_error import ModelError
from nbs_pin.controllers.lyapunov_law import LyapunovLaw
from nbs_pin.motions.references import DesiredMotion, at_times
from nbs_pin.robots.robot import Robot

_PRINTED = "printed ‖z1‖"
_FALSE = "as printed in Theorem 3 of the paper: true for constant torques, false for others (docs/theory.md §5)"
_TRUE = "as printed in Theorem 3 of the paper: here no tighter than the proved bound"


class Start(NamedTuple):
    """A start beside the reference, and what follows from it."""

    q: JointArray
    """q(0) [rad]."""
    v: JointArray
    """v(0) [rad/s]."""
    begin: Reference
    """The reference at t = 0."""
    storage: float
    """V(0) [J]."""

    @classmethod
    def of(cls, law: LyapunovLaw, reference: DesiredMotion | None, q0: Any, v0: Any) -> "Start | None":
        """The start at q0 [rad] and v0 [rad/s], None is at rest; None without q0.

        Raises ArgumentError if these do not fit each other or the law.
        """
        if reference is None and (q0 is not None or v0 is not None):
            raise ArgumentError("q0 and v0 refer to a motion; give the reference too.")
        if q0 is None and v0 is not None:
            raise ArgumentError("v0 was given without q0; give both, or q0 alone for a start at rest.")
        if q0 is None or reference is None:
            return None
        start = floats("q0", q0), np.zeros(law.nv) if v0 is None else floats("v0", v0)
        for name, x in zip(("q0", "v0"), start, strict=True):
            if x.shape != (law.nv,) or not is_usual(x):
                raise ArgumentError(
                    f"{name} is {told(x)}, expected {law.nv} finite numbers, one per joint; correct it."
                )
        begin = Reference(*(x[0] for x in at_times(reference, np.zeros(1), law.nv)))
        return cls(*start, begin, float(law.storage(*start, begin.q, begin.v)))


@dataclass(frozen=True, eq=False, repr=False)
class Certificate(Shown):
    """Bounds of the closed loop of a `LyapunovLaw`, each labelled by how it is known (docs/certificates.md).

    They hold for every admissible disturbance and every reference, under `assumptions`; with a `mismatch`, for loops
    like those that it was measured on, over the length of these.

    Example:
        >>> import nbs_pin as nbs
        >>> bound = nbs.certify(nbs.NeuralBackstepping.for_robot(nbs.load_robot("two_link")), [5.0, 5.0])
        >>> bound.joint_errors.round(3), round(bound.rate, 1), str(bound.label)
        (array([0.017, 0.017]), 8.0, 'PROVED')
    """

    controller: LyapunovLaw
    admissible: Admissible
    constants: Constants
    model_error: ModelError
    """Terms of the error of a learned model."""
    friction: FrictionError
    """Terms of the joint friction that is not fed forward."""
    comparison: ComparisonSystem
    """The inequalities that the bounds follow from."""
    rate: float
    """Without disturbance, errors decay at least like e^{−rate·t}, and V like e^{−2 rate·t} [1/s]."""
    level: Level
    """c and V∞ of V(t) ≤ e^{−ct}V(0) + V∞ under disturbances."""
    potential: float
    """Φ∞ [J]: Φ(z1) ≤ max(V(0), Φ∞) at all times, and ≤ Φ∞ in the limit."""
    error: float
    """Bound of ‖z1‖ [rad], at all times from z1 = z2 = 0; in continuous time also in the limit from any other start."""
    joint_errors: JointArray
    """The same for each |z1_i| [rad]."""
    source: str
    """The proof of the bounds of z1."""
    conditions: tuple[Condition, ...] = ()
    """The conditions of the theorems and of the assumptions, with the numbers of both sides."""
    margins: tuple[Claim, ...] = ()
    """The longest control period and delay by the rules of sampled control."""
    robot: Robot | None = None
    """The true arm; None if none is known."""
    mismatch: Mismatch | None = None
    """The model error that the bounds include."""
    bodies: BodyError | None = None
    """What errors of the bodies add, where these are known to a share."""
    start: Start | None = None
    """The start from which the overshoot is bounded."""
    held: HeldTorque | None = None
    """What is proved of the loop with held torques; None without a period."""

    def _facts(self) -> Iterable[str]:
        arm = joints_told(self.controller.nv) if self.robot is None else self.robot.name
        bound = f"‖z1‖ ≤ {measured(self.error, several(self.joint_units))}"
        void = (f"VOID: {len(self.void)} conditions fail",) if self.void else ()
        return arm, self.disturbance, f"{self.label} {bound} in {self.clock}", *void

    def _cells(self) -> Cells:
        each = zip(self.joint_names, self.joint_errors.tolist(), self.joint_units, strict=True)
        return Cells(("joint", "error at most"), [(name, measured(error, unit)) for name, error, unit in each])

    @property
    def label(self) -> Label:
        """How the bounds are known: the weakest label of all that they rest on, EMPIRICAL if a condition fails."""
        if self.void:
            return Label.EMPIRICAL
        sufficient = (condition.label for condition in self.conditions if condition.role is Role.SUFFICIENT)
        bodies = () if self.bodies is None else self.bodies.lines
        lines = (line.label for line in (*self.model_error.lines, *self.friction.lines, *bodies))
        return weakest(self.constants.label, self.admissible.label, *lines, *sufficient)

    @property
    def void(self) -> tuple[str, ...]:
        """Conditions that the bounds rest on and that do not hold; `label` is then EMPIRICAL."""
        return tuple(condition.name for condition in self.conditions if condition.voids)

    @property
    def assumptions(self) -> tuple[Assumed, ...]:
        """What the bounds assume, and how far each assumption is checked by `conditions`."""
        texts = _texts(self)
        return tuple(assumed(name, self.conditions, text) for name, text in texts.items())

    @property
    def lines(self) -> tuple[Claim, ...]:
        """Every bound and every constant, with its label and reason."""
        whole = (
            *(() if self.held is None else (self.held.line,)),
            *self.admissible.claims,
            *self.constants.lines,
            *self.model_error.lines,
            *self.friction.lines,
            *(() if self.bodies is None else self.bodies.lines),
            *self.margins,
        )
        return (*_bounds(self), *(self._over_joints(claim) for claim in whole))

    @property
    def printed_error(self) -> float:
        """Bound of ‖z1‖ by the paper's Theorem 3 as printed [rad]; false for torques that vary (docs/theory.md §5)."""
        return math.sqrt(self.constants.largest_rate) * self.comparison.t / (2.0 * self.constants.rho)

    @property
    def overshoot(self) -> tuple[float, JointArray] | None:
        """Bounds of ‖z1‖ and each |z1_i| at all times from the given start [rad]."""
        return None if self.start is None else self.from_start(self.start.storage)

    @property
    def stiffness(self) -> Float[np.ndarray, "n n"]:
        """S at the time of certification [J/rad²]; training the controller changes its own."""
        return self.constants.stiffness

    @property
    def useless(self) -> tuple[str, ...]:
        """Why the bounds are of no use to anyone, with the numbers that would help; empty if they are."""
        robot, box, found = self.robot, self.admissible.largest(self.controller.nv), []
        if robot is not None and (box >= robot.effort_limit).any():
            i = int(np.argmax(box / robot.effort_limit))
            unit = units("torque", robot.prismatic)[i]
            found.append(
                f"the disturbance of {self.joint_names[i]}, {box[i]:.3g} {unit}, is no less than the "
                f"{robot.effort_limit[i]:.3g} {unit} of its motor, so no law can hold it; give a smaller one"
            )
        turning = self.joint_errors[np.array([unit == "rad" for unit in self.joint_units])]
        if turning.size and turning.max() > np.pi:
            share = 0.5 / float(turning.max())
            found.append(
                f"a bound of {turning.max() / (2.0 * np.pi):.2g} turns says nothing: a disturbance of {share:.2g} "
                f"times this one is certified to 0.5 rad, or a bandwidth of about {share**-0.5:.2g} times this one, "
                "with a control period as much shorter; rotor inertia that the URDF leaves out would allow more"
            )
        return tuple(found)

    @property
    def clock(self) -> str:
        """What the bounds hold for: continuous time, or torques that are held for a control period."""
        if self.held is None or not self.held.is_proved:
            return "continuous time"
        return f"control periods of {1e3 * self.held.readings.period:.4g} ms"

    @property
    def unproved_hold(self) -> str:
        """Why nothing is proved of torques that are held for the period; empty if it is, or without a period."""
        if self.held is None or self.held.is_proved:
            return ""
        longest = f"the longest period with a proof is {1e3 * self.held.longest:.3g} ms"
        why = self.held.why_not or (longest if self.held.longest else "no period tried has a proof")
        rotors = if_without_rotors(self.robot) if self.held.longest and self.robot is not None else ""
        return f"nothing is proved of torques held for {1e3 * self.held.readings.period:.4g} ms: {why}{rotors}"

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints."""
        n = self.controller.nv
        return tuple(f"joint {i + 1}" for i in range(n)) if self.robot is None else self.robot.joint_names

    @property
    def joint_units(self) -> tuple[str, ...]:
        """Unit of the error of each joint: rad, or m for a prismatic joint."""
        return units("position", self._prismatic)

    @property
    def disturbance(self) -> str:
        """The disturbance in words, with units."""
        return self.admissible.told(units("torque", self._prismatic))

    def _over_joints(self, claim: Claim) -> Claim:
        """A claim about all joints, with the units of those that slide."""
        unit = over_joints(claim.unit, self._prismatic)
        return claim if unit == claim.unit else replace(claim, unit=unit)

    @property
    def _prismatic(self) -> np.ndarray:
        return np.zeros(self.controller.nv, dtype=bool) if self.robot is None else self.robot.prismatic

    @property
    def storage(self) -> float:
        """V∞ [J]."""
        return self.level.storage

    @checked(t=numbers_or_one(least=0.0, unit="s"), initial=number(least=0.0, unit="J"))
    def storage_bound(self, t: Float[np.ndarray, "*rows"], initial: float) -> Float[np.ndarray, "*rows"]:
        """Bound of V(t) from V(0) = `initial` [J]: the lesser of e^{−ct}V(0) + V∞ and max(V(0), V∞), t in [s].

        Where bounds with held torques are proved from such a start, it is theirs, at the control instants.
        """
        if self.bodies is not None:
            return np.full(t.shape, self.storage if initial <= self.bodies.start else np.inf)
        if math.isfinite(held := self.held_storage(initial)):
            return np.full(t.shape, held)
        return np.minimum(initial * np.exp(-self.level.c * t) + self.storage, max(initial, self.storage))

    @checked(initial=number(least=0.0, unit="J"))
    def held_storage(self, initial: float) -> float:
        """Bound of V at the control instants with held torques, from V(0) = `initial` [J]; inf if none is proved."""
        return math.inf if self.held is None else self.held.storage(initial, self.constants.nu)

    @checked(initial=number(least=0.0, unit="J"))
    def is_continuous_from(self, initial: float) -> bool:
        """Whether bounds with held torques are proved from other starts, but not from V(0) = `initial` [J]."""
        return self.held is not None and self.held.is_proved and not math.isfinite(self.held_storage(initial))

    @checked(initial=number(least=0.0, unit="J"))
    def from_start(self, initial: float) -> tuple[float, JointArray]:
        """Bounds of ‖z1‖ and each |z1_i| at all times [rad] from V(0) = `initial` [J], as Φ ≤ max(V(0), Φ∞).

        With held torques where they are proved from such a start, else in continuous time (`is_continuous_from`).
        """
        if initial <= (0.0 if self.bodies is None else self.bodies.start):
            return self.error, self.joint_errors
        if self.bodies is not None:
            return math.inf, np.full(len(self.joint_errors), np.inf)
        if self.held is not None and math.isfinite(proved := self.held.after(initial)[1]):
            initial = max(initial, proved)
        return radians(self.stiffness, max(initial, self.potential))

    def summary(self) -> dict[str, Any]:
        """The certificate as JSON can store it."""
        return {
            "disturbance": self.disturbance,
            "rate_per_s": self.rate if self.bodies is None else None,
            "error_rad": self.error,
            "joint_errors_rad": self.joint_errors.tolist(),
            "printed_error_rad": self.printed_error if self.bodies is None else None,
            "overshoot_rad": None if self.overshoot is None else self.overshoot[0],
            "joint_overshoots_rad": None if self.overshoot is None else self.overshoot[1].tolist(),
            "joints": list(self.joint_names),
            "units": list(self.joint_units),
            "label": str(self.label),
            "clock": self.clock,
            "unproved_hold": self.unproved_hold,
            "void": list(self.void),
            "lines": [line.plain() for line in self.lines],
            "conditions": [condition.plain() for condition in self.conditions],
            "assumptions": [{"assumption": text, "checked": checked} for text, checked in self.assumptions],
        }


CERTIFICATE = a(Certificate, "a Certificate, as certify returns it (for an AdaptiveLaw there is transient_bound)")
"""The check of an argument that is a certificate."""


def _bounds(certificate: Certificate) -> tuple[Claim, ...]:
    """A claim for each bound."""
    label, here, where = certificate.label, "docs/certificates.md §2", "docs/certificates.md §3"
    if certificate.bodies is not None:
        here = where = "docs/certificates.md §14"
    if certificate.held is not None and certificate.held.is_proved:
        here, where = f"{here}, in continuous time", "docs/certificates.md §13"
    harmless = certificate.printed_error >= certificate.error * (1.0 - 1e-6)
    nothing, source = "disturbance", certificate.source
    if certificate.mismatch is not None:
        nothing = "disturbance and constant model error"
        source = f"{source}, for loops drawn alike and up to t = {certificate.mismatch.duration:.4g} s"
    joints = zip(certificate.joint_names, certificate.joint_errors.tolist(), certificate.joint_units, strict=True)
    whole = several(certificate.joint_units)
    printed = Claim(
        _PRINTED, certificate.printed_error, whole, Label.EMPIRICAL, _TRUE if harmless else _FALSE, Group.BOUNDS
    )
    dynamic = (
        printed,
        Claim(f"rate of decay without {nothing}", certificate.rate, "1/s", label, here, Group.BOUNDS),
        Claim("c of V(t) ≤ e^{−ct}V(0) + V∞", certificate.level.c, "1/s", label, here, Group.BOUNDS),
    )
    lines = [
        Claim("‖z1‖", certificate.error, whole, label, source, Group.BOUNDS),
        *(Claim(f"|z1| of {name}", x, unit, label, source, Group.BOUNDS) for name, x, unit in joints),
        *(dynamic if certificate.bodies is None else ()),
        Claim("V∞", certificate.storage, "J", label, here, Group.BOUNDS),
        Claim("Φ∞", certificate.potential, "J", label, where, Group.BOUNDS),
    ]
    if certificate.overshoot is not None and certificate.start is not None:
        because = f"Φ never exceeds max(V(0), Φ∞), {where}"
        lines.insert(1, Claim("‖z1‖ from the start", certificate.overshoot[0], whole, label, because, Group.BOUNDS))
        storage, because = certificate.start.storage, "storage function at the start"
        lines.append(Claim("V(0) of the start", storage, "J", label, because, Group.BOUNDS))
    return tuple(lines)


def _texts(certificate: Certificate) -> dict[Assumption, str]:
    """The assumptions of a certificate, and the words for those that its model, friction and disturbance change."""
    m, friction, robot = certificate.mismatch, certificate.friction, certificate.robot
    texts = dict.fromkeys(Assumption, "")
    if m is not None:
        texts[Assumption.MODEL] = (
            f"the model error is bounded as on {m.trajectories} closed loops of {m.duration:.3g} s, which a further "
            f"one, drawn alike, exceeds with a chance of at most {m.violation:.2g} at a confidence of 1 − {m.doubt:g}"
        )
        texts[Assumption.DISTURBANCE] = "the disturbance is drawn like those of these loops, within its bound"
    if certificate.bodies is not None:
        texts[Assumption.MODEL] = "the bodies are those of the law's model up to the errors stated"
    if friction.lines:
        texts[Assumption.FRICTION] = "joint friction is b v + c sign(v), with the coefficients stated"
    elif certificate.controller.friction is not None:
        texts[Assumption.FRICTION] = "joint friction is exactly what is fed forward"
    else:
        texts[Assumption.FRICTION] = "joints have no friction beyond the disturbance"
    if robot is None or not robot.continuous.any():
        del texts[Assumption.WRAP]
    return texts
