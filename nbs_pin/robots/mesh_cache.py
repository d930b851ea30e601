"""Parsed meshes in the user's cache directory: reading an arm's mesh files takes longer than simulating it."""

import os
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

import numpy as np
import platformdirs

from nbs_pin.base.exceptions import FileFormatError
from nbs_pin.base.npz import read_npz, write_npz

MAX_BYTES = 500_000_000
"""Most that is kept [byte]; what was used longest ago goes first."""
Parsed = TypeVar("Parsed")
Arrays = Mapping[str, np.ndarray]


def cached(
    key: str, make: Callable[[], Parsed], pack: Callable[[Parsed], Arrays], unpack: Callable[[Arrays], Parsed]
) -> Parsed:
    """What `make()` returns, or what `unpack` makes of the arrays that were kept of it.

    A file that is damaged is made again, and nothing is kept where the directory cannot be written.

    Args:
        key: A hash of everything that the result depends on.
        make: Makes it.
        pack: Its arrays.
        unpack: The inverse; raises KeyError or ValueError for arrays of anything else.
    """
    try:
        file = platformdirs.user_cache_path("nbs_pin") / "meshes" / f"{key}.npz"
    except RuntimeError:  # a user without a home directory
        return make()
    with suppress(OSError, FileFormatError, KeyError, ValueError):
        found = unpack(read_npz(file))
        with suppress(OSError):  # somebody else's
            os.utime(file)
        return found
    made = make()
    with suppress(OSError):
        write_npz(file, pack(made), flushed=False)
        _prune(file.parent)
    return made


def _prune(folder: Path) -> None:
    """Remove what was used longest ago, drafts of killed processes too, until the rest has at most `MAX_BYTES`."""
    files = {file: file.stat() for file in folder.iterdir()}
    total = sum(state.st_size for state in files.values())
    for file in sorted(files, key=lambda file: files[file].st_mtime):
        if total <= MAX_BYTES:
            return
        file.unlink(missing_ok=True)
        total -= files[file].st_size
