"""Logs on an even grid: gaps split trajectories, jittered stamps are interpolated, one filter takes noise from all.

A log is differentiated on an even grid. Where its torque is noisy, q, v, a and tau go through the same low-pass filter,
forwards and backwards, so that they keep their relation at every instant (Gautier 1997), and rows that then say nothing
new are left out.
"""

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.interpolate import CubicSpline, PchipInterpolator
from scipy.signal import butter, periodogram, sosfiltfilt

from nbs_pin.base.arrays import JointArray
from nbs_pin.base.doors import option
from nbs_pin.base.exceptions import ArgumentError, FileFormatError
from nbs_pin.identification.datasets import trajectory_slices
from nbs_pin.identification.log_files import Columns
from nbs_pin.identification.measurement import ORDER, derivative
from nbs_pin.motions.recordings import Seam

EVEN = 1e-3
"""Tolerance of even spacing, as a share of the step."""
WINDOW = 0.1
"""Usual width of the window of differentiation [s]."""
_FEWEST = 4
"""Fewest rows of a trajectory that are interpolated."""
_GAP, _SHORT_GAP = 12.0, 0.03
"""Longest gap between rows that is bridged: in median steps; and that is bridged at any rate [s]."""
_PIECE = 20
"""Fewest rows of a piece between gaps that is kept."""
_MOST_ROWS = 10_000_000
_NOISY = 2e-3
"""Noise of the torque, as a share of its deviation, from which on it is filtered."""
_MOTION = 0.99
"""Share of the power of the velocities that lies below the bandwidth of the motion."""
_WIDE = 12.0
"""Cut-off frequency over the bandwidth of the motion."""
_LOWEST = 8.0
"""Lowest cut-off frequency that is chosen [Hz]: slower filters round off Coulomb friction where a joint turns back."""
_RATE = 5.0
"""Rows that are kept per period of the cut-off frequency."""
_FINE = 5.0
"""Fewest rows per period of a cut-off frequency that is chosen."""
_LONG = 6.0
"""Shortest trajectory that is filtered unasked, in periods of the cut-off frequency."""
_BEYOND, _CUBIC = 2.0, 3
"""Periods of the cut-off frequency by which a recording is continued before it is filtered, and the degree there."""
_STAGES = 4
"""Order of the filter, which acts twice."""


class Even(NamedTuple):
    """Columns on an even grid in each trajectory, and how they came there."""

    columns: Columns
    step: float
    """Time between rows [s]."""
    lowpass: float
    """Cut-off frequency of the filter to go through [Hz], 0 for none."""
    every: int
    """Of how many rows one is to be kept."""
    notes: tuple[str, ...]
    """What was done."""


class Parted(NamedTuple):
    """The numbers of the trajectories where every long gap begins another, and the rows of pieces that are kept."""

    numbers: Int[np.ndarray, " rows"]
    kept: Bool[np.ndarray, " rows"]
    notes: tuple[str, ...]


def parted(columns: Columns, seams: Sequence[Seam]) -> Parted:
    """Another trajectory after every long gap and at every seam; short pieces are not kept."""
    numbers, kept = columns.trajectory.copy(), np.ones(len(columns.t), dtype=bool)
    gaps: list[tuple[float, int]] = []
    for rows in trajectory_slices(columns.trajectory):
        steps = np.diff(columns.t[rows])
        if not len(steps):
            continue
        long = np.flatnonzero(steps > max(_GAP * float(np.median(steps)), _SHORT_GAP)) + 1
        gaps += [(float(steps[k - 1]), rows.start + int(k)) for k in long]
        cuts = {*long.tolist(), *(seam.row - rows.start for seam in seams if rows.start < seam.row < rows.stop)}
        for begin, end in pairwise([0, *sorted(cuts), rows.stop - rows.start]) if cuts else ():
            piece = slice(rows.start + begin, rows.start + end)
            numbers[piece] = numbers.max() + 1 if begin else numbers[rows.start]
            kept[piece] = end - begin >= _PIECE
    notes = [seams[0].note + (f", and {len(seams) - 1} more elsewhere" if len(seams) > 1 else "")] if seams else []
    if gaps:
        longest, row = max(gaps, key=lambda gap: gap[0])
        more = f", and less in {len(gaps) - 1} more gaps" if len(gaps) > 1 else ""
        notes.append(
            f"{longest:.4g} s are missing between rows {row} and {row + 1}{more}: another trajectory begins there"
        )
    left = int(np.count_nonzero(~kept))
    if left == len(kept):
        return Parted(columns.trajectory, ~kept, ())
    notes += [f"{left} rows in pieces of fewer than {_PIECE} were left out"] if left else []
    return Parted(numbers, kept, tuple(notes))


