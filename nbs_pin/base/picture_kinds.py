"""Whether pictures are written as SVG too, which the shell asks for with --svg."""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

_TOO: ContextVar[bool] = ContextVar("svg_too", default=False)


@contextmanager
def svg_too(wanted: bool) -> Iterator[None]:
    """Whether every PNG that is drawn in the block is drawn as SVG beside it too."""
    token = _TOO.set(wanted)
    try:
        yield
    finally:
        _TOO.reset(token)


def is_svg_wanted() -> bool:
    """Whether the block is one of `svg_too`."""
    return _TOO.get()


def svg_beside(picture: str | Path) -> Path:
    """Where the SVG of a PNG lies."""
    return Path(picture).with_suffix(".svg")
