"""Tasks in processes, each on one thread."""

import sys
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from typing import Any

from nbs_pin.base.progress import tracked
from nbs_pin.kernels.threads import cores


def in_processes(
    function: Callable[..., Any], tasks: Iterable[tuple[Any, ...]], workers: int, *, ordered: bool = True
) -> Generator[Any]:
    """function(*task) of every task in processes of one thread each, in the order of the tasks or as they end."""
    import joblib  # takes a while, and one process does without

    with joblib.parallel_config(backend="loky", inner_max_num_threads=1):
        pool = joblib.Parallel(n_jobs=workers, return_as="generator" if ordered else "generator_unordered")
        yield from pool(joblib.delayed(_growing)(function, *task) for task in tasks)


def on_all_cores(
    function: Callable[..., Any], tasks: Sequence[tuple[Any, ...]], label: str, progress: bool
) -> Iterator[Any]:
    """function(*task) of every task in order, on all cores, with a progress bar."""
    results = in_processes(function, tasks, min(cores(), len(tasks)))
    for _ in tracked(tasks, label, progress):
        yield next(results)


def _growing(function: Callable[..., Any], *task: Any) -> Any:
    """A task in a process that may grow.

    loky takes 300 MB more than after the first task for a leak and replaces the process, with a warning; a compiler
    that a later task is the first to need takes as much.
    """
    from joblib.externals.loky import process_executor

    process_executor._MAX_MEMORY_LEAK_SIZE = sys.maxsize
    return function(*task)
