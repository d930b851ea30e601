"""Files written whole or not at all."""

import os
import re
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

ABANDONED = 600.0
"""Age [s] from which a draft is that of a writer that was killed: a living one is done long before."""


@contextmanager
def whole_file(path: str | Path) -> Iterator[BinaryIO]:
    """A file to write to, so that a reader, an error or a crash never meets half of it. Missing folders are made.

    The bytes go to a temporary file beside `path`, reach the disk, and then take its name. What a writer of `path` left
    behind when it was killed, more than `ABANDONED` seconds ago, is removed.
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
    """Writes `content` to `path` as `whole_file` does; returns the path."""
    with whole_file(path) as file:
        file.write(content)
    return Path(path)


def _remove_abandoned_drafts(path: Path) -> None:
    name = re.compile(rf"\.{re.escape(path.name)}\.[0-9a-f]{{8}}\.tmp")
    with suppress(OSError), os.scandir(path.parent) as entries:  # tidying never stops a write
        for entry in entries:
            old = name.fullmatch(entry.name) and time.time() - entry.stat(follow_symlinks=False).st_mtime > ABANDONED
            if old and entry.is_file(follow_symlinks=False):
                os.unlink(entry)
