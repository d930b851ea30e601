"""Keyed jobs for one function: shared by threads, processes or a cluster, saved as they come, resumed, failures told.

It knows nothing of robots. A job is any picklable argument; the function returns what JSON can store.
"""

import time
from collections.abc import Callable, Generator, Mapping
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import joblib

from nbs_pin.base.exceptions import ArgumentError, MissingExtra, NbsPinError
from nbs_pin.base.progress import tracked
from nbs_pin.base.units import counted
from nbs_pin.base.versions import versions
from nbs_pin.campaigns.journal import Journal, Outcome
from nbs_pin.simulation.processes import in_processes

Work: TypeAlias = Callable[[Any], Mapping[str, Any]]
"""What is done with the argument of a job."""
_CONNECTING = 10.0


def run_jobs(
    work: Work,
    jobs: Mapping[str, Any],
    folder: str | Path,
    plan: Mapping[str, Any],
    *,
    workers: int = 1,
    processes: bool = False,
    cluster: str | None = None,
    label: str = "jobs",
    progress: bool = False,
) -> dict[str, Outcome]:
    """The outcome of `work(argument)` of every job, by key, in the order of the jobs.

    Outcomes are appended to `journal.JOURNAL` in the folder as they come; jobs that it has are not done again, so that
    the same call goes on where one was stopped, by whatever it was. An `NbsPinError` ends its job alone, and its
    sentence is the outcome; any other error is one of the program and ends the call.

    Args:
        work: A function of a module, so that processes can import it. With threads it should spend its time in kernels
            without the interpreter's lock. The same argument must give the same result.
        jobs: The argument of every job, by a key.
        folder: Where the results are kept.
        plan: All that determines the results, as JSON can store it; results of another plan are refused.
        workers: How many jobs are done at once on this machine.
        processes: Whether each worker is a process on one thread, rather than a thread of this one.
        cluster: Address of a scheduler of dask.distributed, whose workers do the jobs in place of this machine's.
        label: What is done, on the progress bar.
        progress: Show a progress bar on a terminal after 2 s.

    Raises:
        ArgumentError: If another process works in the folder, its results are of another plan, or the cluster cannot be
            reached or has other versions.
        FileFormatError: If the file of results is damaged.
        MissingExtra: If dask.distributed is not installed.
        OSError: If the folder cannot be written.
    """
    with Journal.opened(folder, plan) as journal:
        left = {key: argument for key, argument in jobs.items() if key not in journal.outcomes}
        if left:
            timed = partial(_timed, work)
            coming = _on_cluster(timed, left, cluster) if cluster else _here(timed, left, workers, processes)

            def said() -> str:
                failed = sum(outcome.result is None for outcome in journal.outcomes.values())
                return f"{label}, {counted(failed, 'failure')}" if failed else label

            with closing(coming):
                for _ in tracked(range(len(left)), said, progress):
                    journal.add(next(coming))
        return {key: journal.outcomes[key] for key in jobs}


def _timed(work: Work, key: str, argument: Any) -> Outcome:
    begun = time.perf_counter()
    try:
        result, failure = dict(work(argument)), ""
    except NbsPinError as error:
        result, failure = None, str(error)
    return Outcome(key, result, failure, time.perf_counter() - begun)


def _here(
    timed: Callable[[str, Any], Outcome], jobs: Mapping[str, Any], workers: int, apart: bool
) -> Generator[Outcome]:
    """Outcomes as they come, from threads, which share what this process has, or processes."""
    if apart:
        yield from in_processes(timed, jobs.items(), min(workers, len(jobs)), ordered=False)
        return
    with joblib.parallel_config(backend="threading"):
        pool = joblib.Parallel(n_jobs=min(workers, len(jobs)), return_as="generator_unordered")
        yield from pool(joblib.delayed(timed)(key, argument) for key, argument in jobs.items())


def _on_cluster(timed: Callable[[str, Any], Outcome], jobs: Mapping[str, Any], address: str) -> Generator[Outcome]:
    """Outcomes as they come, from the workers of a cluster; a job that its workers do not survive is a failure."""
    try:
        from distributed import Client, KilledWorker, as_completed
    except ImportError as error:
        raise MissingExtra("a cluster needs dask.distributed: pip install 'nbs-pin[cluster]'.") from error
    try:
        client = Client(address, timeout=_CONNECTING)  # type: ignore[no-untyped-call]
    except (OSError, ValueError) as error:
        raise ArgumentError(
            f"no scheduler answers at '{address}' ({error!s:.200}); give the address that dask-scheduler prints, such"
            " as tcp://10.0.0.1:8786."
        ) from error
    with client:
        _check_versions(client.run(versions))
        futures = client.map(timed, *zip(*jobs.items(), strict=True), pure=False)
        keys = {future.key: key for future, key in zip(futures, jobs, strict=True)}
        for future in as_completed(futures):  # type: ignore[no-untyped-call]
            try:
                yield future.result()
            except KilledWorker as error:
                yield Outcome(keys[future.key], None, f"the workers that did it were lost ({error!s:.200})", 0.0)


def _check_versions(found: Mapping[str, Mapping[str, str]]) -> None:
    """Raise ArgumentError unless there are workers and all have the versions of this machine."""
    if not found:
        raise ArgumentError("the cluster has no workers; start dask worker on its machines.")
    own = versions()
    for worker, theirs in found.items():
        for name, version in own.items():
            if theirs.get(name) != version:
                raise ArgumentError(
                    f"the worker {worker} has {name} {theirs.get(name)}, here it is {version}; install the same."
                )
