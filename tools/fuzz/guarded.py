"""Cases tried in processes that are replaced when one of them hangs or dies."""

import multiprocessing
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

Lost = Callable[[int, str, str], Any]
"""Makes the outcome of a case that ended no other way, from its number, "hang" or "crash", and what is known."""


def guarded(attempt: Callable[[int], Any], count: int, workers: int, patience: float, lost: Lost) -> Iterator[Any]:
    """attempt(case) for `count` cases in any order; `lost` where it takes over `patience` [s] or the process dies."""
    context = multiprocessing.get_context("fork")
    left = {k: list(range(k, count, workers)) for k in range(workers)}
    running: dict[int, tuple[Any, Connection]] = {}

    def start(k: int) -> None:
        if left[k]:
            mine, theirs = context.Pipe(duplex=False)
            process = context.Process(target=_work, args=(attempt, left[k], theirs))
            process.start()
            theirs.close()
            running[k] = process, mine

    for k in left:
        start(k)
    while running:
        for k, (process, pipe) in list(running.items()):
            case, kind = left[k].pop(0), ""
            try:
                kind = "" if pipe.poll(patience) else "hang"
                outcome = lost(case, kind, "") if kind else pipe.recv()
            except EOFError:
                process.join()
                kind = "crash"
                outcome = lost(case, kind, f"exit code {process.exitcode}")
            yield outcome
            if kind or not left[k]:
                process.kill()
                process.join()
                del running[k]
                start(k)


def peak(*, reset: bool = False) -> int:
    """Largest resident memory of this process since the last reset [kB]."""
    if reset:
        Path("/proc/self/clear_refs").write_text("5")
    status = Path("/proc/self/status").read_text()
    return int(status.partition("VmHWM:")[2].split()[0])


def _work(attempt: Callable[[int], Any], cases: list[int], pipe: Connection) -> None:
    for case in cases:
        pipe.send(attempt(case))
