"""How every kernel is compiled: to machine code, cached on disk, without the interpreter's lock.

With NUMBA_DISABLE_JIT=1 in the environment every kernel runs as the Python it is written in, for debugging.
"""

import functools
import hashlib
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
import numpy as np

from nbs_pin.kernels.cache_files import SealedCacheFile

INTERPRETED = bool(numba.config.DISABLE_JIT)  # type: ignore[attr-defined]
"""Whether kernels run as Python."""
NOT_TAKEN = (TypeError, ValueError, OverflowError, numba.core.errors.NumbaError)
"""What a kernel raises for arguments that are not of its types."""
_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy"}


def kernel(function: Callable[..., Any]) -> Any:
    """Compile at first use; sums may be reordered so that they fill vector registers, NaN and inf keep their meaning.

    Arguments: contiguous float64 vectors and the groups of `records.py`; results go into the vectors named last, and
    `work` is scratch space. Kernels allocate nothing and hold no state, so any number of threads may run them, each
    with its own scratch space. The machine code is kept beside the source, or in the user's cache directory where that
    is read-only (NUMBA_CACHE_DIR names another), or nowhere where neither can be written.
    """
    return _compiled(function, {"reassoc", "contract"})


def inlined(function: Callable[..., Any]) -> Any:
    """Like `kernel`, as a part of every kernel that calls it, so that arrays it returns need no counting of owners."""
    return _compiled(function, {"reassoc", "contract"}, forceinline=True)


def exact_kernel(function: Callable[..., Any]) -> Any:
    """Like `kernel`, in the order of operations that is written, even where a kernel that may reorder calls it."""
    return _compiled(function, False)


def compile_for(dispatcher: Any, signature: Any) -> None:
    """Compile the kernel, or load it from disk, for this signature, and let it refuse all others with a TypeError."""
    if INTERPRETED:
        dispatcher.accepts = signature.args
        return
    if signature.args not in dispatcher.overloads:
        dispatcher.disable_compile(False)
        dispatcher.compile(signature)
    dispatcher.disable_compile()  # even if another kernel, which calls this one, has compiled it before


class _Interpreted:
    """A kernel as Python. Division by zero and the like give inf and NaN without a warning, as in machine code."""

    accepts: tuple[Any, ...] | None = None

    def __init__(self, function: Callable[..., Any]) -> None:
        functools.update_wrapper(self, function)
        self.function = function

    def __call__(self, *arguments: Any) -> Any:
        if self.accepts is not None and self.accepts != tuple(map(_type, arguments)):
            raise TypeError(f"{self.function.__name__} takes {self.accepts}.")
        with np.errstate(all="ignore"):
            return self.function(*arguments)


def _type(x: Any) -> Any:
    try:
        return numba.typeof(x)  # type: ignore[no-untyped-call]
    except ValueError:  # nothing that numba knows
        return None


def _sources() -> str:
    """Fingerprint of this folder."""
    files = sorted(Path(__file__).parent.glob("*.py"))
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()


def _compiled(function: Callable[..., Any], fastmath: Any, **options: Any) -> Any:
    plain = inspect.unwrap(function)
    if INTERPRETED:
        return _Interpreted(plain)
    try:
        return _cached(numba.njit(plain, fastmath=fastmath, cache=True, **_OPTIONS, **options))
    except RuntimeError:  # nowhere to keep machine code: neither this folder nor the user's can be written
        return numba.njit(plain, fastmath=fastmath, **_OPTIONS, **options)


def _cached(dispatcher: Any) -> Any:
    # numba renews machine code when the file of the function has changed, but not when that of a function it calls, or
    # of a constant it uses, has: here one change anywhere in the folder renews everything. The version is read first,
    # before the types of arguments, which an older folder may have defined otherwise.
    cache = dispatcher._cache
    version = f"{numba.__version__} {_SOURCES}"
    cache._cache_file = SealedCacheFile(cache._cache_path, cache._impl.filename_base, _SOURCES, version)
    return dispatcher


_SOURCES = _sources()
