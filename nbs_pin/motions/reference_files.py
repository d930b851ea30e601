"""Desired motions from samples and from files: a C² spline with exact derivatives, held constant beyond its ends."""

import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from scipy.interpolate import CubicSpline

from nbs_pin.base.arguments import MOST_JOINTS, checked, either, flag, many, maybe, readable, text
from nbs_pin.base.checks import LARGEST, floats
from nbs_pin.base.csv_files import joint_columns, joint_order, read_csv
from nbs_pin.base.exceptions import ArgumentError, FileFormatError
from nbs_pin.base.npz import read_npz, require
from nbs_pin.base.records import Reference
from nbs_pin.base.shown import Shown, joints_told
from nbs_pin.base.units import counted, units
from nbs_pin.motions.recordings import (
    Joints,
    degrees_fault,
    from_first_row,
    in_radians,
    seconds_in,
    time_fault,
    unwrapped,
)
from nbs_pin.motions.references import instants
from nbs_pin.robots.robot import ARM, Robot

FEWEST_SAMPLES = 4
"""Fewest samples of a not-a-knot cubic spline."""
PLAUSIBLE_JUMP = 1.0
"""Change of velocity from one sample to the next that is always accepted [rad/s]."""
_LARGEST = 1e9  # [s, rad] and [1/s]; the fourth power of it, in the equations of the spline, is finite
_SUDDEN = 10.0  # times the median change of velocity nearby is a jump; fast smooth motions reach two or three
_AROUND = 7  # samples in that median; an outlier of q affects the velocity change at only three of them
_APART = 2.0  # times the steps beside it is what an outlier departs from both neighbours
_MISREAD = 0.1  # tolerance of a stated velocity against dq/dt, relative to the joint's largest speed


@dataclass(frozen=True, eq=False, repr=False)
class Sampled(Shown):
    """The not-a-knot cubic spline through samples q (k, n) [rad] at increasing times t (k,) [s].

    q is C², and v and a are its exact derivatives. Before the first and after the last sample, q is held with
    v = a = 0 (no extrapolation), so samples that begin or end in motion give a velocity jump.

    Raises:
        ArgumentError: If samples are not finite, fewer than four, of wrong shape or not in order of time.

    Example:
        >>> import nbs_pin as nbs
        >>> nbs.Sampled(t=[0.0, 1.0, 2.0, 3.0], q=[[0.0], [1.0], [4.0], [9.0]])(t=1.5).v
        array([3.])
    """

    t: Any
    q: Any

    def __post_init__(self) -> None:
        t, q = floats("t", self.t), floats("q", self.q)
        fault = _fault(t, q, [f"q{i + 1}" for i in range(np.atleast_1d(q).shape[-1])])
        if fault:
            raise ArgumentError(f"samples of a reference: {fault}.")
        object.__setattr__(self, "t", t)
        object.__setattr__(self, "q", q)

    def _facts(self) -> Iterable[str]:
        return joints_told(self.q.shape[1]), counted(len(self.t), "sample"), f"{self.t[0]:.4g} to {self.t[-1]:.4g} s"

    @property
    def duration(self) -> float:
        """Time of the last sample [s]."""
        return float(self.t[-1])

    @property
    def largest_jerk(self) -> np.ndarray:
        """Largest |ȧ_d| of each joint until the last sample, of all cubics [rad/s³]; ∞ if it begins after t = 0."""
        if self.t[0] > 0.0:
            return np.full(self.q.shape[1], np.inf)
        return np.asarray(6.0 * np.abs(self._spline.c[0]).max(axis=0))

    @cached_property
    def _spline(self) -> CubicSpline:
        return CubicSpline(self.t, self.q, axis=0)

    def __call__(self, t: Any) -> Reference:
        """Desired motion at t [s]."""
        t = instants(t)
        spline = self._spline
        inside = np.clip(t, self.t[0], self.t[-1])
        moving = (inside == t)[..., None]
        q, v, a = (spline(inside, order) for order in range(3))
        return Reference(q, np.where(moving, v, 0.0), np.where(moving, a, 0.0))


