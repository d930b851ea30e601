"""Options of every command that loads an arm: what `load_robot` can do."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, Literal, TypeAlias

import tyro

from nbs_pin.cli.values import OptionError, default, plain_number, plain_numbers, text

_FLAGS = {"xacro_args": "arg", "package_dirs": "package-dir"}
_LIMITS = ("lower", "upper", "effort", "velocity")


def _read_lock(words: str) -> dict[str, float]:
    """The joints in the text NAME[=POSITION],… and where to lock them."""
    locked = {}
    for word in words.split(","):
        name, stated, place = word.partition("=")
        value = plain_number(place) if stated else 0.0
        if not name or value is None:
            raise OptionError(
                f"--lock is '{words}'; give joints, at 0 or where stated: --lock finger_left,finger_right=0.02."
            )
        locked[name] = value
    return locked


def _read_limits(words: str) -> dict[str, dict[str, float | None]]:
    """The limits of JOINT.LIMIT=VALUE,…; inf is no limit."""
    limits: dict[str, dict[str, float | None]] = {}
    for word in words.split(","):
        named, _, number = word.partition("=")
        joint, _, key = named.rpartition(".")
        value = None if number == "inf" else plain_number(number)
        small = value is not None and value <= 0.0 and key in ("effort", "velocity")
        if not joint or key not in _LIMITS or (value is None and number != "inf") or small:
            raise OptionError(
                f"--limits is '{words}'; give JOINT.LIMIT=VALUE with one of {', '.join(_LIMITS)}, effort and velocity "
                "above 0, * for every joint, inf for none: --limits elbow.effort=50,*.velocity=2."
            )
        limits.setdefault(joint, {})[key] = value
    return limits


def _read_argument(words: str) -> tuple[str, str]:
    name, stated, value = words.partition(":=")
    if not name or not stated:
        raise OptionError(
            f"--arg is '{words}'; give the name of an argument of the xacro file and its value: --arg name:=ur5e."
        )
    return name, value


def _read_gravity(words: str) -> float | list[float]:
    values = plain_numbers(words)
    if values is None or len(values) not in (1, 3):
        raise OptionError(
            f"--gravity is '{words}'; give the downward acceleration or a vector: --gravity=0,0,-9.81 [m/s²]."
        )
    return values if len(values) == 3 else values[0]


def _checked(read: Callable[[str], Any]) -> Callable[[list[str]], str]:
    def parse(words: list[str]) -> str:
        read(words[0])
        return words[0]

    return parse


@dataclass(frozen=True)
class ArmOptions:
    """How the description of an arm is read where it leaves something open."""

    lock: Annotated[
        tyro.conf.UseAppendAction[tuple[Annotated[str, text("J1,J2=POSITION,…", _checked(_read_lock))], ...]],
        default("none"),
    ] = ()
    """Joints to fix besides those that the catalogue fixes, at 0 or at a position [rad, m]:
    --lock finger_left,finger_right=0.02; may be repeated."""
    zero_limits: Literal["refuse", "unlimited"] | None = None
    """Limits that are left out, not above 0, or an empty range at 0: refuse them, or read them as no limit."""
    limits: Annotated[
        tyro.conf.UseAppendAction[tuple[Annotated[str, text("J1.LIMIT=VALUE,…", _checked(_read_limits))], ...]],
        default("the file's"),
    ] = ()
    """Limits in place of the file's, * for every joint, inf for none: --limits elbow.effort=50,*.velocity=2; may be
    repeated."""
    repair: bool = False
    """Take the nearest inertia of a rigid body where the file states one that no body has."""
    inertia_from: Literal["file", "shapes"] = "file"
    """Inertia of bodies without mass: shapes fills their shapes with 1000 kg/m³, a guess."""
    arg: tyro.conf.UseAppendAction[tuple[Annotated[str, text("NAME:=VALUE", _checked(_read_argument))], ...]] = ()
    """Argument of a .xacro file; may be given several times."""
    package_dir: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="DIR")] = ()
    """Folder with ROS packages that the file refers to; may be given several times."""
    gravity: Annotated[str | None, text("G or X,Y,Z", _checked(_read_gravity)), default("9.81, or the arm's own")] = (
        None
    )
    """Gravity [m/s²], downward or as a vector in the base frame: --gravity=0,0,9.81 for an arm on the ceiling."""

    def refuse_without_arm(self, remedy: str) -> None:
        """Raise OptionError if any of them was given to a command that loads no arm."""
        if self.given():
            flags = " and ".join(f"--{_FLAGS.get(name, name).replace('_', '-')}" for name in self.given())
            raise OptionError(f"{flags} was given, but no arm is loaded here; {remedy}.")

    def given(self) -> dict[str, Any]:
        """The arguments of `load_robot` that were given."""
        given = {
            "lock": _read_lock(",".join(self.lock)) if self.lock else None,
            "zero_limits": self.zero_limits,
            "limits": _read_limits(",".join(self.limits)) if self.limits else None,
            "repair": self.repair or None,
            "inertia_from": None if self.inertia_from == "file" else self.inertia_from,
            "xacro_args": dict(map(_read_argument, self.arg)) or None,
            "package_dirs": list(self.package_dir) or None,
            "gravity": None if self.gravity is None else _read_gravity(self.gravity),
        }
        return {name: value for name, value in given.items() if value is not None}


OfArm: TypeAlias = Annotated[ArmOptions, tyro.conf.OmitArgPrefixes]
"""The type of the field `arm` of a command's options."""
