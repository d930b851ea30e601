"""`nbs-pin log`: what a log of an arm is, and what is wrong with it."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from nbs_pin.cli.arm import ArmOptions, OfArm
from nbs_pin.cli.log_options import LogOptions
from nbs_pin.cli.values import Verbose, default, several_of


@dataclass(frozen=True)
class Log(LogOptions):
    """Show what a log of an arm is: rows, rate, gaps, ranges, what was put right, and what the arm's masses doubt.

    With --out it is written as data that every command takes, resampled and repaired.

    Example: nbs-pin log measured.csv --robot ur10e --out clean.npz
    """

    data: Annotated[tuple[Path, ...], tyro.conf.Positional, several_of("FILE")]
    """Logs with t, q, tau, perhaps v and a: .csv, .txt, .tsv, .dat (also .gz), .npz, .mat, .db3, .mcap, .bag of ROS."""
    robot: Annotated[str | None, tyro.conf.arg(metavar="ROBOT"), default("none")] = None
    """The arm by name or a path to a .urdf, .xacro or MJCF file; without it, units and signs are not questioned."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="DATA.npz"), default("nothing is written")] = None
    """Write the data to this file."""
    force: bool = False
    """Overwrite that file."""
    verbose: Verbose = False
    """Also print a table of the joints."""
    arm: OfArm = field(default_factory=ArmOptions)
    """How the arm is read."""
