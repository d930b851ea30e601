"""The file of a campaign's results: a line of JSON for each job, appended as it ends, so that a kill costs none."""

import fcntl
import json
import os
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from nbs_pin.base.archives import parse_json
from nbs_pin.base.checks import told
from nbs_pin.base.doors import where_printed
from nbs_pin.base.exceptions import ArgumentError, FileFormatError

JOURNAL = "results.jsonl"
"""Name of the file in the folder of results."""
FORMAT = "nbs_pin results 1"
"""What its first line states, beside the plan."""
_BEGINNING = b'{"format": "nbs_pin results 1"'
_FOREIGN = "{}: the first line is not that of 'nbs_pin results 1'; give another folder."
_FLUSHED = 1.0  # results of at most so long are lost with the power, none with the process [s]
_MOST_TOLD = 3


class Outcome(NamedTuple):
    """What came of a job."""

    key: str
    result: dict[str, Any] | None
    """What the function returned, as JSON stores it; None where it failed."""
    failure: str
    """The sentence of the error that ended it; empty where it did not fail."""
    seconds: float
    """How long it took [s]."""


@dataclass
class Journal:
    """The results so far, and the file that gets each further one; made by `opened`."""

    path: Path
    outcomes: dict[str, Outcome]
    """By key, in the order in which they ended."""
    _file: int
    _synced: float = field(default_factory=time.monotonic)

    @classmethod
    @contextmanager
    def opened(cls, folder: str | Path, plan: Mapping[str, Any]) -> Iterator["Journal"]:
        """The journal in the folder, which no other process has open meanwhile; made where there is none.

        A last line that a killed process has not finished is removed. `plan` is all that determines the results, as
        JSON can store it.

        Raises:
            ArgumentError: If another process works in the folder, or its results are of another plan: names what.
            FileFormatError: If the file is damaged.
            OSError: If it cannot be written.
        """
        path = Path(folder) / JOURNAL
        path.parent.mkdir(parents=True, exist_ok=True)
        file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o644)
        try:
            _lock(file, path)
            content = path.read_bytes()
            end = content.rfind(b"\n") + 1
            journal = cls(path, {}, file)
            if end:
                head, *lines = content[:end].split(b"\n")[:-1]
                _check_plan(path, _parsed(path, 1, head), _stored(plan))
                journal.outcomes.update((x.key, x) for x in _outcomes(path, lines))
                os.ftruncate(file, end)
            else:
                if not _BEGINNING.startswith(content[: len(_BEGINNING)]):
                    raise FileFormatError(_FOREIGN.format(path))
                os.ftruncate(file, 0)
                journal._write({"format": FORMAT, "plan": plan})
            yield journal
            os.fsync(file)
        finally:
            os.close(file)

    def add(self, outcome: Outcome) -> None:
        """Append an outcome; it is in the file when this returns. Raises OSError if it cannot be written whole."""
        about = {"failure": outcome.failure} if outcome.result is None else {"result": outcome.result}
        self._write({"key": outcome.key, "seconds": outcome.seconds, **about})
        self.outcomes[outcome.key] = outcome

    def _write(self, entry: Mapping[str, Any]) -> None:
        line, size = json.dumps(entry, allow_nan=False).encode() + b"\n", os.fstat(self._file).st_size
        try:
            rest = memoryview(line)
            while rest:
                rest = rest[os.write(self._file, rest) :]
            if time.monotonic() - self._synced > _FLUSHED:
                os.fsync(self._file)
                self._synced = time.monotonic()
        except OSError as error:
            os.ftruncate(self._file, size)  # a part of a line would spoil the next one
            error.filename = str(self.path)
            raise


def forget(folder: str | Path) -> None:
    """Empty the journal of the folder, if there is one; raises ArgumentError if another process has it open."""
    path = Path(folder) / JOURNAL
    if path.exists():
        file = os.open(path, os.O_RDWR)
        try:
            _lock(file, path)
            os.ftruncate(file, 0)
        finally:
            os.close(file)


def _lock(file: int, path: Path) -> None:
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise ArgumentError(
            f"another process is adding results to '{path}'; wait for its end, or give another folder."
        ) from error
    except OSError:  # a file system without locks
        return


def _stored(plan: Mapping[str, Any]) -> dict[str, Any]:
    """The plan as it is read back."""
    return dict(json.loads(json.dumps(plan, allow_nan=False)))


def _parsed(path: Path, number: int, line: bytes) -> dict[str, Any]:
    return parse_json(path, f"line {number}", line)


def _check_plan(path: Path, head: Mapping[str, Any], plan: Mapping[str, Any]) -> None:
    """Raise unless the file is of this plan."""
    before = head.get("plan")
    if head.get("format") != FORMAT or not isinstance(before, dict):
        raise FileFormatError(_FOREIGN.format(path))
    changed = list(_changes(before, plan))
    if changed:
        more = f" and {len(changed) - _MOST_TOLD} more" if len(changed) > _MOST_TOLD else ""
        remedy = where_printed(python="give another folder", shell="give another --out, or --force to begin again")
        raise ArgumentError(
            f"'{path.parent}' has results of another plan, with {'; '.join(changed[:_MOST_TOLD])}{more}; {remedy}."
        )


def _changes(before: Mapping[str, Any], now: Mapping[str, Any], inside: str = "") -> Iterator[str]:
    """What differs, in words."""
    for name in dict.fromkeys((*before, *now)):
        old, new = before.get(name), now.get(name)
        if isinstance(old, dict) and isinstance(new, dict):
            yield from _changes(old, new, f"{inside}{name}.")
        elif name not in now:
            yield f"{inside}{name} {told(old)}, which is not there now"
        elif name not in before:
            yield f"no {inside}{name}, which is now {told(new)}"
        elif old != new:
            yield f"{inside}{name} {told(old)} where it is now {told(new)}"


def _outcomes(path: Path, lines: list[bytes]) -> Iterator[Outcome]:
    for number, line in enumerate(lines, 2):
        entry = _parsed(path, number, line)
        key, seconds, result, failure = (entry.get(name) for name in ("key", "seconds", "result", "failure"))
        given = isinstance(result, dict) if failure is None else isinstance(failure, str) and result is None
        if not (isinstance(key, str) and isinstance(seconds, float | int) and given):
            raise FileFormatError(f"{path}: line {number} is no result; delete it, and its job is done again.")
        yield Outcome(key, result, failure or "", float(seconds))
