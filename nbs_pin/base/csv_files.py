"""CSV files: reading and writing tables of numbers, and matching columns to joints."""

import csv
import io
import re
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from nbs_pin.base.exceptions import FileFormatError
from nbs_pin.base.files import write_whole
from nbs_pin.base.npz import LARGEST

QUANTITIES = ("tau", "q", "v", "a")
"""Per-joint quantities of a log, in columns named `KIND_JOINT` or `KIND1`, `KIND2`, …."""
ROS_NAMES = {"q": "position", "v": "velocity", "a": "acceleration", "tau": "effort"}
"""What ROS calls the quantities, which is understood as well."""
_SEPARATORS = {";": "semicolons", "\t": "tabs", "|": "bars"}


def read_csv(path: Path, wanted: Sequence[str] = ("t",)) -> tuple[list[str], Float[np.ndarray, "rows columns"]]:
    """The header and the numbers of a CSV file with the columns in `wanted`.

    Raises:
        FileFormatError: If the file is not such a table; names the column and the row, counted from 1.
    """
    if path.stat().st_size > LARGEST // 8:
        raise FileFormatError(f"{path}: more than {LARGEST // 8} bytes, too large for a CSV; store it as npz.")
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            lines = [line for line in csv.reader(file, strict=True) if line]
    except (UnicodeDecodeError, csv.Error) as error:
        raise FileFormatError(f"{path}: not a UTF-8 CSV file ({error}); export it again.") from error
    header = [name.strip() for name in lines[0]] if lines else []
    header = header[:-1] if header[-1:] == [""] else header  # of a comma at the end of the line
    if not set(wanted) <= set(header) or len(set(header)) != len(header):
        raise FileFormatError(f"{path}: {_header_fault(header, wanted)}.")
    if len(lines) < 2:
        raise FileFormatError(f"{path}: no rows of numbers below the header, expected at least 4; record more.")
    table = np.empty((len(lines) - 1, len(header)))
    for row, cells in enumerate(lines[1:]):
        table[row] = _numbers(path, row + 1, cells, header)
    return header, table


def write_csv(path: Path, head: Sequence[str], rows: Sequence[Sequence[Any]]) -> Path:
    """Write a table to a file atomically, with numbers in full precision."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([head, *rows])
    return write_whole(path, text.getvalue().encode())


def joint_columns(header: Sequence[str], kind: str) -> dict[str, int]:
    """Column indices of a quantity by joint name or number: `q_elbow` or `q2` for the kind `q`.

    The names of ROS (`position_elbow`) are understood where there are no others.
    """
    for word in (kind, ROS_NAMES[kind]):
        found = ((re.fullmatch(rf"{word}(?:_(.+)|(\d+))", name), k) for k, name in enumerate(header))
        columns = {match[1] or match[2]: k for match, k in found if match}
        if columns:
            return columns
    return {}


def joint_order(path: Path, found: Sequence[str], joint_names: Sequence[str] | None) -> list[int]:
    """The index in `found` of each joint in `joint_names` (None: the joints of the file in its order).

    Joints that are named 1 to n in the file are taken in the order of their numbers. Further joints of the file, such
    as those of a gripper, are left out, with a warning.

    Raises:
        FileFormatError: If the file lacks a joint, or has other joints than the numbers 1 to n.
    """
    names = list(found if joint_names is None else joint_names)
    numbers = [str(i + 1) for i in range(len(names))]
    if sorted(found) == sorted(numbers):
        return [found.index(number) for number in numbers]
    unknown, absent = ([x for x in some if x not in others] for some, others in ((found, names), (names, found)))
    if absent:
        more = f"; no joint is named {', '.join(unknown)}" if unknown else ""
        remedy = "rename the columns or number them" if unknown else f"add those of {', '.join(absent)}"
        if set(numbers) < set(found):
            more, remedy = "", f"leave out the columns of other joints and number these 1 to {len(names)}"
        raise FileFormatError(
            f"{path}: {len(found)} joints ({', '.join(found)}), expected {len(names)} ({', '.join(names)}){more}; "
            f"{remedy}."
        )
    if unknown:
        warnings.warn(f"{path}: no joint of the arm is named {', '.join(unknown)}; left out.", stacklevel=4)
    return [found.index(name) for name in names]


def _header_fault(header: list[str], wanted: Sequence[str]) -> str:
    """What is wrong with the names of the columns and what to do."""
    other = [
        name
        for mark, name in _SEPARATORS.items()
        if not set(wanted) <= set(header) and any(mark in cell for cell in header)
    ]
    if other:
        return f"the columns are separated by {other[0]}, expected commas, and points in numbers; export it like that"
    needed = ", ".join(f"'{name}'" for name in wanted)
    return f"the header is '{', '.join(header)}', expected {needed} and each name once; add or rename"


def _numbers(path: Path, row: int, cells: list[str], header: list[str]) -> list[float]:
    if len(cells) == len(header) + 1 and not cells[-1].strip():
        cells = cells[:-1]  # a comma at the end of the line
    if len(cells) != len(header):
        raise FileFormatError(f"{path}: row {row} has {len(cells)} values, expected {len(header)}; complete it.")
    numbers = []
    for name, cell in zip(header, cells, strict=True):
        try:
            # float() also accepts '1_0' and non-ASCII digits, which no instrument writes.
            numbers.append(float(cell if cell.isascii() and "_" not in cell else ""))
        except ValueError as error:
            raise FileFormatError(f"{path}: row {row}, column {name}: '{cell}' is not a number; correct it.") from error
    return numbers
