"""How every kernel is compiled: to machine code, cached on disk, without the interpreter's lock."""

import hashlib
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba

_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy"}


def kernel(function: Callable[..., Any]) -> Any:
    """Compile at first use; sums may be reordered so that they fill vector registers, NaN and inf keep their meaning.

    Arguments: contiguous float64 vectors and the parts of `layout.py`; results go into the vectors named last, and
    `work` is scratch space (`layout.workspace`). Kernels allocate nothing and hold no state, so any number of threads
    may run them, each with its own scratch space. The machine code is kept beside the source, or in the user's cache
    directory where that is read-only (NUMBA_CACHE_DIR names another), or nowhere where neither can be written.
    """
    return _compiled(function, {"reassoc", "contract"})


def exact_kernel(function: Callable[..., Any]) -> Any:
    """Like `kernel`, in the order of operations that is written, even where a kernel that may reorder calls it."""
    return _compiled(function, False)


def compile_for(dispatcher: Any, signature: Any) -> None:
    """Compile the kernel, or load it from disk, for this signature, and let it refuse all others with a TypeError."""
    if signature.args not in dispatcher.overloads:
        dispatcher.disable_compile(False)
        dispatcher.compile(signature)
    dispatcher.disable_compile()  # even if another kernel, which calls this one, has compiled it before


def _sources() -> str:
    """Fingerprint of this folder."""
    files = sorted(Path(__file__).parent.glob("*.py"))
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()


def _compiled(function: Callable[..., Any], fastmath: Any) -> Any:
    plain = inspect.unwrap(function)
    try:
        return _cached(numba.njit(plain, fastmath=fastmath, cache=True, **_OPTIONS))
    except RuntimeError:  # nowhere to keep machine code: neither this folder nor the user's can be written
        return numba.njit(plain, fastmath=fastmath, **_OPTIONS)


def _cached(dispatcher: Any) -> Any:
    # numba renews machine code when the file of the function has changed, but not when that of a function it calls, or
    # of a constant it uses, has: here one change anywhere in the folder renews everything.
    dispatcher._cache._cache_file._source_stamp = _SOURCES
    return dispatcher


_SOURCES = _sources()
