"""Values of options, parsed strictly: an invalid value is refused in one sentence that names the flag."""

import difflib
import math
import re
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Annotated, Any, Literal, TypeAlias

import tyro
from tyro.constructors import PrimitiveConstructorSpec

from nbs_pin.base.exceptions import NbsPinError
from nbs_pin.base.units import counted

_NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")
_INTEGER = re.compile(r"[0-9]+")
_LARGEST = 1e30  # torque of a disturbance [N·m, N]
SAVED = ".nbs"
"""File extension of saved controllers and models."""
Verbose: TypeAlias = Annotated[bool, tyro.conf.arg(aliases=["-v"])]
"""Whether to print tables below the verdict."""
DisturbanceKind: TypeAlias = Literal["constant", "square", "sine", "noise"]


class OptionError(NbsPinError):
    """An invalid option of the command line; not a ValueError, which tyro would reword."""


def number(
    flag: str, *, above: float = -math.inf, least: float = -math.inf, most: float, unit: str
) -> PrimitiveConstructorSpec[float]:
    """A tyro parser of a number in (above, most] or [least, most]; raises OptionError for any other text."""
    low = f"above {above:g}" if above > -math.inf else f"of at least {least:g}"

    def parse(words: list[str]) -> float:
        value = plain_number(words[0])
        if value is None or not (value > above and least <= value <= most):
            raise OptionError(f"{flag} is '{words[0]}'; give a number {low} and at most {most:g} {unit}.")
        return value

    return _spec("NUMBER", parse, "{:g}".format)


def percentage(flag: str, *, below: float) -> PrimitiveConstructorSpec[float]:
    """A tyro parser of a share in percent, as in 5%, in (0, below); raises OptionError for any other text."""

    def parse(words: list[str]) -> float:
        value = plain_number(words[0].removesuffix("%"))
        if value is None or not words[0].endswith("%") or not 0.0 < value < below:
            raise OptionError(f"{flag} is '{words[0]}'; give a percentage above 0 % and below {below:g} %: {flag} 5%.")
        return 0.01 * value

    return _spec("PERCENT", parse, lambda share: f"{100.0 * share:g}%")


def configuration(flag: str) -> PrimitiveConstructorSpec[str]:
    """A tyro parser of comma-separated numbers, kept as text for `plain_numbers`; raises OptionError for any other."""

    def parse(words: list[str]) -> str:
        if plain_numbers(words[0]) is None:
            raise OptionError(
                f"{flag} is '{words[0]}'; give one number per joint, separated by commas: {flag}=0.1,-0.2."
            )
        return words[0]

    return _spec("Q1,Q2,…", parse, str)


def couplings(flag: str) -> PrimitiveConstructorSpec[str]:
    """A tyro parser of auto, off, or entries of a matrix as in 6.5=1,5.4=-1; raises OptionError for any other text."""

    def parse(words: list[str]) -> str:
        entry = r"[1-9]\d?\.[1-9]\d?=[-+]?\d+(\.\d*)?"
        if words[0] not in ("auto", "off") and not re.fullmatch(rf"{entry}(,{entry})*", words[0]):
            raise OptionError(
                f"{flag} is '{words[0]}'; give auto, off, or how often a motor turns with another joint: {flag} 6.5=1."
            )
        return words[0]

    return _spec("auto|off|K.J=X,…", parse, str)


def positive_list(flag: str, most: float, unit: str) -> PrimitiveConstructorSpec[str]:
    """A tyro parser of comma-separated numbers in (0, most], kept as text for `plain_numbers`; raises OptionError."""

    def parse(words: list[str]) -> str:
        values = plain_numbers(words[0])
        if values is None or not all(0.0 < value <= most for value in values):
            raise OptionError(
                f"{flag} is '{words[0]}'; give numbers above 0 and at most {most:g} {unit}: {flag} 0.5,1."
            )
        return words[0]

    return _spec("W1,W2,…", parse, str)


def choice(flag: str, known: Collection[str], ending: str = "") -> PrimitiveConstructorSpec[str]:
    """A tyro parser of one of the names, or of a path with the ending; raises OptionError for any other text."""
    file = f" or a {ending} file" if ending else ""

    def parse(words: list[str]) -> str:
        if words[0] not in known and not (ending and words[0].endswith(ending)):
            near = difflib.get_close_matches(words[0], known, n=1)
            hint = f"did you mean {near[0]}? " if near else ""
            raise OptionError(f"{flag} is '{words[0]}'; {hint}give {', '.join(known)}{file}.")
        return words[0]

    return _spec(f"{{{','.join((*known, *([f'FILE{ending}'] if ending else [])))}}}", parse, str)


