"""`nbs-pin bench`: what the laws and plants cost on this machine."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from nbs_pin.cli.values import integer


@dataclass(frozen=True)
class Bench:
    """Time every law on arms of your choice, plant steps, and cost against the number of joints.

    Example: nbs-pin bench --arms panda ur5 --out out/bench --compare old/summary.json
    """

    arms: Annotated[tuple[str, ...], tyro.conf.arg(metavar="ROBOT")] = ("two_link", "panda", "ur5")
    """Arms by name or path."""
    calls: Annotated[int, integer("--calls", most=10_000_000)] = 20_000
    """How often each control step is timed."""
    long: bool = False
    """Also an hour of motion and a thousand starts; a few minutes."""
    compare: Annotated[Path | None, tyro.conf.arg(metavar="SUMMARY")] = None
    """summary.json of an earlier bench: also print what moved by more than a tenth."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")] = Path("out/bench")
    """Folder for summary.json and joints.png."""
