"""Logs of other systems as datasets: read as they are, put right where that is safe, questioned where it is not."""

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from nbs_pin.base.arguments import (
    MOST_JOINTS,
    checked,
    count,
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
from nbs_pin.identification.datasets import DATASET_FORMAT, Dataset, load_dataset
from nbs_pin.identification.log_doubts import log_doubts
from nbs_pin.identification.log_reading import LogSettings, samples_of
from nbs_pin.motions.recordings import seconds_in
from nbs_pin.robots.robot import ARM, Robot


def _files(name: str, value: Any) -> tuple[Any, ...]:
    """One file or a list of files."""
    return (
        many(readable, 1, 10_000, "files")(name, value) if isinstance(value, list | tuple) else (readable(name, value),)
    )


@checked(
    path=_files,
    robot=maybe(ARM),
    columns=maybe(mapping),
    rate=maybe(number(least=0.0, most=1e6, unit="Hz")),
    trajectories=maybe(many(count(), 1, 1_000_000, "numbers")),
    degrees=maybe(flag),
    time_unit=maybe(text),
    torque_gain=maybe(per_joint(unit="N·m per unit of tau")),
    gear=maybe(per_joint(unit="turns of the motor per turn of the joint")),
    zero=maybe(per_joint(unit="rad, m")),
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
    zero: float | Sequence[float] | None = None,
    delay: float = 0.0,
    resample: float | None = None,
    lowpass: float | None = None,
    window: float | None = None,
    prismatic: Sequence[bool] | None = None,
) -> Dataset:
    """Load the measurements in a file or several, joints in the order of the arm (docs/howto/logs.md).

    A log has t [s], per joint q [rad], tau [N·m] and, if known, v and a, and numbers of its trajectories, under these
    or other usual names: a table (*.csv, *.txt, also *.csv.gz) in columns q_NAME or q1 … qn in the arm's order, an
    *.npz or *.mat file in arrays (rows, n), a bag of ROS (*.bag, *.db3, *.mcap) in messages. Recorded runs and datasets
    are logs too, and several files as many recordings.

    Single wrong rows are put right (`repairs.py`), gaps begin another trajectory, jittered stamps are resampled; what
    is not logged is differentiated, all signals low-passed alike where the torque is noisy, wraps of joints without
    limits undone, and rows dropped at the ends of trajectories: each with a warning, and in `about["notes"]`. With a
    robot, unit, sign, zeros and delay are questioned, likewise and in `about["doubts"]`. A saved dataset is returned as
    it is, and takes no further argument than `robot`.

    Args:
        path: The file or files.
        robot: Gives names, tree and ranges of the joints. None assumes a serial arm.
        columns: Names in the file, as {"q": "pos_*"}, * for the joint, {"q": "2-7"} by number, {"v": "-"} to leave out.
        rate: Rows per second, for a log without times [Hz]; 0 for single states in no order.
        trajectories: Numbers of the trajectories to read. None reads all.
        degrees: True converts angles, False takes them as radians, None refuses values that look like degrees.
        time_unit: The unit of t: "s", "ms", "us" or "ns". None takes seconds and refuses times that look otherwise.
        torque_gain: What tau is multiplied by, for all joints or each, as for currents [N·m/A].
        gear: Turns of the motors per turn of the joints, where angles and torques are those of the motors.
        zero: What is added to q, for all joints or each [rad, m].
        delay: How late tau is written, in comparison with q [s].
        resample: Interpolate to this step [s]. None keeps even rows, and takes the usual step of uneven ones.
        lowpass: Cut-off frequency of the filter [Hz], 0 for none. None chooses it by the motion (`resampling.py`).
        window: Width of the differentiation window [s]. None takes 0.1, or less after a filter.
        prismatic: Which joints of a serial arm are prismatic. None takes all as revolute.

    Raises:
        FileNotFoundError: If a file does not exist.
        FileFormatError: If a quantity is missing, an entry is no number, time does not increase, v is not dq/dt, a not
            dv/dt, angles look like degrees, or a dataset is of another arm.

    Example:
        >>> import tempfile
        >>> import numpy as np
        >>> import nbs_pin as nbs
        >>> t = np.arange(0.0, 2.0, 0.01)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     table = np.column_stack([t, t >= 1.0, np.sin(t), -np.sin(t)])
        ...     np.savetxt(f"{folder}/log.csv", table, delimiter=",", header="t,trajectory,q1,tau1")
        ...     nbs.load_log(f"{folder}/log.csv")
        Dataset(180 samples, 2 trajectories, 1 joint)
    """
    files = [Path(file) for file in ([path] if isinstance(path, str | Path) else path)]
    settings = LogSettings(
        columns, rate, trajectories, degrees, time_unit, torque_gain, gear, zero, delay, resample, lowpass, window,
        prismatic,
    )  # fmt: skip
    seconds_in(time_unit)  # refuses what is no unit
    if len(files) == 1 and _is_dataset(files[0]):
        _refuse_settings(files[0], settings.given())
        return _of_arm(files[0], load_dataset(files[0]), robot)
    data = samples_of(files, robot, settings)
    asked = {} if robot is None or not robot.has_bodies else {"doubts": list(log_doubts(data, robot).doubts)}
    for note in [*data.about["notes"], *asked.get("doubts", ()), *_poor(data)]:
        warnings.warn(f"{files[0]}: {note}.", stacklevel=3)
    return replace(data, about={**data.about, **asked})


def _is_dataset(path: Path) -> bool:
    return path.suffix.lower() == ".npz" and str(read_npz(path, {"format"}).get("format", "")) == DATASET_FORMAT


def _refuse_settings(path: Path, given: dict[str, Any]) -> None:
    """Raise ArgumentError for settings of a log, since the quantities of a saved dataset are all known."""
    for name in given:
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


def _poor(data: Dataset) -> Iterator[str]:
    """What the data are too poor for."""
    if data.trajectories == 1 and not data.can_be_split:
        yield (
            "only one trajectory, too short to hold out a part of it; log several, numbered in a column 'trajectory'"
        )
    if not data.tau.any():
        yield "only zero torque, which leaves the scale of a model undetermined; log motions with motors on"
