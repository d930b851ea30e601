"""Kernels in several threads: batches over the cores, as kernels release the interpreter's lock, and scratch space."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

import numba
import numpy as np

FEWEST_ROWS = 64
"""Fewer rows than this are not worth a thread."""


def cores() -> int:
    """How many threads are worth starting; the environment variable NUMBA_NUM_THREADS says otherwise."""
    return int(numba.config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]


def over_cores(function: Callable[[slice], None], rows: int, fewest: int = FEWEST_ROWS) -> None:
    """`function` of slices of at least `fewest` rows, which make up all, at once; one per core at most."""
    parts = min(cores(), rows // fewest)
    if parts < 2:
        function(slice(0, rows))
        return
    bounds = np.linspace(0, rows, parts + 1).astype(int).tolist()
    with ThreadPoolExecutor(parts) as pool:
        list(pool.map(function, [slice(a, b) for a, b in pairwise(bounds)]))


class Scratch:
    """Scratch spaces of one size, each used by one thread at a time, so that threads may share what calls a kernel."""

    __slots__ = ("_idle", "_size")

    def __init__(self, size: int) -> None:
        self._size = size
        self._idle: list[np.ndarray] = []

    def take(self) -> np.ndarray:
        """A space that no other thread is using; its numbers are arbitrary."""
        try:
            return self._idle.pop()  # the interpreter does this, and the append, in one piece
        except IndexError:
            return np.empty(self._size)

    def give(self, work: np.ndarray) -> None:
        """Return a space for later use."""
        self._idle.append(work)
