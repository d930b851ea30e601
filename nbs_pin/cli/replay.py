"""`nbs-pin replay`: a recorded run as a page for the browser."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from nbs_pin.cli.arm import ArmOptions, OfArm
from nbs_pin.cli.values import default, integer


@dataclass(frozen=True)
class Replay:
    """Write a recorded run as one page that plays in any browser without a network.

    Example: nbs-pin replay out/track-panda/run.npz --open
    """

    run_file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """A run.npz, the folder that contains one, or a .mcap or .csv file of nbs-pin export-run."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE"), default("replay.html beside the run")] = None
    """The page to write."""
    robot: Annotated[str | None, tyro.conf.arg(metavar="ROBOT"), default("the one the run names")] = None
    """The arm that ran, if its file has moved."""
    start: Annotated[int, integer("--start", most=10**6)] = 0
    """Which start of a batched run to show."""
    open: bool = False
    """Open the page in the browser."""
    force: bool = False
    """Overwrite the file that --out names."""
    arm: OfArm = field(default_factory=ArmOptions)
    """How the arm is read."""
