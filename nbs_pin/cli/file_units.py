"""Options of every command that reads recorded motions: the units of the file."""

from dataclasses import dataclass
from typing import Any, Literal

from nbs_pin.cli.values import OptionError


@dataclass(frozen=True, kw_only=True)
class FileUnits:
    """Units of a file with a motion, where they are not seconds and radians."""

    time_unit: Literal["s", "ms", "us", "ns"] | None = None
    """Unit of the times in the file; without it they are seconds, and refused if they look otherwise."""
    degrees: bool = False
    """Angles in the file are in degrees."""
    radians: bool = False
    """Angles in the file are in radians, even if they look like degrees."""

    def units(self) -> dict[str, Any]:
        """The arguments of `load_reference` and `load_log`; raises OptionError for both units of angles."""
        if self.degrees and self.radians:
            raise OptionError("--degrees and --radians were both given; choose one.")
        return {"time_unit": self.time_unit, "degrees": True if self.degrees else False if self.radians else None}
