"""From where an arm is to a motion that begins elsewhere, without a step in position, velocity or acceleration."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from nbs_pin.base.arguments import DURATION, check_fields, checked, maybe, numbers
from nbs_pin.base.arrays import JointArray
from nbs_pin.base.checks import vector_of
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.records import Reference
from nbs_pin.motions.references import MOTION, DesiredMotion, at_times, instants
from nbs_pin.robots.robot import ARM, Robot, configuration_difference

_SHORTEST = 0.5  # [s]
_SHARE = 0.5  # of the velocity limit that the approach takes, beside what the motion takes


@dataclass(frozen=True, eq=False)
class Approach:
    """q_d(t) = motion(t) + p(t), where p is the quintic from the given state to 0 in `length` [s].

    Position, velocity and acceleration begin as those of the arm and are the motion's from t = `length` on.
    """

    motion: DesiredMotion
    length: float
    """How long it takes [s]."""
    coefficients: np.ndarray
    """(6, n), of the powers of t/length."""

    def __post_init__(self) -> None:
        check_fields(self, motion=MOTION, length=DURATION, coefficients=numbers(6, None))

    @classmethod
    @checked(motion=MOTION, robot=ARM, length=maybe(DURATION))
    def from_state(
        cls, motion: DesiredMotion, robot: Robot, q: Any, v: Any = None, *, length: float | None = None
    ) -> "Approach":
        """From the state (q, v) [rad, rad/s], at rest if v is None, in a time that half the velocity limits allow.

        Raises:
            ArgumentError: If a state is not one of the arm, or no time up to 1000 s is long enough.

        Example:
            >>> import nbs_pin as nbs
            >>> robot = nbs.load_robot("two_link")
            >>> motion = nbs.Approach.from_state(nbs.Hold([0.3, 0.2]), robot, [0.0, 0.0])
            >>> motion(0.0).q.tolist(), motion(motion.length).q.tolist()
            ([0.0, 0.0], [0.3, 0.2])
        """
        n = robot.nv
        begin = at_times(motion, np.zeros(1), n)
        here = vector_of("q", q, n, "rad")
        rate = np.zeros(n) if v is None else vector_of("v", v, n, "rad/s")
        state = configuration_difference(here, begin.q[0], robot.continuous), rate - begin.v[0], -begin.a[0]
        grid, limit = np.linspace(0.0, 1.0, 101), np.maximum(_SHARE * robot.velocity_limit, np.abs(state[1]))
        for T in [length] if length is not None else np.geomspace(_SHORTEST, 1000.0, 200).tolist():
            made = cls(motion, T, _quintic(*state, T))
            if length is not None or (np.abs(made._polynomial(T * grid)[1]) <= 1.0001 * limit).all():
                return made
        raise ArgumentError("no approach within 1000 s stays below half the velocity limits; give a length.")

    @property
    def notes(self) -> dict[str, Any]:
        """Those of the motion."""
        return dict(getattr(self.motion, "notes", {}))

    def __call__(self, t: Any) -> Reference:
        """Desired motion at t [s]."""
        t = instants(t)
        return Reference(*(x + p for x, p in zip(self.motion(t), self._polynomial(t), strict=True)))

    def _polynomial(self, t: np.ndarray) -> tuple[JointArray, JointArray, JointArray]:
        c, T = self.coefficients, self.length
        s = np.clip(t / T, 0.0, 1.0)[..., None]
        p = sum(c[k] * s**k for k in range(6))
        dp = sum(k * c[k] * s ** (k - 1) for k in range(1, 6)) / T
        ddp = sum(k * (k - 1) * c[k] * s ** (k - 2) for k in range(2, 6)) / T**2
        inside = np.asarray(t < T)[..., None]
        return tuple(np.where(inside, x, 0.0) for x in (p, dp, ddp))  # type: ignore[return-value]


def _quintic(p: JointArray, v: JointArray, a: JointArray, T: float) -> np.ndarray:
    """Coefficients (6, n) of the quintic in t/T from (p, v, a) at 0 to rest at 0 at T."""
    v, a = v * T, a * T * T
    return np.array(
        [p, v, 0.5 * a, -10.0 * p - 6.0 * v - 1.5 * a, 15.0 * p + 8.0 * v + 1.5 * a, -6.0 * p - 3.0 * v - 0.5 * a]
    )