@checked(
    path=readable,
    robot=either(ARM, many(text, 1, MOST_JOINTS, "names of joints")),
    time_unit=maybe(text),
    degrees=maybe(flag),
)
def load_reference(
    path: str | Path, robot: Robot | Sequence[str], *, time_unit: str | None = None, degrees: bool | None = None
) -> Sampled:
    """Load the motion of an arm from a CSV or NPZ file.

    CSV: a header of `t` and the joint names in any order (or q1 … qn in the arm's order), then numbers in [s] and
    [rad]; or the header of a log, with columns `q_NAME` and others (`load_log`).
    NPZ: arrays `t` (rows,) and `q` (rows, n), and `joint_names` (n,) if their order is to be checked; a saved `Run` is
    such a file. A velocity `v` (rows, n) is only compared with dq/dt, which must not jump, not even at the ends.

    Time is counted from the first row. Joints that turn without limit are unwrapped where they jump by a turn. Both
    are said in a warning where they change something.

    Args:
        path: The file, *.csv or *.npz.
        robot: The arm, or the names of its joints, which are then taken as rotary, with limits.
        time_unit: The unit of t: "s", "ms", "us" or "ns". None takes seconds and refuses times that look otherwise.
        degrees: True converts angles, False takes them as radians, None refuses values that look like degrees.

    Raises:
        FileNotFoundError: If the file does not exist.
        FileFormatError: If it has any other fault; names file, row, column and remedy.
        ArgumentError: If the unit of time is unknown.

    Example:
        >>> import tempfile
        >>> import numpy as np
        >>> import nbs_pin as nbs
        >>> t = np.linspace(0.0, 1.0, 21)
        >>> rows = np.column_stack([t, t**2 * (3 - 2 * t), -(t**2) * (3 - 2 * t)])
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     np.savetxt(f"{folder}/m.csv", rows, delimiter=",", header="t,joint1,joint2", comments="")
        ...     nbs.load_reference(f"{folder}/m.csv", nbs.load_robot("two_link"))(0.5).v.round(6)
        array([ 1.5, -1.5])
    """
    path = Path(path)
    read = {".csv": _read_csv, ".npz": _read_npz}.get(path.suffix.lower())
    if read is None:
        raise FileFormatError(f"{path}: a '{path.suffix}' file, expected .csv or .npz; convert it.")
    joints, seconds = Joints.of(robot), seconds_in(time_unit)
    t, q, v, columns = read(path)
    order, names = joint_order(path, columns, joints.names), list(joints.names)
    q, v = q[:, order], None if v is None else v[:, order]
    fault = _fault(t, q, names)
    if not fault and degrees is None:
        fault = degrees_fault(q, joints, robot if isinstance(robot, Robot) else None, turning=True)
    if degrees:
        q, v = in_radians(q, joints.prismatic), None if v is None else in_radians(v, joints.prismatic)
    first, t = t[0] if len(t) else 0.0, from_first_row(t) * seconds
    if not fault and time_unit is None:
        fault = time_fault(t, q, v, [slice(0, len(t))], joints.prismatic)
    if fault:
        raise FileFormatError(f"{path}: {fault}.")
    even = unwrapped(q, joints, [slice(0, len(t))], degrees)
    motion = Sampled(t, even.q)
    fault = even.fault or _jump(motion, joints) or ("" if v is None else _disagreement(motion, v, joints))
    if fault:
        raise FileFormatError(f"{path}: {fault}.")
    late = (f"time is counted from the first row, which is at t = {first:.12g} {time_unit or 's'}",) if first else ()
    for note in (*late, *even.notes):
        warnings.warn(f"{path}: {note}.", stacklevel=2)
    return motion


def _fault(t: np.ndarray, q: np.ndarray, columns: list[str]) -> str:
    """What is wrong with the samples and what to do, or an empty string; rows are counted from 1."""
    if t.ndim != 1 or q.ndim != 2 or len(t) != len(q):
        return f"t has shape {t.shape} and q {q.shape}, expected (rows,) and (rows, joints); give one time per row"
    if len(t) < FEWEST_SAMPLES:
        return f"{len(t)} samples, expected at least {FEWEST_SAMPLES}; record more"
    table = np.column_stack((t, q))
    if not np.isfinite(table).all():
        row, column = np.argwhere(~np.isfinite(table))[0]
        name = ["t", *columns][column]
        return f"row {row + 1}, column {name}: {table[row, column]} is not a finite number; fill the gap"
    if not np.abs(table).max() <= LARGEST:
        return f"a number is {np.abs(table).max():.3g}, expected at most {LARGEST:g} in [s] and [rad]; correct it"
    if not (np.diff(t) > 0.0).all():
        row = int(np.argmin(np.diff(t) > 0.0)) + 1
        return f"time must increase, but row {row + 1} ({t[row]:g}) is not after row {row} ({t[row - 1]:g}); sort it"
    return _overflow(t, q, columns)


def _overflow(t: np.ndarray, q: np.ndarray, columns: list[str]) -> str:
    """Which number is so large, or so soon after the one before, that the spline overflows; or an empty string."""
    if np.abs(q).max() > _LARGEST:
        row, column = np.argwhere(np.abs(q) > _LARGEST)[0]
        return f"row {row + 1}, column {columns[column]}: {q[row, column]:g} is beyond ±{_LARGEST:g}; correct it"
    steps = np.diff(t)
    if steps.min() < 1.0 / _LARGEST:
        row = int(np.argmin(steps)) + 1
        return f"row {row + 1} is {steps.min():g} s after row {row}, expected at least {1.0 / _LARGEST:g} s; correct t"
    return ""


