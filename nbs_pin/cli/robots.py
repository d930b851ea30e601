"""`nbs-pin robots`: the arms known by name, or what is known of one arm."""

from dataclasses import dataclass, field
from typing import Annotated

import tyro

from nbs_pin.cli.arm import ArmOptions, OfArm
from nbs_pin.cli.values import default


@dataclass(frozen=True)
class Robots:
    """List the arms known by name and the files that are accepted, or the joints and links of one arm.

    Example: nbs-pin robots
    """

    robot: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="ROBOT"), default("all")] = None
    """The arm to describe: a name, or the path of a description; without it, all arms are listed."""
    arm: OfArm = field(default_factory=ArmOptions)
    """How the arm is read."""
