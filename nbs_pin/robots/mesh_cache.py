"""Parsed meshes in the user's cache directory: reading an arm's mesh files takes longer than simulating it."""

import os
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path

import numpy as np
import platformdirs

from nbs_pin.base.exceptions import FileFormatError
from nbs_pin.base.npz import read_npz, write_npz

MAX_BYTES = 500_000_000
"""Most that is kept [byte]; what was used longest ago goes first."""


def cached(key: str, make: Callable[[], Mapping[str, np.ndarray]]) -> Mapping[str, np.ndarray]:
    """The arrays that `make()` returns, or those kept under that key, a file name that stands for all they depend on.

    A damaged file is made again, and nothing is kept where the directory cannot be written.
    """
    file = platformdirs.user_cache_path("nbs_pin") / "meshes" / f"{key}.npz"
    with suppress(OSError, FileFormatError):
        found = read_npz(file)
        os.utime(file)
        return found
    made = make()
    with suppress(OSError):
        write_npz(file, made, flushed=False)
        _prune(file.parent)
    return made


def _prune(folder: Path) -> None:
    """Remove what was used longest ago until the rest has at most `MAX_BYTES`."""
    files = {file: file.stat() for file in folder.glob("*.npz")}
    total = sum(state.st_size for state in files.values())
    for file in sorted(files, key=lambda file: files[file].st_mtime):
        if total <= MAX_BYTES:
            return
        file.unlink(missing_ok=True)
        total -= files[file].st_size
