"""The columns of a log in a file, in the joint order of an arm: tables, arrays, and messages of ROS."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from nbs_pin.base.csv_files import (
    QUANTITIES,
    ROS_NAMES,
    from_one,
    header_of,
    joint_columns,
    joint_order,
    numbers_in,
    read_cells,
    time_column,
)
from nbs_pin.base.doors import BLANK, option
from nbs_pin.base.exceptions import ArgumentError, FileFormatError
from nbs_pin.base.npz import LARGEST

_NEEDED = "log t, q and tau (and v and a if known)"
CHOSEN = ("t", "trajectory", *QUANTITIES, "topic")
"""What columns can be named for."""
NOT_READ = "-"
"""What stands for no column."""
_KINDS = {".csv", ".txt", ".dat", ".tsv"}
"""Ends of the names of tables in text."""


class Columns(NamedTuple):
    """The columns of a log, None where not logged; angles in the unit of the log."""

    t: Float[np.ndarray, " rows"]
    q: Float[np.ndarray, "rows n"]
    tau: Float[np.ndarray, "rows n"]
    v: Float[np.ndarray, "rows n"] | None
    a: Float[np.ndarray, "rows n"] | None
    trajectory: Int[np.ndarray, " rows"]
    """Number of the trajectory; 0 if the log has no numbers."""

    def take(self, rows: Any) -> "Columns":
        """The rows selected by the numpy index."""
        taken: Any = [None if x is None else x[rows] for x in self]
        return Columns(*taken)


class Table(NamedTuple):
    """A table of text or of numbers; without a header, columns are called by their numbers, from 1."""

    header: list[str]
    cells: list[list[str]]
    """Rows of text, empty if it has `numbers`."""
    numbers: np.ndarray | None = None
    named: bool = True
    """Whether it has a header."""

    def of(self, path: Path, columns: Sequence[int]) -> Float[np.ndarray, "rows columns"]:
        """The numbers in some columns."""
        if self.numbers is not None:
            return np.asarray(self.numbers[:, list(columns)], dtype=float)
        return numbers_in(path, self.header, self.cells, columns, blanks=True)


def is_table(path: Path) -> bool:
    """Whether the file is a table of text."""
    name = path.with_suffix("") if path.suffix.lower() == ".gz" else path
    return name.suffix.lower() in _KINDS


def columns_of_table(
    path: Path, joint_names: Sequence[str] | None, chosen: Mapping[str, str], rate: float | None
) -> tuple[Columns, tuple[str, ...]]:
    """The columns of a text file (see `load_log`), joints in the order of `joint_names`, and a note on the others."""
    table = _table(path)
    if not table.named and not chosen:
        raise FileFormatError(
            f"{path}: the first line has {len(table.header)} numbers in place of a header; give "
            f"{option('columns', {'t': '1', 'q': '2-7', 'tau': '8-13'})}, with the numbers of its columns."
        )
    return _of_table(path, table, joint_names, chosen, rate)


def _table(path: Path) -> Table:
    """The table in a text file."""
    lines = read_cells(path)
    if not lines:
        raise FileFormatError(f"{path}: no lines, expected a header and rows of numbers; record more.")
    header = header_of(lines[0])
    if not header:
        return Table([str(k + 1) for k in range(len(lines[0]))], lines, named=False)
    if len(set(header)) != len(header):
        twice = next(name for name in header if header.count(name) > 1)
        raise FileFormatError(f"{path}: the header has '{twice}' twice, expected each name once; rename one.")
    return Table(header, lines[1:])


def columns_of_files(
    files: Sequence[Path], joint_names: Sequence[str] | None, chosen: Mapping[str, str], rate: float | None
) -> Columns:
    """The columns of signals in text files of their own, chosen as FILE:COLUMNS, or FILE for all of its columns.

    A file with one number a line has those of a row in as many lines.
    """
    known, arrays = {file.name: file for file in files}, {}
    for kind, spec in chosen.items():
        name, _, part = spec.partition(":")
        if name not in known:
            raise ArgumentError(f"columns has {kind}={spec}, and the files are {', '.join(known)}; give one of these.")
        table = _table(known[name])
        picked = (
            _picked(known[name], table.header, kind, {kind: part})
            if part
            else {name: k for k, name in enumerate(table.header)}
        )
        arrays[kind] = table.of(known[name], list(picked.values()))
    for kind in ("t", "trajectory"):
        if kind in arrays:
            arrays[kind] = arrays[kind].ravel()
    absent = [kind for kind in ("t", "q", "tau") if kind not in arrays and (kind != "t" or rate is None)]
    if absent:
        raise ArgumentError(f"columns names no {absent[0]}; {_NEEDED}, each as FILE:COLUMNS.")
    rows = len(arrays["t"]) if "t" in arrays else min(len(arrays[kind]) for kind in arrays)
    for kind, x in arrays.items():
        if kind in QUANTITIES and x.shape[1] == 1 and len(x) > rows and len(x) % rows == 0:
            arrays[kind] = x.reshape(rows, -1)
        elif len(x) != rows:
            raise FileFormatError(f"{chosen[kind]}: {len(x)} rows, expected {rows} as in the others; match them.")
    found = [str(k + 1) for k in range(arrays["q"].shape[1])]
    wrong = [kind for kind in QUANTITIES if kind in arrays and arrays[kind].shape[1] != len(found)]
    if wrong:
        raise FileFormatError(
            f"{chosen[wrong[0]]}: {arrays[wrong[0]].shape[1]} columns of {wrong[0]}, and {len(found)} of q; match them."
        )
    return _columns(files[0], arrays, found, joint_names, rate)


def _of_table(
    path: Path, table: Table, joint_names: Sequence[str] | None, chosen: Mapping[str, str], rate: float | None
) -> tuple[Columns, tuple[str, ...]]:
    header = table.header
    columns = {kind: _picked(path, header, kind, chosen) for kind in QUANTITIES}
    found = list(columns["q"])
    joints = [found[i] for i in joint_order(path, found, joint_names)] if found else ["1"]
    needed = [kind for kind in QUANTITIES if columns[kind] or kind in ("q", "tau")]
    for kind in needed:  # numbered in one quantity and named in another
        if len(columns[kind]) == len(found) and not set(columns[kind]) & set(found):
            columns[kind] = dict(zip(found, columns[kind].values(), strict=True))
    absent = [f"{kind}_{joint}" for kind in needed for joint in joints if joint not in columns[kind]]
    if absent:
        raise FileFormatError(
            f"{path}: no column '{absent[0]}' among {', '.join(header)}; {_NEEDED}, for each joint, or name them with "
            f"{option('columns', {absent[0].partition('_')[0]: 'NAME_*'})}."
        )
    used = {kind: [columns[kind][joint] for joint in joints] for kind in needed}
    time = next(iter(_picked(path, header, "t", chosen).values()), None) if "t" in chosen else time_column(header)
    if time is None and rate is None:
        raise FileFormatError(
            f"{path}: no column 't' of times among {', '.join(header)}, expected one; name it with "
            f"{option('columns', {'t': 'NAME'})}, or give {option('rate', BLANK)} in Hz if rows are evenly spaced, or "
            "0 if they are single states."
        )
    numbers = next(iter(_picked(path, header, "trajectory", chosen).values()), None)
    places = used | {name: [k] for name, k in (("t", time), ("trajectory", numbers)) if k is not None}
    arrays = {name: table.of(path, at) for name, at in places.items()}
    arrays |= {name: arrays[name][:, 0] for name in ("t", "trajectory") if name in arrays}
    taken = {k for at in places.values() for k in at} | {k for named in columns.values() for k in named.values()}
    others = [name for k, name in enumerate(header) if k not in taken]
    note = [f"columns that are not read: {', '.join(others):.300}"] if others and table.numbers is None else []
    return _columns(path, arrays, joints, None, rate), tuple(note)


def _picked(path: Path, header: list[str], kind: str, chosen: Mapping[str, str]) -> dict[str, int]:
    """The columns of a quantity by the names of the joints: those chosen, or those called as usual."""
    if chosen.get(kind) == NOT_READ:
        return {}
    if kind not in chosen:
        return (
            joint_columns(header, kind) if kind in QUANTITIES else {kind: header.index(kind)} if kind in header else {}
        )
    found: dict[str, int] = {}
    for part in [chosen[kind]] if chosen[kind] in header else chosen[kind].split("+"):
        span = re.fullmatch(r"(\d+)(?:-(\d+))?", part)
        if part in header:
            found[str(len(found) + 1)] = header.index(part)
        elif span:
            first, last = int(span[1]), int(span[2] or span[1])
            if not 1 <= first <= last <= len(header):
                raise ArgumentError(
                    f"columns has {kind}={part}, and {path} {len(header)} columns; give numbers up to that."
                )
            found |= {str(len(found) + 1 + k): first - 1 + k for k in range(last - first + 1)}
        else:
            form = re.escape(part).replace(r"\*", "(.*)")
            matches = ((re.fullmatch(form, name), k) for k, name in enumerate(header))
            named = {(match[1] if "*" in part else str(len(found) + 1)): k for match, k in matches if match}
            if not named:
                raise ArgumentError(f"columns has {kind}={part}, and {path} {', '.join(header)}; correct the name.")
            found |= from_one(named)
    return found


def columns_of_arrays(
    path: Path,
    stored: Mapping[str, np.ndarray],
    joint_names: Sequence[str] | None,
    chosen: Mapping[str, str],
    rate: float | None,
) -> tuple[Columns, tuple[str, ...]]:
    """The columns of named arrays (see `load_log`), joints in the order of `joint_names`; None keeps the file's.

    An array may be transposed, or have another name, given in `chosen`. A single matrix is a table without a header.
    """
    matrices = [x for x in stored.values() if x.ndim == 2 and min(x.shape) > 1 and x.dtype.kind in "fiu"]
    if len(matrices) == 1 and len([x for x in stored.values() if x.size > 1]) == 1:
        matrix = matrices[0] if matrices[0].shape[0] >= matrices[0].shape[1] else matrices[0].T
        if not chosen:
            raise FileFormatError(
                f"{path}: one matrix of {matrix.shape[1]} columns; give "
                f"{option('columns', {'t': '1', 'q': '2-7', 'tau': '8-13'})}, with the numbers of its columns."
            )
        table = Table([str(k + 1) for k in range(matrix.shape[1])], [], matrix)
        return _of_table(path, table, joint_names, chosen, rate)
    for kind, name in chosen.items():
        if name not in stored and name != NOT_READ:
            raise ArgumentError(f"columns has {kind}={name}, and {path} {', '.join(stored)}; correct the name.")
    arrays = {kind: stored[ROS_NAMES[kind]] for kind in QUANTITIES if ROS_NAMES[kind] in stored}
    arrays |= {name: stored[name] for name in CHOSEN if name in stored}
    arrays |= {kind: stored[name] for kind, name in chosen.items() if name != NOT_READ}
    arrays = {kind: x for kind, x in arrays.items() if chosen.get(kind) != NOT_READ}
    if "t" not in arrays and "time" in stored:
        arrays["t"] = stored["time"]
    absent = [name for name in ("t", "q", "tau") if name not in arrays and (name != "t" or rate is None)]
    if absent:
        raise FileFormatError(
            f"{path}: no '{absent[0]}' among {', '.join(stored) or 'no keys'}; {_NEEDED}, or name them with "
            f"{option('columns', {absent[0]: 'NAME'})}."
        )
    arrays = _upright(arrays)
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
    return _columns(path, arrays, found, joint_names, rate), ()


def _upright(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Arrays with one row per time: times of shape (rows, 1) flat, matrices of shape (joints, rows) turned."""
    flat = {name: x.ravel() if name in ("t", "trajectory") and x.size == max(x.shape, default=0) else x for name, x in
            arrays.items()}  # fmt: skip
    rows = flat["t"].size if "t" in flat else 0
    return {
        name: x.T if name in QUANTITIES and x.ndim == 2 and x.shape[0] != rows == x.shape[1] else x
        for name, x in flat.items()
    }


