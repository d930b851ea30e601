"""Paths of a tool from CSV and NPZ files: x, y, z [m], and, if known, t [s] and the quaternion qx, qy, qz, qw."""

from pathlib import Path

import numpy as np

from nbs_pin.base.arguments import checked, maybe, readable, text
from nbs_pin.base.csv_files import read_csv
from nbs_pin.base.exceptions import ArgumentError, FileFormatError
from nbs_pin.base.npz import read_npz, require
from nbs_pin.motions.recordings import from_first_row, seconds_in
from nbs_pin.motions.tool_paths import ToolPath

POSITION, QUATERNION = ("x", "y", "z"), ("qx", "qy", "qz", "qw")
_NAMES = ("t", *POSITION, *QUATERNION)
MOST_ROWS = 100_000


def is_tool_file(path: Path) -> bool:
    """Whether the file states positions of a tool, in columns x, y and z; False if it cannot be read."""
    if path.suffix.lower() == ".npz":
        return set(POSITION) <= set(read_npz(path, POSITION))
    with path.open(newline="", encoding="utf-8-sig", errors="replace") as file:
        line = file.readline(100_000)
    return set(POSITION) <= {name.strip().strip('"') for name in line.split(",")}


@checked(path=readable, time_unit=maybe(text))
def load_tool_path(path: str | Path, *, time_unit: str | None = None) -> ToolPath:
    r"""A path through the rows of a file: columns x, y, z [m], optional t [s] and optional qx, qy, qz, qw.

    A file with t gives the path its times; one without leaves them open. The quaternion is that of the frame in the
    base frame, scalar last, normalised. Other columns are ignored. `time_unit` is that of t: "s", "ms", "us" or "ns".

    Raises:
        FileFormatError: If the file is not such a table.
        ArgumentError: If points coincide, times do not increase or a quaternion is not of length 1.

    Example:
        >>> import tempfile
        >>> from pathlib import Path
        >>> import nbs_pin as nbs
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     file = Path(folder) / "path.csv"
        ...     _ = file.write_text("x,y,z\n0.4,0,0.3\n0.5,0,0.3\n0.5,0.1,0.3\n")
        ...     print(nbs.load_tool_path(file).curve(1.0))
        [0.5 0.1 0.3]
    """
    file = Path(path)
    columns = _npz_columns(file) if file.suffix.lower() == ".npz" else _csv_columns(file)
    rows = len(columns["x"])
    if rows > MOST_ROWS:
        raise FileFormatError(f"{path}: {rows} rows, at most {MOST_ROWS} are read; thin it out.")
    for name, column in columns.items():
        if column.shape != (rows,) or not np.isfinite(column).all():
            raise FileFormatError(f"{path}: '{name}' is not one finite number for each of {rows} rows; correct it.")
    absent = [name for name in QUATERNION if name not in columns]
    if absent and len(absent) < len(QUATERNION):
        raise FileFormatError(f"{path}: a quaternion without {', '.join(absent)}; give all of {', '.join(QUATERNION)}.")
    turned = None if absent else np.stack([columns[name] for name in QUATERNION], axis=-1)
    times = from_first_row(columns["t"]) * seconds_in(time_unit) if "t" in columns else None
    try:
        return ToolPath.through(np.stack([columns[name] for name in POSITION], axis=-1), turned, times)
    except ArgumentError as error:
        raise FileFormatError(f"{path}: {error}") from error


def _csv_columns(path: Path) -> dict[str, np.ndarray]:
    header, table = read_csv(path, POSITION)
    return {name: table[:, k] for k, name in enumerate(header) if name in _NAMES}


def _npz_columns(path: Path) -> dict[str, np.ndarray]:
    data = read_npz(path, _NAMES)
    require(data, path, dict.fromkeys(POSITION, "f") | {name: "f" for name in _NAMES if name in data})
    return data
