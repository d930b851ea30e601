"""Atomic writing of files, and of files that belong together."""

import fcntl
import os
import re
import shutil
import tempfile
import time
import uuid
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

ABANDONED = 600.0
"""Age [s] above which a temporary file is taken to be left by a writer that was killed."""
_WRITING = ".writing-"
_SETTLED = 1.0  # a folder younger than this may not be locked yet [s]


@contextmanager
def whole_file(path: str | Path, *, flushed: bool = True) -> Iterator[BinaryIO]:
    """A file to write to that replaces `path` atomically at the end. Missing folders are created.

    The bytes go to a temporary file beside `path`, which is flushed to disk, unless they may be lost in a power cut
    (`flushed` false), and then renamed; after an error it is deleted. Temporary files of `path` that are older than
    `ABANDONED`, left by writers that were killed, are removed.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    _remove_abandoned_drafts(path)
    draft = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.tmp")
    try:
        with _naming(draft, path), draft.open("xb") as file:
            yield file
            if flushed:
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


@contextmanager
def replaced_together(folder: Path, names: Sequence[str]) -> Iterator[Path]:
    """A new folder for files that take the place of those in `folder` when the block ends, all of one origin.

    Of the files in `names`, the old ones are removed and the new ones moved in, in that order, except that the first
    new one after `names[0]` replaces its predecessor at once, so that it never lacks. `names[0]` is what describes the
    others and goes first. At every moment `folder` therefore holds files of those names from one block alone, and the
    old ones are untouched if the block fails. Files of other names stay. Raises OSError if something cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    _remove_abandoned_folders(folder)
    with _drafts(folder) as drafts, _locked(Path(drafts)) as draft:
        with _naming(draft, folder):
            yield draft
        new = [name for name in (*names[1:], names[0]) if (draft / name).exists()]
        for name in new:
            with (draft / name).open("rb") as file:
                os.fsync(file.fileno())
        try:
            _move(draft, folder, names, new)
        except KeyboardInterrupt:
            _move(draft, folder, names, new)  # either all of the new files or none
            raise


def _drafts(folder: Path) -> tempfile.TemporaryDirectory[str]:
    """A new folder inside; an OSError names the folder itself, such as one that is read-only."""
    try:
        return tempfile.TemporaryDirectory(dir=folder, prefix=_WRITING)
    except OSError as error:
        error.filename = str(folder)
        raise


@contextmanager
def _naming(draft: Path, final: Path) -> Iterator[None]:
    """An OSError in the block names the final file, in place of a draft or of none, as when a disk is full."""
    try:
        yield
    except OSError as error:
        named = str(final if error.filename is None else error.filename)
        if named.startswith(str(draft)):
            named = f"{final}{named.removeprefix(str(draft))}"
        error.filename = named
        raise


def _move(draft: Path, folder: Path, names: Sequence[str], new: Sequence[str]) -> None:
    """Move the new files in, the old ones out; does the rest if it was interrupted."""
    if (draft / new[0]).exists():
        for name in names:
            if name != new[0]:
                (folder / name).unlink(missing_ok=True)
    for name in new:
        if (draft / name).exists():
            os.replace(draft / name, folder / name)


@contextmanager
def _locked(folder: Path) -> Iterator[Path]:
    """The folder, locked until the block ends or the process does, so that others know that it is in use."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        with suppress(OSError):  # a file system without locks; the age of the folder has to do
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield folder
    finally:
        os.close(handle)


def _remove_abandoned_folders(folder: Path) -> None:
    """Remove what `replaced_together` left where a process was killed."""
    for path in folder.glob(f"{_WRITING}*"):
        with suppress(OSError):  # a failed cleanup must not prevent the write
            if not path.is_symlink() and path.is_dir() and _is_abandoned(path):
                shutil.rmtree(path)


def _is_abandoned(folder: Path) -> bool:
    """Whether nobody holds the lock of a folder that is not brand-new."""
    if time.time() - folder.stat().st_mtime < _SETTLED:
        return False
    handle = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    finally:
        os.close(handle)
    return True


def _remove_abandoned_drafts(path: Path) -> None:
    name = re.compile(rf"\.{re.escape(path.name)}\.[0-9a-f]{{8}}\.tmp")
    with suppress(OSError), os.scandir(path.parent) as entries:  # a failed cleanup must not prevent the write
        for entry in entries:
            old = name.fullmatch(entry.name) and time.time() - entry.stat(follow_symlinks=False).st_mtime > ABANDONED
            if old and entry.is_file(follow_symlinks=False):
                os.unlink(entry)
