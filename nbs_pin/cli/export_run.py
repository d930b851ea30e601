"""`nbs-pin export-run`: a recorded run for the tools that others have."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from nbs_pin.base.exports import KINDS, SIGNALS
from nbs_pin.cli.arm import ArmOptions, OfArm
from nbs_pin.cli.values import choice, choices, default, integer


@dataclass(frozen=True)
class ExportRun:
    """Write a recorded run for Foxglove, PlotJuggler, Rerun and ROS 2 (mcap) or as a table (csv).

    nbs-pin log, learn and replay read both.

    Example: nbs-pin export-run out/track-panda --to csv --signals states,error
    """

    run_file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """A run.npz, or the folder that contains one."""
    to: Annotated[str, choice("--to", KINDS)] = "mcap"
    """The kind of file: mcap has messages of ROS 2, with the arm, and needs the extra logs; csv has columns."""
    signals: Annotated[str | None, choices("--signals", SIGNALS), default("what cannot be computed from the rest")] = (
        None
    )
    """What to write: states (q, v, tau), the reference, the command (torque before the limits), errors, the
    disturbance, estimates of a law that adapts, the external torque that a momentum observer sees."""
    monitored: Annotated[Path | None, tyro.conf.arg(metavar="DIR"), default("none")] = None
    """Folder of nbs-pin certify --monitor RUN, whose V and bound are written too."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE"), default("beside the run, with its name")] = None
    """The file to write."""
    robot: Annotated[str | None, tyro.conf.arg(metavar="ROBOT"), default("the one the run names")] = None
    """The arm that ran, if its file has moved."""
    start: Annotated[int, integer("--start", most=10**6)] = 0
    """Which start of a batched run to write."""
    force: bool = False
    """Overwrite the file that --out names."""
    arm: OfArm = field(default_factory=ArmOptions)
    """How the arm is read."""
