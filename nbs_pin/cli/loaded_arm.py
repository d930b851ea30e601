"""Options of an arm in the commands that simulate it in time, where a load may appear and go again."""

from dataclasses import dataclass
from typing import Annotated, Any, TypeAlias

import tyro

from nbs_pin.cli.arm import ArmOptions
from nbs_pin.cli.payloads import TimedLoad, read_payload_or_timed
from nbs_pin.cli.values import text


def _parse(words: list[str]) -> str:
    read_payload_or_timed(words[0])
    return words[0]


@dataclass(frozen=True)
class LoadedArmOptions(ArmOptions):
    """How the description of an arm is read where it leaves something open, and what it is loaded with meanwhile."""

    payload: tyro.conf.UseAppendAction[tuple[Annotated[str, text("MASS@LINK:X,Y,Z@TIME-TIME", _parse)], ...]] = ()
    """Load [kg] at a link, with its centre of mass in the link's frame [m]: --payload 2@flange:0,0,0.05; no link is the
    last one, no centre its origin; may be given several times. With times [s] it appears in the plant then, and the law
    does not know of it: --payload 2@5, or --payload 2@5-12 to take it off again."""

    def loads(self) -> tuple[TimedLoad, ...]:
        """The loads that appear during the run."""
        return tuple(load for load in map(read_payload_or_timed, self.payload) if load is not None)

    def given(self) -> dict[str, Any]:
        """The arguments of `load_robot` that were given: those of the arm that law and checks believe in."""
        timed = {load.words for load in self.loads()}
        known = tuple(words for words in self.payload if words not in timed)
        return ArmOptions(**(vars(self) | {"payload": known})).given()


OfLoadedArm: TypeAlias = Annotated[LoadedArmOptions, tyro.conf.OmitArgPrefixes]
"""The type of the field `arm` of a command's options."""
