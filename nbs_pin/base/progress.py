"""Progress display for long work, shown only at a terminal."""

import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import TypeVar

T = TypeVar("T")

_PATIENCE = 2.0
_REFRESH = 0.1
_BEAT = 4.0
_now: list[Callable[[], str]] = []
"""Tells how far the last loop got that is not drawn."""


def tracked(items: Sequence[T], label: str | Callable[[], str], show: bool = True) -> Iterator[T]:
    """The items one by one, with a progress bar on stderr after 2 s of work if stderr is a terminal.

    A function as `label` is called whenever the bar is drawn.
    """
    if not (show and _is_terminal()):
        begun = time.perf_counter()
        for done, item in enumerate(items):
            if show:
                _now[:] = [partial(_far, label, done, len(items), begun)]
            yield item
        return
    from rich.console import Console
    from rich.progress import Progress

    start = drawn = time.perf_counter()
    with Progress(console=Console(stderr=True), auto_refresh=False, transient=True) as bar:
        task = bar.add_task(_text(label), total=len(items), visible=False)
        for done, item in enumerate(items):
            now = time.perf_counter()
            if now - start > _PATIENCE and now - drawn > _REFRESH:
                bar.update(task, description=_text(label), completed=done, visible=True, refresh=True)
                drawn = now
            yield item


def _is_terminal() -> bool:
    """Whether stderr is one; it may be closed."""
    return sys.stderr is not None and sys.stderr.isatty()


@contextmanager
def heartbeat(what: str) -> Iterator[None]:
    """A line on stderr every 4 s while the body of the `with` statement runs, if stderr is no terminal.

    It says `what`, for how long, and how far the last loop of `tracked` got. At a terminal its bar says so.
    """
    if sys.stderr is None or _is_terminal():
        yield
        return
    ended, start = threading.Event(), time.perf_counter()
    _now.clear()

    def tell() -> None:
        while not ended.wait(_BEAT):
            far = f": {_now[0]()}" if _now else ""
            sys.stderr.write(f"{what}, {time.perf_counter() - start:.0f} s{far}\n")
            sys.stderr.flush()

    thread = threading.Thread(target=tell, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
        _now.clear()


@contextmanager
def waiting(label: str, show: bool = True) -> Iterator[None]:
    """A spinner on stderr while the body of the `with` statement runs, if stderr is a terminal."""
    if not (show and _is_terminal()):
        yield
        return
    from rich.console import Console

    with Console(stderr=True).status(label):
        yield


def _far(label: str | Callable[[], str], done: int, count: int, begun: float) -> str:
    """How far a loop is at this moment; an item that takes long makes what is left longer."""
    left = (time.perf_counter() - begun) * (count - done) / max(done, 1)
    return f"{_text(label)}, {done} of {count}{f', about {left:.0f} s left' if done else ''}"


def _text(label: str | Callable[[], str]) -> str:
    return label if isinstance(label, str) else label()
