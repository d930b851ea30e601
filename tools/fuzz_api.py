"""Hostile arguments at every door of the Python interface: seeded calls, each under guard of time and memory.

    python tools/fuzz_api.py                          # 10,000 calls, seed 0, two processes; about ten minutes
    python tools/fuzz_api.py --count 500 --seed 3 --show
    python tools/fuzz_api.py --only simulate --show

Each call takes good arguments and makes one or two of them hostile. Its outcome is one of typed (an `NbsPinError`),
accepted, untyped (any other exception), non-finite (a result with NaN or inf from arguments without), memory (more than
1 GB), hang (longer than 5 s of processor time, or 60 s at all) and crash (the process died). Any of the last five is a
fault: the exit code is 1, and the calls are listed with their numbers, by which `--call` repeats one.
"""

import argparse
import functools
import multiprocessing
import os
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from typing import Any, NamedTuple

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import psutil

_COMPILING = ("train", "attack", "propose", "Watch.step", "LagrangianDynamics.forward_dynamics", "simulate", "replay")
TIME, PATIENCE, MEMORY = 5.0, 60.0, 1 << 30
FAULTS = ("untyped", "non-finite", "memory", "hang", "crash")


class Outcome(NamedTuple):
    """What a call did."""

    call: int
    kind: str
    door: str
    hostile: str
    told: str
    """The message, or the type of the result."""


