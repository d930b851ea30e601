"""How the files of a log become samples: read, converted, put right, filtered and differentiated."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool
from scipy.interpolate import PchipInterpolator

from nbs_pin.base.doors import option
from nbs_pin.base.exceptions import ArgumentError, FileFormatError
from nbs_pin.base.npz import read_npz
from nbs_pin.identification.datasets import Dataset, trajectory_slices
from nbs_pin.identification.log_bags import BAGS, read_bag
from nbs_pin.identification.log_derivatives import check_derivatives, derived
from nbs_pin.identification.log_files import (
    CHOSEN,
    Columns,
    arrays_of_matlab,
    columns_of_arrays,
    columns_of_files,
    columns_of_table,
    is_table,
)
from nbs_pin.identification.repairs import beyond, repaired
from nbs_pin.identification.resampling import evenly, parted
from nbs_pin.motions.recordings import TURN, Joints, degrees_fault, in_radians, seams, seconds_in, time_fault, unwrapped
from nbs_pin.robots.robot import Robot

_MOST_RESTARTS = 1000
"""Most times that the clock of a file goes back where recordings begin; a clock that does so more often is none."""


@dataclass(frozen=True)
class LogSettings:
    """How a log is read; the arguments of `load_log` of these names."""

    columns: Mapping[str, str] | None
    rate: float | None
    trajectories: Sequence[int] | None
    degrees: bool | None
    time_unit: str | None
    torque_gain: Any
    gear: Any
    zero: Any
    delay: float
    resample: float | None
    lowpass: float | None
    window: float | None
    prismatic: Sequence[bool] | None

    def given(self) -> dict[str, Any]:
        """Those that ask for anything but seconds and radians."""
        plain = {"degrees": False, "delay": 0.0, "lowpass": 0.0, "time_unit": "s"}
        return {n: x for n, x in vars(self).items() if x is not None and not (n in plain and plain[n] == x)}


def samples_of(files: Sequence[Path], robot: Robot | None, settings: LogSettings) -> Dataset:
    """The samples in the files; `about["notes"]` says what was put right. Errors are those of `load_log`."""
    path, chosen = files[0], _chosen(settings.columns)
    if any(spec.partition(":")[0] in {file.name for file in files} for spec in chosen.values()):
        names = None if robot is None else robot.joint_names
        read, notes = columns_of_files(files, names, chosen, settings.rate), list[str]()
    else:
        read, notes = _joined([_read(file, robot, chosen, settings.rate) for file in files], files)
    if settings.trajectories is not None:
        read = _only(path, read, settings.trajectories)
        notes.append("rows are counted in the trajectories that are read")
    tree = _serial(read.q.shape[1], settings.prismatic) if robot is None else (robot.parents, robot.prismatic)
    joints, name = _joints(read, tree[1], robot), "" if robot is None else robot.name
    if settings.rate is not None and settings.time_unit not in (None, "s"):
        given = f"{option('rate', settings.rate)} and {option('time_unit', settings.time_unit)}"
        raise ArgumentError(f"{given} are given, and times made of a rate are in seconds; leave one of them out.")
    read = _in_units(path, _scaled(read, settings), joints, settings.degrees, settings.time_unit, robot)
    if settings.zero is not None:
        read = read._replace(q=read.q + settings.zero)
    read, absent, blanks = _filled(*_clocked(read))
    stated = {kind: read.q if getattr(read, kind) is None else getattr(read, kind) for kind in "va"}
    _dataset(path, read._replace(**stated), tree, name, {})  # refuses what is no table of numbers
    spacing, more, limits = _spacing(read), list[str](), None
    if spacing["rows"] > len(np.unique(read.trajectory)):  # not of single states
        read, limits, more = _put_right(path, read, joints, settings.degrees, absent)
    elif absent.any():
        read = read.take(~absent)
    read = _advanced(read, settings.delay) if settings.delay else read
    lowpass = 0.0 if settings.lowpass is None and settings.window is not None else settings.lowpass
    even = evenly(path, read, settings.resample, lowpass)
    whole = derived(path, even, settings.window)
    about = {
        "log": str(path),
        "read": spacing,
        "notes": [*notes, *blanks, *more, *even.notes],
        "lowpass_Hz": even.lowpass,
        "asked": {name: _told(getattr(settings, name)) for name in ("torque_gain", "zero", "delay")},
        "differentiated": [kind for kind in "va" if getattr(even.columns, kind) is None],
    }
    data = _dataset(path, whole.columns, tree, name, about)
    check_derivatives(path, data)
    kept = whole.kept if limits is None else whole.kept[~beyond(data.tau[whole.kept], limits)]
    return data.take(kept) if len(kept) < len(data) else data


def _told(given: Any) -> Any:
    """A number, or one per joint, as JSON stores it; None for none."""
    return given if given is None or isinstance(given, int | float) else np.asarray(given, dtype=float).tolist()


def _read(
    path: Path, robot: Robot | None, chosen: Mapping[str, str], rate: float | None
) -> tuple[Columns, tuple[str, ...]]:
    """The columns of one file, and notes on them."""
    names, ending = None if robot is None else robot.joint_names, path.suffix.lower()
    if is_table(path):
        return columns_of_table(path, names, chosen, rate)
    if ending in BAGS:
        bag = read_bag(path, chosen.get("topic"))
        own = {kind: name for kind, name in chosen.items() if kind != "topic"}
        return columns_of_arrays(path, bag.arrays, names, own, rate)[0], bag.notes
    if ending not in (".npz", ".mat"):
        known = ", ".join((".csv", ".csv.gz", ".txt", ".npz", ".mat", *BAGS))
        raise FileFormatError(f"{path}: a '{path.suffix}' file, expected one of {known}; convert it.")
    arrays = read_npz(path) if ending == ".npz" else arrays_of_matlab(path)
    return columns_of_arrays(path, arrays, names, chosen, rate)


def _chosen(columns: Mapping[str, str] | None) -> dict[str, str]:
    """The names of columns as texts; raises ArgumentError for a quantity that there is not."""
    chosen = {kind: str(name) for kind, name in (columns or {}).items()}
    unknown = [kind for kind in chosen if kind not in CHOSEN]
    if unknown:
        raise ArgumentError(f"columns has '{unknown[0]}'; give names for some of {', '.join(CHOSEN)}.")
    return chosen


def _joined(parts: Sequence[tuple[Columns, tuple[str, ...]]], files: Sequence[Path]) -> tuple[Columns, list[str]]:
    """The columns of several files, whose trajectories are numbered on; each note once."""
    first, number, found = parts[0][0], 0, []
    for (columns, _), file in zip(parts, files, strict=True):
        alike = columns.q.shape[1] == first.q.shape[1]
        if not alike or [x is None for x in columns] != [x is None for x in first]:
            raise FileFormatError(f"{file}: has other joints or quantities than {files[0]}; give logs of one kind.")
        own = columns.trajectory if len(parts) == 1 else np.unique(columns.trajectory, return_inverse=True)[1] + number
        number = int(own.max(initial=-1)) + 1
        found.append(columns._replace(trajectory=own))
    joined: Any = [None if x[0] is None else np.concatenate(x) for x in zip(*found, strict=True)]
    return Columns(*joined), list(dict.fromkeys(note for _, notes in parts for note in notes))


def _only(path: Path, columns: Columns, trajectories: Sequence[int]) -> Columns:
    """The rows of those trajectories."""
    absent = [number for number in trajectories if number not in columns.trajectory]
    if absent:
        known = ", ".join(map(str, np.unique(columns.trajectory)))
        raise ArgumentError(f"trajectories has {absent[0]}, and {path} {known:.200}; give some of these.")
    return columns.take(np.isin(columns.trajectory, trajectories))


def _scaled(columns: Columns, settings: LogSettings) -> Columns:
    """The columns with torques in N·m and angles of the joints; raises ArgumentError for another number of joints."""
    n, gear = columns.q.shape[1], settings.gear
    for name in ("torque_gain", "gear", "zero"):
        value = getattr(settings, name)
        if value is not None and np.ndim(value) and np.size(value) != n:
            raise ArgumentError(f"{name} has {np.size(value)} numbers and the log {n} joints; give one for each.")
    if settings.torque_gain is not None:
        columns = columns._replace(tau=columns.tau * settings.torque_gain)
    if gear is None:
        return columns
    if not np.all(gear):
        raise ArgumentError(f"gear is {gear}; give ratios that are not 0.")
    v, a = (x if x is None else x / gear for x in (columns.v, columns.a))
    return columns._replace(q=columns.q / gear, v=v, a=a, tau=columns.tau * gear)


def _spacing(columns: Columns) -> dict[str, Any]:
    """The number of rows as they were, and the least, usual and largest time between them [s]."""
    steps = [np.diff(columns.t[rows]) for rows in trajectory_slices(columns.trajectory)]
    known = np.concatenate([*steps, [] if any(map(len, steps)) else [1.0]])
    return {"rows": len(columns.t), "steps_s": [float(f(known)) for f in (np.min, np.median, np.max)]}


def _clocked(columns: Columns) -> tuple[Columns, np.ndarray, list[str]]:
    """The columns with times that increase, rows that have the time of the row before, and notes.

    Where time goes back another recording begins.
    """
    t, numbers, notes = columns.t.copy(), columns.trajectory.copy(), []
    same = np.diff(columns.trajectory) == 0
    back = np.flatnonzero(same & (np.diff(t) < 0.0)) + 1
    stopped = np.append(False, same & (np.diff(t) == 0.0))
    if not np.isfinite(t).all() or stopped.mean() > 0.5 or len(back) > _MOST_RESTARTS:
        return columns, np.zeros(len(t), dtype=bool), []
    if len(back):
        more = f", and {len(back) - 1} more times" if len(back) > 1 else ""
        notes.append(f"time goes back between rows {back[0]} and {back[0] + 1}{more}: another recording begins there")
        ends = np.append(np.flatnonzero(~same) + 1, len(t))
        for k, row in enumerate(back.tolist()):
            numbers[row : ends[np.searchsorted(ends, row, side="right")]] = columns.trajectory.max() + 1 + k
    if stopped.any():
        many = f"{np.count_nonzero(stopped)} rows with the time of the row before were left out"
        notes.append(f"{many}, first row {int(np.argmax(stopped)) + 1}")
        for rows in trajectory_slices(numbers):
            place, moves = np.arange(rows.stop - rows.start), ~stopped[rows]
            late = place > place[moves].max()  # at the end, which nothing follows
            t[rows] = np.interp(place, place[moves], t[rows][moves]) + 1e-6 * np.cumsum(late)
    return columns._replace(t=t, trajectory=numbers), stopped, notes


def _filled(columns: Columns, absent: np.ndarray, notes: list[str]) -> tuple[Columns, np.ndarray, list[str]]:
    """The columns with NaN in q, v, a and tau bridged, which rows had some or are absent already, and notes."""
    found, holes, place = {}, np.zeros(len(columns.t), dtype=bool), np.arange(len(columns.t))
    for name in ("q", "v", "a", "tau"):
        x = getattr(columns, name)
        if x is not None and np.isnan(x).any() and not np.isnan(x).all():
            blank = np.isnan(x).any(axis=1)
            holes |= blank
            if not blank.all():
                found[name] = np.column_stack([np.interp(place, place[~blank], y[~blank]) for y in x.T])
    if not holes.any() or holes.mean() > 0.5:
        return columns, absent, notes
    many = f"{np.count_nonzero(holes)} rows with entries that are missing were left out"
    return columns._replace(**found), absent | holes, [*notes, f"{many}, first row {int(np.argmax(holes)) + 1}"]


def _put_right(
    path: Path, columns: Columns, joints: Joints, degrees: bool | None, absent: Bool[np.ndarray, " rows"]
) -> tuple[Columns, np.ndarray, list[str]]:
    """The columns without wraps and what is wrong in single rows, the limits of the torques, and notes."""
    found = repaired(columns, joints, absent)
    columns, stretches = found.columns, trajectory_slices(found.columns.trajectory)
    turned = unwrapped(columns.q, joints, stretches, degrees)
    if turned.fault:
        raise FileFormatError(f"{path}: {turned.fault}.")
    columns = columns._replace(q=turned.q)
    pieces = parted(columns, seams(columns.t, columns.q, joints, stretches))
    columns = columns._replace(trajectory=pieces.numbers).take(found.fresh & pieces.kept)
    return columns, found.limits, [*found.notes, *turned.notes, *pieces.notes]


def _advanced(columns: Columns, delay: float) -> Columns:
    """The columns with the torque that was written `delay` later, without the rows for which there is none."""
    tau, known = columns.tau.copy(), np.zeros(len(columns.t), dtype=bool)
    for rows in (rows for rows in trajectory_slices(columns.trajectory) if rows.stop - rows.start > 1):
        t, late = columns.t[rows], columns.t[rows] + delay
        tau[rows] = PchipInterpolator(t, columns.tau[rows])(np.clip(late, t[0], t[-1]))
        known[rows] = (late >= t[0]) & (late <= t[-1])
    if not known.any():
        raise ArgumentError(f"{option('delay', delay)} s is longer than every trajectory; give a shorter one.")
    return columns._replace(tau=tau).take(known)


def _serial(n: int, prismatic: Sequence[bool] | None) -> tuple[np.ndarray, np.ndarray]:
    """Parents and kinds of the joints of a serial arm."""
    slides = np.zeros(n, dtype=bool) if prismatic is None else np.array(list(prismatic), dtype=bool)
    if slides.shape != (n,):
        raise ArgumentError(f"prismatic has {slides.size} entries and the log {n} joints; give one for each.")
    return np.arange(n, dtype=np.int64), slides


def _joints(columns: Columns, prismatic: Bool[np.ndarray, " n"], robot: Robot | None) -> Joints:
    """What is known of the joints; those of an unknown arm are numbered. Which may turn further is by their range."""
    if robot is not None:
        return Joints(robot.joint_names, ~robot.prismatic & (robot.upper - robot.lower > TURN), robot.prismatic)
    return Joints([f"joint {i + 1}" for i in range(columns.q.shape[1])], ~prismatic, prismatic)


def _in_units(
    path: Path, columns: Columns, joints: Joints, degrees: bool | None, time_unit: str | None, robot: Robot | None
) -> Columns:
    """The columns with every angle in radians and time in seconds."""
    fault = degrees_fault(columns.q, joints, robot, turning=False) if degrees is None else ""
    if degrees:
        v, a = (x if x is None else in_radians(x, joints.prismatic) for x in (columns.v, columns.a))
        columns = columns._replace(q=in_radians(columns.q, joints.prismatic), v=v, a=a)
    if not fault and time_unit is None:
        fault = time_fault(columns.t, columns.q, columns.v, trajectory_slices(columns.trajectory), joints.prismatic)
    if fault:
        raise FileFormatError(f"{path}: {fault}.")
    return columns if time_unit is None else columns._replace(t=columns.t * seconds_in(time_unit))


def _dataset(
    path: Path, columns: Columns, tree: tuple[np.ndarray, np.ndarray], robot: str, about: dict[str, Any]
) -> Dataset:
    """The samples; raises FileFormatError for what is none."""
    v: Any = columns.v
    a: Any = columns.a
    try:
        return Dataset(columns.q, v, a, columns.tau, columns.t, columns.trajectory, *tree, robot, about)
    except ArgumentError as error:
        raise FileFormatError(f"{path}: {error}") from error
