"""Options of the commands that follow a motion: which one, and for how long."""

from dataclasses import dataclass
from typing import Annotated

import tyro

from nbs_pin.cli.file_units import FileUnits
from nbs_pin.cli.values import default, number


@dataclass(frozen=True, kw_only=True)
class Followed(FileUnits):
    """The motion to follow."""

    reference: Annotated[str, tyro.conf.arg(metavar="MOTION")] = "sinusoid"
    """Motion to follow: sinusoid (fitted to the arm), paper, or a .csv or .npz file with t and the joints.
    Paths of the tool: circle:RADIUS[@PLANE], line:DX,DY,DZ [m], or a .csv or .npz file with x, y, z."""
    frequency: Annotated[float, number("--frequency", above=0.0, most=1000.0, unit="rad/s")] = 1.0
    """Frequency of the sinusoid [rad/s]."""
    duration: Annotated[
        float | None,
        number("--duration", above=0.0, most=100_000.0, unit="s"),
        default("10, 5 for a path of the tool, or the file's"),
    ] = None
    """How long the arm moves, a whole number of periods [s]; a path of the tool takes all of it."""
