"""The columns of a CSV or NPZ log, in the joint order of an arm."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from nbs_pin.base.csv_files import QUANTITIES, ROS_NAMES, joint_columns, joint_order, read_csv
from nbs_pin.base.exceptions import FileFormatError

_NEEDED = "log t, q and tau (and v and a if known)"


class Columns(NamedTuple):
    """The columns of a log, None where not logged; angles in the unit of the log."""

    t: Float[np.ndarray, " rows"]
    q: Float[np.ndarray, "rows n"]
    tau: Float[np.ndarray, "rows n"]
    v: Float[np.ndarray, "rows n"] | None
    a: Float[np.ndarray, "rows n"] | None
    trajectory: Int[np.ndarray, " rows"]
    """Number of the trajectory; 0 if the log has no numbers."""


def columns_of_csv(path: Path, joint_names: Sequence[str] | None) -> Columns:
    """The columns of a CSV file (see `load_log`), joints in the order of `joint_names`; None keeps the file's."""
    header, table = read_csv(path)
    columns = {kind: joint_columns(header, kind) for kind in QUANTITIES}
    found = list(columns["q"])
    joints = [found[i] for i in joint_order(path, found, joint_names)] if found else ["1"]
    needed = [kind for kind in QUANTITIES if columns[kind] or kind in ("q", "tau")]
    absent = [f"{kind}_{joint}" for kind in needed for joint in joints if joint not in columns[kind]]
    if absent:
        raise FileFormatError(f"{path}: no column '{absent[0]}' among {', '.join(header)}; {_NEEDED}, for each joint.")
    arrays = {kind: table[:, [columns[kind][joint] for joint in joints]] for kind in needed}
    arrays |= {name: table[:, header.index(name)] for name in ("t", "trajectory") if name in header}
    return _columns(path, arrays, joints, None)


def columns_of_arrays(path: Path, stored: dict[str, np.ndarray], joint_names: Sequence[str] | None) -> Columns:
    """The columns of an NPZ file (see `load_log`), joints in the order of `joint_names`; None keeps the file's."""
    arrays = {kind: stored[ROS_NAMES[kind]] for kind in QUANTITIES if ROS_NAMES[kind] in stored}
    arrays |= {name: stored[name] for name in ("t", "trajectory", *QUANTITIES) if name in stored}
    absent = [name for name in ("t", "q", "tau") if name not in arrays]
    if absent:
        raise FileFormatError(f"{path}: no '{absent[0]}' among {', '.join(stored) or 'no keys'}; {_NEEDED}.")
    shape = arrays["q"].shape
    for name, x in arrays.items():
        wanted = shape if name in QUANTITIES else shape[:1]
        if x.dtype.kind not in "fiu" or len(shape) != 2 or 0 in shape or x.shape != wanted:
            raise FileFormatError(
                f"{path}: '{name}' is {x.dtype} of shape {x.shape} beside q of shape {shape}, expected numbers, "
                "(rows,) for t and trajectory and (rows, joints) for the others; correct it."
            )
    found = [str(name) for name in np.ravel(stored.get("joint_names", np.arange(1, shape[1] + 1)))]
    if len(found) != shape[1]:
        raise FileFormatError(f"{path}: {len(found)} joint_names for {shape[1]} columns of q; give one per column.")
    return _columns(path, arrays, found, joint_names)


def _columns(path: Path, arrays: dict[str, np.ndarray], found: list[str], joint_names: Sequence[str] | None) -> Columns:
    """The columns with joints in the requested order and trajectories numbered."""
    order = joint_order(path, found, joint_names)
    numbers = arrays.get("trajectory", np.zeros(len(arrays["t"])))
    if not np.array_equal(numbers, np.round(numbers)):
        raise FileFormatError(f"{path}: 'trajectory' must hold a whole number in every row; number them 0, 1, 2, ….")
    given = {kind: arrays[kind].astype(float)[:, order] for kind in QUANTITIES if kind in arrays}
    return Columns(
        t=arrays["t"].astype(float),
        q=given["q"],
        tau=given["tau"],
        v=given.get("v"),
        a=given.get("a"),
        trajectory=numbers.astype(np.int64),
    )
