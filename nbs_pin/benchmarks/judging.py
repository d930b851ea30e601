"""Judging an entrant on an arm, in a process of its own that is ended when a task takes too long."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import Any, Literal, NamedTuple

_CLOSING = 5.0  # for a process whose connection is closed to end [s]
_ONE_THREAD = {f"{name}_NUM_THREADS": "1" for name in ("OMP", "OPENBLAS", "MKL", "NUMBA")} | {"MUJOCO_GL": "disable"}


class Budget(NamedTuple):
    """What an entrant may take of the clock; far more than a usable law needs, as machines differ."""

    start: float = 300.0
    """From the start of its process to its first task [s]: imports, compilers, and making a law of ours."""
    run: float = 60.0
    """One run of 5,000 steps, with what a callable takes to be made [s]."""
    promise: float = 300.0
    """One promise [s]."""
    stops: int = 2
    """So many times it is stopped on an arm; its further tasks there are not run."""


BUDGET = Budget()


@dataclass(frozen=True)
class Job:
    """All tasks of an entrant on an arm."""

    kind: Literal["run", "promise"]
    entrant: str
    arm: str
    seed: int
    motions: tuple[str, ...]
    conditions: tuple[str, ...]
    budget: Budget = BUDGET

    @property
    def limit(self) -> float:
        """Longest time of a task [s]."""
        return self.budget.run if self.kind == "run" else self.budget.promise


def judge(job: Job) -> dict[str, Any]:
    """What came of every task by "motion condition": the figures or the promise, or a sentence on why there are none.

    Whatever the entrant does, raise, exit, hang or crash, its other tasks are run, up to `Budget.stops`.
    """
    left = [(motion, condition) for motion in job.motions for condition in job.conditions]
    found: dict[str, Any] = {}
    stops, reason = 0, ""
    while left and not reason:
        with _process(job) as process:
            said = process.begin()
            if said:
                reason = f"not run: {said}"
            while left and not said:
                task = left.pop(0)
                found[" ".join(task)], said = process.asked(*task)
        stops += bool(said)
        if stops == job.budget.stops:
            reason = reason or "not run, as it was stopped before on this arm"
    return found | {" ".join(task): {"failure": reason} for task in left}


@dataclass
class _Process:
    """A running `worker`."""

    process: subprocess.Popen[bytes]
    parent: Connection
    job: Job

    def begin(self) -> str:
        """Wait until it is ready; a sentence if it is not."""
        about = {"kind": self.job.kind, "entrant": self.job.entrant, "arm": self.job.arm, "seed": self.job.seed}
        about["limit"] = self.job.budget.start
        _, said = self._answer(about, self.job.budget.start, "its start")
        return said

    def asked(self, motion: str, condition: str) -> tuple[Mapping[str, Any], str]:
        """The answer for a task, and a sentence if the process is not to be asked again."""
        request = {"motion": motion, "condition": condition, "limit": self.job.limit}
        what = "a run" if self.job.kind == "run" else "a promise"
        answer, said = self._answer(request, self.job.limit, what)
        return ({"failure": said} if said else answer), said

    def _answer(self, request: Mapping[str, Any], limit: float, what: str) -> tuple[Mapping[str, Any], str]:
        try:
            self.parent.send(request)
            if self.parent.poll(limit):
                return self.parent.recv(), ""
        except (EOFError, OSError):
            try:
                code = self.process.wait(timeout=_CLOSING)
            except subprocess.TimeoutExpired:
                return {}, f"its process closed its connection during {what}"
            how = f"signal {-code}" if code < 0 else f"exit code {code}"
            return {}, f"its process ended during {what} ({how})"
        return {}, f"stopped: {what} took more than {limit:g} s"


@contextmanager
def _process(job: Job) -> Iterator[_Process]:
    """A worker, which is ended with all processes that it has started."""
    parent, child = Pipe()
    with parent:
        with child:
            # A session of its own, so that Ctrl-C reaches the parent alone and everything in it can be ended.
            process = subprocess.Popen(
                [sys.executable, "-m", "nbs_pin.benchmarks.entrant_process", str(child.fileno())],
                pass_fds=(child.fileno(),),
                stdin=subprocess.PIPE,
                env=os.environ | _ONE_THREAD,
                start_new_session=True,
            )
        try:
            yield _Process(process, parent, job)
        finally:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            assert process.stdin is not None
            process.stdin.close()
