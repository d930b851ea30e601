"""Bounds of the loop as it runs, with every torque held for a period, where they can be proved."""

import math
from dataclasses import dataclass

import numpy as np

from nbs_pin.base.arrays import JointArray
from nbs_pin.base.claims import Claim, Group, Label
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.certificates.claims import Assumption, Condition
from nbs_pin.certificates.comparison_system import ComparisonSystem
from nbs_pin.certificates.constants import Constants
from nbs_pin.certificates.coriolis import MOST_JOINTS, CoriolisBounds
from nbs_pin.certificates.effort_bound import Asked, torque_bound
from nbs_pin.certificates.sampled_law import Curvature, Fed, SampledLaw
from nbs_pin.certificates.sampled_loop import kept_level
from nbs_pin.certificates.sampled_motion import SampledMotion
from nbs_pin.controllers.lyapunov_law import LyapunovLaw
from nbs_pin.dynamics.analytic import AnalyticDynamics
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.motions.reference_files import Sampled
from nbs_pin.motions.references import DesiredMotion, at_times
from nbs_pin.robots.robot import Robot

_HALVINGS, _BISECTIONS = 7, 4
_HERE = "docs/certificates.md §13"
_NOTHING = (math.inf,) * 4
_ROUNDING = 1e-9  # of a V(0) that is computed again


@dataclass(frozen=True, eq=False)
class Readings:
    """How a sampled loop reads the state, and when its torque acts."""

    period: float
    """h [s]."""
    lookahead: float
    """How far ahead of a reading the law is evaluated [s]."""
    delay: float = 0.0
    """From a reading to the beginning of the hold that it acts in [s]."""
    steps: JointArray | None = None
    """Encoder steps, with velocities that are differences over a period [rad]; None for exact states."""

    @classmethod
    def of(cls, period: float, lookahead: float | None, delay: float, steps: JointArray | None) -> "Readings":
        """Those of the arguments of `certify`; raises ArgumentError for times out of range."""
        if not 0.0 <= delay <= period:
            raise ArgumentError(f"delay is {delay} s, expected 0 to the period of {period} s; correct it.")
        lead = 0.5 * period + delay if lookahead is None else lookahead
        if not 0.0 <= lead <= period + delay:
            text = f"0 to {period + delay} s, the period and the delay"
            raise ArgumentError(f"lookahead is {lead} s, expected {text}; the delay and half a period is usual.")
        return cls(period, lead, delay, steps)

    @property
    def is_plain(self) -> bool:
        """Whether states are exact and torques act at once."""
        return self.delay == 0.0 and self.steps is None

    def at(self, period: float) -> "Readings":
        """The same with another period, to which the times are proportional."""
        share = period / self.period
        return Readings(period, share * self.lookahead, share * self.delay, self.steps)

    def __str__(self) -> str:
        late = f", {1e3 * self.delay:g} ms after its reading" if self.delay > 0.0 else ""
        differences = "" if self.steps is None else ", on encoder readings and their differences over a period"
        before = "" if self.is_plain else ", from an arm that was on the reference before t = 0"
        return f"torque held for {1e3 * self.period:g} ms{late}{differences}{before}"

    @property
    def oldest(self) -> float:
        """How long before t = 0 the first torque's readings reach back [s]."""
        return self.delay + (self.period if self.steps is not None else 0.0)


@dataclass(frozen=True, eq=False)
class HeldTorque:
    """What is proved of a loop whose torque is held for a period."""

    readings: Readings
    """Its times and encoders."""
    level: float
    """Level of V' that no hold leaves from a start on the reference [J]; inf if none is proved."""
    level_from_start: float
    """The same from the given start [J]; no hold leaves it from any start with V(0) below it."""
    potential: float
    """Largest Φ from a start on the reference [J]."""
    potential_from_start: float
    """Largest Φ from the given start [J]."""
    room: JointArray
    """How far each torque can be from that of the reference at its samples [N·m]; inf if unknown."""
    longest: float
    """Longest of the periods tried that has a proof [s], 0 if none has; `period` if that has one."""
    why_not: str
    """Why no proof was tried; empty if it was."""

    @property
    def is_proved(self) -> bool:
        """Whether the bounds hold at this period."""
        return math.isfinite(self.potential_from_start)

    def after(self, initial: float) -> tuple[float, float]:
        """The level of V' and the largest Φ from V(0) = `initial` [J], as V' ≤ V; inf beyond what is proved."""
        # With a history, V(0) alone does not bound V'.
        if not self.readings.is_plain and initial > _ROUNDING * self.level:
            return math.inf, math.inf
        for level, potential in ((self.level, self.potential), (self.level_from_start, self.potential_from_start)):
            if self.is_proved and initial <= level * (1.0 + _ROUNDING):
                return level, potential
        return math.inf, math.inf

    def storage(self, initial: float, nu: float) -> float:
        """Bound of V at the control instants from V(0) = `initial` [J], as V' ≥ (1 − ½hν)V; inf if none is known."""
        return self.after(initial)[0] / (1.0 - 0.5 * self.readings.period * nu)

    @property
    def condition(self) -> Condition:
        """The condition that stands for the assumption of continuous time."""
        name = "longest period with a proof for held torques ≥ the period"
        sides = self.longest * (1.0 + 1e-12), self.readings.period
        return Condition(name, *sides, "s", Label.PROVED, _HERE, checks=Assumption.TIME)

    @property
    def line(self) -> Claim:
        """What is known of the held torque, for the table."""
        if self.is_proved:
            because = f"{_HERE}, {self.readings}"
            return Claim("V' that no hold leaves", self.level, "J", Label.PROVED, because, Group.BOUNDS)
        tried = "of the periods tried, the longest that has a proof; " if self.longest > 0.0 else ""
        because = f"{tried}nothing is proved at {1e3 * self.readings.period:g} ms" + (
            f": {self.why_not}" if self.why_not else ""
        )
        return Claim("period with held torques proved", self.longest, "s", Label.PROVED, because, Group.CONSTANTS)


