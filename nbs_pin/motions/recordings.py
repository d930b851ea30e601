"""What files of recorded motions often have wrong: the unit of time, wrapped angles, single outliers, degrees.

Rows are counted from 1 in messages. A fault is a clause of a sentence, empty where there is none.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import median_filter

from nbs_pin.base.doors import option
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.units import several, units
from nbs_pin.robots.robot import Robot

TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
"""Units of time of a file, in [s]."""
_CALLED = {"ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds"}
_LONG_STEP = 0.5  # [s]; recordings have shorter steps
_CRAWL = 0.03  # [rad/s, m/s]; no joint faster than this at such steps is no motion of an arm
_LIKE_A_RATIO = 0.2  # relative tolerance of a ratio of units
TURN = 2.0 * np.pi
_BEYOND_A_TURN = 1.02  # share of a turn that wrapped angles span at most
_NEAR_A_TURN = 0.1  # [rad]; least tolerance of a jump by a turn
_WINDOW = 7  # rows of the median that tells what is usual
_OUTLIER, _LEAST_OUTLIER = 10.0, 0.1  # times the usual step; [rad, m]
_SEAM, _NO_MOTOR = 20.0, 30.0  # times the usual speed; [rad/s, m/s]
_TURNS = 4.0 * np.pi  # [rad]; rarely reached by angles in radians, soon by degrees
_OFTEN = 0.05  # share of samples that distinguishes degrees from outliers


class Joints(NamedTuple):
    """What is known of the joints of a file."""

    names: Sequence[str]
    continuous: Bool[np.ndarray, " n"]
    """True for joints that turn without limit, or may at least turn further than by one turn."""
    prismatic: Bool[np.ndarray, " n"]

    @classmethod
    def of(cls, robot: Robot | Sequence[str]) -> "Joints":
        """Of an arm; mere names are of joints with limits."""
        if isinstance(robot, Robot):
            return cls(robot.joint_names, robot.continuous, robot.prismatic)
        names, no = list(robot), np.zeros(len(robot), dtype=bool)
        return cls(names, no, no)


def seconds_in(time_unit: str | None) -> float:
    """The unit of time [s], None for seconds; raises ArgumentError if it is unknown."""
    if time_unit is not None and time_unit not in TIME_UNITS:
        raise ArgumentError(f"time_unit is {time_unit!r:.80}; give one of {', '.join(TIME_UNITS)}.")
    return 1.0 if time_unit is None else TIME_UNITS[time_unit]


def from_first_row(t: Float[np.ndarray, " rows"]) -> Float[np.ndarray, " rows"]:
    """Times from the first row on; even where they are so but for the rounding of large stamps.

    Seconds since 1970 are rounded to 2e-7 s, which would make steps of accelerations.
    """
    if not len(t) or t[0] == 0.0:
        return t
    passed = t - t[0]
    even = np.linspace(0.0, passed[-1], len(t))
    return even if (np.abs(passed - even) <= 2.0 * np.spacing(np.abs(t).max())).all() else passed


def in_radians(x: Float[np.ndarray, "rows n"], prismatic: Bool[np.ndarray, " n"]) -> Float[np.ndarray, "rows n"]:
    """Angles, or their derivatives, converted from degrees; prismatic joints are not changed."""
    return x * np.where(prismatic, 1.0, np.pi / 180.0)


def time_fault(
    t: Float[np.ndarray, " rows"],
    q: Float[np.ndarray, "rows n"],
    v: Float[np.ndarray, "rows n"] | None,
    stretches: Sequence[slice],
    prismatic: Bool[np.ndarray, " n"],
) -> str:
    """Why t cannot be in seconds.

    If v is stated, its integral is that many times too large, also where joints turn: that of a joint that slides may
    be in mm/s. Otherwise the rows are far apart, no joint gets anywhere between them, and in the unit named it would
    move as arms do.
    """
    kept = [rows for rows in stretches if rows.stop - rows.start > 1]
    if not kept:
        return ""
    steps = np.concatenate([np.diff(t[rows]) for rows in kept])
    moved = np.concatenate([np.diff(q[rows], axis=0) for rows in kept])
    runs = steps > 0.0
    if not (np.isfinite(moved).all() and runs.mean() > 0.5):
        return ""  # which is another fault
    step, unit, why = float(np.median(steps[runs])), "", ""
    if v is not None and np.isfinite(v).all() and v.any():
        area = np.concatenate([0.5 * (v[rows][1:] + v[rows][:-1]) for rows in kept]) * steps[:, None]
        area = area[runs]
        known = np.ones_like(prismatic) if step > _LONG_STEP else ~prismatic
        moved_there, area = moved[runs][:, known], area[:, known]
        ratio = float(np.vdot(moved_there, area) / max(np.vdot(area, area), 1e-300))
        unit = next((u for u in _CALLED if abs(ratio / TIME_UNITS[u] - 1.0) < _LIKE_A_RATIO), "")
        why = f"in which q changes as v states; give {option('time_unit', unit)}"
    if not unit and step > _LONG_STEP:
        way = np.where(np.abs(moved) > np.pi, 0.0, np.abs(moved))[runs]
        speed = float((way / steps[runs][:, None]).max(initial=0.0))
        unit = _unit_of_speed(speed, step)
        why = (
            f"since in seconds its rows are {step:.4g} s apart and no joint is faster than {speed:.3g} "
            f"{several(units('velocity', prismatic))}; give "
            f"{option('time_unit', unit)}, or {option('time_unit', 's')} if it is that slow"
        )
    return f"t looks like {_CALLED[unit]}, {why}" if unit else ""


def _unit_of_speed(speed: float, step: float) -> str:
    """The unit of time in which a largest speed is nearest to 1 rad/s and a step is below `_LONG_STEP`; "" for s."""
    if speed >= _CRAWL:
        return ""
    if speed == 0.0:  # nothing moves, so only steps of many minutes tell
        return "" if step < 1e3 else "us" if step < 1e5 else "ns"
    fit = {u: abs(np.log10(speed / TIME_UNITS[u])) for u in _CALLED if step * TIME_UNITS[u] <= _LONG_STEP}
    return min(fit, key=lambda u: fit[u], default="")


def degrees_fault(q: Float[np.ndarray, "rows n"], joints: Joints, robot: Robot | None, turning: bool) -> str:
    """Why angles may be in degrees: many lie far outside the joint's range or, unless `turning`, beyond two turns."""
    beyond = np.zeros(q.shape, dtype=bool) if turning else np.abs(q) > _TURNS
    if robot is not None:  # joint ranges reveal degrees sooner
        beyond |= (q < robot.lower - np.pi) | (q > robot.upper + np.pi)
    far = (beyond.mean(axis=0) > _OFTEN) & ~joints.prismatic
    if not far.any():
        return ""
    i = int(np.argmax(far))
    return (
        f"q of {joints.names[i]} reaches {np.abs(q[:, i]).max():.4g}, which looks like degrees; give "
        f"{option('degrees', True)}, or {option('degrees', False)} if the joint turns so far"
    )