def main() -> int:
    """Run the calls and print how many ended how."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--only", default="", help="doors whose name begins so")
    parser.add_argument("--call", type=int, help="repeat this call alone, here")
    parser.add_argument("--show", action="store_true", help="print every fault as it occurs")
    options = parser.parse_args()
    os.chdir(tempfile.mkdtemp(prefix="fuzz-"))  # hostile texts are taken as names of files to write
    if options.call is not None:
        print(attempt(options.seed, options.call, options.only, trace=True))
        return 0
    found = []
    for outcome in outcomes(options.seed, options.count, options.workers, options.only):
        found.append(outcome)
        if options.show and outcome.kind in FAULTS:
            print(*outcome, sep=" | ", flush=True)
    return report(found)


def report(found: list[Outcome]) -> int:
    """Print the counts and the faults; 1 if there are any."""
    kinds = Counter(outcome.kind for outcome in found)
    print(f"{len(found)} calls at {len({outcome.door for outcome in found})} doors: ", end="")
    print(", ".join(f"{kinds[kind]} {kind}" for kind in ("typed", "accepted", *FAULTS)))
    faults = [outcome for outcome in found if outcome.kind in FAULTS]
    for (door, kind), count in Counter((x.door, x.kind) for x in faults).most_common():
        first = next(x for x in faults if (x.door, x.kind) == (door, kind))
        print(f"  {count:4d} {kind:10s} {door}: call {first.call}: {first.hostile}: {first.told}")
    return 1 if faults else 0


def attempt(
    seed: int,
    call: int,
    only: str = "",
    *,
    quick: bool = False,
    trace: bool = False,
    begins: Callable[[Outcome], Any] = id,
) -> Outcome:
    """Make one call in this process, without guard; `begins` is told of it before.

    Args:
        seed: Seed of all calls.
        call: Number of the call.
        only: Beginning of the names of the doors to choose from.
        quick: Leave out the doors that compile or work for seconds.
        trace: Print the traceback of an untyped exception.
        begins: Called with the door and the arguments in words.
    """
    from fuzz.doors import INFINITE
    from fuzz.values import hostile, is_finite

    import nbs_pin as nbs

    rng = np.random.default_rng((seed, call))
    choice = [d for d in _doors() if d.name.startswith(only) and not (quick and d.name in _COMPILING)]
    door = choice[int(rng.integers(len(choice)))]
    arguments, changed = dict(door.good), []
    count = min(len(door.parameters), 1 + int(rng.random() < 0.2))
    for name in rng.permutation(list(door.parameters))[:count].tolist():
        label, arguments[name] = hostile(door.good.get(name), rng)
        changed.append(f"{name} = {label}")
    what = ", ".join(changed) or "good arguments"
    finite = all(is_finite(x) for x in arguments.values())
    begins(Outcome(call, "begun", door.name, what, ""))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            result = door.function(**arguments)
            result = next(result) if isinstance(result, Iterator) else result
    except nbs.NbsPinError as error:
        return Outcome(call, "typed", door.name, what, f"{type(error).__name__}: {error}"[:300])
    except MemoryError as error:
        return Outcome(call, "memory", door.name, what, str(error)[:200])
    except Exception as error:
        if trace:
            traceback.print_exc()
        where = traceback.extract_tb(error.__traceback__)[-1]
        at = f"{os.path.basename(where.filename)}:{where.lineno}"
        return Outcome(call, "untyped", door.name, what, f"{type(error).__name__}: {error!s:.120} ({at})")
    numbers = {name: getattr(result, name) for name in ("q", "v", "tau")} if isinstance(result, nbs.Run) else result
    numbers = list(numbers.values()) if isinstance(numbers, dict) else numbers
    if door.name == "Watch.step":  # the memory beside the result has inf where no bound for held torques is proved
        numbers = result[0]
    if finite and door.name.split(".")[-1] not in INFINITE and not is_finite(numbers):
        return Outcome(call, "non-finite", door.name, what, str(numbers)[:100])
    return Outcome(call, "accepted", door.name, what, type(result).__name__)


@functools.cache
def _doors() -> list[Any]:
    from fuzz.doors import doors

    return doors()


def outcomes(seed: int, count: int, workers: int, only: str) -> Iterator[Outcome]:
    """The calls in several processes; one that hangs, grows or dies is replaced."""
    context = multiprocessing.get_context("spawn")
    left, running = list(range(count))[::-1], [_Worker(context, seed, only) for _ in range(min(workers, count))]
    while left or any(worker.call is not None for worker in running):
        for place, worker in enumerate(running):
            outcome = worker.poll()
            if outcome is not None:
                yield outcome
                if outcome.kind in ("hang", "memory", "crash"):
                    worker.stop()
                    running[place] = _Worker(context, seed, only)
            elif worker.is_idle and left:
                worker.start(left.pop())
        time.sleep(0.0005)
    for worker in running:
        worker.stop()


class _Worker:
    """A process that makes calls one after the other."""

    def __init__(self, context: Any, seed: int, only: str) -> None:
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(theirs, seed, only), daemon=True)
        self.process.start()
        theirs.close()
        self.watched, self.worked = psutil.Process(self.process.pid), 0.0
        self.is_ready, self.call, self.began, self.base = False, None, 0.0, 0
        self.last = Outcome(-1, "begun", "", "", "")

    @property
    def is_idle(self) -> bool:
        """Whether it waits for a call."""
        return self.is_ready and self.call is None

    def start(self, call: int) -> None:
        """Let it make a call."""
        self.call, self.began = call, time.monotonic()
        self.base, self.worked = self.watched.memory_info().rss, self._work()
        self.pipe.send(call)

    def poll(self) -> Outcome | None:
        """The outcome of its call, once there is one."""
        try:
            if self.pipe.poll():
                return self._received(self.pipe.recv())
        except (EOFError, ConnectionError):
            return self._ended("crash", f"exit code {self.process.exitcode}")
        if self.call is None:
            return None
        if not self.process.is_alive():
            return self._ended("crash", f"exit code {self.process.exitcode}")
        if self._work() - self.worked > TIME or time.monotonic() - self.began > PATIENCE:
            return self._ended("hang", f"more than {TIME:g} s")
        if self._grown() > MEMORY:
            return self._ended("memory", f"{self._grown() / 2**30:.1f} GiB")
        return None

    def _received(self, found: Outcome | None) -> Outcome | None:
        if found is None:
            self.is_ready = True
            return None
        if found.kind == "begun":
            self.last = found
            return None
        self.call = None
        return found

    def _grown(self) -> int:
        return int(self.watched.memory_info().rss) - self.base

    def _work(self) -> float:
        used = self.watched.cpu_times()
        return float(used.user + used.system)

    def _ended(self, kind: str, told: str) -> Outcome:
        if self.call is None:
            raise RuntimeError("a worker died before its first call; run one call with --call 0.")
        self.call = None
        return self.last._replace(kind=kind, told=told)

    def stop(self) -> None:
        """End the process."""
        self.process.kill()
        self.process.join()
        self.pipe.close()


def _serve(pipe: Connection, seed: int, only: str) -> None:
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for door in _doors():  # so that nothing is left to import or to compile
            if door.name in _COMPILING:
                door.function(**door.good)
    pipe.send(None)
    while True:
        pipe.send(attempt(seed, pipe.recv(), only, begins=pipe.send))


if __name__ == "__main__":
    sys.exit(main())
