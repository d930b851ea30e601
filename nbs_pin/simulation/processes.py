"""Tasks on all cores, each in a process on one thread."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

from nbs_pin.base.progress import tracked
from nbs_pin.kernels.threads import cores


def on_all_cores(
    function: Callable[..., Any], tasks: Sequence[tuple[Any, ...]], label: str, progress: bool
) -> Iterator[Any]:
    """function(*task) of every task in order, each in a process on one thread, with a progress bar."""
    import joblib  # takes a while, and one process does without

    with joblib.parallel_config(backend="loky", inner_max_num_threads=1):
        pool = joblib.Parallel(n_jobs=min(cores(), len(tasks)), return_as="generator")
        results = iter(pool(joblib.delayed(function)(*task) for task in tasks))
        for _ in tracked(tasks, label, progress):
            yield next(results)