class Unwrapped(NamedTuple):
    """Angles without wraps, and what there is to say about it."""

    q: Float[np.ndarray, "rows n"]
    notes: tuple[str, ...]
    """One for each joint that was unwrapped."""
    fault: str
    """A wrap of a joint that cannot be unwrapped, or an outlier."""


def unwrapped(
    q: Float[np.ndarray, "rows n"], joints: Joints, stretches: Sequence[slice], degrees: bool | None
) -> Unwrapped:
    """The angles with jumps by whole turns taken out of joints that turn without limit; of others they are a fault.

    A jump by about a turn is a wrap where all angles lie within one turn and the joint goes on as before.
    """
    q, notes, fault = q.copy(), [], ""
    for i, name in enumerate(joints.names):
        found: list[int] = []
        for rows in stretches:
            x = q[rows, i]
            fault = fault or _outlier_fault(x, rows.start, name)
            if joints.prismatic[i]:
                continue
            turns = wraps(x, TURN)
            at = np.flatnonzero(turns)
            found += (rows.start + at).tolist()
            if at.size and joints.continuous[i]:
                x[1:] -= TURN * np.cumsum(turns)  # a view of q
            fault = fault or ("" if degrees is not None else _degree_wrap_fault(x, rows.start, name))
        if found and joints.continuous[i]:
            often = "once," if len(found) == 1 else f"{len(found)} times, first"
            notes.append(
                f"{name} jumps by a turn {often} between rows {found[0] + 1} and {found[0] + 2}; it can turn further, "
                "so it was unwrapped"
            )
        elif found:
            k = found[0]
            fault = fault or (
                f"{name} jumps by {q[k + 1, i] - q[k, i]:.4g} rad between rows {k + 1} and {k + 2}: a wrap? unwrap "
                "that column"
            )
    return Unwrapped(q, tuple(notes), fault)