def arrays_of_matlab(path: Path) -> dict[str, np.ndarray]:
    """The numbers in a .mat file, those within structures by their own names.

    Raises:
        FileFormatError: If it is damaged, too large, or of version 7.3, which is HDF5.
    """
    from scipy.io import loadmat

    if path.stat().st_size > LARGEST // 8:
        raise FileFormatError(f"{path}: more than {LARGEST // 8} bytes; store it as npz.")
    try:
        stored = loadmat(path, squeeze_me=False, struct_as_record=False)
    except NotImplementedError as error:
        raise FileFormatError(f"{path}: a MATLAB file of version 7.3; save it with save(…, '-v7').") from error
    except Exception as error:  # damaged files raise many kinds of errors
        raise FileFormatError(f"{path}: not an intact .mat file ({error!s:.200}); save it again.") from error
    found: dict[str, np.ndarray] = {}
    waiting = [(name, x) for name, x in stored.items() if not name.startswith("__")]
    while waiting:
        name, x = waiting.pop()
        if isinstance(x, np.ndarray) and x.dtype == object and x.size == 1:
            waiting.append((name, x.item()))
        elif hasattr(x, "_fieldnames"):
            waiting += [(field, getattr(x, field)) for field in x._fieldnames]
        elif isinstance(x, np.ndarray) and x.dtype.kind in "fiu" and x.size:
            found[name] = x
    return found


def _columns(
    path: Path, arrays: dict[str, np.ndarray], found: list[str], joint_names: Sequence[str] | None, rate: float | None
) -> Columns:
    """The columns with joints in the requested order and trajectories numbered."""
    order, rows = joint_order(path, found, joint_names), len(arrays["q"])
    single = rate == 0.0
    if single and not {"v", "a"} <= arrays.keys():
        raise FileFormatError(f"{path}: rows without times need v and a, which cannot be found from q; log them.")
    numbers = np.arange(rows) if single else arrays.get("trajectory", np.zeros(rows))
    if not np.array_equal(numbers, np.round(numbers)):
        raise FileFormatError(f"{path}: 'trajectory' must hold a whole number in every row; number them 0, 1, 2, ….")
    given = {kind: arrays[kind].astype(float)[:, order] for kind in QUANTITIES if kind in arrays}
    return Columns(
        t=arrays["t"].astype(float) if rate is None else np.arange(rows) / (rate or np.inf),
        q=given["q"],
        tau=given["tau"],
        v=given.get("v"),
        a=given.get("a"),
        trajectory=numbers.astype(np.int64),
    )
