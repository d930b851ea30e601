"""From where an arm is to a motion that begins elsewhere, without a step in position, velocity or acceleration."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin

from nbs_pin.base.arguments import DURATION, check_fields, checked, maybe, numbers
from nbs_pin.base.arrays import JointArray
from nbs_pin.base.checks import vector_of
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.records import Reference
from nbs_pin.base.units import units
from nbs_pin.motions.references import MOTION, DesiredMotion, at_times, check_reference, instants
from nbs_pin.motions.timings import Smooth
from nbs_pin.robots.robot import ARM, Robot, configuration_difference

_LENGTHS = np.geomspace(0.5, 1000.0, 200).tolist()  # [s]
_LONGEST_WITH_MOTION = 30.0  # a motion does not have to hurry for a longer approach, it waits [s]
_RAMPS = (1.0, 2.0, 4.0)  # [s]
_SHARE = 0.5  # of the velocity limit that the approach takes, beside what the motion takes
_STEP = 0.01  # between instants at which limits are looked at [s]
_SPARE = 1e-3  # of velocity and effort limits, and distance from position limits [rad, m], for what is between them
_EDGE = 1e-9  # an arm on a limit begins this far inside, so that no rounding leads it out [rad, m]


@dataclass(frozen=True, eq=False)
class Approach:
    """q_d(t) = motion(s(t)) + p(t), where p is the quintic from the given state to 0 in `length` [s].

    The motion runs from the beginning, s = t, so that all of it has its own time, unless motion and p together would
    leave the limits of the arm. Then it waits: the arm comes to rest where the motion begins, and from there ṡ rises
    smoothly from 0 to 1 within `ramp`, after which the motion is `lag` late. Position, velocity and acceleration begin
    as those of the arm and end as the motion's.
    """

    motion: DesiredMotion
    length: float
    """How long p takes [s]."""
    coefficients: np.ndarray
    """(6, n), of the powers of t/length."""
    ramp: float | None = None
    """How long a motion that waits takes to its own speed [s]; None for one that does not wait."""

    def __post_init__(self) -> None:
        check_fields(self, motion=MOTION, length=DURATION, coefficients=numbers(6, None), ramp=maybe(DURATION))

    @classmethod
    @checked(motion=MOTION, robot=ARM, length=maybe(DURATION))
    def from_state(
        cls, motion: DesiredMotion, robot: Robot, q: Any, v: Any = None, *, length: float | None = None
    ) -> "Approach":
        """From the state (q, v) [rad, rad/s], at rest if v is None, within position, velocity and effort limits.

        Without a `length`, p takes the shortest of 0.5 to 1000 s in which it needs half the velocity limits at most.
        The motion waits where no length up to 30 s, or not the one given, keeps the limits while it runs. What it
        does after the approach is left to `check_reference`.

        Raises:
            ArgumentError: If the state is not one of the arm or outside its limits, or no approach keeps them.

        Example:
            >>> import nbs_pin as nbs
            >>> robot = nbs.load_robot("two_link")
            >>> motion = nbs.Approach.from_state(nbs.Hold([0.3, 0.2]), robot, [0.0, 0.0])
            >>> motion(0.0).q.tolist(), motion(motion.length).q.tolist(), motion.lag
            ([0.0, 0.0], [0.3, 0.2], 0.0)
        """
        n, lengths = robot.nv, _LENGTHS if length is None else [length]
        here, rate = vector_of("q", q, n, "rad"), np.zeros(n) if v is None else vector_of("v", v, n, "rad/s")
        here = _inside(robot, here, rate)
        begin = Reference(*(x[0] for x in at_times(motion, np.zeros(1), n)))
        apart = configuration_difference(here, begin.q, robot.continuous)
        edges = np.sort([begin.q + apart, begin.q], axis=0)
        lower = np.maximum(robot.lower, np.minimum(robot.lower + _SPARE, edges[0] - 0.5 * _EDGE))
        upper = np.minimum(robot.upper, np.maximum(robot.upper - _SPARE, edges[1] + 0.5 * _EDGE))
        for T in lengths:
            made = cls(motion, T, _quintic(apart, rate - begin.v, -begin.a, T))
            fits = length is not None or (T <= _LONGEST_WITH_MOTION and made._is_calm(robot, rate - begin.v))
            if fits and _keeps(made, robot, np.linspace(0.0, T, 200 + round(T / _STEP)), lower, upper):
                return made
        check_reference(motion, robot, _RAMPS[-1])
        for T in lengths:
            made = cls(motion, T, _quintic(apart, rate, np.zeros(n), T), _RAMPS[-1])
            fits = length is not None or made._is_calm(robot, rate)
            if fits and _keeps(made, robot, np.linspace(0.0, T, 200), lower, upper):
                break
        else:
            if length is None and rate.any():
                raise ArgumentError(
                    "no approach from where the arm is, at its velocity, keeps its limits; let it come to rest first."
                )
        nearer = "bring the arm nearer to the beginning of the motion first"
        return made._with_ramp(robot, nearer if length is None else "give another length, or none")

    def _with_ramp(self, robot: Robot, advice: str) -> "Approach":
        """The same that waits, with the shortest ramp that keeps the limits; raises ArgumentError if none does."""
        for ramp in _RAMPS:
            made = Approach(self.motion, self.length, self.coefficients, ramp)
            t = np.linspace(self.length, self.length + ramp, 200 + round(ramp / _STEP))
            if _keeps(made, robot, t, robot.lower, robot.upper):
                break
        try:
            check_reference(made, robot, made.length + ramp)
        except ArgumentError as error:
            raise ArgumentError(
                f"no approach to the motion keeps the limits of the arm: {str(error).removesuffix('.')}, or {advice}."
            ) from error
        return made

    @property
    def lag(self) -> float:
        """By how much the motion is late, once it is followed [s]."""
        return 0.0 if self.ramp is None else self.length + 0.5 * self.ramp

    @property
    def notes(self) -> dict[str, Any]:
        """Those of the motion."""
        return dict(getattr(self.motion, "notes", {}))

    def __call__(self, t: Any) -> Reference:
        """Desired motion at t [s]."""
        t = instants(t)
        p, dp, ddp = self._polynomial(t)
        s, ds, dds = self._time(t)
        q, v, a = (np.asarray(x, dtype=float) for x in self.motion(s))
        ds, dds = ds[..., None], dds[..., None]
        return Reference(q + p, v * ds + dp, a * ds**2 + v * dds + ddp)

    def _time(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Time of the motion with its two derivatives."""
        if self.ramp is None:
            return t, np.ones_like(t), np.zeros_like(t)
        late = np.maximum(t - self.length, 0.0)
        u, speed = np.minimum(late / self.ramp, 1.0), Smooth(self.ramp)(late)
        s = self.ramp * u**4 * (2.5 - 3.0 * u + u**2) + np.maximum(late - self.ramp, 0.0)
        return s, np.asarray(speed.s), np.asarray(speed.ds)

    def _is_calm(self, robot: Robot, begin: JointArray) -> bool:
        """Whether p stays below its share of the velocity limits, or its own beginning where that is more."""
        _, rate, _ = self._polynomial(np.linspace(0.0, self.length, 101))
        return bool((np.abs(rate) <= 1.0001 * np.maximum(_SHARE * robot.velocity_limit, np.abs(begin))).all())

    def _polynomial(self, t: np.ndarray) -> tuple[JointArray, JointArray, JointArray]:
        c, T = self.coefficients, self.length
        s = np.clip(t / T, 0.0, 1.0)[..., None]
        p = sum(c[k] * s**k for k in range(6))
        dp = sum(k * c[k] * s ** (k - 1) for k in range(1, 6)) / T
        ddp = sum(k * (k - 1) * c[k] * s ** (k - 2) for k in range(2, 6)) / T**2
        inside = np.asarray(t < T)[..., None]
        return tuple(np.where(inside, x, 0.0) for x in (p, dp, ddp))  # type: ignore[return-value]


