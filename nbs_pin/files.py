"""Files written whole or not at all."""

import os
from pathlib import Path


def write_whole(path: str | Path, content: bytes) -> Path:
    """Writes `content` to `path` so that a reader or a crash never meets half of it; returns the path.

    The bytes go to a temporary file beside `path`, reach the disk, and then take its name. Missing folders are made.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
    return path
