"""`nbs-pin bench`: run times of laws and plants on this machine."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from nbs_pin.cli.reported import Reported
from nbs_pin.cli.values import Verbose, default, integer


@dataclass(frozen=True)
class Bench(Reported):
    """Time every law on the given arms, steps of the plants, and the cost against the number of joints.

    Example: nbs-pin bench --arms panda ur5 --out out/bench --compare old/summary.json
    """

    arms: Annotated[tuple[str, ...], tyro.conf.arg(metavar="ROBOT")] = ("two_link", "panda", "ur5")
    """Arms by name or path."""
    calls: Annotated[int, integer("--calls", most=10_000_000)] = 20_000
    """Number of timed calls of each law."""
    long: bool = False
    """Also time an hour of motion and a thousand starts, which takes a few minutes."""
    compare: Annotated[Path | None, tyro.conf.arg(metavar="SUMMARY"), default("none")] = None
    """summary.json of an earlier bench; print the figures that changed by more than 10 %."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")] = Path("out/bench")
    """Folder for summary.json and joints.png."""
    verbose: Verbose = False
    """Also print every row; summary.json always has every number."""
