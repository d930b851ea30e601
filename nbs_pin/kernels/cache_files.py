"""Machine code on disk, sealed with checksums: damaged files are compiled again instead of believed.

numba unpickles what it finds, and runs it. A damaged file would raise any exception, or crash the process. The
checksums detect damage; they do not authenticate the author: keep the folder writable for yourself alone.
"""

import contextlib
import functools
import hashlib
import io
import os
import pickle
import warnings
from collections.abc import Iterator
from typing import Any, BinaryIO

from numba.core.caching import IndexDataCacheFile

_DIGEST = hashlib.sha256().digest_size


class SealedCacheFile(IndexDataCacheFile):
    """The index and the machine code of one kernel, each behind the SHA-256 of the rest of its file.

    Args:
        folder: The folder.
        name: Beginning of the names of the files.
        stamp: Fingerprint of the sources; files of another are out of date.
        version: Version of what wrote the files, read before anything else.
    """

    def __init__(self, folder: str, name: str, stamp: str, version: str) -> None:
        super().__init__(cache_path=folder, filename_base=f"{name}.sealed", source_stamp=stamp)  # type: ignore[no-untyped-call]
        self._version = version

    def save(self, key: Any, data: Any) -> None:
        """Keep machine code; if it cannot be written, a warning says so and it is compiled again next time."""
        try:
            super().save(key, data)  # type: ignore[no-untyped-call]
        except OSError as error:
            _tell(self._cache_path, f"cannot be kept ({error.strerror}): it is compiled again next time")

    def _load_index(self) -> dict[Any, str]:
        try:
            content = io.BytesIO(self._content(self._index_path))
            if pickle.load(content) != self._version:
                return {}
            stamp, overloads = pickle.loads(content.read())
        except OSError:
            return {}
        return overloads if stamp == self._source_stamp else {}

    def _load_data(self, name: str) -> Any:
        return pickle.loads(self._content(self._data_path(name)))  # type: ignore[no-untyped-call]

    def _content(self, path: str) -> bytes:
        """The content of a file; raises OSError if it cannot be read or is damaged."""
        with open(path, "rb") as file:
            digest, content = file.read(_DIGEST), file.read()
        if hashlib.sha256(content).digest() != digest:
            _tell(self._cache_path, "is damaged: it is compiled again and replaced")
            raise OSError(f"{path} is damaged")
        return content

    @contextlib.contextmanager
    def _open_for_write(self, filepath: str) -> Iterator[BinaryIO]:
        content = io.BytesIO()
        yield content
        with super()._open_for_write(filepath) as file:
            file.write(hashlib.sha256(content.getvalue()).digest())
            file.write(content.getvalue())


@functools.cache
def _tell(folder: str, fault: str) -> None:
    """Warn once in a process, however many files are concerned."""
    warnings.warn(f"machine code in '{os.path.normpath(folder)}' {fault}.", stacklevel=2)