def _jump(motion: Sampled, joints: Joints) -> str:
    """Where the velocity jumps and what to do, or an empty string."""
    t, q = motion.t, motion.q
    jumps = _jumps(motion)
    if not jumps.any():
        return ""
    row, joint = (int(k) for k in np.unravel_index(np.argmax(jumps), jumps.shape))
    unit = units("velocity", joints.prismatic)[joint]
    at = f"velocity jump {jumps[row, joint]:.3g} {unit} of {joints.names[joint]} at t = {t[row]:.6g} s"
    if row in (0, len(t) - 1):
        return f"{at}, where the motion {'ends' if row else 'starts'} and q is held; add samples at rest there"
    for k in range(max(row - 1, 1), min(row + 2, len(t) - 1)):
        if _stands_alone(motion, k, joint):
            return (
                f"{at}: q is {q[k, joint]:.6g} in row {k + 1}, between {q[k - 1, joint]:.6g} and "
                f"{q[k + 1, joint]:.6g}, an outlier? correct it or remove that row"
            )
    return f"{at} (row {row + 1}); smooth the motion or sample it more finely"


def _stands_alone(motion: Sampled, row: int, joint: int) -> bool:
    """Whether a sample is far from both neighbours, compared with their own steps, and without it nothing jumps."""
    x, rest = motion.q[:, joint], np.arange(len(motion.t)) != row
    if len(x) <= FEWEST_SAMPLES:
        return False
    beside = np.abs(np.diff(x))[[k for k in (row - 2, row + 1) if 0 <= k < len(x) - 1]]
    apart = min(abs(x[row] - x[row - 1]), abs(x[row + 1] - x[row]))
    return bool(apart > _APART * beside.max() and not _jumps(Sampled(motion.t[rest], x[rest][:, None])).any())


def _jumps(motion: Sampled) -> np.ndarray:
    """Implausible changes of velocity at each sample (rows, n) [rad/s], 0 where there is none."""
    t, q = motion.t, motion.q
    ends = motion(t[[0, -1]]).v
    changes = np.abs(np.vstack((ends[:1], np.diff(np.diff(q, axis=0) / np.diff(t)[:, None], axis=0), ends[1:])))
    padded = np.pad(changes[1:-1], ((_AROUND // 2, _AROUND // 2), (0, 0)))
    usual = np.median(np.lib.stride_tricks.sliding_window_view(padded, _AROUND, axis=0), axis=-1)
    bound = np.pad(_SUDDEN * usual, ((1, 1), (0, 0)))
    return np.asarray(np.where(changes > np.maximum(bound, PLAUSIBLE_JUMP), changes, 0.0))


def _disagreement(motion: Sampled, v: np.ndarray, joints: Joints) -> str:
    """Where the velocity stated in a file is not the derivative of q, and what to do, or an empty string."""
    slope = motion(motion.t).v
    bound = _MISREAD * np.maximum(np.abs(slope).max(axis=0), PLAUSIBLE_JUMP)
    wrong = ~(np.abs(v - slope) <= bound)
    if not wrong.any():
        return ""
    row, joint = np.argwhere(wrong)[0]
    at, stated, found = f"row {row + 1}, v of {joints.names[joint]}", v[row, joint], slope[row, joint]
    unit = units("velocity", joints.prismatic)[joint]
    return f"{at}: {stated:.6g} {unit}, but q changes by {found:.6g} {unit}; correct it or leave v out"


_Columns: TypeAlias = tuple[np.ndarray, np.ndarray, np.ndarray | None, list[str]]
"""t (rows,), q (rows, n), v (rows, n) if it is stated, and the names of the joints."""


def _read_npz(path: Path) -> _Columns:
    data = read_npz(path)
    if data.get("t", np.empty(0)).dtype.kind in "iu":  # stamps
        data["t"] = data["t"].astype(float)
    require(data, path, {"t": "f", "q": "f"} | ({"v": "f"} if "v" in data else {}))
    if data["q"].ndim != 2:
        raise FileFormatError(f"{path}: 'q' has shape {data['q'].shape}, expected (rows, joints); choose one motion.")
    if data["t"].shape != data["q"].shape[:1]:
        wanted = data["q"].shape[:1]
        raise FileFormatError(f"{path}: 't' has shape {data['t'].shape}, expected {wanted}: one time per row of q.")
    if "v" in data and data["v"].shape != data["q"].shape:
        raise FileFormatError(f"{path}: 'v' has shape {data['v'].shape}, q {data['q'].shape}; match them.")
    if "joint_names" not in data:
        return data["t"], data["q"], data.get("v"), [str(i + 1) for i in range(data["q"].shape[1])]
    require(data, path, {"joint_names": "U"})
    names = [str(name) for name in data["joint_names"].ravel()]
    if len(names) != data["q"].shape[1]:
        raise FileFormatError(f"{path}: {len(names)} joint_names for {data['q'].shape[1]} columns of q; match them.")
    return data["t"], data["q"], data.get("v"), names


def _read_csv(path: Path) -> _Columns:
    header, table = read_csv(path)
    if header[:1] != ["t"]:
        raise FileFormatError(f"{path}: the first column is '{header[0]}', expected 't'; put time first.")
    q, v = (joint_columns(header, kind) for kind in "qv")
    if not q:  # not the header of a log, so every other column is named by its joint
        return table[:, 0], table[:, 1:], None, header[1:]
    stated = table[:, [v[joint] for joint in q]] if q.keys() <= v.keys() else None
    return table[:, 0], table[:, list(q.values())], stated, list(q)
