"""The guard between a law and an arm: what may go in, what may come out, and when to stop (docs/runtime.md).

It is a monitor that keeps torques within what the arm can give and stops on what it can see. It is not a safety
function: nothing here replaces the brakes, the limits and the emergency stop of the arm itself.
"""

from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from nbs_pin.base.arguments import PERIOD, check_fields, checked, count, flag, joints, maybe, number
from nbs_pin.base.arrays import JointArray
from nbs_pin.base.checks import PerJoint, floats, told
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.certificates.certificate import CERTIFICATE, Certificate
from nbs_pin.controllers.gains import gains_for_robot
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.kernels import guarding as at
from nbs_pin.robots.robot import ARM, Robot

PATIENCE = 20
"""Missed or bad samples in a row at which the guard stops."""
FULL_EFFORT_IN = 0.025
"""Time from no torque to the effort limit where no torque rate is given [s], at 1000 N·m/s or more."""
ERROR, SLIDE = 0.5, 0.1
"""Default errors beyond which a loop counts as diverged [rad, m]."""
RESOLUTION, SLIDE_RESOLUTION = 2.0 * np.pi * 2.0**-11, 1e-4
"""Default encoder steps [rad, m]."""
BRAKE = 10.0
"""Bandwidth of the gains whose damping the safe stop has [rad/s]."""
_IMPLAUSIBLE = 3.0  # times the velocity limit: no reading of an arm that works
_STRICT = 1.0 - 1e-6  # of the torque rate, so that a receiver that rounds sees no more than the limit
_LOST_AFTER, _RECOVERY, _REVERSALS, _SIGN_SPEED = 5, 100, 10.0, 0.1


class Mode(IntEnum):
    """State of a guard; STOPPED is left by an explicit reset only.

    Example:
        >>> import nbs_pin as nbs
        >>> [mode.name for mode in nbs.Mode]
        ['OK', 'DEGRADED', 'STOPPED']
    """

    OK = at.OK
    DEGRADED = at.DEGRADED
    """Something was held, late or missing within the last hundred instants."""
    STOPPED = at.STOPPED


class Fault(IntEnum):
    """What made a guard stop.

    Example:
        >>> import nbs_pin as nbs
        >>> nbs.Fault.FROZEN.sentence
        'a position did not change while the reference moved'
    """

    NONE = at.NONE
    MISSED = at.MISSED
    NOT_FINITE = at.NOT_FINITE
    JUMP = at.JUMP
    FROZEN = at.FROZEN
    TIME = at.TIME
    PERIOD = at.PERIOD
    REFERENCE = at.REFERENCE
    SIGN = at.SIGN
    DIVERGED = at.DIVERGED
    EXTERNAL = at.EXTERNAL
    OUTPUT = at.OUTPUT
    CHATTER = at.CHATTER
    MODEL = at.MODEL
    LAW = at.LAW
    ARM = at.ARM
    REQUESTED = at.REQUESTED

    @property
    def sentence(self) -> str:
        """What it means."""
        return _SENTENCES[self]


_SENTENCES = {
    Fault.NONE: "nothing is wrong",
    Fault.MISSED: "no sample arrived for too many periods",
    Fault.NOT_FINITE: "readings were not finite for too many periods",
    Fault.JUMP: "positions or velocities were where no motion of the arm leads",
    Fault.FROZEN: "a position did not change while the reference moved",
    Fault.TIME: "time stood still, went back or jumped",
    Fault.PERIOD: "the period is not the one that the law was designed for",
    Fault.REFERENCE: "the reference jumped, was not finite or left the range of a joint",
    Fault.SIGN: "a velocity has the wrong sign for its position",
    Fault.DIVERGED: "the tracking error is beyond its bound",
    Fault.EXTERNAL: "a torque from outside is beyond its bound",
    Fault.OUTPUT: "the law gave torques that are not finite for too many periods",
    Fault.CHATTER: "torques went from limit to limit",
    Fault.MODEL: "the law does not hold the arm against gravity",
    Fault.LAW: "the law raised an exception",
    Fault.ARM: "the arm reported a fault",
    Fault.REQUESTED: "a stop was asked for",
}


class Counters(NamedTuple):
    """What has happened since the guard began."""

    held: int
    """Instants at which the last torque was held."""
    late: int
    """Periods that passed without a call."""
    overruns: int
    """Calls that came back after the end of their period."""
    saturated: int
    """Instants at which the law asked for more than the arm gives."""


