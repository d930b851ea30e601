"""What `--payload` means: a load that the arm always carries, or one that appears in the plant during a run."""

import re
from dataclasses import dataclass
from typing import Any

from nbs_pin.cli.values import OptionError, plain_number, plain_numbers

_NUMBER = r"(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?"
_TIMES = re.compile(rf"({_NUMBER})(?:-({_NUMBER}))?")
_MEANT = re.compile(rf"[+-]?(?:{_NUMBER}|nan|inf)(?:-[+-]?(?:{_NUMBER}|nan|inf)?)?", re.IGNORECASE)
"""What can only be meant as times, right or wrong: a link of such a name is given with its centre, as in 2@5:0,0,0."""


@dataclass(frozen=True)
class TimedLoad:
    """A load that the plant carries from one time on, and maybe up to another, and that the law knows nothing of."""

    words: str
    """As it was typed."""
    link: str
    """The link that carries it; the last one if empty."""
    mass: float
    """Mass [kg]."""
    com: tuple[float, float, float]
    """Centre of mass in the frame of the link [m]."""
    begin: float
    """When it appears [s]."""
    end: float | None
    """When it is gone again [s]; None if it stays."""

    def acts_at(self, t: float) -> bool:
        """Whether the arm carries it at time t [s]."""
        return self.begin <= t and (self.end is None or t < self.end)

    def told(self) -> dict[str, Any]:
        """What summaries and runs keep of it."""
        place = {"link": self.link, "com_m": list(self.com)}
        return {"mass_kg": self.mass, **place, "from_s": self.begin, "until_s": self.end}


def read_payload(words: str) -> tuple[str, dict[str, Any]]:
    """The link and the load of MASS, MASS@LINK or MASS@LINK:X,Y,Z; raises OptionError, also for one with times."""
    load, times = _split(words)
    if times:
        raise OptionError(
            f"--payload is '{words}', a load that appears during a run, which only nbs-pin track and nbs-pin run "
            f"simulate; give --payload {load} for one that the arm carries all the time."
        )
    return _read_load(words, words)


def read_payload_or_timed(words: str) -> TimedLoad | None:
    """The load of MASS@…@BEGIN or MASS@…@BEGIN-END, None for one without times; raises OptionError for neither."""
    load, times = _split(words)
    link, given = _read_load(load, words, timed=bool(times))
    if not times:
        return None
    found = _TIMES.fullmatch(times)
    begin, end = (plain_number(text) if text else None for text in (found.groups() if found else (None, None)))
    if begin is None or begin <= 0.0 or (found is not None and found[2] and (end is None or end <= begin)):
        raise OptionError(
            f"--payload is '{words}'; give the time at which the load appears, above 0 s, and if it goes again a later "
            f"one: --payload {load}@5 or --payload {load}@5-12."
        )
    x, y, z = given["com"]
    return TimedLoad(words, link, given["mass"], (x, y, z), begin, end)


def _split(words: str) -> tuple[str, str]:
    """The load, and what follows its last @ if that can only be meant as times."""
    load, _, last = words.rpartition("@")
    return (load, last) if _MEANT.fullmatch(last) and "@" in words else (words, "")


def _read_load(load: str, words: str, *, timed: bool = False) -> tuple[str, dict[str, Any]]:
    mass, _, where = load.partition("@")
    link, _, at = where.partition(":")
    kilograms, com = plain_number(mass), plain_numbers(at) if at else [0.0, 0.0, 0.0]
    twice = timed and _MEANT.fullmatch(where)
    if kilograms is None or kilograms <= 0.0 or com is None or len(com) != 3 or twice:
        raise OptionError(
            f"--payload is '{words}'; give MASS [kg], MASS@LINK, or with its centre of mass in the frame of the link "
            f"[m]: --payload 2@flange:0,0,0.05{', and times once, at the end' if timed else ''}."
        )
    return link, {"mass": kilograms, "com": com}
