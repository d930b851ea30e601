"""`transient_bound`: how far an arm with an unknown load strays while an adaptive law learns it."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from nbs_pin.base.arguments import DURATION, a, checked, count, maybe, number
from nbs_pin.base.arrays import JointArray
from nbs_pin.base.checks import PerJoint
from nbs_pin.base.claims import Claim, Group, Known, Label, known, refuse, weakest
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.known_code import foreign_code
from nbs_pin.base.records import RUN, Run
from nbs_pin.base.rounding import up
from nbs_pin.base.shown import Cells, Shown
from nbs_pin.base.units import measured, several, units
from nbs_pin.certificates.adaptive_storage import Beginning, loaded_start
from nbs_pin.certificates.admissible import Admissible
from nbs_pin.certificates.certificate import Certificate, Start
from nbs_pin.certificates.certify import certify
from nbs_pin.certificates.error_bounds import radians
from nbs_pin.certificates.fixed_beside import FixedLaw, fixed_law, frame_of
from nbs_pin.certificates.transient_check import Assumed, TransientCheck
from nbs_pin.certificates.uncertainty import Payload
from nbs_pin.certificates.worst_load import Divergence, WorstLoad, of_number
from nbs_pin.controllers.adaptive_law import AdaptiveLaw
from nbs_pin.controllers.lyapunov_law import LyapunovLaw
from nbs_pin.dynamics.friction import FRICTION, JointFriction
from nbs_pin.motions.references import MOTION, DesiredMotion

_HERE = "docs/certificates.md §16"
_LENGTH = 10.0  # of a loop without a reference [s]


@dataclass(frozen=True, eq=False, repr=False)
class TransientBound(Shown):
    """Bounds of the closed loop of an `AdaptiveLaw` for every load of a box, from `transient_bound`.

    Example:
        >>> import nbs_pin as nbs
        >>> law = nbs.AdaptiveLaw(nbs.NeuralBackstepping.for_robot(nbs.load_robot("panda")), load_mass=2.0)
        >>> nbs.transient_bound(law, 2.0)
        TransientBound(panda, 0 to 2 kg at panda_hand_tcp, PROVED ‖z1‖ ≤ 0.0239 rad (1.37°) for 10 s in continuous time)
    """

    law: AdaptiveLaw
    load_mass: float
    """Largest mass of the load [kg]."""
    load_radius: float
    """All of it lies within this distance of the frame's origin [m]."""
    start: float
    """V(0) [J]."""
    admissible: Admissible
    """The disturbance."""
    friction: JointFriction
    """Joint friction of the arm."""
    worst: WorstLoad
    """The load that is farthest from the first estimate."""
    divergence: float
    """Σ d(X‖X₀)/γ over all unknowns [J], at most, for every load of the box."""
    duration: float
    """How long the bounds hold [s]: inf, at all times, if nothing disturbs the loop."""
    storage_within: float
    """V is at most this for the duration [J]; V_a(0) if nothing disturbs the loop."""
    storage_always: float
    """V is at most this at all times [J]; inf where nothing is known."""
    potential: float
    """Φ is at most this for the duration [J]."""
    error: float
    """Bound of ‖z1‖ for the duration [rad, m]."""
    joint_errors: JointArray
    """Bound of each |z1_i| for the duration [rad, m]."""
    lines: tuple[Claim, ...]
    """Every number that the bounds rest on, with its label and reason."""
    label: Label
    """How the bounds are known in continuous time."""
    fixed: FixedLaw | None
    """The law without adaptation; None without a reference."""

    @property
    def storage(self) -> float:
        """V_a(0) = V(0) + Σ d(X‖X₀)/γ [J]."""
        return self.start + self.divergence

    @property
    def error_always(self) -> float:
        """Bound of ‖z1‖ at all times, the residual under the disturbance [rad, m]; inf where nothing is known."""
        return self.error * self._growth

    @property
    def joint_errors_always(self) -> JointArray:
        """Bound of each |z1_i| at all times [rad, m]."""
        return np.asarray(self.joint_errors * self._growth)

    @property
    def useless(self) -> tuple[str, ...]:
        """Why the bound is of no use to anyone, empty if it is of some."""
        turning = self.joint_errors[~self.law.robot.prismatic]
        if not (turning.size and turning.max() > np.pi):
            return ()
        turns = f"a bound of {turning.max() / (2.0 * np.pi):.2g} turns says nothing"
        return (f"{turns}; give a smaller load, start or disturbance, or a larger bandwidth",)

    @property
    def _growth(self) -> float:
        """√(bound of Φ at all times / that for the duration), as errors are √Φ times constants."""
        return 1.0 if math.isinf(self.duration) else up(math.sqrt(self.storage_always / self.potential))

    @property
    def frame(self) -> str:
        """The link that carries the load."""
        return frame_of(self.law)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints."""
        return self.law.robot.joint_names

    @property
    def joint_units(self) -> tuple[str, ...]:
        """Unit of the error of each joint: rad, or m for a prismatic joint."""
        return units("position", self.law.robot.prismatic)

    @checked(run=RUN, start=count(0))
    def check(self, run: Run, start: int = 0) -> TransientCheck:
        """The errors of a run of the law, simulated or logged, beside their bounds, and the assumptions that failed.

        Raises ArgumentError for a run of other joints or estimates; that γ and the gains were those of the law is not
        checked.

        Example:
            >>> import nbs_pin as nbs
            >>> robot = nbs.load_robot("two_link")
            >>> law = nbs.AdaptiveLaw(nbs.NeuralBackstepping.for_robot(robot), load_mass=0.5)
            >>> plant = nbs.DynamicsPlant.for_robot(robot.with_payload("tip", 0.3))
            >>> run = nbs.simulate(plant, law, nbs.Sinusoid.for_robot(robot), 2.0, 0.001)
            >>> nbs.transient_bound(law, 0.5).check(run).is_kept
            True
        """
        bounds = self.joint_errors, self.joint_errors_always
        assumed = Assumed(self.law, self.start, self.admissible, self.duration, *bounds)
        return assumed.check(run, start, self.joint_units)

    def _facts(self) -> Iterable[str]:
        within = f" within {self.load_radius:g} m" if self.load_radius else ""
        bound = f"‖z1‖ ≤ {measured(self.error, several(self.joint_units))}"
        pushed = () if self.admissible.is_zero else (self.admissible.told(units("torque", self.law.robot.prismatic)),)
        load = f"0 to {self.load_mass:g} kg{within} at {self.frame}"
        lasting = f" for {self.duration:g} s" if math.isfinite(self.duration) else ""
        return self.law.robot.name, load, *pushed, f"{self.label} {bound}{lasting} in continuous time"

    def _cells(self) -> Cells:
        columns = [self.joint_errors] if self.fixed is None else [self.joint_errors, self.fixed.joint_errors]
        each = zip(self.joint_names, self.joint_units, *(x.tolist() for x in columns), strict=True)
        rows = [(name, *(measured(x, unit) for x in errors)) for name, unit, *errors in each]
        return Cells(("joint", "error at most", "fixed law, measured")[: 1 + len(columns)], rows)

    def summary(self) -> dict[str, Any]:
        """The bounds as JSON can store them."""
        fixed, certified = self.fixed, self.fixed and self.fixed.certificate
        torques = units("torque", self.law.robot.prismatic)
        return {
            "frame": self.frame,
            "load_mass_kg": self.load_mass,
            "load_radius_m": self.load_radius,
            "start_J": self.start,
            "disturbance": "none" if self.admissible.is_zero else self.admissible.told(torques),
            "worst_mass_kg": self.worst.mass,
            "worst_centre_m": self.worst.centre.tolist(),
            "divergence_J": self.divergence,
            "storage_J": self.storage,
            "duration_s": self.duration if math.isfinite(self.duration) else None,
            "storage_within_J": self.storage_within,
            "storage_always_J": self.storage_always if math.isfinite(self.storage_always) else None,
            "potential_J": self.potential,
            "error_rad": self.error,
            "joint_errors_rad": self.joint_errors.tolist(),
            "error_always_rad": self.error_always if math.isfinite(self.error_always) else None,
            "joint_errors_always_rad": self.joint_errors_always.tolist() if math.isfinite(self.error_always) else None,
            "joints": list(self.joint_names),
            "units": list(self.joint_units),
            "label": str(self.label),
            "lines": [line.plain() for line in self.lines],
            "fixed_joint_errors_rad": None if fixed is None else fixed.joint_errors.tolist(),
            "fixed_error_bound_rad": certified and certified.error,
            "fixed_joint_error_bounds_rad": certified and certified.joint_errors.tolist(),
            "fixed_refused": None if fixed is None else fixed.refused,
        }


@checked(
    law=a(AdaptiveLaw, "an AdaptiveLaw, and for a compiled one the AdaptiveLaw that it was compiled from"),
    load_mass=number(above=0.0, unit="kg"),
    load_radius=number(least=0.0, most=100.0, unit="m"),
    start=number(least=0.0, unit="J"),
    friction=maybe(FRICTION),
    reference=maybe(MOTION),
    duration=maybe(DURATION),
)
def transient_bound(
    law: AdaptiveLaw,
    load_mass: float,
    load_radius: float = 0.0,
    start: float = 0.0,
    *,
    disturbance: PerJoint | Admissible = 0.0,
    friction: JointFriction | None = None,
    reference: DesiredMotion | None = None,
    duration: float | None = None,
    q0: Any = None,
    v0: Any = None,
) -> TransientBound:
    """Bound the error of an adaptive law for every unknown load of a box, from before it has learned anything.

    Without disturbance V_a = V + Σ d(X‖X̂)/γ never increases, so that for all times and every reference

        Φ ≤ V ≤ V_a(0) = V(0) + Σ d(X‖X₀)/γ,    Φ ≤ (V(0) + k V_a(0))/(1 + k),    |z1_i| ≤ √(Φ (S⁻¹)_ii),

    with d(X‖X₀) the largest over all loads, found by branch and bound, and 4k(1 + k)δ ≥ 1. A disturbance, friction that
    is not fed forward and a leak add to V_a what they supply in the duration; at all times V ≤ max(V_a(0), V∞ + Σ d̄/γ)
    (`storage_always`). Everything but the load is as the model has it (docs/certificates.md §16).

    Args:
        law: A law that adapts a load.
        load_mass: The load has at most this mass [kg]; no load is one of them.
        load_radius: All of it lies within this distance of the frame's origin [m]; 0 for a point.
        start: V(0) with the load [J], `storage` of the law that `law` is about, plus ½z2ᵀM z2 of the load; 0 on the
            reference.
        disturbance: One bound per joint on |τ_d,i|, one number that bounds ‖τ_d‖ [N·m], or an `Admissible`.
        reference: A motion along which the law without adaptation is certified and simulated, to compare.
        friction: Joint friction of the arm. None takes the URDF's.
        duration: How long a disturbed loop is bounded, and the length of the reference that is used [s]. None takes the
            reference's own `duration`, or 10 s without one.
        q0: A start [rad] in place of `start`, which is then V(0) there with any load of the box. Needs the reference.
        v0: Its velocity [rad/s]; None is at rest.

    Raises:
        CertificateRefused: For a law that adapts no load, loads beyond its own, or a law without a bound.
        ArgumentError: If arguments do not fit.

    Example:
        >>> import nbs_pin as nbs
        >>> law = nbs.AdaptiveLaw(nbs.NeuralBackstepping.for_robot(nbs.load_robot("panda")), load_mass=2.0)
        >>> bound = nbs.transient_bound(law, 2.0)
        >>> print(f"{bound.label}: V ≤ {bound.storage:.4f} J")
        PROVED: V ≤ 0.0179 J
    """
    _check_box(law, load_mass, load_radius)
    assert isinstance(law.law, LyapunovLaw)  # as no other law adapts a load
    begin = Start.of(law.law, reference, q0, v0)
    if begin is not None and start:
        raise ArgumentError("start and q0 both state the beginning; give one of them.")
    admissible = Admissible.of(disturbance, law.nv)
    nothing = np.zeros(law.nv)  # a box of 0, so that the law's own certificate is one of friction alone
    base = certify(law.law, nothing if admissible.is_zero else admissible, friction=friction)
    length = getattr(reference, "duration", _LENGTH) if duration is None else duration
    payload = Payload(load_mass, load_radius, law.frame)
    start = start if begin is None else loaded_start(law, frame_of(law), payload, begin)
    found = _bounded(law, payload, base, start, length)
    if reference is None:
        return found
    given = {"disturbance": base.admissible, "friction": friction or JointFriction.of(law.robot)}
    return replace(found, fixed=fixed_law(law, payload, found.worst, given, reference, length))


def _check_box(law: AdaptiveLaw, mass: float, radius: float) -> None:
    """Raises CertificateRefused unless every load of the box is one that the law can learn."""
    if law.load_mass is None or law.load_radius is None or law.load_across is None:
        refuse(f"the law adapts {', '.join(law.adapts)} and no load", 'give one that adapts "load"')
    if not 0.0 <= law.leak < math.inf:
        refuse(f"the leak of the law is {law.leak}", "give a finite number ≥ 0")
    within = min(law.load_radius, law.load_across)
    if mass > law.load_mass or radius > within:
        refuse(
            f"loads up to {mass:g} kg within {radius:g} m are beyond what the law can learn, {law.load_mass:g} kg "
            f"within {within:g} m",
            "give a law with a larger load_mass, load_radius or load_across",
        )
    rates, count = np.asarray(law.rates), len(law.unknowns.bodies) + len(law.unknowns.numbers)
    if rates.shape != (count,) or not (np.isfinite(rates).all() and (rates >= 0.0).all()):
        refuse(f"the rates of the law are not {count} finite numbers ≥ 0", "correct them")
    if rates[[body.is_load for body in law.unknowns.bodies].index(True)] == 0.0:
        refuse("the rate of the load is 0, so the law does not learn it", "give a rate above 0")


def _divergence(law: AdaptiveLaw, mass: float, radius: float) -> tuple[WorstLoad, float]:
    """The worst load, and Σ d(X‖X₀)/γ with it [J]; what is as the model has it counts where its estimate was cut."""
    rates, unknowns, total = np.asarray(law.rates).tolist(), law.unknowns, 0.0
    worst = None
    for body, rate in zip(unknowns.bodies, rates, strict=False):
        found = Divergence(body)
        if body.is_load:
            worst = found.worst(mass, radius)
        total += _cost(worst.bound if body.is_load and worst else found.at_known(), rate, body.name)
    for one, rate in zip(unknowns.numbers, rates[len(unknowns.bodies) :], strict=True):
        total += _cost(of_number(one), rate, f"a number of {law.robot.joint_names[one.joint]}")
    assert worst is not None
    return worst, up(total)


def _cost(divergence: float, rate: float, name: str) -> float:
    """d/γ [J]; raises CertificateRefused for an estimate that is wrong at first and never moves."""
    if divergence > 0.0 and rate == 0.0:
        refuse(f"the first estimate of {name} is not the model's and its rate is 0", "give a rate above 0")
    return divergence / rate if rate > 0.0 else 0.0


def _bounded(law: AdaptiveLaw, payload: Payload, base: Certificate, start: float, length: float) -> TransientBound:
    """The bounds, from the certificate of the law that `law` is about."""
    worst, divergence = _divergence(law, payload.mass, payload.radius)
    # The bounds of M are those of the arm without its load: nothing may rest on them.
    comparison = replace(base.comparison, kappa=0.0, nu=math.inf)
    beginning = Beginning(law, comparison, start, divergence, length)
    within = beginning.within()
    potential = min(within, beginning.potential())
    error, joint_errors = radians(base.stiffness, potential)
    if (joint_errors[law.robot.continuous] >= math.pi).any():
        refuse(
            "the bound of a continuous joint is π or more, where its error jumps",
            "give a smaller load, start or disturbance",
        )
    always = beginning.always()
    if (radians(base.stiffness, always)[1][law.robot.continuous] >= math.pi).any():
        always = math.inf  # where the error jumps, V does too
    code = known(foreign_code(law), f"V_a does not increase but by what is supplied, {_HERE}")
    is_free = comparison.t == comparison.power == law.leak == 0.0
    found = TransientBound(
        law=law,
        load_mass=payload.mass,
        load_radius=payload.radius,
        start=start,
        admissible=base.admissible,
        friction=base.friction.gap.arm,
        worst=worst,
        divergence=divergence,
        duration=math.inf if is_free else length,
        storage_within=within,
        storage_always=always,
        potential=potential,
        error=error,
        joint_errors=joint_errors,
        lines=(),
        label=weakest(code.label, base.label),
        fixed=None,
    )
    return replace(found, lines=_lines(found, base, code))


def _lines(found: TransientBound, base: Certificate, code: Known) -> tuple[Claim, ...]:
    """A claim for every number."""
    label, worst = found.label, found.worst
    where = f"{worst.mass:g} kg at ({', '.join(f'{1e3 * x:.0f}' for x in worst.centre)}) mm"
    edge = "a load at the edge of the law's own box counts as one within it up to 1e-9 of the largest body"
    lasting = "at all times" if math.isinf(found.duration) else f"for {found.duration:g} s"
    why = f"{lasting}; {code.because}"
    sampled = (
        "share of the damping's work that a step of the law's period and rates costs at most in usual motions, those "
        "sampled for the rates; held torques are not in the bounds"
    )
    box = f"largest over all loads of the box, by branch and bound, near {where}; {edge}"
    joints = zip(found.joint_names, found.joint_errors.tolist(), found.joint_units, strict=True)
    always, total = found.storage_always, up(found.storage)
    source = f"{lasting}; Φ ≥ z1ᵀSz1, {_HERE}"
    return (
        Claim("‖z1‖", found.error, several(found.joint_units), label, source, Group.BOUNDS),
        *(Claim(f"|z1| of {name}", x, unit, label, source, Group.BOUNDS) for name, x, unit in joints),
        Claim("Φ, largest", found.potential, "J", label, why, Group.BOUNDS),
        Claim("V, largest", found.storage_within, "J", label, why, Group.BOUNDS),
        Claim("V at all times", always, "J", label, f"V∞ and the largest divergence, {_HERE}", Group.BOUNDS),
        Claim("V_a(0)", total, "J", label, f"V(0) is given; {code.because}", Group.BOUNDS),
        Claim("Σ d(X‖X₀)/γ", found.divergence, "J", Label.PROVED, box, Group.BODIES),
        Claim("cost of a step", found.law.step_cost(), "", Label.EMPIRICAL, sampled, Group.SAMPLED),
        *base.admissible.claims,
        *base.constants.lines,
        *base.friction.lines,
    )
