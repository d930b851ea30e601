"""Arrays in npz files: written whole or not at all, read without pickle and without believing the headers."""

import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from nbs_pin.base.exceptions import FileFormatError
from nbs_pin.base.files import whole_file

LARGEST = 2**31
"""Most bytes of arrays that a file may hold, 2 GiB."""
_KINDS = {"f": "real numbers", "b": "booleans", "U": "text", "i": "integers"}


def write_npz(path: str | Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write the arrays to `path`; whatever interrupts it, the name holds the old file or the new one, never half."""
    with whole_file(path) as file:
        np.savez(file, allow_pickle=False, **arrays)


def read_npz(path: str | Path) -> dict[str, np.ndarray]:
    """All arrays of an npz file.

    Raises FileNotFoundError for no file and FileFormatError for one that is damaged, holds Python objects, or
    declares more than it has or than `LARGEST`.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
            if size > LARGEST:
                raise FileFormatError(f"{path}: declares {size} bytes, at most {LARGEST} are read; split the file.")
            return {entry.filename.removesuffix(".npy"): _read_entry(archive, entry) for entry in archive.infolist()}
    except (zipfile.BadZipFile, zlib.error, ValueError, EOFError, NotImplementedError, RuntimeError) as error:
        if isinstance(error, FileFormatError):
            raise
        raise FileFormatError(f"{path}: not an intact npz file ({error}); write it again.") from error


def require(data: Mapping[str, np.ndarray], path: str | Path, kinds: Mapping[str, str]) -> None:
    """Check that each key exists with numpy's kind letter; raises FileFormatError naming file, key and remedy."""
    for key, kind in kinds.items():
        if key not in data:
            raise FileFormatError(f"{path}: no '{key}' among {', '.join(data) or 'no keys'}; write the file again.")
        if data[key].dtype.kind != kind:
            raise FileFormatError(f"{path}: '{key}' is {data[key].dtype}, expected {_KINDS[kind]}; write it again.")


def _read_entry(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> np.ndarray:
    # A header may claim terabytes, which numpy would allocate before it reads them: compare with the entry's size.
    with archive.open(entry) as file:
        version = np.lib.format.read_magic(file)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read(file)
        bytes_declared = int(np.prod([float(n) for n in shape])) * dtype.itemsize
        if not dtype.hasobject and file.tell() + bytes_declared != entry.file_size:
            raise ValueError(f"'{entry.filename}' declares {bytes_declared} bytes in an entry of {entry.file_size}")
    with archive.open(entry) as file:
        return np.lib.format.read_array(file, allow_pickle=False)
