"""Atomic writing of files."""

import os
import re
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

ABANDONED = 600.0
"""Age [s] above which a temporary file is taken to be left by a writer that was killed."""


@contextmanager
def whole_file(path: str | Path) -> Iterator[BinaryIO]:
    """A file to write to that replaces `path` atomically at the end. Missing folders are created.

    The bytes go to a temporary file beside `path`, which is flushed to disk and then renamed; after an error it is
    deleted. Temporary files of `path` that are older than `ABANDONED`, left by writers that were killed, are removed.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    _remove_abandoned_drafts(path)
    draft = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.tmp")
    try:
        with draft.open("xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)


def write_whole(path: str | Path, content: bytes) -> Path:
    """Write `content` to `path` atomically (`whole_file`) and return the path."""
    with whole_file(path) as file:
        file.write(content)
    return Path(path)


def _remove_abandoned_drafts(path: Path) -> None:
    name = re.compile(rf"\.{re.escape(path.name)}\.[0-9a-f]{{8}}\.tmp")
    with suppress(OSError), os.scandir(path.parent) as entries:  # a failed cleanup must not prevent the write
        for entry in entries:
            old = name.fullmatch(entry.name) and time.time() - entry.stat(follow_symlinks=False).st_mtime > ABANDONED
            if old and entry.is_file(follow_symlinks=False):
                os.unlink(entry)
