"""Desired motions from samples and from files: a C² spline with its exact derivatives, held at both ends."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from scipy.interpolate import CubicSpline

from nbs_pin.base.checks import floats
from nbs_pin.base.csv_files import joint_columns, joint_order, read_csv
from nbs_pin.base.exceptions import ArgumentError, FileFormatError
from nbs_pin.base.npz import read_npz, require
from nbs_pin.base.records import Reference

FEWEST_SAMPLES = 4
"""A not-a-knot cubic spline needs four samples."""
PLAUSIBLE_JUMP = 1.0
"""Change of velocity from one sample to the next that any sampling may show [rad/s]."""
_SUDDEN = 10.0  # times the usual change of velocity around it is a jump, where a fast smooth motion shows two or three
_AROUND = 7  # samples; even a single outlying q changes the velocity at only three of them
_MISREAD = 0.1  # how far a stated velocity may lie from dq/dt, per the joint's largest speed


@dataclass(frozen=True, eq=False)
class Sampled:
    """The not-a-knot cubic spline through samples q (k, n) [rad] at increasing times t (k,) [s].

    q is C² between the samples, v and a are its exact derivatives, a is continuous. Outside the samples the first or
    the last one is held with v = a = 0 (never extrapolated), so samples that end in motion end in a velocity jump.
    Raises ArgumentError for samples that are not finite, too few, of other shapes or not in order of time.
    """

    t: Any
    q: Any

    def __post_init__(self) -> None:
        t, q = floats("t", self.t), floats("q", self.q)
        fault = _fault(t, q, _numbered(np.atleast_1d(q).shape[-1]))
        if fault:
            raise ArgumentError(f"samples of a reference: {fault}.")
        object.__setattr__(self, "t", t)
        object.__setattr__(self, "q", q)

    @property
    def duration(self) -> float:
        """Time of the last sample [s], after which it is held."""
        return float(self.t[-1])

    @cached_property
    def _spline(self) -> CubicSpline:
        return CubicSpline(self.t, self.q, axis=0)

    def __call__(self, t: Any) -> Reference:
        """Desired motion at t [s]."""
        t = np.asarray(t, dtype=float)
        spline = self._spline
        inside = np.clip(t, self.t[0], self.t[-1])
        moving = (inside == t)[..., None]
        q, v, a = (spline(inside, order) for order in range(3))
        return Reference(q, np.where(moving, v, 0.0), np.where(moving, a, 0.0))


def load_reference(path: str | Path, joint_names: Sequence[str]) -> Sampled:
    """The motion in a CSV or NPZ file for the joints named, in their order.

    CSV: a header `t` and the joint names in any order (or q1 … qn in the arm's order), then numbers in [s] and [rad];
    or the header of a log, `q_NAME` and whatever else it holds (`load_log`).
    NPZ: arrays `t` (rows,) and `q` (rows, n), with `joint_names` (n,) if their order is to be checked; a recorded
    run is such a file. A velocity `v` (rows, n) beside them is only compared with dq/dt.
    A motion whose velocity jumps is refused: between samples, or at the ends, beyond which it is held.
    Raises FileNotFoundError for no file and FileFormatError naming file, row, column and remedy for any other fault.
    """
    path = Path(path)
    read = {".csv": _read_csv, ".npz": _read_npz}.get(path.suffix.lower())
    if read is None:
        raise FileFormatError(f"{path}: a '{path.suffix}' file, expected .csv or .npz; convert it.")
    t, q, v, columns = read(path)
    order, names = joint_order(path, columns, joint_names), list(joint_names)
    q = q[:, order]
    fault = _fault(t, q, names)
    if fault:
        raise FileFormatError(f"{path}: {fault}.")
    motion = Sampled(t, q)
    fault = _jump(motion, names) or ("" if v is None else _disagreement(motion, v[:, order], names))
    if fault:
        raise FileFormatError(f"{path}: {fault}.")
    return motion


def _fault(t: np.ndarray, q: np.ndarray, columns: list[str]) -> str:
    """What is wrong with samples and what to do, or an empty string; rows count from 1."""
    if t.ndim != 1 or q.ndim != 2 or len(t) != len(q):
        return f"t has shape {t.shape} and q {q.shape}, expected (rows,) and (rows, joints); give one time per row"
    if len(t) < FEWEST_SAMPLES:
        return f"{len(t)} samples, expected at least {FEWEST_SAMPLES}; record more"
    table = np.column_stack((t, q))
    if not np.isfinite(table).all():
        row, column = np.argwhere(~np.isfinite(table))[0]
        name = ["t", *columns][column]
        return f"row {row + 1}, column {name}: {table[row, column]} is not a finite number; fill the gap"
    if not (np.diff(t) > 0.0).all():
        row = int(np.argmin(np.diff(t) > 0.0)) + 1
        return f"time must increase, but row {row + 1} ({t[row]:g}) is not after row {row} ({t[row - 1]:g}); sort it"
    return ""


def _jump(motion: Sampled, columns: list[str]) -> str:
    """Where the velocity jumps and what to do, or an empty string."""
    t, q = motion.t, motion.q
    ends = motion(t[[0, -1]]).v
    changes = np.abs(np.vstack((ends[:1], np.diff(np.diff(q, axis=0) / np.diff(t)[:, None], axis=0), ends[1:])))
    padded = np.pad(changes[1:-1], ((_AROUND // 2, _AROUND // 2), (0, 0)))
    usual = np.median(np.lib.stride_tricks.sliding_window_view(padded, _AROUND, axis=0), axis=-1)
    bound = np.pad(_SUDDEN * usual, ((1, 1), (0, 0)))
    jumps = np.where(changes > np.maximum(bound, PLAUSIBLE_JUMP), changes, 0.0)
    if not jumps.any():
        return ""
    row, joint = np.unravel_index(np.argmax(jumps), jumps.shape)
    at = f"velocity jump {jumps[row, joint]:.3g} rad/s of {columns[joint]} at t = {t[row]:.6g} s"
    if row in (0, len(t) - 1):
        return f"{at}, where the motion {'ends' if row else 'starts'} and beyond which it is held; let it rest there"
    return f"{at} (row {row + 1}); smooth the motion or sample it more finely"


def _disagreement(motion: Sampled, v: np.ndarray, columns: list[str]) -> str:
    """Where the velocity that a file states is not the derivative of q, or an empty string."""
    slope = motion(motion.t).v
    bound = _MISREAD * np.maximum(np.abs(slope).max(axis=0), PLAUSIBLE_JUMP)
    wrong = ~(np.abs(v - slope) <= bound)
    if not wrong.any():
        return ""
    row, joint = np.argwhere(wrong)[0]
    return (
        f"row {row + 1}, v of {columns[joint]}: {v[row, joint]:.6g} rad/s, but q changes by {slope[row, joint]:.6g} "
        "rad/s; correct it or leave v out"
    )


def _numbered(n: int) -> list[str]:
    return [f"q{i + 1}" for i in range(n)]


_Columns: TypeAlias = tuple[np.ndarray, np.ndarray, np.ndarray | None, list[str]]
"""t (rows,), q (rows, n), v (rows, n) if it is stated, and the names of the joints."""


def _read_npz(path: Path) -> _Columns:
    data = read_npz(path)
    require(data, path, {"t": "f", "q": "f"} | ({"v": "f"} if "v" in data else {}))
    if data["q"].ndim != 2:
        raise FileFormatError(f"{path}: 'q' has shape {data['q'].shape}, expected (rows, joints); choose one motion.")
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
    if not q:  # no log's header, so every other column is the joint that it names
        return table[:, 0], table[:, 1:], None, header[1:]
    stated = table[:, [v[joint] for joint in q]] if q.keys() <= v.keys() else None
    return table[:, 0], table[:, list(q.values())], stated, list(q)
