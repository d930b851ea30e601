"""Desired motions: callables ref(t) -> Reference(q, v, a) whose v and a are the exact derivatives of q.

t is a time [s], giving shapes (n,), or an array of times, giving shapes (..., n); `simulate` takes any such callable.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import pinocchio as pin

from nbs_pin.base.arguments import DURATION, MOST_JOINTS, called, checked, choice, count, function, number
from nbs_pin.base.checks import LARGEST, SMALLEST, PerJoint, floats, is_usual, per_joint, told
from nbs_pin.base.doors import option
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.records import Reference
from nbs_pin.base.shown import Shown, joints_told, spread
from nbs_pin.base.units import units
from nbs_pin.robots.robot import ARM, Robot

DesiredMotion: TypeAlias = Callable[[Any], Reference]
"""ref(t) -> Reference, for a time [s] (shapes (n,)) or an array of times (shapes (..., n)).

Motions may state `duration` [s], how long they last, `largest_jerk` (n,), a bound of |ȧ_d| while they do [rad/s³], and
`notes`, a dict for `Run.info`.
"""


MOTION = function(1, "a motion, a function of times [s] that returns a Reference, such as Sinusoid")


def at_times(reference: DesiredMotion, t: np.ndarray, nv: int) -> Reference:
    """The reference at times t (rows,) [s], which it receives read-only, as float arrays (rows, nv).

    Raises:
        ArgumentError: If it is not a motion of nv joints for an array of times, fails, or is not finite.
    """
    given = called("the reference", reference, t)
    if not isinstance(given, tuple | list) or len(given) != len(Reference._fields):
        raise ArgumentError(
            f"the reference gave {told(given)}, expected a Reference of q, v and a; take Hold, Sinusoid or a file's."
        )
    sampled = Reference(*(floats(f"the reference's {name}", x) for name, x in zip("qva", given, strict=True)))
    for name, rows in sampled._asdict().items():
        if rows.ndim and rows.shape[-1] != nv:
            raise ArgumentError(
                f"the reference has {rows.shape[-1]} joints, the arm has {nv}; give one motion per joint."
            )
        if rows.shape != (t.size, nv):
            raise ArgumentError(
                f"the reference at {t.size} times gave {name} of shape {rows.shape}, expected ({t.size}, {nv}); let it "
                f"take arrays of times and return one value for each of the {nv} joints."
            )
        if not is_usual(rows):
            k, joint = np.argwhere(~(np.abs(rows) <= LARGEST))[0]
            raise ArgumentError(
                f"the reference's {name} of joint {joint} at t = {t[k]:g} s is {rows[k, joint]:g}, expected a finite"
                f" number of at most {LARGEST:g}; correct it."
            )
    return sampled


def instants(t: Any) -> np.ndarray:
    """Times as a float array of any shape; raises ArgumentError unless they are finite numbers."""
    if type(t) is float and abs(t) <= LARGEST:
        return np.array(t)
    array = floats("t", t)
    if not is_usual(array):
        raise ArgumentError(f"t is {told(t)}, expected a time or times, finite numbers [s]; correct it.")
    return array


@dataclass(frozen=True, eq=False, repr=False)
class Sinusoid(Shown):
    """q = offset + amplitude·sin(frequency·t + phase), each one number or one per joint.

    amplitude, offset and phase [rad]; frequency [rad/s]. Numbers alone give the motion of one joint.

    Example:
        >>> import nbs_pin as nbs
        >>> nbs.Sinusoid(amplitude=[0.5, 0.2], frequency=2.0)(t=0.0).v
        array([1. , 0.4])
    """

    amplitude: PerJoint
    frequency: PerJoint
    phase: PerJoint = 0.0
    offset: PerJoint = 0.0

    def __post_init__(self) -> None:
        names = ("amplitude", "frequency", "phase", "offset")
        per_joint(self, *names)
        fields = np.broadcast_arrays(*(np.atleast_1d(getattr(self, name)) for name in names))
        for name, value in zip(names, fields, strict=True):
            object.__setattr__(self, name, value)

    @classmethod
    @checked(robot=ARM, frequency=number(above=0.0, most=1000.0, unit="rad/s"), amplitude=number(above=0.0, unit="rad"))
    def for_robot(cls, robot: Robot, frequency: float = 1.0, amplitude: float = 0.5) -> "Sinusoid":
        """A moderate motion about `resting_posture`, with neighbouring joints a quarter period apart.

        Each joint has the angular frequency `frequency` [rad/s] and the least of three amplitudes: `amplitude` [rad], a
        quarter of its range, and half its velocity limit over `frequency`. Raises ArgumentError unless both are > 0.
        """
        span = np.minimum(robot.upper - robot.lower, 2.0 * np.pi)
        reach = np.minimum.reduce([np.full(robot.nv, amplitude), 0.25 * span, 0.5 * robot.velocity_limit / frequency])
        return cls(reach, frequency, 0.5 * np.pi * (np.arange(robot.nv) % 2), resting_posture(robot))

    def _facts(self) -> Iterable[str]:
        ranges = spread("amplitude", self.amplitude, "rad"), spread("frequency", self.frequency, "rad/s")
        return joints_told(np.size(self.amplitude)), *ranges

    @property
    def largest_jerk(self) -> np.ndarray:
        """Bound of |ȧ_d| of each joint, |A|ω³ [rad/s³]."""
        return np.abs(self.amplitude * np.asarray(self.frequency, dtype=float) ** 3)

    def __call__(self, t: Any) -> Reference:
        """Desired motion at t [s]."""
        A, w = self.amplitude, self.frequency
        angle = w * instants(t)[..., None] + self.phase
        sine, cosine = np.sin(angle), np.cos(angle)
        return Reference(self.offset + A * sine, A * w * cosine, -A * w**2 * sine)


def resting_posture(robot: Robot) -> np.ndarray:
    """The middle of the joint ranges [rad], or the posture nearest to it that needs at most half the effort limits.

    It is chosen among samples within a quarter of each range of the middle; if none qualifies, the one of least load.
    """
    lower, upper = robot.sampling_range
    middle, data = 0.5 * (lower + upper), robot.model.createData()
    inner = np.random.default_rng(0).uniform(-0.25, 0.25, (2000, robot.nv)) * (upper - lower)
    postures = middle + inner[np.argsort(np.linalg.norm(inner, axis=-1))]
    postures = np.concatenate([middle[None], postures])
    effort = [np.abs(pin.computeGeneralizedGravity(robot.model, data, q)) / robot.effort_limit for q in postures]
    load = np.max(effort, axis=-1)
    return postures[np.argmax(load <= max(0.5, load.min()))]


@checked(n=count(1, MOST_JOINTS, "joints"))
def paper_reference(n: int) -> Sinusoid:
    """The paper's q_d = [sin 0.1t, cos 0.1t, sin 0.1t, …] for n joints [rad].

    Example:
        >>> import nbs_pin as nbs
        >>> nbs.paper_reference(2)(0.0).q
        array([0., 1.])
    """
    return Sinusoid(amplitude=np.ones(n), frequency=0.1, phase=0.5 * np.pi * (np.arange(n) % 2))


@dataclass(frozen=True, eq=False)
class Hold:
    """Constant q [rad], one number per joint, with v = a = 0.

    Example:
        >>> import nbs_pin as nbs
        >>> nbs.Hold([0.1, 0.2])(t=0.0)
        Reference(q=array([0.1, 0.2]), v=array([0., 0.]), a=array([0., 0.]))
    """

    q: PerJoint

    def __post_init__(self) -> None:
        per_joint(self, "q")

    @property
    def largest_jerk(self) -> np.ndarray:
        """0: it does not move [rad/s³]."""
        return np.zeros(np.size(self.q))

    def __call__(self, t: Any) -> Reference:
        """Desired motion at t [s]."""
        q = np.atleast_1d(self.q)
        zero = np.zeros((*instants(t).shape, q.size))
        return Reference(zero + q, zero, zero.copy())


@dataclass(frozen=True, eq=False, repr=False)
class MinimumJerk(Shown):
    """Motion through waypoints, at rest at each: quintics 10s³ − 15s⁴ + 6s⁵, which minimise the integral of jerk².

    waypoints (k, n) [rad] are reached at increasing times (k,) [s]; q is held before the first and after the last.
    On a segment of length Δq and duration T, |v| ≤ 1.875 |Δq|/T and |a| ≤ 5.774 |Δq|/T².

    Example:
        >>> import nbs_pin as nbs
        >>> nbs.MinimumJerk(waypoints=[[0.0], [1.0]], times=[0.0, 2.0])(t=1.0)
        Reference(q=array([0.5]), v=array([0.9375]), a=array([0.]))
    """

    waypoints: Any
    times: Any

    def __post_init__(self) -> None:
        waypoints, times = floats("waypoints", self.waypoints), floats("times", self.times)
        if waypoints.ndim != 2 or times.shape != waypoints.shape[:1] or times.size < 2 or waypoints.shape[1] == 0:
            raise ArgumentError(
                f"MinimumJerk was given waypoints of shape {waypoints.shape} at times of shape {times.shape}, "
                "expected (k, n) and (k,) with k ≥ 2; give one time per waypoint."
            )
        if not (is_usual(waypoints) and is_usual(times)):
            raise ArgumentError("MinimumJerk's waypoints and times must be finite; correct the one that is not.")
        if not (np.diff(times) >= SMALLEST).all():
            k = int(np.argmin(np.diff(times) >= SMALLEST))
            raise ArgumentError(f"times must increase, but times[{k + 1}] = {times[k + 1]} ≤ {times[k]}; correct them.")
        object.__setattr__(self, "waypoints", waypoints)
        object.__setattr__(self, "times", times)

    def _facts(self) -> Iterable[str]:
        joints = joints_told(self.waypoints.shape[1])
        return joints, f"{len(self.times)} waypoints", f"{self.times[0]:.4g} to {self.times[-1]:.4g} s"

    @property
    def duration(self) -> float:
        """Time of the last waypoint [s]."""
        return float(self.times[-1])

    @property
    def largest_jerk(self) -> np.ndarray:
        """Bound of |ȧ_d| of each joint, the largest 60|Δq|/T³ of the segments [rad/s³]."""
        moved = np.abs(np.diff(self.waypoints, axis=0))
        return np.asarray((60.0 * moved / np.diff(self.times)[:, None] ** 3).max(axis=0))

    def __call__(self, t: Any) -> Reference:
        """Desired motion at t [s]."""
        t = instants(t)
        k = np.clip(np.searchsorted(self.times, t, side="right") - 1, 0, self.times.size - 2)
        duration = (self.times[k + 1] - self.times[k])[..., None]
        s = np.clip((t - self.times[k])[..., None] / duration, 0.0, 1.0)
        start, delta = self.waypoints[k], self.waypoints[k + 1] - self.waypoints[k]
        return Reference(
            start + delta * (s**3 * (10.0 - 15.0 * s + 6.0 * s**2)),
            delta / duration * (30.0 * (s * (1.0 - s)) ** 2),
            delta / duration**2 * (60.0 * s * (1.0 - s) * (1.0 - 2.0 * s)),
        )


@checked(reference=MOTION, robot=ARM, duration=DURATION, samples=count(2, 1_000_000))
def check_reference(
    reference: DesiredMotion, robot: Robot, duration: float, *, samples: int = 2001, joint_friction: str = "drop"
) -> None:
    """Check a desired motion against the limits of the arm at `samples` times over `duration` [s].

    Its torque is M a + C v + G, with the joint friction of the URDF if `joint_friction` is "keep" and without it if it
    is "drop"; `Robot.with_effort_limit` sets other effort limits.

    Raises:
        ArgumentError: If a limit is exceeded; names the joint, the time, the value, the limit and the remedy.

    Example:
        >>> import nbs_pin as nbs
        >>> robot = nbs.load_robot("two_link")
        >>> motion = nbs.Sinusoid.for_robot(robot)
        >>> nbs.check_reference(motion, robot, duration=10.0)
        >>> nbs.check_reference(motion, robot.with_effort_limit(1.0), duration=10.0)
        Traceback (most recent call last):
            ...
        nbs_pin.base.exceptions.ArgumentError: ...
    """
    choice("drop", "keep")("check_reference: joint_friction", joint_friction)
    t = np.linspace(0.0, duration, samples)
    desired = at_times(reference, t, robot.nv)
    degrees = " (are these degrees?)" if np.median(np.max(np.abs(desired.q), axis=-1)) > 2.0 * np.pi else ""
    _check_range(robot, t, "position", desired.q, robot.lower, robot.upper, f"stay inside{degrees}")
    _check_range(robot, t, "velocity", desired.v, -robot.velocity_limit, robot.velocity_limit, "slow it down")
    _check_torque(robot, t, desired, joint_friction == "keep")


def _check_torque(robot: Robot, t: np.ndarray, desired: Reference, friction: bool) -> None:
    """Raise ArgumentError where the torque exceeds a limit; the remedy tells friction and weight from inertia."""
    data, effort = robot.model.createData(), robot.effort_limit
    drag = np.zeros(robot.nv)
    if friction:
        _check_friction(robot, desired.v)
        drag = robot.damping * desired.v + robot.friction * np.tanh(desired.v / _TRANSITION)
    tau = np.array([pin.rnea(robot.model, data, *row) for row in zip(*desired, strict=True)]) + drag
    beyond = np.argwhere(~(np.abs(tau) <= effort))
    if not beyond.size:
        return
    k, i = beyond[0]
    weights = np.abs([pin.computeGeneralizedGravity(robot.model, data, q) for q in desired.q])
    weight, most = weights[k, i], np.maximum(np.abs(tau), weights).max(axis=0)
    wanted = {robot.joint_names[j]: {"effort": _rounded_up(float(most[j]))} for j in np.unique(beyond[:, 1])}
    enough = option("limits", wanted)
    remedy = f"slow it down, choose another posture or raise the limit: {enough}"
    if weight > effort[i]:
        remedy = remedy.replace("slow it down, choose", f"its weight alone takes {weight:.4g}, so choose")
    elif friction and abs(drag[k, i]) > 0.5 * abs(tau[k, i]):
        remedy = f"its friction takes {abs(drag[k, i]):.4g} of that: {option('joint_friction', 'drop')}, or {remedy}"
    _check_range(robot, t, "torque", tau, -effort, effort, remedy)


def _check_friction(robot: Robot, v: np.ndarray) -> None:
    """Raise ArgumentError if a joint that is to move cannot, because its friction takes all of its effort."""
    stuck = (robot.friction >= robot.effort_limit) & v.any(axis=0)
    if stuck.any():
        joint = robot.joints[int(np.argmax(stuck))]
        (unit,) = units("torque", [joint.prismatic])
        raise ArgumentError(
            f"the Coulomb friction {joint.friction:g} {unit} of joint '{joint.name}' is not below its effort limit "
            f"{joint.effort:g} {unit}, so that it cannot move; correct the URDF, leave friction out "
            f"({option('joint_friction', 'drop')}) or raise the limit "
            f"({option('limits', {joint.name: {'effort': _rounded_up(2.0 * joint.friction)}})})."
        )


def _rounded_up(value: float) -> float:
    """The value rounded up to two digits."""
    unit = 10.0 ** (np.floor(np.log10(value)) - 1.0)
    return float(f"{np.ceil(value / unit) * unit:.6g}")


_TRANSITION = 0.01
"""Speed scale of Coulomb friction, that of `JointFriction.of` [rad/s]."""


def _check_range(
    robot: Robot, t: np.ndarray, what: str, x: np.ndarray, lower: np.ndarray, upper: np.ndarray, remedy: str
) -> None:
    inside = (x >= lower) & (x <= upper)
    if inside.all():
        return
    k, i = np.argwhere(~inside)[0]
    joint = robot.joints[i]
    (unit,) = units(what, [joint.prismatic])
    raise ArgumentError(
        f"the reference needs the {what} {x[k, i]:.6g} {unit} of joint '{joint.name}' at t = {t[k]:.4g} s, "
        f"outside [{lower[i]:.6g}, {upper[i]:.6g}]; {remedy}."
    )