def held_torque(
    law: LyapunovLaw,
    robot: Robot | None,
    constants: Constants,
    comparison: ComparisonSystem,
    viscous: JointArray,
    unfed: JointArray,
    motion: SampledMotion | None,
    jerk: JointArray | None,
    least: float,
    begin: float,
    readings: Readings,
    other: str = "",
) -> HeldTorque:
    """The bounds for a period, or the longest period that has them.

    viscous, unfed: friction of the joints, and what of it is not fed forward, at most. jerk: bound of |ȧ_d|. least: V∞
    in continuous time. begin: V(0) of the start, 0 without one. other: what else of the loop the proof does not cover.
    """
    why_not = other or _why_not(law, robot, motion, jerk)
    unknown, period = np.full(law.nv, np.inf), readings.period
    if why_not or robot is None or motion is None or jerk is None:
        return unproved(readings, law.nv, why_not)
    arm = CoriolisBounds.of(robot, constants)
    bounds = arm.motion(motion, constants.floor, jerk)
    numbers = constants, arm, bounds, comparison.t, comparison.alpha, viscous
    fed = Fed.of(law.friction, constants, comparison.power)

    def loop(h: float) -> SampledLaw:
        read = readings.at(h)
        return SampledLaw(law, *numbers, h, read.lookahead, read.delay, read.steps, fed, unfed)

    def room(level: float) -> JointArray:
        if not math.isfinite(level):
            return unknown
        asked = Asked(law, constants, *Curvature.with_diagonal(loop(period), level), level)
        return torque_bound(asked, arm, bounds, motion.half)

    begin = max(least, begin)
    near = kept_level(loop(period), least)
    far = near if begin == least else kept_level(loop(period), begin)
    if math.isfinite(far.potential):
        levels = near.reached, max(near.reached, far.reached)
        found = *levels, near.potential, far.potential, room(max(near.seen, far.seen))
        return HeldTorque(readings, *found, period, "")
    shorter = (period * 0.5**k for k in range(1, _HALVINGS + 1))
    longest = next((h for h in shorter if math.isfinite(kept_level(loop(h), begin).potential)), 0.0)
    low, high = longest, 2.0 * longest
    for _ in range(_BISECTIONS if longest > 0.0 else 0):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if math.isfinite(kept_level(loop(middle), begin).potential) else (low, middle)
    return HeldTorque(readings, *_NOTHING, room(begin) if readings.is_plain else unknown, low, "")


def unproved(readings: Readings, nv: int, why_not: str) -> HeldTorque:
    """Nothing is proved of held torques, for this reason."""
    return HeldTorque(readings, *_NOTHING, np.full(nv, np.inf), 0.0, why_not)


def unknown_before(reference: DesiredMotion, nv: int, jerk: JointArray, span: float) -> str:
    """Why a reference has no smooth past of that length before t = 0 [s], from which it could have come; or nothing."""
    late = "what the reference does before t = 0, where the first readings fall, is not the past of its motion"
    now, past = at_times(reference, np.array([0.0]), nv), at_times(reference, np.array([-span]), nv)
    held = isinstance(reference, Sampled) and reference.t[0] > -span  # before its first sample
    if held and max(np.abs(now.v).max(), np.abs(now.a).max()) > 1e-9:
        return f"{late}: begin at rest"
    slack = 1e-9 * (1.0 + np.abs(now.q) + np.abs(now.v) + np.abs(now.a))
    for order, change in enumerate(
        (now.a - past.a, now.v - past.v - span * now.a, now.q - past.q - span * now.v + 0.5 * span**2 * now.a), start=1
    ):
        if (np.abs(change) > (1.0 + 1e-6) * jerk * span**order / math.factorial(order) + slack).any():
            return late
    return ""


def _why_not(law: LyapunovLaw, robot: Robot | None, motion: SampledMotion | None, jerk: JointArray | None) -> str:
    if motion is None:
        return "give the reference"
    if jerk is None:
        return "the reference states no bound of its jerk, `largest_jerk`"
    return why_no_arm_bounds(law, robot)


def why_no_arm_bounds(law: LyapunovLaw, robot: Robot | None) -> str:
    """Why the velocities of a loop are not bounded in every pose of the arm; empty if they are."""
    if robot is None or type(law.dynamics) not in (PinocchioDynamics, AnalyticDynamics):
        return "only for the exact model of an arm"
    return f"not tried for more than {MOST_JOINTS} joints" if law.nv > MOST_JOINTS else ""
