"""Options of every command that follows a motion: how a path of the tool is followed."""

from dataclasses import dataclass
from typing import Annotated, Any, Literal, TypeAlias

import tyro

from nbs_pin.cli.values import configuration, default, number, plain_numbers


@dataclass(frozen=True)
class ToolOptions:
    """How a path of the tool is followed."""

    frame: Annotated[str | None, tyro.conf.arg(metavar="LINK"), default("the arm's end")] = None
    """Link or joint that a path of the tool leads."""
    orientation: Annotated[
        Literal["hold", "free"] | None,
        tyro.conf.arg(metavar="{hold,free}"),
        default("hold, where six joints or more move the frame"),
    ] = None
    """Orientation of the frame along a path of the tool: that of the path or of its beginning, or any."""
    posture: Annotated[str | None, configuration("--posture"), default("one with room around it")] = None
    """Configuration in which a path of the tool begins and to which spare joints keep [rad]: --posture=0,-0.3,0.1."""
    fastest: bool = False
    """Follow the path of the tool in the least time that the limits of velocity, effort and --acceleration allow."""
    acceleration: Annotated[
        float | None, number("--acceleration", above=0.0, most=1e6, unit="rad/s²"), default("none besides effort")
    ] = None
    """Largest acceleration of every joint for --fastest [rad/s²]."""

    def given(self) -> dict[str, Any]:
        """The settings of `tool_motion` that were given."""
        settings = {
            "frame": self.frame,
            "orientation": self.orientation,
            "posture": None if self.posture is None else plain_numbers(self.posture),
            "fastest": self.fastest or None,
            "acceleration": self.acceleration,
        }
        return {name: value for name, value in settings.items() if value is not None}


OfTool: TypeAlias = Annotated[ToolOptions, tyro.conf.OmitArgPrefixes]
"""The type of the field `tool` of a command's options."""
