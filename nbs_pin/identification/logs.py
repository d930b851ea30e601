"""Logs of other systems as datasets: read as they are, put right where that is safe, questioned where it is not."""

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool
from scipy.interpolate import PchipInterpolator

from nbs_pin.base.arguments import (
    MOST_JOINTS,
    checked,
    count,
    either,
    flag,
    joints as per_joint,
    many,
    mapping,
    maybe,
    number,
    readable,
    text,
)
from nbs_pin.base.doors import option
from nbs_pin.base.exceptions import ArgumentError, FileFormatError
from nbs_pin.base.npz import read_npz
from nbs_pin.identification.compatibility import arm_fault
from nbs_pin.identification.datasets import DATASET_FORMAT, Dataset, load_dataset, trajectory_slices
from nbs_pin.identification.log_derivatives import check_derivatives, derived
from nbs_pin.identification.log_files import (
    CHOSEN,
    Columns,
    arrays_of_matlab,
    columns_of_arrays,
    columns_of_table,
    is_table,
)
from nbs_pin.identification.repairs import repaired
from nbs_pin.identification.resampling import evenly, parted_at_gaps
from nbs_pin.motions.recordings import Joints, degrees_fault, in_radians, seam_fault, seconds_in, time_fault, unwrapped
from nbs_pin.robots.robot import ARM, Robot


