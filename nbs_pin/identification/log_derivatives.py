"""Derivatives of logged signals: found where they are not logged, and compared where they are."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from nbs_pin.base.doors import BLANK, option
from nbs_pin.base.exceptions import FileFormatError
from nbs_pin.identification.datasets import Dataset, trajectory_slices
from nbs_pin.identification.log_files import NOT_READ, Columns
from nbs_pin.identification.measurement import ORDER, derivative
from nbs_pin.identification.resampling import WINDOW, Even, lowpassed

_SPAN = 0.05  # [s]; interval over which derivatives are integrated for comparison, to average sensor noise
_DISAGREES = 0.3  # largest RMS error of a logged derivative, as a share of the RMS change
_STILL = 1e-3  # [rad, rad/s]; joints that change less are not checked


class Derived(NamedTuple):
    """Columns with v and a, and the rows that are far enough from the ends of their trajectories."""

    columns: Columns
    kept: np.ndarray


def derived(path: Path, even: Even, window: float | None) -> Derived:
    """The columns through their filter, with v and a differentiated (Savitzky–Golay) if they are not logged.

    Raises:
        FileFormatError: If a trajectory is too short; names its first row.
    """
    columns, step = even.columns, even.step
    if even.lowpass:
        needed = 2 * round(1.0 / (even.lowpass * step)) + 1
        for rows in trajectory_slices(columns.trajectory):
            if rows.stop - rows.start < needed:
                raise FileFormatError(
                    f"{path}: from row {rows.start + 1}, a trajectory of {rows.stop - rows.start} samples is too short "
                    f"for a low-pass filter of {even.lowpass:g} Hz, which takes {needed}; give "
                    f"{option('lowpass', BLANK)} with a higher frequency, or longer trajectories."
                )
        columns = lowpassed(columns, step, even.lowpass)
        window = 0.0 if window is None else window
    elif columns.v is not None and columns.a is not None:
        return Derived(columns, np.arange(0, len(columns.t), even.every))
    stretches = [_Stretch.of(path, columns, rows, window, even) for rows in trajectory_slices(columns.trajectory)]
    v, a = (np.concatenate([getattr(stretch, name) for stretch in stretches]) for name in "va")
    return Derived(columns._replace(v=v, a=a), np.concatenate([stretch.kept for stretch in stretches]))


class _Stretch(NamedTuple):
    """One trajectory with both derivatives, and the rows to keep, away from its ends."""

    v: np.ndarray
    a: np.ndarray
    kept: np.ndarray

    @classmethod
    def of(cls, path: Path, columns: Columns, rows: slice, window: float | None, even: Even) -> "_Stretch":
        at, step = f"{path}: from row {rows.start + 1}", even.step
        half = max(round(0.5 * (WINDOW if window is None else window) / step), ORDER // 2 + 1)
        length = 2 * half + 1
        if rows.stop - rows.start < length:
            raise FileFormatError(
                f"{at}, a trajectory of {rows.stop - rows.start} samples is too short to be differentiated over "
                f"{length}; give a shorter {option('window', BLANK)}, or longer trajectories."
            )
        if columns.v is None:
            v, a = (derivative(columns.q[rows], step, length, order) for order in (1, 2))
        else:
            v, a = columns.v[rows], derivative(columns.v[rows], step, length)
        a = a if columns.a is None else columns.a[rows]
        end = max(half, round(1.0 / (even.lowpass * step))) if even.lowpass else half
        return cls(v, a, np.arange(rows.start + end, rows.stop - end, even.every))


def check_derivatives(path: Path, data: Dataset) -> None:
    """Raise FileFormatError if v is not dq/dt or a is not dv/dt."""
    for name, of in (("v", "q"), ("a", "v")):
        change, stated = _changes(data, getattr(data, of), getattr(data, name))
        size = _rms(np.vstack((change, stated)))
        missed = np.where(size > _STILL, _rms(change - stated) / np.maximum(size, _STILL), 0.0)
        if missed.max() > _DISAGREES:
            joint = int(np.argmax(missed))
            at = f"{path}: {name} of joint {joint + 1}"
            if name in data.about["differentiated"]:
                raise FileFormatError(
                    f"{at} cannot be found from {of}, whose noise or jumps are as large as its motion; give a longer "
                    f"{option('window', BLANK)}, or log {name}."
                )
            said = stated[:, joint]
            if not said.any():
                raise FileFormatError(f"{at} is 0 in every row while {of} changes; log it, or {_without(name)}.")
            ratio = float(change[:, joint] @ said / (said @ said))
            raise FileFormatError(
                f"{at} is not the derivative of {of}, which changes {ratio:.3g} times as much as {name} states; "
                f"{_remedy(ratio, name, of)}."
            )


def _changes(
    data: Dataset, x: Float[np.ndarray, "samples n"], rate: Float[np.ndarray, "samples n"]
) -> tuple[np.ndarray, np.ndarray]:
    """Changes of x over `_SPAN`, and integrals of its stated rate (trapezoidal rule), of all trajectories."""
    changes, integrals = [np.zeros((1, data.nv))], [np.zeros((1, data.nv))]
    for rows in trajectory_slices(data.trajectory):
        t, y, dy = data.t[rows], x[rows], rate[rows]
        if len(t) > 1:
            lag = min(max(1, round(_SPAN / float(np.median(np.diff(t))))), len(t) - 1)
            areas = 0.5 * (dy[1:] + dy[:-1]) * np.diff(t)[:, None]
            total = np.vstack((np.zeros(data.nv), np.cumsum(areas, axis=0)))
            changes.append(y[lag:] - y[:-lag])
            integrals.append(total[lag:] - total[:-lag])
    return np.concatenate(changes), np.concatenate(integrals)


def _remedy(ratio: float, name: str, of: str) -> str:
    known = {np.pi / 180.0: f"convert {name} from degrees", 180.0 / np.pi: f"convert {of} from degrees"}
    known[-1.0] = f"one of their signs is wrong, so correct {name}"
    near = [remedy for factor, remedy in known.items() if abs(ratio / factor - 1.0) < 0.1]
    return near[0] if near else f"correct its unit or the order of the columns, or {_without(name)}"


def _without(name: str) -> str:
    """How the reader leaves a quantity out."""
    return f"leave {name} out with {option('columns', {name: NOT_READ})}"


def _rms(x: np.ndarray) -> np.ndarray:
    return np.sqrt((x**2).mean(axis=0))
