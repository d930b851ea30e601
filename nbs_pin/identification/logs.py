"""Logs of other systems as datasets, with units and derivatives checked for consistency."""

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from nbs_pin.base.arguments import MOST_JOINTS, checked, flag, many, maybe, number, readable, text
from nbs_pin.base.doors import BLANK, option
from nbs_pin.base.exceptions import ArgumentError, FileFormatError
from nbs_pin.base.npz import read_npz
from nbs_pin.identification.compatibility import arm_fault
from nbs_pin.identification.datasets import DATASET_FORMAT, Dataset, load_dataset, trajectory_slices
from nbs_pin.identification.log_files import Columns, columns_of_arrays, columns_of_csv
from nbs_pin.identification.measurement import ORDER, derivative
from nbs_pin.identification.resampling import resampled
from nbs_pin.motions.recordings import Joints, degrees_fault, in_radians, seam_fault, seconds_in, time_fault, unwrapped
from nbs_pin.robots.robot import ARM, Robot

_SPAN = 0.05  # [s]; interval over which derivatives are integrated for comparison, to average sensor noise
_DISAGREES = 0.3  # largest RMS error of a logged derivative, as a share of the RMS change
_STILL = 1e-3  # [rad, rad/s]; joints that change less are not checked
_WINDOW = 0.1  # [s]; usual width of the differentiation window
_EVEN = 1e-3  # tolerance of even spacing, as a share of the step


