"""CSV files: reading and writing tables of numbers, and matching columns to joints."""

import csv
import io
import re
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


def read_csv(path: Path) -> tuple[list[str], Float[np.ndarray, "rows columns"]]:
    """The header and the numbers of a CSV file with a column `t`.

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
    if "t" not in header or len(set(header)) != len(header):
        raise FileFormatError(
            f"{path}: the header is '{', '.join(header)}', expected 't' and each name once; add or rename."
        )
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
    """Column indices of a quantity by joint name or number: `q_elbow` or `q2` for the kind `q`."""
    found = ((re.fullmatch(rf"{kind}(?:_(.+)|(\d+))", name), k) for k, name in enumerate(header))
    return {match[1] or match[2]: k for match, k in found if match}


def joint_order(path: Path, found: Sequence[str], joint_names: Sequence[str] | None) -> list[int]:
    """The index in `found` of each joint in `joint_names` (None: the joints of the file in its order).

    Joints that are named 1 to n in the file are taken in the order of their numbers.

    Raises:
        FileFormatError: If the two do not name the same joints.
    """
    names = list(found if joint_names is None else joint_names)
    numbers = [str(i + 1) for i in range(len(names))]
    if sorted(found) == sorted(numbers):
        return [found.index(number) for number in numbers]
    if sorted(found) != sorted(names):
        unknown = [name for name in found if name not in names]
        more = f"; no joint is named {', '.join(unknown)}" if unknown else ""
        raise FileFormatError(
            f"{path}: {len(found)} joints ({', '.join(found)}), expected {len(names)} ({', '.join(names)}){more}; "
            "rename the columns or number them."
        )
    return [found.index(name) for name in names]


def _numbers(path: Path, row: int, cells: list[str], header: list[str]) -> list[float]:
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
