"""Datasets: measured states, accelerations and torques of an arm, sorted into trajectories."""

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from nbs_pin.base.archives import parse_json
from nbs_pin.base.arguments import SEED, a, check_fields, checked, count, mapping, number, readable, text, writable
from nbs_pin.base.checks import LARGEST, floats, is_usual, told
from nbs_pin.base.doors import in_words
from nbs_pin.base.exceptions import ArgumentError, FileFormatError
from nbs_pin.base.npz import read_npz, require, write_npz
from nbs_pin.base.shown import Shown, joints_told
from nbs_pin.base.units import counted

DATASET_FORMAT = "nbs_pin dataset 1"
"""Value of the `format` entry of a data file."""
_STATES = ("q", "v", "a", "tau")
_GUARD = 0.5
"""Time between training data and a part of the same recording that is held out [s]."""
_LONG, _FEW = 5.0, 10
"""Shortest recording of which a part is held out [s], and fewest rows of a part."""
_KINDS: dict[tuple[str, ...], type] = {
    (*_STATES, "t"): np.float64,
    ("trajectory", "parents"): np.int64,
    ("prismatic",): np.bool_,
}


@dataclass(frozen=True, eq=False, repr=False)
class Dataset(Shown):
    """Samples of an arm in motion; row k of every array belongs to the same instant.

    The samples of a trajectory are contiguous and in the order of time. They are correlated, so `split` holds out whole
    trajectories, and statistical claims count trajectories, not samples (docs/theory.md §6). Lists and arrays of other
    types are converted to float64, int64 and bool.

    Raises:
        ArgumentError: If an array is not numeric, shapes do not match, a number is not finite, a trajectory is
            interrupted or its time does not increase, or a joint comes before its parent.

    Example:
        >>> import numpy as np
        >>> import nbs_pin as nbs
        >>> t = np.linspace(0.0, 1.0, 50)
        >>> q, v, a = (x[:, None] for x in (np.sin(t), np.cos(t), -np.sin(t)))
        >>> nbs.Dataset(q, v, a, 2.0 * a, t, trajectory=np.arange(50) // 25, parents=[0], prismatic=[False])
        Dataset(50 samples, 2 trajectories, 1 joint)
    """

    q: Float[np.ndarray, "samples n"]
    """Configuration [rad]."""
    v: Float[np.ndarray, "samples n"]
    """Velocity [rad/s]."""
    a: Float[np.ndarray, "samples n"]
    """Acceleration [rad/s²]."""
    tau: Float[np.ndarray, "samples n"]
    """Motor torque [N·m], including the part that overcomes friction."""
    t: Float[np.ndarray, " samples"]
    """Time within the trajectory [s]."""
    trajectory: Int[np.ndarray, " samples"]
    """Number of the trajectory of each sample."""
    parents: Int[np.ndarray, " n"]
    """Joint tree: 0 if the parent is the base, i + 1 if it is joint i; parents come first."""
    prismatic: Bool[np.ndarray, " n"]
    """True for prismatic joints, whose q is in [m] and whose torque is a force [N]."""
    robot: str = ""
    """Name of the arm; empty if unknown."""
    about: Mapping[str, Any] = field(default_factory=dict)
    """Origin of the data (recipe, seed, noise, friction, …), JSON-serialisable."""

    def __post_init__(self) -> None:
        check_fields(self, robot=text, about=mapping)
        for names, kind in _KINDS.items():
            for name in names:
                object.__setattr__(self, name, _array(name, getattr(self, name), kind))
        fault = _fault(self)
        if fault:
            raise ArgumentError(f"dataset{f' of {self.robot}' if self.robot else ''}: {fault}.")

    def __len__(self) -> int:
        return len(self.t)

    def _facts(self) -> Iterable[str]:
        of = f" of {self.robot}" if self.robot else ""
        many = counted(self.trajectories, "trajectory", "trajectories")
        return f"{counted(len(self), 'sample')}{of}", many, joints_told(self.nv)

    @property
    def nv(self) -> int:
        """Number of joints."""
        return int(self.q.shape[1])

    @property
    def samples(self) -> int:
        """Number of samples."""
        return len(self)

    @property
    def trajectories(self) -> int:
        """Number of trajectories."""
        return int(np.unique(self.trajectory).size)

    @property
    def can_be_split(self) -> bool:
        """Whether a part can be held out: some of several trajectories, or the end of a long one."""
        return len(recordings(self)) > 1 or bool(_held_from(self, 0.2))

    @checked(share=number(above=0.0, below=1.0), seed=SEED)
    def split(self, share: float = 0.2, seed: int = 0) -> tuple["Dataset", "Dataset"]:
        """Split into training data and held-out data, about `share`.

        Whole trajectories are held out, at least one, at random; pieces of one recording (`recordings`) go together.
        Of a single recording its last part is held out, and half a second before it is in neither.

        Raises:
            ArgumentError: If share is outside (0, 1), or there is only one trajectory, too short to be parted.
        """
        groups = recordings(self)
        if len(groups) > 1:
            many = int(np.clip(round(share * len(groups)), 1, len(groups) - 1))
            chosen = np.random.default_rng(seed).permutation(len(groups))[:many]
            held_out = np.isin(self.trajectory, np.concatenate([groups[k] for k in chosen]))
            return self.take(~held_out), self.take(held_out)
        begin = _held_from(self, share)
        if not begin:
            raise ArgumentError(
                f"{in_words(self, 'the data')} cannot be split: it has only one trajectory; collect several."
            )
        clock = _clock(self)
        return self.take(clock < clock[begin] - _GUARD), self.take(slice(begin, None))

    def take(self, rows: Any) -> "Dataset":
        """The samples selected by the numpy index `rows` (a slice, a mask, or increasing indices)."""
        if isinstance(rows, range) and len(rows) > len(self):
            raise ArgumentError(
                f"rows is a range of {len(rows)}, expected at most the {len(self)} samples; correct it."
            )
        try:
            index = np.arange(len(self))[rows if isinstance(rows, slice) else np.asarray(rows)]
        except (IndexError, ValueError, TypeError, OverflowError, RuntimeError) as error:
            raise ArgumentError(
                f"rows is {told(rows)}, expected a slice, a mask or indices; {error!s:.100}."
            ) from error
        return replace(self, **{name: getattr(self, name)[index] for name in (*_STATES, "t", "trajectory")})

    @checked(most=count(1))
    def thinned(self, most: int) -> "Dataset":
        """At most that many samples, evenly spaced: neighbours in a fast log say little new."""
        return self if len(self) <= most else self.take(np.linspace(0, len(self) - 1, most).astype(int))

    @checked(path=writable)
    def save(self, path: str | Path) -> None:
        """Write an npz file atomically; missing folders are created.

        Raises:
            ArgumentError: If `about` cannot be stored as JSON.
        """
        try:
            about = json.dumps(dict(self.about), allow_nan=False)
        except (TypeError, ValueError) as error:
            raise ArgumentError(f"about cannot be stored as JSON ({error}); keep numbers, text and lists.") from error
        arrays = {entry.name: np.asarray(getattr(self, entry.name)) for entry in fields(self) if entry.name != "about"}
        write_npz(path, {"format": np.array(DATASET_FORMAT), **arrays, "about": np.array(about)})