@checked(
    path=either(many(readable, 1, 10_000, "files"), readable),
    robot=maybe(ARM),
    columns=maybe(mapping),
    rate=maybe(number(above=0.0, most=1e6, unit="Hz")),
    trajectories=maybe(many(count(), 1, 1_000_000, "numbers")),
    degrees=maybe(flag),
    time_unit=maybe(text),
    torque_gain=maybe(per_joint(unit="N·m per unit of tau")),
    gear=maybe(per_joint(unit="turns of the motor per turn of the joint")),
    delay=number(least=-10.0, most=10.0, unit="s"),
    resample=maybe(number(above=0.0, most=1000.0, unit="s")),
    lowpass=maybe(number(least=0.0, most=1e6, unit="Hz")),
    window=maybe(number(least=1e-6, most=1000.0, unit="s")),
    prismatic=maybe(many(flag, 1, MOST_JOINTS, "joints")),
)
def load_log(
    path: str | Path | Sequence[str | Path],
    *,
    robot: Robot | None = None,
    columns: Mapping[str, str] | None = None,
    rate: float | None = None,
    trajectories: Sequence[int] | None = None,
    degrees: bool | None = None,
    time_unit: str | None = None,
    torque_gain: float | Sequence[float] | None = None,
    gear: float | Sequence[float] | None = None,
    delay: float = 0.0,
    resample: float | None = None,
    lowpass: float | None = None,
    window: float | None = None,
    prismatic: Sequence[bool] | None = None,
) -> Dataset:
    """Load the measurements in a file or several, joints in the order of the arm.

    Tables (*.csv, *.txt, also *.csv.gz): a header with `t` [s], per joint `q_NAME` [rad], `tau_NAME` [N·m] and, if
    logged, `v_NAME` [rad/s] and `a_NAME` [rad/s²] (NAME a joint's name; or q1 … qn, tau1 … taun in the arm's order),
    and `trajectory`, a whole number, if there are several. Other usual names are understood too, such as those of ROS.
    Arrays (*.npz, *.mat): `t` (rows,), `q`, `tau`, `v`, `a` (rows, n), `trajectory` (rows,) and `joint_names` (n,)
    likewise; a recorded run and a dataset are such files. Bags of ROS (*.bag, *.mcap, a folder of ROS 2, with the extra
    `logs`): messages of type JointState. Each of several files is a trajectory of its own.

    What is wrong in single rows is put right with a warning that names the first (`repairs.py`): repeated rows, spikes,
    angles that stood still, velocities that are zero throughout. Long gaps begin another trajectory. What is not logged
    is differentiated (Savitzky–Golay), on an even grid if stamps jitter; where the torque is noisy, all signals are
    low-passed alike before, and rows that say nothing new are left out (`resampling.py`). Some rows are dropped at both
    ends of each trajectory. Joints that turn without limit are unwrapped where they jump by a turn. Warns of a log that
    is too short to hold out a part, and of one without torque, from which no model can be identified (docs/theory.md
    §6). `about["notes"]` has all that was said. A saved dataset is returned as it is, and takes no further argument
    than `robot`.

    Args:
        path: The file, or several of one arm.
        robot: Gives names, tree and ranges of the joints. None assumes a serial arm.
        columns: What the file calls t, q, v, a, tau and trajectory, where it has other names or none: {"q": "pos_*"},
            with * for the name of a joint, {"q": "2-7"} by number from 1, {"q": "a+b"} one by one; the name of an array
            or, as "topic", of a topic in a bag.
        rate: Rows per second, for a log without times [Hz].
        trajectories: Numbers of the trajectories to read. None reads all.
        degrees: True converts angles, False takes them as radians, None refuses values that look like degrees.
        time_unit: The unit of t: "s", "ms", "us" or "ns". None takes seconds and refuses times that look otherwise.
        torque_gain: What tau is multiplied by, for all joints or each: the gain of motor currents [N·m/A], a gear ratio
            where torques are those of the motors, −1 for a sign.
        gear: Turns of the motors per turn of the joints, where angles and torques are those of the motors.
        delay: How late tau is written, in comparison with q [s].
        resample: Interpolate to this step [s]. None keeps even rows, and takes the usual step of uneven ones.
        lowpass: Cut-off frequency of a filter for q, v, a and tau [Hz], 0 for none. None takes 12 times the bandwidth
            of the motion where the torque is noisy and something must be differentiated.
        window: Width of the differentiation window [s]. None takes 0.1, or the least where a filter took the noise.
        prismatic: Which joints of a serial arm are prismatic. None takes all as revolute.

    Raises:
        FileNotFoundError: If the file does not exist.
        FileFormatError: If a column is missing, an entry is not a number, time does not increase, v is not dq/dt, a is
            not dv/dt, angles look like degrees, or a dataset is of another arm than `robot`.
        MissingExtra: If a bag is to be read without the extra `logs`.

    Example:
        >>> import tempfile
        >>> import numpy as np
        >>> import nbs_pin as nbs
        >>> t = np.arange(0.0, 2.0, 0.01)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     table = np.column_stack([t, t >= 1.0, np.sin(t), -np.sin(t)])
        ...     np.savetxt(f"{folder}/log.csv", table, delimiter=",", header="t,trajectory,q1,tau1", comments="")
        ...     nbs.load_log(f"{folder}/log.csv")
        Dataset(180 samples, 2 trajectories, 1 joint)
    """
    given = [Path(file) for file in ([path] if isinstance(path, str | Path) else path)]
    path, seconds, chosen = given[0], seconds_in(time_unit), _chosen(columns)
    stored = read_npz(path) if path.suffix.lower() == ".npz" else {}
    if str(stored.get("format", "")) == DATASET_FORMAT and len(given) == 1:
        said: dict[str, Any] = {
            "columns": columns,
            "degrees": degrees or None,
            "time_unit": time_unit if seconds != 1.0 else None,
        }
        said |= {"rate": rate, "trajectories": trajectories, "torque_gain": torque_gain, "gear": gear, "window": window}
        said |= {"delay": delay or None, "resample": resample, "lowpass": lowpass or None, "prismatic": prismatic}
        _refuse_settings(path, said)
        return _of_arm(path, load_dataset(path), robot)
    read, notes = _joined([_read(file, robot, chosen, rate) for file in given], given)
    if trajectories is not None:
        read = _only(path, read, trajectories)
        notes.append("rows are counted in the trajectories that are read")
    tree = _serial(read.q.shape[1], prismatic) if robot is None else (robot.parents, robot.prismatic)
    joints, name = _joints(read, tree[1], robot), "" if robot is None else robot.name
    read = _scaled(read, joints, torque_gain, gear)
    read = _in_units(path, read, joints, degrees, time_unit, robot)
    _dataset(path, read._replace(v=read.q, a=read.q), tree, name, {})  # refuses what is no table of numbers
    read, more = _put_right(path, read, joints, degrees)
    if delay:
        read = _advanced(read, delay)
    even = evenly(path, read, resample, lowpass) if window is None or lowpass else evenly(path, read, resample, 0.0)
    whole = derived(path, even, window)
    notes = [*notes, *more, *even.notes]
    about = {"log": str(path), "notes": notes, "lowpass_Hz": even.lowpass, "step_s": even.step * even.every}
    about["differentiated"] = [kind for kind in "va" if getattr(even.columns, kind) is None]
    data = _dataset(path, whole.columns, tree, name, about)
    check_derivatives(path, data)
    for note in notes:
        warnings.warn(f"{path}: {note}.", stacklevel=2)
    _warn(path, data)
    return data.take(whole.kept) if len(whole.kept) < len(data) else data


def _read(
    path: Path, robot: Robot | None, chosen: Mapping[str, str], rate: float | None
) -> tuple[Columns, tuple[str, ...]]:
    """The columns of one file, and notes on them."""
    names, ending = None if robot is None else robot.joint_names, path.suffix.lower()
    if is_table(path):
        return columns_of_table(path, names, chosen, rate)
    if ending not in (".npz", ".mat"):
        raise FileFormatError(f"{path}: a '{path.suffix}' file, expected .csv, .csv.gz, .npz or .mat; convert it.")
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


