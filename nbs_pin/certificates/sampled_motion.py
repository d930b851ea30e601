"""A reference at evenly spaced instants, with what it can do between them."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from nbs_pin.base.arrays import JointArray
from nbs_pin.base.records import Reference
from nbs_pin.motions.references import DesiredMotion, at_times
from nbs_pin.robots.robot import configuration_difference

STEP = 0.005
"""Longest time between instants [s], for at most `_MOST` of them."""
INSTANTS, _MOST = 2001, 400_000
"""Least number of instants."""
_OF_RATE, _OF_ACCELERATION, _ROUNDING = 1e-3, 0.02, 1e-9


class SampledMotion(NamedTuple):
    """q_d, v_d and a_d at evenly spaced instants."""

    t: Float[np.ndarray, " rows"]
    """Time [s]."""
    q: Float[np.ndarray, "rows n"]
    """q_d [rad]."""
    v: Float[np.ndarray, "rows n"]
    """v_d [rad/s]."""
    a: Float[np.ndarray, "rows n"]
    """a_d [rad/s²]."""

    @classmethod
    def of(cls, reference: DesiredMotion, nv: int, duration: float) -> "SampledMotion":
        """The reference over `duration` [s]; raises ArgumentError if it is no finite motion of `nv` joints."""
        t = np.linspace(0.0, duration, min(max(INSTANTS, math.ceil(duration / STEP) + 1), _MOST))
        return cls(t, *at_times(reference, t, nv))

    def contradiction(self) -> tuple[float, float, float, int]:
        """Where the motion contradicts its derivatives most: the change left over, that allowed, time [s] and joint."""
        worst, found = -1.0, (0.0, 1.0, 0.0, 0)
        for rest, allowed in unexplained_steps(self.t, self.q, self.v, self.a):
            row, joint = np.unravel_index(int(np.argmax(rest / allowed)), rest.shape)
            if rest[row, joint] / allowed[row, joint] > worst:
                worst = float(rest[row, joint] / allowed[row, joint])
                found = (float(rest[row, joint]), float(allowed[row, joint]), float(self.t[row]), int(joint))
        return found

    @property
    def rows(self) -> Reference:
        """The samples as a `Reference`."""
        return Reference(self.q, self.v, self.a)

    @property
    def half(self) -> float:
        """Half the time between instants [s]: no time is farther from an instant."""
        return float(0.5 * self.t[1])

    @property
    def speed(self) -> JointArray:
        """Bound of |v_d| at and between the instants, for accelerations that are largest at them [rad/s]."""
        return np.asarray(np.abs(self.v).max(axis=0) + self.half * np.abs(self.a).max(axis=0))


def unexplained_steps(
    t: Float[np.ndarray, " rows"],
    q: Float[np.ndarray, "rows n"],
    v: Float[np.ndarray, "rows n"],
    a: Float[np.ndarray, "rows n"],
    continuous: Bool[np.ndarray, " n"] | None = None,
) -> tuple[tuple[Float[np.ndarray, "steps n"], Float[np.ndarray, "steps n"]], ...]:
    """Of q and of v, what remains of each change after that which the derivatives explain, and what a motion may leave.

    Over a step h a smooth q changes by ½h(v₀ + v₁) − h²/12 (a₁ − a₀) up to terms of higher order, and v by ½h(a₀ + a₁);
    accelerations may jump. Positions of `continuous` joints count modulo a turn.
    """
    h = np.diff(t)[:, None]
    jump, size = np.abs(np.diff(a, axis=0)), np.abs(a[1:]) + np.abs(a[:-1])
    travel = configuration_difference(q[1:], q[:-1], continuous)
    moved = np.abs(travel - 0.5 * h * (v[1:] + v[:-1]) + h * h / 12.0 * np.diff(a, axis=0))
    turned = np.abs(np.diff(v, axis=0) - 0.5 * h * (a[1:] + a[:-1]))
    rounding = tuple(_ROUNDING * (1.0 + np.abs(x[1:])) for x in (q, v))
    return (
        (moved, h * h * jump + h * _OF_RATE * (np.abs(v[1:]) + np.abs(v[:-1])) + rounding[0]),
        (turned, h * jump + h * _OF_ACCELERATION * size + rounding[1]),
    )
