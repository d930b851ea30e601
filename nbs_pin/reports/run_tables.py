"""Runs as CSV: a row for each instant, and columns that say what they have and in which unit."""

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

from nbs_pin.base.csv_files import read_csv, write_csv
from nbs_pin.base.exceptions import ArgumentError, FileFormatError

TIME = "t [s]"
_COLUMN = re.compile(r"([a-z]+)_(.+?)(?: \[([^\]]+)\])?")


def write_table(path: Path, t: Float[np.ndarray, " rows"], columns: Mapping[str, Float[np.ndarray, " rows"]]) -> None:
    """Write times and columns, by their heads, atomically and in full precision.

    Raises:
        ArgumentError: If a head has a semicolon, which readers of CSV take for the separator, or a line break.
    """
    for head in columns:
        if set(head) & set(";\n\r"):
            raise ArgumentError(f"'{head}' would separate columns or lines of a CSV file; export to .mcap.")
    write_csv(path, [TIME, *columns], np.column_stack([t, *columns.values()]).tolist())


def read_table(path: Path) -> tuple[Float[np.ndarray, " rows"], dict[str, dict[str, tuple[str, np.ndarray]]]]:
    """The times, and unit and numbers of each column KIND_NAME [UNIT], by kind and name; raises FileFormatError.

    The unit is empty if there is none.
    """
    header, numbers = read_csv(path, [TIME])
    found: dict[str, dict[str, tuple[str, np.ndarray]]] = {}
    for head, column in zip(header, numbers.T, strict=True):
        named = _COLUMN.fullmatch(head)
        if named:
            found.setdefault(named[1], {})[named[2]] = named[3] or "", column
    if "q" not in found:
        raise FileFormatError(f"{path}: no columns q_JOINT [rad] of a run that was exported; export it again.")
    return numbers[:, header.index(TIME)], found
