"""Progress display for long work, shown only at a terminal."""

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TypeVar

T = TypeVar("T")

_PATIENCE = 2.0
_REFRESH = 0.1


def tracked(items: Sequence[T], label: str | Callable[[], str], show: bool = True) -> Iterator[T]:
    """The items one by one, with a progress bar on stderr after 2 s of work if stderr is a terminal.

    A function as `label` is called whenever the bar is drawn.
    """
    if not (show and _is_terminal()):
        yield from items
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
def waiting(label: str, show: bool = True) -> Iterator[None]:
    """A spinner on stderr while the body of the `with` statement runs, if stderr is a terminal."""
    if not (show and _is_terminal()):
        yield
        return
    from rich.console import Console

    with Console(stderr=True).status(label):
        yield


def _text(label: str | Callable[[], str]) -> str:
    return label if isinstance(label, str) else label()