def _bound(name: str, value: Any) -> np.ndarray:
    """A bound of positions per joint, which may be infinite."""
    array = floats(name, value)
    if array.ndim > 1 or array.size == 0 or np.isnan(array).any():
        raise ArgumentError(f"{name} is {told(value)}; give one number, or one per joint, ±inf for none.")
    return array


@dataclass(frozen=True, eq=False)
class Guard:
    """The limits of a guard; `Guarded` applies them to a law, and `begin`, `admit`, `release` are one step of it.

    Per joint, one number or (n,). Errors count where they exceed `error_limit` plus twice the size of the error at the
    start, which fades at 1/s.

    Raises:
        ArgumentError: If a number is out of range, or the numbers of joints differ.

    Example:
        >>> import nbs_pin as nbs
        >>> guard = nbs.Guard.for_robot(nbs.load_robot("panda"))
        >>> guard.effort_limit[0], guard.torque_rate[0], guard.error_limit[0]
        (np.float64(87.0), np.float64(3480.0), np.float64(0.5))
    """

    period: float
    """The control period that the law was designed for [s]."""
    effort_limit: PerJoint
    """Largest |τ| [N·m]."""
    velocity_limit: PerJoint
    """Velocities beyond three times this are no readings of an arm that works [rad/s]; inf for no check."""
    lower: PerJoint
    """Range of the reference [rad]."""
    upper: PerJoint
    damping: PerJoint
    """Damping of the safe stop [N·m·s/rad]."""
    torque_rate: PerJoint = np.inf
    """Largest |Δτ|/period [N·m/s]."""
    error_limit: PerJoint = ERROR
    """|z1| beyond which the loop has diverged [rad]; a certificate's bounds are the natural choice."""
    external_limit: PerJoint = np.inf
    """Largest torque from outside [N·m], as the arm tells it, or else a `MomentumObserver`; inf for no check."""
    resolution: PerJoint = RESOLUTION
    """Encoder step [rad]: a reading that stays while the reference moves by two of them is frozen."""
    wraps: PerJoint = 0.0
    """1 for continuous joints."""
    compensated: bool = False
    """Whether the arm adds G(q) by itself: torques are then sent without it."""
    patience: int = PATIENCE
    """Missed or bad samples in a row at which it stops."""
    longest: float = 1.5
    """Mean period at which it stops, as a multiple of `period`; from 1.2 on it is degraded."""

    def __post_init__(self) -> None:
        above = {"effort_limit": "N·m", "velocity_limit": "rad/s", "torque_rate": "N·m/s", "error_limit": "rad"}
        positive = {name: joints(above=0.0, unit=unit, infinite=True) for name, unit in above.items()}
        least = {"damping": "N·m·s/rad", "resolution": "rad", "wraps": ""}
        check_fields(
            self,
            period=PERIOD,
            **positive,
            external_limit=joints(above=0.0, unit="N·m", infinite=True),
            **{name: joints(least=0.0, unit=unit) for name, unit in least.items()},
            lower=_bound,
            upper=_bound,
            compensated=flag,
            patience=count(2, 1000, "samples"),
            longest=number(above=1.2, most=100.0),
        )
        sizes = {np.size(getattr(self, name)) for name in _PER_JOINT} - {1}
        if len(sizes) > 1:
            raise ArgumentError(f"Guard was given limits of {sorted(sizes)} joints; give one number, or one per joint.")
        n = max(sizes, default=1)
        for name in _PER_JOINT:
            object.__setattr__(self, name, np.full(n, getattr(self, name), dtype=float))
        at.compile_guarding()

    @classmethod
    @checked(
        robot=ARM,
        period=PERIOD,
        certificate=maybe(CERTIFICATE),
        torque_rate=maybe(joints(above=0.0, unit="N·m/s", infinite=True)),
        external_limit=joints(above=0.0, unit="N·m", infinite=True),
        compensated=flag,
    )
    def for_robot(
        cls,
        robot: Robot,
        period: float = 0.001,
        *,
        certificate: Certificate | None = None,
        torque_rate: PerJoint = None,
        external_limit: PerJoint = np.inf,
        compensated: bool = False,
    ) -> "Guard":
        """The guard of an arm: its limits, and the certificate's bounds of each |z1| in place of 0.5 rad (0.1 m).

        Without a torque rate the effort limit is reached in 25 ms, at 1000 N·m/s or more; a driver may state what its
        arm takes, such as `FrankaArm.torque_rate`.
        """
        if torque_rate is None:
            torque_rate = np.maximum(1000.0, robot.effort_limit / FULL_EFFORT_IN)
        gains = gains_for_robot(robot, PinocchioDynamics(robot), bandwidth=BRAKE, period=max(period, 0.005))
        error = np.where(robot.prismatic, SLIDE, ERROR) if certificate is None else certificate.joint_errors
        return cls(
            period=period,
            effort_limit=robot.effort_limit,
            velocity_limit=robot.velocity_limit,
            lower=robot.lower - 1e-9,
            upper=robot.upper + 1e-9,
            damping=gains.damping,
            torque_rate=torque_rate,
            error_limit=np.minimum(error, 1e6),
            external_limit=external_limit,
            resolution=np.where(robot.prismatic, SLIDE_RESOLUTION, RESOLUTION),
            wraps=robot.continuous.astype(float),
            compensated=compensated,
        )

    @property
    def nv(self) -> int:
        """Number of joints."""
        return int(np.size(self.effort_limit))

    @cached_property
    def config(self) -> np.ndarray:
        """The configuration of the kernels (`kernels/guarding.py`)."""
        c = np.zeros(at.NUMBERS)
        c[at.LENGTH], c[at.COMPENSATED], c[at.PATIENCE] = self.period, float(self.compensated), self.patience
        c[at.LOST_AFTER], c[at.RECOVERY], c[at.REVERSALS] = _LOST_AFTER * self.patience, _RECOVERY, _REVERSALS
        c[at.SLOWEST], c[at.SLOW], c[at.FAST], c[at.FASTEST] = self.longest, 1.2, 0.8, 0.5
        c[at.DECAY], c[at.SIGN_SPEED] = np.exp(-self.period), _SIGN_SPEED
        rows = np.zeros((at.VECTORS, self.nv))
        rows[at.EFFORT], rows[at.STEP] = self.effort_limit, self.torque_rate * self.period * _STRICT
        rows[at.REACH], rows[at.SPEED] = _IMPLAUSIBLE * self.velocity_limit, self.velocity_limit
        rows[at.ERROR], rows[at.PUSH], rows[at.DAMPING] = self.error_limit, self.external_limit, self.damping
        rows[at.RESOLUTION], rows[at.WRAPS] = self.resolution, self.wraps
        rows[at.LOWER], rows[at.UPPER] = self.lower, self.upper
        return np.concatenate([c, rows.ravel()])

    def begin(self, q: JointArray, q_ref: JointArray, gravity: JointArray) -> np.ndarray:
        """The state before the first sample, for an arm that is held at q against gravity [N·m]."""
        state = np.zeros(at.SCALARS)
        state[at.MEAN], state[at.QUIET] = 1.0, _RECOVERY
        rows = np.zeros((at.ROWS, self.nv))
        rows[at.Q], rows[at.Q_REF], rows[at.GRAVITY] = q, q_ref, gravity
        sent = np.zeros(self.nv) if self.compensated else gravity
        rows[at.TAU] = np.clip(sent, -self.effort_limit, self.effort_limit)
        off = np.asarray(q - q_ref)
        off = np.where(self.wraps > 0.0, np.arctan2(np.sin(off), np.cos(off)), off)
        rows[at.ROOM] = 2.0 * np.linalg.norm(off)
        return np.concatenate([state, rows.ravel()])

    def vector(self, state: np.ndarray, which: int) -> JointArray:
        """A view of one vector of a state, such as `guarding.TAU`."""
        return state[at.SCALARS + which * self.nv : at.SCALARS + (which + 1) * self.nv]

    def counters(self, state: np.ndarray) -> Counters:
        """What a state has counted."""
        return Counters(*(int(state[k]) for k in (at.HELD, at.LATE, at.OVERRUN, at.CUT)))


_PER_JOINT = (
    "effort_limit",
    "velocity_limit",
    "lower",
    "upper",
    "damping",
    "torque_rate",
    "error_limit",
    "external_limit",
    "resolution",
    "wraps",
)
