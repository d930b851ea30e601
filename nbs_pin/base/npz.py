"""Arrays in npz files: written atomically, read without pickle and without trusting the headers."""

import zipfile
from collections.abc import Collection, Mapping
from pathlib import Path

import numpy as np

from nbs_pin.base.exceptions import FileFormatError
from nbs_pin.base.files import whole_file

LARGEST = 2**31
"""Largest total size of the arrays in a file [bytes], 2 GiB."""
MOST_ENTRIES = 10_000
"""Most entries of a file that is read."""
MOST_UNPACKED = 100
"""Most bytes that a byte may be unpacked to, in a file that unpacks to more than `HARMLESS`."""
HARMLESS = 2**26
"""Total size that is unpacked whatever it is packed into [bytes], 64 MiB."""
_KINDS = {"f": "real numbers", "b": "booleans", "U": "text", "i": "integers"}


def write_npz(path: str | Path, arrays: Mapping[str, np.ndarray], *, flushed: bool = True) -> None:
    """Write the arrays atomically, as `whole_file` does: an interruption leaves either the old file or the new one."""
    with whole_file(path, flushed=flushed) as file:
        np.savez(file, allow_pickle=False, **arrays)


def read_npz(path: str | Path, keys: Collection[str] | None = None) -> dict[str, np.ndarray]:
    """The arrays of an npz file, all or only those of the names in `keys`; others are then not even unpacked.

    Raises:
        FileNotFoundError: If the file does not exist.
        FileFormatError: If it is damaged, holds Python objects, or declares more than it contains or may hold.
    """
    with Path(path).open("rb") as file:
        try:
            with zipfile.ZipFile(file) as archive:
                entries = _entries(path, archive, keys)
                return {name: _read_entry(archive, entry) for name, entry in entries.items()}
        except FileFormatError:
            raise
        except Exception as error:  # zip files and array headers can be damaged in many ways: even as OSError
            fault = f"{type(error).__name__}: {error!s:.300}"
            raise FileFormatError(f"{path}: not an intact npz file ({fault}); write it again.") from error


def _entries(path: str | Path, archive: zipfile.ZipFile, keys: Collection[str] | None) -> dict[str, zipfile.ZipInfo]:
    """The entries of those names; raises FileFormatError if they are too many or too large."""
    found = archive.infolist()
    if len(found) > MOST_ENTRIES:
        raise FileFormatError(f"{path}: has {len(found)} entries, at most {MOST_ENTRIES} are read; split the file.")
    named = [(entry.filename.removesuffix(".npy"), entry) for entry in found]
    entries = {name: entry for name, entry in named if keys is None or name in keys}
    if len(entries) < sum(keys is None or name in keys for name, _ in named):
        raise FileFormatError(f"{path}: not an intact npz file (several entries have one name); write it again.")
    declared = sum(entry.file_size for entry in entries.values())
    # Headers can lie, and entries can overlap: there is never more than the file.
    packed = min(sum(entry.compress_size for entry in entries.values()), Path(path).stat().st_size)
    if declared > LARGEST:
        raise FileFormatError(f"{path}: declares {declared} bytes, at most {LARGEST} are read; split the file.")
    if declared > max(MOST_UNPACKED * packed, HARMLESS):
        raise FileFormatError(
            f"{path}: declares {declared} bytes packed in {packed}, at most {MOST_UNPACKED} times as many are "
            "unpacked; write it without compression."
        )
    return entries


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