DATA = a(Dataset, "a Dataset, as collect or load_log returns it")
"""The check of an argument that is data."""


@checked(path=readable)
def load_dataset(path: str | Path) -> Dataset:
    """Load an npz file written by `Dataset.save`; `load_log` reads other logs.

    Raises:
        FileNotFoundError: If the file does not exist.
        FileFormatError: If it is damaged, of another format, lacks an array, or its arrays are not a valid dataset.

    Example:
        >>> import tempfile
        >>> import nbs_pin as nbs
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     nbs.collect(nbs.load_robot("two_link"), "uniform", samples=50).save(f"{folder}/data.npz")
        ...     nbs.load_dataset(f"{folder}/data.npz").q.shape
        (50, 2)
    """
    data = read_npz(path, {entry.name for entry in fields(Dataset)} | {"format"})
    require(data, path, {"format": "U"})
    if str(data["format"]) != DATASET_FORMAT:
        raise FileFormatError(f"{path}: format '{data['format']}', expected '{DATASET_FORMAT}'; collect it again.")
    kinds = {**dict.fromkeys((*_STATES, "t"), "f"), "trajectory": "i", "parents": "i", "prismatic": "b"}
    require(data, path, {**kinds, "robot": "U", "about": "U"})
    arrays = {name: data[name].astype(float) if kind == "f" else data[name] for name, kind in kinds.items()}
    fault = _shape_fault(arrays)
    if fault:
        raise FileFormatError(f"{path}: {fault}.")
    try:
        about = parse_json(path, "about", str(data["about"]))
        return Dataset(**arrays, robot=str(data["robot"]), about=about)
    except ArgumentError as error:
        raise FileFormatError(f"{path}: {error}") from error


def trajectory_slices(trajectory: Int[np.ndarray, " samples"]) -> list[slice]:
    """The rows of each trajectory, in order."""
    cuts = np.flatnonzero(np.diff(trajectory)) + 1
    bounds = [0, *cuts.tolist(), len(trajectory)]
    return [slice(begin, end) for begin, end in pairwise(bounds) if end > begin]


def recordings(data: Dataset) -> list[np.ndarray]:
    """The numbers of the trajectories of each recording: those that run on where another ends are pieces of one.

    There q and v go on as within a trajectory, and the arm moves.
    """
    groups: list[list[int]] = []
    slices = trajectory_slices(data.trajectory)
    for k, rows in enumerate(slices):
        number = int(data.trajectory[rows.start])
        if k and _runs_on(data, slices[k - 1], rows):
            groups[-1].append(number)
        else:
            groups.append([number])
    return [np.array(group) for group in groups]