def choices(flag: str, known: Collection[str], ending: str = "") -> PrimitiveConstructorSpec[str]:
    """A tyro parser of one or several of what `choice` takes, different ones, separated by commas."""
    one = choice(flag, known, ending)

    def parse(words: list[str]) -> str:
        names = words[0].split(",")
        for name in names:
            one.instance_from_str([name])
        if len({*names}) < len(names):
            raise OptionError(f"{flag} is '{words[0]}', with one of them twice; give different ones.")
        return words[0]

    return _spec(f"{one.metavar}[,…]", parse, str)


def default(hint: str) -> Any:
    """The text of --help for an option whose default is computed later."""
    return tyro.conf.arg(help_behavior_hint=f"(default: {hint})")


def several_of(metavar: str) -> Any:
    """The name, in --help, of an argument that takes one path or several."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint="(one or several)")


def text(metavar: str, parse: Callable[[list[str]], str]) -> PrimitiveConstructorSpec[str]:
    """A tyro parser of a text that `parse` checks."""
    return _spec(metavar, parse, str)


def integer(flag: str, most: int, least: int = 0) -> PrimitiveConstructorSpec[int]:
    """A tyro parser of a whole number in [least, most]; raises OptionError for any other text."""

    def parse(words: list[str]) -> int:
        if not _INTEGER.fullmatch(words[0]) or not least <= int(words[0][:20]) <= most:
            raise OptionError(f"{flag} is '{words[0]}'; give a whole number from {least} to {most}.")
        return int(words[0])

    return _spec("INTEGER", parse, str)


def plain_number(text: str) -> float | None:
    """The finite number in plain ASCII digits, else None; float() would also accept nan, 1_0 and ٣."""
    value = float(text) if _NUMBER.fullmatch(text) else math.nan
    return value if math.isfinite(value) else None


def plain_numbers(text: str) -> list[float] | None:
    """The numbers of a comma-separated list, or None if one is not a plain number."""
    values = [plain_number(word) for word in text.split(",")]
    return None if None in values else [value for value in values if value is not None]


@dataclass(frozen=True)
class DisturbanceText:
    """A disturbance as typed: `none` or KIND:SIZE[,SIZE…][@FREQUENCY], sizes in [N·m], frequency in [rad/s]."""

    text: str
    kind: DisturbanceKind | Literal["none"]
    sizes: tuple[float, ...] = ()
    frequency: float = 0.0
    named: str = "--disturbance"
    """What a message calls it."""

    def build(self, nv: int, period: float, seed: int) -> Callable[..., Any] | None:
        """The torque on `nv` joints, noise held for `period` [s]; raises OptionError if the number of sizes differs."""
        from nbs_pin.motions.disturbances import ConstantTorque, SinusoidalTorque, SquareWave, TorqueNoise

        if len(self.sizes) not in (0, 1, nv):
            raise OptionError(
                f"{self.named} '{self.text}' has {len(self.sizes)} torques for {counted(nv, 'joint')}; give one or "
                "one per joint."
            )
        size = self.sizes[0] if len(self.sizes) == 1 else list(self.sizes)
        match self.kind:
            case "none":
                return None
            case "constant":
                return ConstantTorque(size)
            case "square":
                return SquareWave(size, self.frequency)
            case "sine":
                return SinusoidalTorque(size, self.frequency)
            case "noise":
                return TorqueNoise(size, period, seed)


def disturbance_text() -> PrimitiveConstructorSpec[str]:
    """A tyro parser of the text of a disturbance; raises OptionError if `parse_disturbance` cannot read it."""
    return _spec("TORQUE", lambda words: parse_disturbance(words[0]).text, str)


def parse_disturbance(text: str, named: str = "--disturbance") -> DisturbanceText:
    """Parse `none`, `constant:5`, `constant:5,5,3`, `square:5@8`, `sine:5@8` or `noise:0.5`; raises OptionError."""
    if text == "none":
        return DisturbanceText(text, "none", named=named)
    parts = re.fullmatch(r"(?:(constant|noise):([^@]+)|(square|sine):([^@]+)@(.+))", text)
    if parts:
        kind, listed, frequency = parts[1] or parts[3], parts[2] or parts[4], plain_number(parts[5] or "0")
        sizes = [plain_number(size) for size in listed.split(",")]
        usable = frequency is not None and (frequency > 0.0 or not parts[5])
        usable = usable and all(
            size is not None and abs(size) <= _LARGEST and (size >= 0.0 or kind != "noise") for size in sizes
        )
        if usable:
            return DisturbanceText(text, kind, tuple(sizes), frequency, named)  # type: ignore[arg-type]
    raise OptionError(
        f"{named} is '{text}'; give none, constant:5, square:5@8, sine:5@8 or noise:0.5 "
        "(N·m, or N where it slides, one for all joints or one per joint, separated by commas; "
        "@ frequency above 0 rad/s)."
    )


def _spec(metavar: str, parse: Any, show: Any) -> PrimitiveConstructorSpec[Any]:
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=metavar,
        instance_from_str=parse,
        is_instance=lambda value: True,
        str_from_instance=lambda value: ["" if value is None else show(value)],
    )