def _inside(robot: Robot, q: JointArray, v: JointArray) -> JointArray:
    """The position, on a limit a little inside of it; raises ArgumentError for a state outside the limits."""
    for what, x, lower, upper, remedy in (
        ("position", q, robot.lower, robot.upper, "move it inside first"),
        ("velocity", v, -robot.velocity_limit, robot.velocity_limit, "let it slow down first"),
    ):
        outside = (x < lower - _EDGE) | (x > upper + _EDGE)
        if outside.any():
            i = int(np.argmax(outside))
            unit = units(what, robot.prismatic)[i]
            raise ArgumentError(
                f"the arm has the {what} {x[i]:.6g} {unit} of joint '{robot.joint_names[i]}', outside "
                f"[{lower[i]:.6g}, {upper[i]:.6g}]; {remedy}."
            )
    return np.clip(q, robot.lower + _EDGE, robot.upper - _EDGE)


def _keeps(motion: DesiredMotion, robot: Robot, t: np.ndarray, lower: JointArray, upper: JointArray) -> bool:
    """Whether a motion keeps these positions, and the limits of velocity and effort but for what is spared of them."""
    q, v, a = at_times(motion, t, robot.nv)
    share = 1.0 - _SPARE
    if ((q < lower) | (q > upper)).any() or (np.abs(v) > share * robot.velocity_limit).any():
        return False
    data, most = robot.model.createData(), share * robot.effort_limit
    return all((np.abs(pin.rnea(robot.model, data, *row)) <= most).all() for row in zip(q, v, a, strict=True))


def _quintic(p: JointArray, v: JointArray, a: JointArray, T: float) -> np.ndarray:
    """Coefficients (6, n) of the quintic in t/T from (p, v, a) at 0 to rest at 0 at T."""
    v, a = v * T, a * T * T
    return np.array(
        [p, v, 0.5 * a, -10.0 * p - 6.0 * v - 1.5 * a, 15.0 * p + 8.0 * v + 1.5 * a, -6.0 * p - 3.0 * v - 0.5 * a]
    )