def evenly(path: Path, columns: Columns, resample: float | None, lowpass: float | None) -> Even:
    """The columns at even times, with the filter that they need if it is not given.

    Positions, velocities and accelerations follow cubic splines, torques the monotone cubics of Fritsch and Carlson
    (PCHIP), which do not overshoot where a torque jumps.

    Raises:
        ArgumentError: If the step is finer than a log can be stored.
        FileFormatError: If a trajectory has too few rows; names the rows.
    """
    stretches = trajectory_slices(columns.trajectory)
    steps = np.concatenate([np.diff(columns.t[rows]) for rows in stretches])
    step = float(np.median(steps)) if steps.size else 1.0
    uneven = bool((np.abs(steps - step) > EVEN * step).any())
    derived, notes = columns.v is None or columns.a is None, []
    every = 1 if resample is None else max(1, int(np.ceil(resample / step - 0.1)))
    fine = resample / every if resample is not None else float(f"{step:.3g}") if uneven else step
    if resample is None and uneven:
        if not (derived or lowpass):
            return Even(columns, step, 0.0, 1, ())
        apart = f"{steps.min():.3g} to {steps.max():.3g} s"
        notes.append(f"rows are {apart} apart, so they were interpolated to one every {fine:g} s")
    if resample is not None or uneven:
        parts = [_interpolated(path, columns, rows, fine) for rows in stretches]
        joined: Any = [None if x[0] is None else np.concatenate(x) for x in zip(*parts, strict=True)]
        columns = Columns(*joined)
    chosen = _cutoff(columns, fine) if lowpass is None and derived else 0.0
    lowpass = chosen if lowpass is None else lowpass
    if lowpass and resample is None:
        every = max(1, int(1.0 / (_RATE * lowpass * fine)))
    thinned = f"one row of {every} was kept" if every > 1 and lowpass and resample is None else ""
    if chosen:
        alike = f"the torque is noisy, so q, v, a and tau were low-passed alike at {chosen:g} Hz, undelayed"
        notes.append(f"{alike}, and {thinned}" if thinned else alike)
    elif thinned:
        notes.append(f"{thinned}, since after the low-pass filter others say nothing new")
    return Even(columns, fine, lowpass, every, tuple(notes))


def _interpolated(path: Path, columns: Columns, rows: slice, step: float) -> Columns:
    t, first = columns.t[rows] - columns.t[rows.start], rows.start + 1
    if len(t) < _FEWEST:
        raise FileFormatError(f"{path}: from row {first}, {len(t)} rows are too few to resample; leave them out.")
    if t[-1] / step > _MOST_ROWS:
        raise ArgumentError(f"resample is {step:g} s, which makes more than {_MOST_ROWS:,} rows; give a longer step.")
    even = step * np.arange(int(t[-1] / step + 1e-9) + 1)
    inside = np.minimum(even, t[-1])
    v, a = (None if x is None else CubicSpline(t, x[rows])(inside) for x in (columns.v, columns.a))
    q = CubicSpline(t, columns.q[rows])(inside)
    tau = PchipInterpolator(t, columns.tau[rows])(inside)
    number = np.full(len(even), columns.trajectory[rows.start])
    return Columns(t=columns.t[rows.start] + even, q=q, tau=tau, v=v, a=a, trajectory=number)


