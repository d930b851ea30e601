"""Options of every command that reads recorded motions: the units of the file."""

from dataclasses import dataclass
from typing import Annotated, Any, Literal

import tyro

from nbs_pin.cli.values import OptionError, default


@dataclass(frozen=True, kw_only=True)
class FileUnits:
    """Units of a file with a motion, where they are not seconds and radians."""

    time_unit: Annotated[Literal["s", "ms", "us", "ns"] | None, tyro.conf.arg(metavar="{s,ms,us,ns}"), default("s")] = (
        None
    )
    """Unit of the times in the file; without it they are refused if they do not look like seconds."""
    degrees: bool = False
    """Angles in the file are in degrees."""
    radians: bool = False
    """Angles in the file are in radians, even if they look like degrees."""

    def units(self) -> dict[str, Any]:
        """The arguments of `load_reference` and `load_log`; raises OptionError for both units of angles."""
        if self.degrees and self.radians:
            raise OptionError("--degrees and --radians were both given; choose one.")
        return {"time_unit": self.time_unit, "degrees": True if self.degrees else False if self.radians else None}
