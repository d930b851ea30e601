"""Options of every command that loads an arm: what `load_robot` can do."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, Literal, TypeAlias

import tyro

from nbs_pin.cli.payloads import read_payload
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


def _read_by_joint(flag: str) -> Callable[[str], float | dict[str, float]]:
    """A reader of one number for every joint, or of numbers by joint."""

    def read(words: str) -> float | dict[str, float]:
        found: dict[str, float] = {}
        for word in words.split(","):
            joint, stated, number = word.rpartition("=")
            value = plain_number(number)
            if value is None or value < 0.0 or bool(joint) != bool(stated) or (not joint and "," in words):
                raise OptionError(
                    f"{flag} is '{words}'; give one number at least 0 for every joint, or JOINT=NUMBER for some: "
                    f"{flag} shoulder=0.2,elbow=0.1."
                )
            if not joint:
                return value
            found[joint] = value
        return found

    return read


def _read_tool(words: str) -> dict[str, Any]:
    """The file and the link of FILE or FILE@LINK."""
    file, _, link = words.rpartition("@") if "@" in words else (words, "", "")
    if not file:
        raise OptionError(f"--tool is '{words}'; give FILE or FILE@LINK: --tool gripper.urdf@flange.")
    return {"file": file, "frame": link}


def _read_three(flag: str) -> Callable[[str], list[float]]:
    def read(words: str) -> list[float]:
        values = plain_numbers(words)
        if values is None or len(values) != 3:
            raise OptionError(f"{flag} is '{words}'; give three numbers: {flag}=3.1416,0,0.")
        return values

    return read


_FLAGS_BY_JOINT = ("armature", "rotor-inertia", "viscous-friction", "coulomb-friction")
_READ_BY_JOINT = {flag: _read_by_joint(f"--{flag}") for flag in _FLAGS_BY_JOINT}
_READ_RPY, _READ_XYZ = _read_three("--base-rpy"), _read_three("--base-xyz")


def _checked(read: Callable[[str], Any]) -> Callable[[list[str]], str]:
    def parse(words: list[str]) -> str:
        read(words[0])
        return words[0]

    return parse


def _by_joint(flag: str) -> Any:
    return text("X or J1=X,…", _checked(_READ_BY_JOINT[flag]))


@dataclass(frozen=True)
class ArmOptions:
    """How the description of an arm is read where it leaves something open."""

    lock: Annotated[
        tyro.conf.UseAppendAction[tuple[Annotated[str, text("J1,J2=POSITION,…", _checked(_read_lock))], ...]],
        default("none"),
    ] = ()
    """Joints to fix besides those that the catalogue fixes, at 0 or at a position [rad, m]:
    --lock finger_left,finger_right=0.02; may be repeated."""
    zero_limits: Annotated[
        Literal["refuse", "unlimited"] | None,
        tyro.conf.arg(metavar="{refuse,unlimited}"),
        default("as is known of the arm, else refuse"),
    ] = None
    """Limits that are left out, not above 0, or an empty range at 0: refuse them, or read them as no limit."""
    limits: Annotated[
        tyro.conf.UseAppendAction[tuple[Annotated[str, text("J1.LIMIT=VALUE,…", _checked(_read_limits))], ...]],
        default("the file's"),
    ] = ()
    """Limits in place of the file's, * for every joint, inf for none: --limits elbow.effort=50,*.velocity=2; may be
    repeated."""
    repair: bool = False
    """Take the nearest inertia of a rigid body where the file states one that no body has."""
    inertia_from: Literal["file", "shapes", "links"] = "file"
    """Inertia of bodies without mass: shapes fills their shapes with 1000 kg/m³, a guess. links takes the geometry of
    the file alone, with balls for bodies that are to be learned."""
    arg: tyro.conf.UseAppendAction[tuple[Annotated[str, text("NAME:=VALUE", _checked(_read_argument))], ...]] = ()
    """Argument of a .xacro file; may be given several times."""
    package_dir: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="DIR")] = ()
    """Folder with ROS packages that the file refers to; may be given several times."""
    gravity: Annotated[str | None, text("G or X,Y,Z", _checked(_read_gravity)), default("9.81, or the arm's own")] = (
        None
    )
    """Gravity [m/s²], downward or as a vector in the frame of the world: --gravity 1.62 on the moon."""

    armature: Annotated[str | None, _by_joint("armature"), default("the file's")] = None
    """Rotor inertia as the joints feel it [kg·m², kg]: --armature 0.1, or --armature shoulder=0.2,elbow=0.1."""
    rotor_inertia: Annotated[str | None, _by_joint("rotor-inertia"), default("the file's")] = None
    """Inertia of the rotors themselves [kg·m²]; joints feel it times the squared reduction of their transmission."""
    viscous_friction: Annotated[str | None, _by_joint("viscous-friction"), default("the file's")] = None
    """Viscous joint friction [N·m·s/rad, N·s/m], of every joint or by joint."""
    coulomb_friction: Annotated[str | None, _by_joint("coulomb-friction"), default("the file's")] = None
    """Coulomb joint friction [N·m, N], of every joint or by joint."""
    payload: tyro.conf.UseAppendAction[tuple[Annotated[str, text("MASS@LINK:X,Y,Z", _checked(read_payload))], ...]] = ()
    """Load [kg] at a link, with its centre of mass in the link's frame [m]: --payload 2@flange:0,0,0.05; no link is the
    last one, no centre its origin; may be given several times."""
    tool: Annotated[str | None, text("FILE@LINK", _checked(_read_tool))] = None
    """Description of a tool to fix to a link, to the last one where none is named: --tool gripper.urdf@flange."""
    base_rpy: Annotated[str | None, text("R,P,Y", _checked(_READ_RPY))] = None
    """Roll, pitch and yaw of the base in the world [rad]: --base-rpy=3.1416,0,0 hangs the arm from the ceiling."""
    base_xyz: Annotated[str | None, text("X,Y,Z", _checked(_READ_XYZ))] = None
    """Position of the base in the world [m]."""

    def refuse_without_arm(self, remedy: str) -> None:
        """Raise OptionError if any of them was given to a command that loads no arm."""
        if self.given():
            flags = " and ".join(f"--{_FLAGS.get(name, name).replace('_', '-')}" for name in self.given())
            raise OptionError(f"{flags} was given, but no arm is loaded here; {remedy}.")

    def typed(self) -> list[str]:
        """The options that were given, as words of the shell."""
        words = []
        for name, value in vars(self).items():
            flag = f"--{name.replace('_', '-')}"
            if value is True:
                words.append(flag)
            elif value != type(self).__dataclass_fields__[name].default:
                words += [f"{flag}={item}" for item in (value if isinstance(value, tuple) else (value,))]
        return words

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
            "payload": dict(map(read_payload, self.payload)) or None,
            "tool": None if self.tool is None else _read_tool(self.tool),
            "base_rpy": None if self.base_rpy is None else _READ_RPY(self.base_rpy),
            "base_xyz": None if self.base_xyz is None else _READ_XYZ(self.base_xyz),
        }
        for flag, read in _READ_BY_JOINT.items():
            words = getattr(self, flag.replace("-", "_"))
            given[flag.replace("-", "_")] = None if words is None else read(words)
        return {name: value for name, value in given.items() if value is not None}


OfArm: TypeAlias = Annotated[ArmOptions, tyro.conf.OmitArgPrefixes]
"""The type of the field `arm` of a command's options."""
