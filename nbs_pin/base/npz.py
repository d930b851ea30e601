"""Arrays in npz files: written atomically, read without pickle and without trusting the headers."""

import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from nbs_pin.base.exceptions import FileFormatError
from nbs_pin.base.files import whole_file

LARGEST = 2**31
"""Largest total size of the arrays in a file [bytes], 2 GiB."""
_KINDS = {"f": "real numbers", "b": "booleans", "U": "text", "i": "integers"}


def write_npz(path: str | Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write the arrays to `path` atomically: an interruption leaves either the old file or the new one."""
    with whole_file(path) as file:
        np.savez(file, allow_pickle=False, **arrays)


def read_npz(path: str | Path) -> dict[str, np.ndarray]:
    """All arrays of an npz file.

    Raises:
        FileNotFoundError: If the file does not exist.
        FileFormatError: If it is damaged, holds Python objects, or declares more than it contains or than `LARGEST`.
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
    """Raise FileFormatError, naming file and key, unless each key exists with the given numpy `dtype.kind`."""
    for key, kind in kinds.items():
        if key not in data:
            raise FileFormatError(f"{path}: no '{key}' among {', '.join(data) or 'no keys'}; write the file again.")
        if data[key].dtype.kind != kind:
            raise FileFormatError(f"{path}: '{key}' is {data[key].dtype}, expected {_KINDS[kind]}; write it again.")


def _read_entry(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> np.ndarray:
    # numpy allocates the declared size, perhaps terabytes, before it reads: compare it with the size of the entry.
    with archive.open(entry) as file:
        version = np.lib.format.read_magic(file)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read(file)
        bytes_declared = int(np.prod([float(n) for n in shape])) * dtype.itemsize
        if not dtype.hasobject and file.tell() + bytes_declared != entry.file_size:
            raise ValueError(f"'{entry.filename}' declares {bytes_declared} bytes in an entry of {entry.file_size}")
    with archive.open(entry) as file:
        return np.lib.format.read_array(file, allow_pickle=False)