def lowpassed(columns: Columns, step: float, cutoff: float) -> Columns:
    """The columns through one Butterworth filter, forwards and backwards, which delays nothing."""
    if not 2.0 * step * cutoff < 1.0:
        most = float(f"{0.49 / step:.3g}")
        raise ArgumentError(
            f"lowpass is {cutoff:g} Hz, expected less than half the {1.0 / step:.4g} rows per second; give "
            f"{option('lowpass', most)} at most, or {option('lowpass', 0.0)} for none."
        )
    stages = butter(_STAGES, 2.0 * step * cutoff, output="sos")
    found: dict[str, Any] = {}
    for name in ("q", "v", "a", "tau"):
        x = getattr(columns, name)
        if x is not None:
            parts = []
            for rows in trajectory_slices(columns.trajectory):
                count = rows.stop - rows.start
                more = min(round(_BEYOND / (cutoff * step)), count - 1)
                parts.append(sosfiltfilt(stages, _continued(x[rows], more), axis=0, padlen=more)[more : more + count])
            found[name] = np.concatenate(parts)
    return columns._replace(**found)


def _continued(x: Float[np.ndarray, "rows n"], more: int) -> Float[np.ndarray, "longer n"]:
    """The signals with as many rows more at both ends, of the cubic that is nearest to as many rows there.

    A filter starts as if at rest beyond the rows. Reflected there, as is usual, a motion would keep its speed and turn
    its acceleration round, and the filter would spoil that of two periods of its cut-off frequency.
    """
    here = np.linspace(0.0, 1.0, more + 1)[:, None] ** np.arange(_CUBIC + 1)
    there = np.linspace(-1.0, 0.0, more + 1)[:-1, None] ** np.arange(_CUBIC + 1)
    before, after = (there @ np.linalg.lstsq(here, end[: more + 1], rcond=None)[0] for end in (x, x[::-1]))
    return np.concatenate([before, x, after[::-1]])


def torque_noise(columns: Columns) -> JointArray:
    """Standard deviation of white noise in the torque [N·m], by third differences.

    It is from the size that a fifth of them exceed: rare jumps do not move it, nor do rows that hold the value before.
    """
    thirds = [np.diff(columns.tau[rows], n=3, axis=0) for rows in trajectory_slices(columns.trajectory)]
    return np.percentile(np.abs(np.concatenate(thirds)), 80, axis=0) / (1.2816 * np.sqrt(20.0))


def _cutoff(columns: Columns, step: float) -> float:
    """A cut-off frequency [Hz] that lets the motion pass, 0 where no filter is needed or the rows are too few."""
    stretches = trajectory_slices(columns.trajectory)
    if min(rows.stop - rows.start for rows in stretches) < 2 * ORDER:
        return 0.0
    if not (torque_noise(columns) > _NOISY * np.maximum(columns.tau.std(axis=0), 1e-12)).any():
        return 0.0
    widest, length = 0.0, 2 * max(round(0.5 * WINDOW / step), ORDER // 2 + 1) + 1
    speeds = [derivative(columns.q[s], step, length) for s in stretches if s.stop - s.start >= 2 * length]
    moving = 0.1 * max((float(v.std(axis=0).max()) for v in speeds), default=0.0)
    for v in (v[:, v.std(axis=0) > moving] for v in speeds):
        if not v.size:
            continue  # at rest
        frequency, power = periodogram(v, 1.0 / step, window="hann", axis=0)
        shares = np.cumsum(power, axis=0) / power.sum(axis=0)
        widest = max(widest, float(frequency[np.argmax(shares > _MOTION, axis=0)].max()))
    cutoff = float(f"{max(_WIDE * widest, min(_LOWEST, 0.9 / (_FINE * step))):.2g}")
    shortest = min(rows.stop - rows.start for rows in stretches) * step
    return cutoff if widest and cutoff * step * _FINE < 1.0 and shortest * cutoff > _LONG else 0.0
