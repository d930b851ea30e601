"""Options of every command that reads logs: what a file calls its columns, their units, and what is to be put right."""

import re
from dataclasses import dataclass
from typing import Annotated, Any

import tyro
from tyro.constructors import PrimitiveConstructorSpec

from nbs_pin.cli.file_units import FileUnits
from nbs_pin.cli.values import OptionError, configuration, default, number, plain_numbers, text


def column_names() -> PrimitiveConstructorSpec[str]:
    """A tyro parser of names of columns, as in t=time,q=pos_*; raises OptionError for any other text."""

    def parse(words: list[str]) -> str:
        if not all(re.fullmatch(r"[^=,]+=[^=,]+", part) for part in words[0].split(",")):
            raise OptionError(
                f"--columns is '{words[0]}'; give what the file calls t, q, tau and others, as in "
                "--columns t=time,q=pos_*,tau=effort_*, or their numbers: --columns t=1,q=2-7,tau=8-13."
            )
        return words[0]

    return text("KIND=NAME,…", parse)


def whole_numbers(flag: str) -> PrimitiveConstructorSpec[str]:
    """A tyro parser of whole numbers and spans of them, as in 0-3,5; raises OptionError for any other text."""

    def parse(words: list[str]) -> str:
        spans = [re.fullmatch(r"(\d{1,6})(?:-(\d{1,6}))?", part) for part in words[0].split(",")]
        if not all(span is not None and int(span[1]) <= int(span[2] or span[1]) for span in spans):
            raise OptionError(f"{flag} is '{words[0]}'; give whole numbers, or spans of them: {flag} 0-3,5.")
        return words[0]

    return text("I,J-K,…", parse)


def numbers_of(typed: str) -> list[int]:
    """The numbers in what `whole_numbers` took."""
    spans = (part.partition("-") for part in typed.split(","))
    return [k for first, _, last in spans for k in range(int(first), int(last or first) + 1)]


@dataclass(frozen=True, kw_only=True)
class LogOptions(FileUnits):
    """How a log is read, where it is not t [s], q [rad] and tau [N·m] under these names."""

    columns: Annotated[str | None, column_names(), default("their usual names")] = None
    """What the file calls t, q, v, a, tau and trajectory: a name, one with * for the joints, or numbers from 1; - for
    none. Signals in files of their own: t=time.txt:1,q=angles.txt:1-6,tau=load.txt:1-6."""
    rate: Annotated[
        float | None, number("--rate", least=0.0, most=1e6, unit="Hz"), default("the times in the file")
    ] = None
    """Rows per second of a log without times [Hz]; 0 if its rows are single states in no order."""
    trajectories: Annotated[str | None, whole_numbers("--trajectories"), default("all")] = None
    """Numbers of the trajectories to read."""
    torque_gain: Annotated[
        str | None, configuration("--torque-gain"), tyro.conf.arg(metavar="K1,K2,…"), default("1")
    ] = None
    """What tau is multiplied by, one number or one per joint: gains of motor currents [N·m/A], or -1 for a sign."""
    gear: Annotated[str | None, configuration("--gear"), tyro.conf.arg(metavar="N1,N2,…"), default("1")] = None
    """Turns of the motor per turn of the joint, where angles and torques are those of the motors."""
    zero: Annotated[str | None, configuration("--zero"), tyro.conf.arg(metavar="Q1,Q2,…"), default("0")] = None
    """What is added to q, one number or one per joint, where zeros are not those of the arm's description [rad, m]."""
    delay: Annotated[float, number("--delay", least=-10.0, most=10.0, unit="s")] = 0.0
    """How late the torques are written, in comparison with q [s]."""
    resample: Annotated[
        float | None, number("--resample", least=1e-6, most=10.0, unit="s"), default("the usual step of uneven rows")
    ] = None
    """Time between rows to interpolate to [s]."""
    lowpass: Annotated[
        float | None, number("--lowpass", least=0.0, most=1e6, unit="Hz"), default("by the motion, if tau is noisy")
    ] = None
    """Cut-off frequency of a filter for q, v, a and tau [Hz]; 0 for none."""
    window: Annotated[
        float | None, number("--window", above=0.0, most=100.0, unit="s"), default("0.1, less after a filter")
    ] = None
    """Width of the window in which a log without v and a is differentiated [s]."""
    prismatic: Annotated[str | None, whole_numbers("--prismatic"), default("those of the arm")] = None
    """1 for each joint that slides and 0 for each other, where no arm is given."""

    def read(self) -> dict[str, Any]:
        """The arguments of `load_log`; raises OptionError for both units of angles."""
        found: dict[str, Any] = {
            name: getattr(self, name) for name in ("rate", "resample", "lowpass", "window") if getattr(self, name)
        }
        found |= {name: 0.0 for name in ("lowpass", "rate") if getattr(self, name) == 0.0}
        if self.columns is not None:
            found["columns"] = dict(part.split("=") for part in self.columns.split(","))
        if self.trajectories is not None:
            found["trajectories"] = numbers_of(self.trajectories)
        if self.prismatic is not None:
            found["prismatic"] = [bool(k) for k in numbers_of(self.prismatic)]
        for name in ("torque_gain", "gear", "zero"):
            values = plain_numbers(getattr(self, name) or "")
            if getattr(self, name) is not None and values is not None:
                found[name] = values[0] if len(values) == 1 else values
        return self.units() | found | {"delay": self.delay}