def wraps(x: Float[np.ndarray, " rows"], turn: float) -> Float[np.ndarray, " steps"]:
    """By how many turns x jumps from each row to the next; all 0 where x spans more than one turn."""
    steps = np.diff(x)
    turns = np.round(steps / turn)
    if not (turns.any() and np.isfinite(x).all()) or np.ptp(x) > _BEYOND_A_TURN * turn:
        return np.zeros(len(steps))
    rest = steps - turn * turns
    usual = median_filter(rest, _WINDOW, mode="nearest")
    near = np.abs(rest - usual) <= np.maximum(_NEAR_A_TURN / TURN * turn, np.abs(usual))
    return np.where(near & (np.abs(usual) < 0.25 * turn), turns, 0.0)


def _degree_wrap_fault(x: Float[np.ndarray, " rows"], start: int, name: str) -> str:
    at = np.flatnonzero(wraps(x, 360.0))
    if not at.size:
        return ""
    k = int(at[0])
    return (
        f"{name} jumps by {x[k + 1] - x[k]:.4g} between rows {start + k + 1} and {start + k + 2}: a wrap in degrees? "
        f"give {option('degrees', True)}"
    )


class Seam(NamedTuple):
    """Where one recording seems to end and another to begin."""

    row: int
    """The first row of the other, from 0."""
    note: str


def seams(
    t: Float[np.ndarray, " rows"], q: Float[np.ndarray, "rows n"], joints: Joints, stretches: Sequence[slice]
) -> list[Seam]:
    """Jumps that no motor makes, and no return."""
    found = []
    for rows in stretches:
        speed = np.abs(np.diff(q[rows], axis=0)) / np.diff(t[rows])[:, None]
        if len(speed) < _WINDOW:
            continue
        jumps = speed > np.maximum(_SEAM * np.percentile(speed, 80, axis=0), _NO_MOTOR)
        for k in map(int, np.flatnonzero(jumps.any(axis=1))):
            i, row = int(np.argmax(jumps[k])), rows.start + k + 1
            x = q[rows, i]
            note = (
                f"q of {joints.names[i]} jumps from {x[k]:.4g} to {x[k + 1]:.4g} between rows {row} and {row + 1}: "
                "another recording begins there"
            )
            found.append(Seam(row, note))
    return found


def _outlier_fault(x: Float[np.ndarray, " rows"], start: int, name: str) -> str:
    """A single row that departs from both of its neighbours by ten times the usual step."""
    steps = np.diff(x)
    if len(steps) < _WINDOW or not np.isfinite(x).all() or wraps(x, TURN).any():
        return ""
    there, back = steps[:-1], steps[1:]
    size = np.minimum(np.abs(there), np.abs(back))
    least = max(_OUTLIER * float(np.percentile(np.abs(steps), 80)), _LEAST_OUTLIER)
    out = (there * back < 0.0) & (size > least)
    if not out.any():
        return ""
    k = int(np.argmax(np.where(out, size, 0.0))) + 1
    return (
        f"q of {name} is {x[k]:.6g} in row {start + k + 1}, between {x[k - 1]:.6g} and {x[k + 1]:.6g}: an outlier? "
        "correct it or remove that row"
    )
