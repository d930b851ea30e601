"""CSV files: reading and writing tables of numbers, and matching columns to joints."""

import csv
import gzip
import io
import re
import warnings
import zlib
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
_WORDS = {
    "q": ("q", "position", "pos", "angle"),
    "v": ("v", "velocity", "vel", "qd", "dq", "speed"),
    "a": ("a", "acceleration", "acc", "qdd", "ddq"),
    "tau": ("tau", "effort", "torque", "trq"),
}
"""What the quantities are called in the columns of logs, by rank."""
_TIMES = ("t", "time", "stamp", "timestamp", "__time", "elapsed", "header.stamp", "field.header.stamp")
_SEPARATORS = (";", ",", "\t", "|")


def read_cells(path: Path) -> list[list[str]]:
    """The cells of a table in a text file, *.csv or *.csv.gz, by rows; empty lines are left out.

    Columns are separated by semicolons, commas, tabs, bars or blanks, as the first line shows.

    Raises:
        FileFormatError: If it is too large or no text.
    """
    too_large = FileFormatError(f"{path}: more than {LARGEST // 8} bytes, too large for a CSV; store it as npz.")
    if path.stat().st_size > LARGEST // 8:
        raise too_large
    try:
        data = path.read_bytes()
        if path.suffix.lower() == ".gz":
            with gzip.open(io.BytesIO(data)) as packed:
                data = packed.read(LARGEST // 8 + 1)
            if len(data) > LARGEST // 8:
                raise too_large
        text = _without_remarks(data.decode("utf-8-sig"))
        first = text.partition("\n")[0]
        mark = _separator(first)
        if not mark and len(first.split()) > 1:
            return [line.split() for line in text.splitlines() if line.strip()]
        lines = [line for line in csv.reader(io.StringIO(text, newline=""), strict=True, delimiter=mark or ",") if line]
    except (UnicodeDecodeError, csv.Error, EOFError, OSError, zlib.error) as error:
        if isinstance(error, OSError) and not isinstance(error, gzip.BadGzipFile):
            raise
        raise FileFormatError(f"{path}: not a UTF-8 CSV file ({error}); export it again.") from error
    # where semicolons separate numbers, a comma is the decimal point of another language
    return [[cell.replace(",", ".") for cell in line] for line in lines] if mark == ";" else lines


def _separator(first: str) -> str:
    """What separates the columns: of numbers with decimal commas the semicolon, else the most frequent mark."""
    if ";" in first and all(_is_number(cell.replace(",", ".")) for cell in first.split(";") if cell.strip()):
        return ";"
    mark = max(_SEPARATORS, key=first.count)
    return mark if mark in first else ""


def header_of(cells: Sequence[str]) -> list[str]:
    """The names of the columns in the first line; empty if it has numbers, as the table then has no header."""
    if cells and all(_is_number(cell) for cell in cells if cell.strip()):
        return []
    header = [name.strip() for name in cells]
    return header[:-1] if header[-1:] == [""] else header  # of a comma at the end of the line


def read_csv(path: Path, wanted: Sequence[str] = ("t",)) -> tuple[list[str], Float[np.ndarray, "rows columns"]]:
    """The header and the numbers of a CSV file with the columns in `wanted`.

    Raises:
        FileFormatError: If the file is not such a table; names the column and the row, counted from 1.
    """
    lines = read_cells(path)
    header = header_of(lines[0]) if lines else []
    if not set(wanted) <= set(header) or len(set(header)) != len(header):
        needed = ", ".join(f"'{name}'" for name in wanted)
        said = ", ".join(header if header or not lines else lines[0])
        raise FileFormatError(
            f"{path}: the header is '{said:.300}', expected {needed} and each name once; add or rename."
        )
    return header, numbers_in(path, header, lines[1:], range(len(header)))


def numbers_in(
    path: Path, header: Sequence[str], lines: Sequence[list[str]], columns: Sequence[int], blanks: bool = False
) -> Float[np.ndarray, "rows columns"]:
    """The numbers in some columns of a table below its header; raises FileFormatError as `read_csv` does.

    With `blanks`, empty cells are NaN.
    """
    if not lines:
        raise FileFormatError(f"{path}: no rows of numbers below the header, expected at least 4; record more.")
    table = np.empty((len(lines), len(columns)))
    for row, cells in enumerate(lines):
        table[row] = _numbers(path, row + 1, cells, header, columns, blanks)
    return table


def write_csv(path: Path, head: Sequence[str], rows: Sequence[Sequence[Any]]) -> Path:
    """Write a table to a file atomically, with numbers in full precision."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([head, *rows])
    return write_whole(path, text.getvalue().encode())


def joint_columns(header: Sequence[str], kind: str) -> dict[str, int]:
    """Column indices of a quantity by joint name or number: `q_elbow` or `q2` for the kind `q`.

    Where there are none, the names of ROS and of other programs are understood: position_elbow, elbow_position,
    /joint_states/elbow/position, position[0], field.position0, actual_q_0. Joints numbered from 0 are numbered from 1.
    """
    names = [re.sub(r"\s*[\[(][^\d\])]*[\])]$", "", name) for name in header]  # q1 [rad]
    for word in _WORDS[kind]:
        forms = (
            rf"{word}(?:_(.+)|(\d+))",
            rf"(?:.*[._/])?{word}[._]?\[?(\d+)\]?",
            rf"(?:.*/)?(.+?)[._/]{word}",
            rf".*[._/]{word}_(.+)",
        )
        for form in forms:
            found = [(re.fullmatch(form, name, re.IGNORECASE), k) for k, name in enumerate(names)]
            named = [(next(part for part in match.groups() if part), k) for match, k in found if match]
            columns = dict(named)
            if columns and len(columns) == len(named):
                return from_one(columns)
    return {}


def time_column(header: Sequence[str]) -> int | None:
    """The column of time, called t or as in other programs."""
    names = [re.sub(r"\s*[\[(].*[\])]$", "", name).lower() for name in header]
    return next((names.index(name) for name in _TIMES if name in names), None)


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


def _without_remarks(text: str) -> str:
    """The text from its header on, which may be the last line of remarks before numbers, without its mark."""
    first, _, rest = text.partition("\n")
    while first[:1] in ("#", "%") and rest and header_of(re.split(r"[,;|\s]+", rest.partition("\n")[0])):
        text = rest
        first, _, rest = text.partition("\n")
    return re.sub(r"\A[#%]\s*", "", text)


def from_one(columns: dict[str, int]) -> dict[str, int]:
    """Joints that are numbered from 0, numbered from 1."""
    if sorted(columns) != sorted(str(k) for k in range(len(columns))):
        return columns
    return {str(int(name) + 1): k for name, k in columns.items()}


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _numbers(
    path: Path, row: int, cells: list[str], header: Sequence[str], columns: Sequence[int], blanks: bool
) -> list[float]:
    if len(cells) == len(header) + 1 and not cells[-1].strip():
        cells = cells[:-1]  # a comma at the end of the line
    if len(cells) != len(header):
        raise FileFormatError(f"{path}: row {row} has {len(cells)} values, expected {len(header)}; complete it.")
    numbers = []
    for k in columns:
        cell = "nan" if blanks and not cells[k].strip() else cells[k]
        try:
            # float() also accepts '1_0' and non-ASCII digits, which no instrument writes.
            numbers.append(float(cell if cell.isascii() and "_" not in cell else ""))
        except ValueError as error:
            raise FileFormatError(
                f"{path}: row {row}, column {header[k]}: '{cell}' is not a number; correct it."
            ) from error
    return numbers