def _scaled(columns: Columns, joints: Joints, torque_gain: Any, gear: Any) -> Columns:
    """The columns with torques in N·m and angles of the joints; raises ArgumentError for another number of joints."""
    for name, value in (("torque_gain", torque_gain), ("gear", gear)):
        if value is not None and np.ndim(value) and len(value) != len(joints.names):
            raise ArgumentError(f"{name} has {len(value)} numbers and the log {len(joints.names)} joints; match them.")
    if torque_gain is not None:
        columns = columns._replace(tau=columns.tau * np.asarray(torque_gain))
    if gear is None:
        return columns
    if not np.all(np.asarray(gear)):
        raise ArgumentError(f"gear is {gear}; give ratios that are not 0.")
    v, a = (x if x is None else x / gear for x in (columns.v, columns.a))
    return columns._replace(q=columns.q / gear, v=v, a=a, tau=columns.tau * gear)


def _put_right(path: Path, columns: Columns, joints: Joints, degrees: bool | None) -> tuple[Columns, list[str]]:
    """The columns without wraps and without what is wrong in single rows, and notes on it."""
    found = repaired(columns, joints)
    columns, stretches = found.columns, trajectory_slices(found.columns.trajectory)
    turned, parted = unwrapped(columns.q, joints, stretches, degrees), parted_at_gaps(columns)
    columns = columns._replace(q=turned.q)
    fault = turned.fault or seam_fault(columns.t, columns.q, joints, stretches)
    if fault:
        raise FileFormatError(f"{path}: {fault}.")
    columns = columns._replace(trajectory=parted.numbers).take(found.fresh & parted.kept)
    return columns, [*found.notes, *turned.notes, *([parted.note] if parted.note else [])]


def _advanced(columns: Columns, delay: float) -> Columns:
    """The columns with the torque that was written `delay` later, without the rows for which there is none."""
    tau, known = columns.tau.copy(), np.zeros(len(columns.t), dtype=bool)
    for rows in trajectory_slices(columns.trajectory):
        t, late = columns.t[rows], columns.t[rows] + delay
        tau[rows] = PchipInterpolator(t, columns.tau[rows])(np.clip(late, t[0], t[-1]))
        known[rows] = (late >= t[0]) & (late <= t[-1])
    return columns._replace(tau=tau).take(known)


def _refuse_settings(path: Path, given: dict[str, Any]) -> None:
    """Raise ArgumentError for settings of a log, since the quantities of a saved dataset are all known."""
    needless = [name for name, value in given.items() if value is not None]
    if needless:
        name = needless[0]
        raise ArgumentError(
            f"{path} is a saved dataset, in seconds and radians, with all derivatives: it takes no "
            f"{option(name, given[name])}; leave that out."
        )


def _of_arm(path: Path, data: Dataset, robot: Robot | None) -> Dataset:
    """The data, checked to be of the arm."""
    fault = "" if robot is None else arm_fault(data, robot)
    if fault:
        raise FileFormatError(f"{path}: {fault}.")
    return data


def _serial(n: int, prismatic: Sequence[bool] | None) -> tuple[np.ndarray, np.ndarray]:
    """Parents and kinds of the joints of a serial arm."""
    slides = np.zeros(n, dtype=bool) if prismatic is None else np.array(list(prismatic), dtype=bool)
    if slides.shape != (n,):
        raise ArgumentError(f"prismatic has {slides.size} entries and the log {n} joints; give one for each.")
    return np.arange(n, dtype=np.int64), slides


def _joints(columns: Columns, prismatic: Bool[np.ndarray, " n"], robot: Robot | None) -> Joints:
    """What is known of the joints; those of an unknown arm are numbered and turn within limits."""
    if robot is not None:
        return Joints.of(robot)
    names = [f"joint {i + 1}" for i in range(columns.q.shape[1])]
    return Joints(names, np.zeros(len(names), dtype=bool), prismatic)


def _in_units(
    path: Path, columns: Columns, joints: Joints, degrees: bool | None, time_unit: str | None, robot: Robot | None
) -> Columns:
    """The columns with every angle in radians and time in seconds from the first row of its trajectory."""
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


def _warn(path: Path, data: Dataset) -> None:
    if data.trajectories == 1 and not data.can_be_split:
        warnings.warn(
            f"{path} has only one trajectory, too short to hold out a part of it; log several, numbered in a column "
            "'trajectory'.",
            stacklevel=3,
        )
    if not data.tau.any():
        warnings.warn(
            f"{path} has only zero torque, which leaves the scale of a model undetermined; log motions with motors on.",
            stacklevel=3,
        )
