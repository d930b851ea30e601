"""Files written whole or not at all."""

import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO


@contextmanager
def whole_file(path: str | Path) -> Iterator[BinaryIO]:
    """A file to write to, so that a reader, an error or a crash never meets half of it. Missing folders are made.

    The bytes go to a temporary file beside `path`, reach the disk, and then take its name.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
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