def _runs_on(data: Dataset, before: slice, after: slice) -> bool:
    """Whether a trajectory begins where another ends, at most a guard time later, in motion."""
    if min(rows.stop - rows.start for rows in (before, after)) < _FEW:
        return False
    last, first = before.stop - 1, after.start
    passed = float(data.t[first] - data.t[last])
    step = float(data.t[last] - data.t[last - 1])
    passed = passed if 0.0 < passed <= _GUARD else step  # where every piece has its own time
    speed, moving = np.abs(data.v[[last, first]]).max(axis=0), 0.05 * data.v.std(axis=0)
    went = passed * 0.5 * (data.v[last] + data.v[first])
    miss = np.abs(data.q[first] - data.q[last] - went)
    turned = np.abs(data.v[first] - data.v[last])
    ahead = passed * np.abs(data.a[[last, first]]).max(axis=0)
    fits = (miss <= 0.5 * passed * speed + 1e-6) & (turned <= 2.0 * ahead + moving)
    return bool((speed > 2.0 * moving).any() and fits.all())


def _clock(data: Dataset) -> np.ndarray:
    """Time since the beginning of the recording [s], where each piece may have its own."""
    steps = np.diff(data.t, prepend=data.t[:1])
    usual = float(np.median(steps[1:])) if len(steps) > 1 else 1.0
    return np.cumsum(np.where((steps > 0.0) & (steps <= _GUARD), steps, usual))


def _held_from(data: Dataset, share: float) -> int:
    """The first row of the last `share` of one recording, 0 if it is too short to be parted."""
    clock = _clock(data)
    begin = int(np.searchsorted(clock, clock[-1] - share * clock[-1]))
    before = int(np.count_nonzero(clock < clock[min(begin, len(clock) - 1)] - _GUARD))
    return begin if clock[-1] > _LONG and before >= _FEW and len(clock) - begin >= _FEW else 0


def _fault(data: Dataset) -> str:
    """What is wrong with a dataset and how to correct it, or an empty string."""
    arrays = {name: getattr(data, name) for name in (*_STATES, "t", "trajectory", "parents", "prismatic")}
    return _shape_fault(arrays) or _number_fault(arrays) or _order_fault(data) or _tree_fault(data)


def _array(name: str, value: Any, kind: type) -> np.ndarray:
    """The values as an array of that type, uncopied if it is one; nothing is rounded to a whole number or a bool."""
    numbers = floats(f"the dataset's {name}", value, truths=kind is not np.float64)
    with np.errstate(invalid="ignore"):  # NaN cast to an integer is refused below
        array: np.ndarray = np.asarray(value).astype(kind, copy=False)
    if kind is not np.float64 and not np.array_equal(array, numbers):
        expected = "whole numbers" if kind is np.int64 else "true or false for every joint"
        raise ArgumentError(f"the dataset's {name} is {told(value)}, expected {expected}; correct it.")
    return array


def _shape_fault(arrays: Mapping[str, np.ndarray]) -> str:
    shape = arrays["q"].shape
    if len(shape) != 2 or 0 in shape:
        return f"q has shape {shape}, expected (samples, joints) with at least one of each; record some"
    expected = dict.fromkeys(_STATES, shape) | dict.fromkeys(("t", "trajectory"), shape[:1])
    for name, wanted in (expected | dict.fromkeys(("parents", "prismatic"), shape[1:])).items():
        if arrays[name].shape != wanted:
            return f"{name} has shape {arrays[name].shape}, expected {wanted} beside q of shape {shape}; match them"
    return ""


def _number_fault(arrays: Mapping[str, np.ndarray]) -> str:
    for name in (*_STATES, "t"):
        if not np.isfinite(arrays[name]).all():
            at = np.argwhere(~np.isfinite(arrays[name]))[0]
            joint = f", joint {at[1] + 1}" if at.size > 1 else ""
            return f"{name} of sample {at[0] + 1}{joint} is {arrays[name][tuple(at)]}; leave that sample out"
        if not is_usual(arrays[name]):
            return f"{name} reaches {np.abs(arrays[name]).max():.3g}, expected at most {LARGEST:g}; correct its unit"
    return ""


def _order_fault(data: Dataset) -> str:
    stretches = trajectory_slices(data.trajectory)
    if len(stretches) != data.trajectories:
        return "the samples of a trajectory are interrupted by another's; sort them by trajectory"
    same = np.diff(data.trajectory) == 0
    backwards = same & ~(np.diff(data.t) > 0.0)
    if backwards.any():
        k = int(np.argmax(backwards)) + 1
        return f"time must increase along a trajectory, but sample {k + 1} is not after sample {k}; sort them"
    return ""


def _tree_fault(data: Dataset) -> str:
    wrong = ~((data.parents >= 0) & (data.parents <= np.arange(data.nv)))
    if wrong.any():
        i = int(np.argmax(wrong))
        return f"joint {i + 1} has parent {data.parents[i]}, expected 0 for the base to {i}; number parents first"
    return ""
