"""What a run can be exported as and what of it, in words that the shell lists without loading anything."""

from pathlib import Path

from nbs_pin.base.doors import argument
from nbs_pin.base.exceptions import ArgumentError

KINDS = ("mcap", "csv")
"""Ends of the names of exported files."""
SIGNALS = ("states", "reference", "command", "error", "disturbance", "estimates", "external")
"""What can be exported of a run (`export_run`)."""


def kind_of(function: str, path: str | Path) -> str:
    """Which of `KINDS` the path is; raises ArgumentError, naming the function, for another."""
    kind = Path(path).suffix.lower().removeprefix(".")
    if kind not in KINDS:
        known = " or ".join(f".{kind}" for kind in KINDS)
        raise ArgumentError(f"{argument(function, 'path', path)} is '{path}'; give a file that ends in {known}.")
    return kind