@checked(
    path=readable,
    robot=maybe(ARM),
    degrees=maybe(flag),
    time_unit=maybe(text),
    resample=maybe(number(above=0.0, most=1000.0, unit="s")),
    window=maybe(number(least=1e-6, most=1000.0, unit="s")),
    prismatic=maybe(many(flag, 1, MOST_JOINTS, "joints")),
)
def load_log(
    path: str | Path,
    *,
    robot: Robot | None = None,
    degrees: bool | None = None,
    time_unit: str | None = None,
    resample: float | None = None,
    window: float | None = None,
    prismatic: Sequence[bool] | None = None,
) -> Dataset:
    """Load the measurements in a CSV or NPZ file, joints in the order of the arm.

    CSV: a header with `t` [s], per joint `q_NAME` [rad], `tau_NAME` [N·m] and, if logged, `v_NAME` [rad/s] and
    `a_NAME` [rad/s²] (NAME a joint's name; or q1 … qn, tau1 … taun in the arm's order), and `trajectory`, a whole
    number, if there are several. The names of ROS, position_NAME, velocity_NAME and effort_NAME, are understood too.
    NPZ: arrays `t` (rows,), `q`, `tau`, `v`, `a` (rows, n), `trajectory` (rows,) and `joint_names` (n,) likewise; a
    recorded run and a dataset are such files.

    Quantities not logged are computed by differentiation (Savitzky–Golay); samples must then be evenly spaced, and half
    a window is dropped at both ends of each trajectory. Joints that turn without limit are unwrapped where they jump by
    a turn. Warns of that, of a log with only one trajectory, and of one without torque, from which no model can be
    identified (docs/theory.md §6). A saved dataset is returned as it is, and takes no further argument than `robot`.

    Args:
        path: The file, *.csv or *.npz.
        robot: Gives names, tree and ranges of the joints. None assumes a serial arm.
        degrees: True converts angles, False takes them as radians, None refuses values that look like degrees.
        time_unit: The unit of t: "s", "ms", "us" or "ns". None takes seconds and refuses times that look otherwise.
        resample: Interpolate to this step [s] (`resampling.py`), for rows that are not evenly spaced.
        window: Width of the differentiation window [s]. None takes 0.1.
        prismatic: Which joints of a serial arm are prismatic. None takes all as revolute.

    Raises:
        FileNotFoundError: If the file does not exist.
        FileFormatError: If a column is missing, an entry is not a number, time does not increase, v is not dq/dt, a is
            not dv/dt, angles look like degrees, or a dataset is of another arm than `robot`.

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
    path, seconds = Path(path), seconds_in(time_unit)
    names = None if robot is None else robot.joint_names
    if path.suffix.lower() == ".npz":
        stored = read_npz(path)
        if str(stored.get("format", "")) == DATASET_FORMAT:
            given = {"degrees": degrees or None, "time_unit": time_unit if seconds != 1.0 else None, "window": window}
            _refuse_settings(path, given | {"resample": resample, "prismatic": prismatic})
            return _of_arm(path, load_dataset(path), robot)
        columns = columns_of_arrays(path, stored, names)
    elif path.suffix.lower() == ".csv":
        columns = columns_of_csv(path, names)
    else:
        raise FileFormatError(f"{path}: a '{path.suffix}' file, expected .csv or .npz; convert it.")
    tree = _serial(columns.q.shape[1], prismatic) if robot is None else (robot.parents, robot.prismatic)
    columns = _in_units(path, columns, _joints(columns, tree[1], robot), degrees, time_unit, robot)
    name = "" if robot is None else robot.name
    _dataset(path, columns._replace(v=columns.q, a=columns.q), tree, 1.0, name)  # refuses what is no table of numbers
    columns = _even(path, columns, _joints(columns, tree[1], robot), degrees, resample)
    data = _dataset(path, columns, tree, _WINDOW if window is None else window, name)
    _check_derivatives(path, data)
    _warn(path, data)
    return data


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


def _even(path: Path, columns: Columns, joints: Joints, degrees: bool | None, resample: float | None) -> Columns:
    """The columns without wraps, and with rows `resample` [s] apart unless it is None."""
    stretches = trajectory_slices(columns.trajectory)
    found = unwrapped(columns.q, joints, stretches, degrees)
    fault = found.fault or seam_fault(columns.t, found.q, joints, stretches)
    if fault:
        raise FileFormatError(f"{path}: {fault}.")
    for note in found.notes:
        warnings.warn(f"{path}: {note}.", stacklevel=3)
    columns = columns._replace(q=found.q)
    return columns if resample is None else resampled(path, columns, resample)


def _dataset(path: Path, columns: Columns, tree: tuple[np.ndarray, np.ndarray], window: float, robot: str) -> Dataset:
    """The samples, with v and a differentiated if they are not logged."""
    derived = [name for name in "va" if getattr(columns, name) is None]
    blank = np.zeros_like(columns.q)
    v, a = (blank if x is None else x for x in (columns.v, columns.a))
    about = {"log": str(path), "differentiated": derived}
    try:
        logged = Dataset(columns.q, v, a, columns.tau, columns.t, columns.trajectory, *tree, robot, about)
    except ArgumentError as error:
        raise FileFormatError(f"{path}: {error}") from error
    if not derived:
        return logged
    stretches = [_Stretch.of(path, columns, rows, window) for rows in trajectory_slices(columns.trajectory)]
    v, a = (np.concatenate([getattr(stretch, name) for stretch in stretches]) for name in "va")
    whole = Dataset(columns.q, v, a, columns.tau, columns.t, columns.trajectory, *tree, robot, about)
    return whole.take(np.concatenate([stretch.kept for stretch in stretches]))


class _Stretch(NamedTuple):
    """One trajectory with both derivatives, and the rows at least half a window away from its ends."""

    v: np.ndarray
    a: np.ndarray
    kept: np.ndarray

    @classmethod
    def of(cls, path: Path, columns: Columns, rows: slice, window: float) -> "_Stretch":
        at, steps = f"{path}: from row {rows.start + 1}", np.diff(columns.t[rows])
        step = float(np.median(steps)) if steps.size else 1.0
        if np.abs(steps - step).max(initial=0.0) > _EVEN * step:
            raise FileFormatError(
                f"{at}, samples to differentiate are not evenly spaced ({steps.min():.4g} to {steps.max():.4g} s); "
                f"give {option('resample', float(f'{step:.3g}'))}, or log v and a."
            )
        half = max(round(0.5 * window / step), ORDER // 2 + 1)
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
        return cls(v, a, np.arange(rows.start + half, rows.stop - half))


def _check_derivatives(path: Path, data: Dataset) -> None:
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
                raise FileFormatError(f"{at} is 0 in every row while {of} changes; log it, or leave {name} out.")
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
    return near[0] if near else f"correct its unit or the order of the columns, or leave {name} out"


def _warn(path: Path, data: Dataset) -> None:
    if data.trajectories == 1:
        warnings.warn(
            f"{path} has only one trajectory, so none can be held out; log several, numbered in a column 'trajectory'.",
            stacklevel=3,
        )
    if not data.tau.any():
        warnings.warn(
            f"{path} has only zero torque, which leaves the scale of a model undetermined; log motions with motors on.",
            stacklevel=3,
        )


def _rms(x: np.ndarray) -> np.ndarray:
    return np.sqrt((x**2).mean(axis=0))
