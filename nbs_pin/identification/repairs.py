"""Single rows of a log that are wrong, found by comparison with the rows around them, and put right with a note.

Rows are counted from 1 in notes. What is found: rows that repeat the one before, spikes of up to three rows, angles
that stood still while the joint moved, velocities that are zero throughout. Where a torque is cut off at a
largest value, what it was is unknown, and the rows are left out.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import median_filter, percentile_filter

from nbs_pin.base.units import units
from nbs_pin.identification.datasets import trajectory_slices
from nbs_pin.identification.log_files import Columns
from nbs_pin.motions.recordings import TURN, Joints, wraps

_NEAR, _BESIDE, _AROUND = 7, 25, 101
"""Rows of the medians that tell what a row should be, and how far rows beside and around usually are from that."""
_ALONE, _SPIKE = 3.0, 12.0
"""Departure of a spike, in those of most rows beside it and in the usual ones around."""
_SHARE = 0.25
"""Least departure of a spike in a torque or velocity, as a share of its range."""
_STEPS, _LEAST = 10.0, 1e-3
"""Least departure of a spike in an angle: in usual steps; [rad, m]."""
_RARE = 0.05
"""Largest share of rows that are repaired; where more are odd, that is how the signal is."""
_REPEATED = 10
"""Most rows in succession that repeat one while the arm moves."""
_FRESH = 1.6
"""Step after an angle stood still, in the steps around: two or more are made up for."""
_CUT_ROWS, _CUT_SHARE = 3, 5e-4
"""A largest torque is a limit if it lasts so many rows in succession, and is that share of all rows."""
_ABOUT, _SLOW = 5, 0.05
"""Rows before and after one over which its motion is seen, and the share of the usual largest one that is rest."""
_QUANTA = 8.0
"""Least way into a limit, in units of the smallest step of the torque."""
_NEAR_LIMIT, _MOST_CUT = 0.03, 0.8
"""Distance from a limit, as a share of it, at which rows are left out; largest share of all rows that are."""


_CALLED = {"q": "position", "v": "velocity", "tau": "torque"}
"""The signals that may have spikes."""


class Repaired(NamedTuple):
    """The columns with wrong rows put right, and a note on each kind of fault."""

    columns: Columns
    fresh: Bool[np.ndarray, " rows"]
    """Rows that do not merely repeat the one before."""
    limits: Float[np.ndarray, "2 n"]
    """Least and largest torque at which tau is cut off, infinite where it is not."""
    notes: tuple[str, ...]


def repaired(columns: Columns, joints: Joints, absent: Bool[np.ndarray, " rows"]) -> Repaired:
    """The columns without what is wrong in single rows; all rows are there still, so that they can be named.

    Rows that are `absent` for another reason are not fresh.
    """
    fresh, repeats = _fresh(columns, absent)
    columns, zeros = _without_zero_rates(columns, joints)
    limits, cut = _cut(columns.tau, fresh[:, None] & _in_motion(columns.q), joints)
    rows, notes = trajectory_slices(columns.trajectory), [*repeats, *zeros, *cut]
    for name in _CALLED:
        x = getattr(columns, name)
        if x is not None:
            x, noted = _without_spikes(x, columns.t, rows, joints, name)
            columns, notes = columns._replace(**{name: x}), notes + noted
    q, noted = _moving(columns.q, columns.t, rows, joints, fresh)
    return Repaired(columns._replace(q=q), fresh, limits, (*notes, *noted))


def _fresh(columns: Columns, absent: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """Rows whose q, v or tau differ from the row before: an arm that is asked too soon answers the same again."""
    same = np.zeros(len(columns.t), dtype=bool)
    signals = [x for x in (columns.q, columns.v, columns.tau) if x is not None]
    for rows in trajectory_slices(columns.trajectory):
        alike = np.logical_and.reduce([(np.diff(x[rows], axis=0) == 0.0).all(axis=1) for x in signals])
        same[rows] = np.append(False, alike & ~_long(alike, _REPEATED))
    same &= ~absent
    if not same.any() or same.mean() > 0.5:
        return ~absent, []
    return ~(same | absent), [f"{_rows(same)} that repeat the one before were left out, first row {_first(same)}"]


def _without_zero_rates(columns: Columns, joints: Joints) -> tuple[Columns, list[str]]:
    """Without v and a that are 0 in every row of a joint that moves."""
    notes = []
    for name, of in (("v", "q"), ("a", "v")):
        x, source = getattr(columns, name), getattr(columns, of)
        if x is None or source is None or not np.isfinite(x).all():
            continue
        idle = ~x.any(axis=0) & (np.ptp(source, axis=0) > _LEAST)
        if idle.any():
            columns = columns._replace(v=None) if name == "v" else columns._replace(a=None)
            notes.append(
                f"{name} of {joints.names[int(np.argmax(idle))]} is 0 in every row while {of} changes, so {name} was "
                f"differentiated from {'q' if columns.v is None else of} instead"
            )
    return columns, notes


def _moving(
    q: Float[np.ndarray, "rows n"],
    t: Float[np.ndarray, " rows"],
    stretches: Sequence[slice],
    joints: Joints,
    fresh: Bool[np.ndarray, " rows"],
) -> tuple[np.ndarray, list[str]]:
    """Angles without rows in which they stood still while the joint moved."""
    q, stale = q.copy(), np.zeros(q.shape, dtype=bool)
    for i in range(q.shape[1]):
        for rows in stretches:
            stale[rows, i] = _stale(q[rows, i]) & fresh[rows]
        stale[:, i] &= stale[:, i].mean() < _RARE
        q[:, i] = _bridged(q[:, i], t, stale[:, i], stretches)
    if not stale.any():
        return q, []
    row, i = np.argwhere(stale)[0]
    more = f" and that of {_others(stale)}" if stale.any(axis=0).sum() > 1 else ""
    return q, [
        f"q of {joints.names[i]}{more} stood still in motion, in {_rows(stale.any(axis=1))}, first row {row + 1}; "
        "interpolated"
    ]


def _without_spikes(
    x: Float[np.ndarray, "rows n"], t: Float[np.ndarray, " rows"], stretches: Sequence[slice], joints: Joints, name: str
) -> tuple[np.ndarray, list[str]]:
    """The signals of that name with spikes replaced by what is between the rows beside them."""
    if not np.isfinite(x).all():
        return x, []
    x, odd = x.copy(), np.zeros(x.shape, dtype=bool)
    for i in range(x.shape[1]):
        size = np.ptp(np.percentile(x[:, i], [1.0, 99.0]))
        for rows in stretches:
            least = _SHARE * size
            if name == "q":
                if not joints.prismatic[i] and wraps(x[rows, i], TURN).any():
                    continue
                steps = np.abs(np.diff(x[rows, i]))
                least = max(_STEPS * float(np.percentile(steps, 80)), _LEAST) if len(steps) else 0.0
            odd[rows, i] = _spikes(x[rows, i], least)
        odd[:, i] &= odd[:, i].mean() < _RARE
    if not odd.any():
        return x, []
    row, i = np.argwhere(odd)[0]
    was = x[row, i]
    for j in range(x.shape[1]):
        x[:, j] = _bridged(x[:, j], t, odd[:, j], stretches)
    unit = units(_CALLED[name], joints.prismatic)[i]
    many = int(np.count_nonzero(odd))
    more = (
        f"one of {many} spikes (others in {_others(odd)})"
        if odd.any(axis=0).sum() > 1
        else (f"the first of {many} spikes" if many > 1 else "a spike")
    )
    return x, [
        f"{name} of {joints.names[i]} is {was:.6g} {unit} in row {row + 1}, where about {x[row, i]:.6g} was expected, "
        f"{more}: an outlier? interpolated"
    ]


def _spikes(x: Float[np.ndarray, " rows"], least: float) -> Bool[np.ndarray, " rows"]:
    """Rows that depart by more than `least`, and many times what is usual around, from what the rows beside tell.

    That is their median, which a step does not move, and the cubic through the second and third on both sides, which a
    peak of the motion does not leave.
    """
    if len(x) < 2 * _NEAR:
        return np.zeros(len(x), dtype=bool)
    ends = np.concatenate([2.0 * x[0] - x[3:0:-1], x, 2.0 * x[-1] - x[-2:-5:-1]])
    cubic = 0.9 * (ends[1:-5] + ends[5:-1]) - 0.4 * (ends[:-6] + ends[6:])
    departure = np.minimum(np.abs(x - median_filter(x, _NEAR, mode="nearest")), np.abs(x - cubic))
    usual = 1.4826 * median_filter(departure, min(_AROUND, len(x)), mode="nearest")
    beside = percentile_filter(departure, 75, min(_BESIDE, len(x)), mode="nearest")
    return np.asarray(departure > np.maximum(np.maximum(_SPIKE * usual, _ALONE * beside), least))


def _stale(x: Float[np.ndarray, " rows"]) -> Bool[np.ndarray, " rows"]:
    """Rows in which x is as in the row before though it moved before, and made up for it afterwards."""
    steps, found = np.diff(x), np.zeros(len(x), dtype=bool)
    if len(steps) < 2 * _NEAR or not np.isfinite(x).all():
        return found
    still = (steps == 0.0) & ~_long(steps == 0.0, _REPEATED)
    for k in np.flatnonzero(still & ~np.append(False, still[:-1])):
        end = k + int(np.argmin(still[k:])) if not still[k:].all() else len(steps)
        around = np.concatenate([steps[max(k - _NEAR, 0) : k], steps[end + 1 : end + 1 + _NEAR]])
        if end >= len(steps) or len(around) < _NEAR or (around == 0.0).any():
            continue
        usual = float(np.median(around))
        missed = (end - k + 1) * usual
        if np.abs(around - usual).max() < 0.5 * abs(usual) and abs(steps[end] - missed) < (1.0 - 1.0 / _FRESH) * abs(
            missed
        ):
            found[k + 1 : end + 1] = True
    return found


def _in_motion(q: Float[np.ndarray, "rows n"]) -> Bool[np.ndarray, "rows n"]:
    """Where each joint moves: a torque that stays the same at rest is no limit."""
    padded = np.pad(q, ((_ABOUT, _ABOUT), (0, 0)), mode="edge")
    way = np.abs(padded[2 * _ABOUT :] - padded[: -2 * _ABOUT])
    return np.asarray(way > _SLOW * np.percentile(way, 95, axis=0))


def _cut(
    tau: Float[np.ndarray, "rows n"], judged: Bool[np.ndarray, "rows n"], joints: Joints
) -> tuple[np.ndarray, list[str]]:
    """The torques at which they are cut off, since they stay there, and notes on that."""
    limits, notes = np.array([[-np.inf], [np.inf]]) * np.ones(tau.shape[1]), []
    for i, name in enumerate(joints.names):
        unit = units("torque", joints.prismatic)[i]
        for side, value in enumerate((float(tau[:, i].min()), float(tau[:, i].max()))):
            at = (tau[:, i] == value) & judged[:, i]
            if _long(at, _CUT_ROWS - 1).any() and _CUT_SHARE < at.mean() < 0.5 and _runs_into(tau[:, i], at):
                limits[side, i] = value
                notes.append(
                    f"tau of {name} is cut off at {value:.6g} {unit}, which it has in {_rows(at)}, first row "
                    f"{_first(at)}: a limit of the motor or of the recording; rows near it were left out"
                )
    return limits, notes


def _runs_into(tau: Float[np.ndarray, " rows"], at: Bool[np.ndarray, " rows"]) -> bool:
    """Whether the torque runs into the value that it has in these rows, where a smooth peak creeps up to it.

    Before a plateau as long as the rounding of a parabola makes it, that one moves by four steps of the rounding in
    the same time.
    """
    steps = np.abs(np.diff(tau))
    edges = np.flatnonzero(np.diff(np.concatenate([[False], at, [False]]).astype(int))).reshape(-1, 2)
    moved = [abs(tau[begin] - tau[max(2 * begin - end, 0)]) for begin, end in edges]
    return bool((steps > 0.0).any() and np.median(moved) > _QUANTA * steps[steps > 0.0].min())


def beyond(tau: Float[np.ndarray, "rows n"], limits: Float[np.ndarray, "2 n"]) -> Bool[np.ndarray, " rows"]:
    """Rows whose torque, which may be smoothed since, is near a limit or beyond; none where that leaves too few."""
    margins = np.where(np.isfinite(limits), _NEAR_LIMIT * np.abs(limits), 0.0)
    rows = ((tau < limits[0] + margins[0]) | (tau > limits[1] - margins[1])).any(axis=1)
    return np.asarray(rows & (rows.mean() < _MOST_CUT))


def _bridged(x: np.ndarray, t: np.ndarray, odd: np.ndarray, stretches: Sequence[slice]) -> np.ndarray:
    """x with the odd rows interpolated between the others of their trajectory."""
    x = x.copy()
    for rows in stretches:
        wrong = odd[rows]
        if wrong.any() and not wrong.all():
            x[rows] = np.where(wrong, np.interp(t[rows], t[rows][~wrong], x[rows][~wrong]), x[rows])
    return x


def _long(flags: Bool[np.ndarray, " rows"], most: int) -> Bool[np.ndarray, " rows"]:
    """Which of the flags belong to more than `most` in succession."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    found = np.zeros(len(flags), dtype=bool)
    for begin, end in edges.reshape(-1, 2):
        found[begin:end] = end - begin > most
    return found


def _first(flags: np.ndarray) -> int:
    return int(np.argmax(flags)) + 1


def _rows(which: Any) -> str:
    many = which if isinstance(which, int) else int(np.count_nonzero(which))
    return "1 row" if many == 1 else f"{many} rows"


def _others(which: np.ndarray) -> str:
    """The number of further joints than the first of which it is true anywhere."""
    many = int(which.any(axis=0).sum()) - 1
    return "1 more joint" if many == 1 else f"{many} more joints"
