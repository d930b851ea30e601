"""Logs whose rows are not evenly spaced, as times of a computer's clock are, moved to an even grid."""

from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline, PchipInterpolator

from nbs_pin.base.checks import positive
from nbs_pin.base.exceptions import ArgumentError, FileFormatError
from nbs_pin.identification.datasets import trajectory_slices
from nbs_pin.identification.log_files import Columns

_FEWEST = 4
"""Fewest rows of a trajectory that are interpolated."""
_GAP = 12.0
"""Longest gap between rows, in median steps, that is bridged."""
_MOST_ROWS = 10_000_000


def resampled(path: Path, columns: Columns, step: float) -> Columns:
    """The columns at times `step` [s] apart in each trajectory, from its first row on.

    Positions, velocities and accelerations follow cubic splines, torques the monotone cubics of Fritsch and Carlson
    (PCHIP), which do not overshoot where a torque jumps.

    Raises:
        ArgumentError: If the step is not > 0, or finer than a log can be stored.
        FileFormatError: If a trajectory has a long gap or too few rows; names the rows.
    """
    positive("resample", step, "s")
    parts = [_stretch(path, columns, rows, step) for rows in trajectory_slices(columns.trajectory)]
    joined: Any = [None if x[0] is None else np.concatenate(x) for x in zip(*parts, strict=True)]
    return Columns(*joined)


def _stretch(path: Path, columns: Columns, rows: slice, step: float) -> Columns:
    t, first = columns.t[rows] - columns.t[rows.start], rows.start + 1
    if len(t) < _FEWEST:
        raise FileFormatError(f"{path}: from row {first}, {len(t)} rows are too few to resample; leave them out.")
    gaps = np.diff(t)
    k = int(np.argmax(gaps))
    if gaps[k] > _GAP * float(np.median(gaps)):
        raise FileFormatError(
            f"{path}: {gaps[k]:.4g} s are missing between rows {first + k} and {first + k + 1}, too long to "
            "interpolate; let another 'trajectory' begin there."
        )
    if t[-1] / step > _MOST_ROWS:
        raise ArgumentError(f"resample is {step:g} s, which makes more than {_MOST_ROWS:,} rows; give a longer step.")
    even = step * np.arange(int(t[-1] / step + 1e-9) + 1)
    inside = np.minimum(even, t[-1])
    v, a = (None if x is None else CubicSpline(t, x[rows])(inside) for x in (columns.v, columns.a))
    q = CubicSpline(t, columns.q[rows])(inside)
    tau = PchipInterpolator(t, columns.tau[rows])(inside)
    number = np.full(len(even), columns.trajectory[rows.start])
    return Columns(t=even, q=q, tau=tau, v=v, a=a, trajectory=number)
