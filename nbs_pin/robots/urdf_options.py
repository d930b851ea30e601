"""How a description is read where it leaves something open: locked joints, limits, packages, inertias."""

import math
import warnings
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from numbers import Real
from pathlib import Path
from typing import Any, Literal, TypeAlias, get_args

import numpy as np

from nbs_pin.base.checks import floats, is_usual
from nbs_pin.base.exceptions import ArgumentError

ZeroLimits: TypeAlias = Literal["refuse", "unlimited"]
"""How to treat limits that are left out, an effort or velocity that is not > 0 and an empty range at zero."""
ZERO_LIMITS: tuple[ZeroLimits, ...] = get_args(ZeroLimits)
InertiaFrom: TypeAlias = Literal["file", "shapes", "links"]
"""Whether bodies without mass are refused, or filled with material; or whether all bodies are balls along the links."""
INERTIA_FROM: tuple[InertiaFrom, ...] = get_args(InertiaFrom)
DRIVE = ("armature", "rotor_inertia", "viscous_friction", "coulomb_friction")
"""Arguments with a number ≥ 0 by joint."""
LARGEST_DRIVE = 1e9
"""Largest coefficient of friction and rotor inertia that a joint can have [SI]."""
LIMITS = ("lower", "upper", "effort", "velocity")
ALL = "*"
"""Stands for every joint in `limits` and in what `DRIVE` names."""


@dataclass(frozen=True)
class Payload:
    """A load fixed to a link."""

    mass: float
    """Mass [kg]."""
    com: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Centre of mass in the frame of the link [m]."""
    inertia: tuple[float, ...] = (0.0,) * 6
    """Ixx, Ixy, Ixz, Iyy, Iyz, Izz about the centre of mass in the directions of the link's frame [kg·m²]."""


@dataclass(frozen=True)
class Tool:
    """The description of a tool, and where its base is fixed."""

    file: Path
    frame: str = ""
    """The link that carries it, the arm's only last link if empty."""
    xyz: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rpy: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Placement of the tool's base in that link's frame [m, rad]."""


@dataclass(frozen=True)
class UrdfOptions:
    """Arguments of `load_robot` about the file; see there."""

    lock: Mapping[str, float] = field(default_factory=dict)
    """Joints to fix, and where [rad, m]."""
    zero_limits: ZeroLimits = "refuse"
    limits: Mapping[str, Mapping[str, float | None]] = field(default_factory=dict)
    """Limits in place of those of the file, by joint or `ALL`; None for no limit."""
    repair: bool = False
    inertia_from: InertiaFrom = "file"
    xacro_args: Mapping[str, str] = field(default_factory=dict)
    package_dirs: tuple[Path, ...] = ()
    armature: Mapping[str, float] = field(default_factory=dict)
    rotor_inertia: Mapping[str, float] = field(default_factory=dict)
    viscous_friction: Mapping[str, float] = field(default_factory=dict)
    coulomb_friction: Mapping[str, float] = field(default_factory=dict)
    payload: Mapping[str, Payload] = field(default_factory=dict)
    """Loads by the link that carries them."""
    tool: Tool | None = None
    base_rpy: tuple[float, float, float] = (0.0, 0.0, 0.0)
    base_xyz: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """How the base is mounted in the world [rad, m]."""

    def drive(self, joint: str, key: str) -> float | None:
        """What one of `DRIVE` gives for a joint; None if it gives nothing."""
        given: Mapping[str, float] = getattr(self, key)
        return given.get(joint, given.get(ALL))

    def limit(self, joint: str, key: str) -> float | None:
        """The limit that was given for a joint, inf for none; None if none was given."""
        for name in (joint, ALL):
            given = self.limits.get(name, {})
            if key in given:
                value = given[key]
                none = -math.inf if key == "lower" else math.inf
                return none if value is None else float(value)
        return None

    def stored(self) -> dict[str, Any]:
        """The options as JSON can store them and `load_robot` takes them."""
        at_zero = not any(self.lock.values())
        return {
            "lock": list(self.lock) if at_zero else dict(self.lock),
            "zero_limits": self.zero_limits,
            "limits": {joint: dict(limits) for joint, limits in self.limits.items()},
            "repair": self.repair,
            "inertia_from": self.inertia_from,
            "xacro_args": dict(self.xacro_args),
            "package_dirs": [str(folder) for folder in self.package_dirs],
            **{key: _for_all(getattr(self, key)) for key in DRIVE},
            "payload": {frame: _plain(payload) for frame, payload in self.payload.items()},
            "tool": None if self.tool is None else _plain(self.tool),
            "base_rpy": list(self.base_rpy),
            "base_xyz": list(self.base_xyz),
        }


def layered(under: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments of `load_robot` with others over them.

    What is given by joint, link or name is added to what lies under it and comes before it, an empty list or dict
    clears that, and everything else takes its place: a single number for all joints too. What is given for every joint
    ("*") comes before what lies under it for one.

    Raises:
        ArgumentError: If one that is added is of another type or out of range.
    """
    merged = {name: value for name, value in {**under, **over}.items() if value is not None}
    for name in _ADDED:
        if under.get(name) is None or over.get(name) is None or (name in DRIVE and _number(over[name])):
            continue
        convert: Callable[[Any], dict[str, Any]] = partial(_by_joint, name) if name in DRIVE else _CONVERT[name]
        lower, upper = convert(under[name]), convert(over[name])
        if name == "limits":
            every = upper.get(ALL, {}).keys()
            lower = {joint: {k: x for k, x in limits.items() if k not in every} for joint, limits in lower.items()}
            upper = {joint: {**lower.get(joint, {}), **limits} for joint, limits in upper.items()}
        elif name in DRIVE and ALL in upper:
            lower = {}
        merged[name] = {**lower, **upper} if upper else {}
    return merged


def read_options(told: Mapping[str, Any]) -> UrdfOptions:
    """The options from arguments of `load_robot`, those left out or None at their defaults.

    Raises:
        ArgumentError: If one is of another type or out of range.
    """
    given = {name: value for name, value in told.items() if value is not None}
    for name, known in (("zero_limits", ZERO_LIMITS), ("inertia_from", INERTIA_FROM)):
        if not isinstance(given.get(name, known[0]), str) or given.get(name, known[0]) not in known:
            raise ArgumentError(f"{name} is {given[name]!r}; give {' or '.join(map(repr, known))}.")
    if not isinstance(given.get("repair", False), bool):
        raise ArgumentError(f"repair is {given['repair']!r}; give True or False.")
    for name, convert in _CONVERT.items():
        if name in given:
            given[name] = convert(given[name])
    given |= {name: _by_joint(name, given[name]) for name in DRIVE if name in given}
    return UrdfOptions(**given)


def _locked(value: Any) -> dict[str, float]:
    names = [value] if isinstance(value, str) else list(value) if isinstance(value, Iterable) else [value]
    places = list(value.values()) if isinstance(value, Mapping) else [0.0] * len(names)
    if not all(isinstance(name, str) and _finite(place) for name, place in zip(names, places, strict=True)):
        raise ArgumentError(
            f"lock is {value!r}, expected names of joints, or a dict from names to finite positions; give for instance "
            "lock=['finger'] or lock={'finger': 0.02}."
        )
    return {name: float(place) for name, place in zip(names, places, strict=True)}


def _limits(value: Any) -> dict[str, dict[str, float | None]]:
    usable = isinstance(value, Mapping) and all(
        isinstance(joint, str)
        and isinstance(limits, Mapping)
        and all(key in LIMITS and (x is None or _number(x)) for key, x in limits.items())
        and all(x is None or x > 0.0 for key, x in limits.items() if key in ("effort", "velocity"))
        for joint, limits in value.items()
    )
    if not usable:
        raise ArgumentError(
            f"limits is {value!r}, expected a dict from joints (or '{ALL}') to dicts of {', '.join(LIMITS)}, effort "
            f"and velocity > 0, None for no limit; give for instance limits={{'{ALL}': {{'effort': 50.0}}}}."
        )
    return {joint: {key: _stored(x) for key, x in limits.items()} for joint, limits in value.items()}


def _by_joint(name: str, value: Any) -> dict[str, float]:
    numbers = dict(value) if isinstance(value, Mapping) else {ALL: value}
    if not all(isinstance(joint, str) and _number(x) and 0.0 <= x <= LARGEST_DRIVE for joint, x in numbers.items()):
        raise ArgumentError(
            f"{name} is {value!r}, expected a number in [0, {LARGEST_DRIVE:g}], or a dict from joints (or '{ALL}') to "
            f"such numbers; give for instance {name}={{'elbow': 0.2}}."
        )
    return {joint: float(x) for joint, x in numbers.items()}


def _for_all(numbers: Mapping[str, float]) -> float | dict[str, float]:
    """One number if it is that of all joints: `layered` does not add it to what a file states by joint."""
    return numbers[ALL] if numbers.keys() == {ALL} else dict(numbers)


def _payloads(value: Any) -> dict[str, Payload]:
    loads = dict(value) if isinstance(value, Mapping) else {"": value}
    found = {}
    for frame, load in loads.items():
        given = vars(load) if isinstance(load, Payload) else dict(load) if isinstance(load, Mapping) else {"mass": load}
        inertia, com = _six(given.get("inertia", 0.0)), _numbers(given.get("com", (0.0, 0.0, 0.0)), 3)
        known = given.keys() <= {"mass", "com", "inertia"} and isinstance(frame, str)
        if not (known and com and inertia and _finite(given.get("mass")) and given["mass"] > 0.0):
            raise ArgumentError(
                f"payload is {value!r}, expected a mass [kg], or a dict from links to masses or to dicts of mass > 0, "
                "com (3 numbers [m]) and inertia (3 moments or a 3×3 matrix about the centre of mass [kg·m²]); give "
                "for instance payload={'flange': {'mass': 2.0, 'com': [0, 0, 0.05]}}."
            )
        found[frame] = Payload(float(given["mass"]), (com[0], com[1], com[2]), inertia)
    return found


def _tool(value: Any) -> Tool:
    given = dict(value) if isinstance(value, Mapping) else {"file": value}
    file, frame = given.get("file"), given.get("frame", "")
    xyz, rpy = (_numbers(given.get(key, (0.0, 0.0, 0.0)), 3) for key in ("xyz", "rpy"))
    known = given.keys() <= {"file", "frame", "xyz", "rpy"} and isinstance(file, str | Path) and isinstance(frame, str)
    if not (known and xyz and rpy):
        raise ArgumentError(
            f"tool is {value!r}, expected the path of a description, or a dict of file, frame (the carrying link), "
            "xyz [m] and rpy [rad]; give for instance tool={'file': 'gripper.urdf', 'frame': 'flange'}."
        )
    return Tool(Path(str(file)).expanduser().resolve(), frame, (xyz[0], xyz[1], xyz[2]), (rpy[0], rpy[1], rpy[2]))


def _three(name: str) -> Callable[[Any], tuple[float, ...]]:
    def convert(value: Any) -> tuple[float, ...]:
        numbers = _numbers(value, 3)
        if not numbers:
            raise ArgumentError(
                f"{name} is {value!r}, expected three finite numbers; give for instance [3.1416, 0, 0]."
            )
        return numbers

    return convert


def _array(value: Any) -> np.ndarray:
    """The value as an array of finite numbers, empty if it is none."""
    try:
        numbers = floats("numbers", value)
    except ArgumentError:
        return np.empty(0)
    return numbers if is_usual(numbers) else np.empty(0)


def _numbers(value: Any, count: int) -> tuple[float, ...]:
    """`count` finite numbers as a tuple, or the empty tuple."""
    numbers = _array(value)
    return tuple(numbers.tolist()) if numbers.shape == (count,) else ()


def _six(value: Any) -> tuple[float, ...]:
    """Ixx, Ixy, Ixz, Iyy, Iyz, Izz of one number, three moments, six numbers or a symmetric matrix; else empty."""
    numbers = _array(value)
    if numbers.shape == (6,):
        return tuple(numbers.tolist())
    if numbers.shape in ((), (3,)):
        numbers = np.diag(np.full(3, numbers))
    if numbers.shape != (3, 3) or not np.array_equal(numbers, numbers.T):
        return ()
    return tuple(numbers[np.triu_indices(3)].tolist())


def _plain(value: Payload | Tool) -> dict[str, Any]:
    return {
        key: str(x) if isinstance(x, Path) else list(x) if isinstance(x, tuple) else x for key, x in vars(value).items()
    }


def _arguments(value: Any) -> dict[str, str]:
    if not isinstance(value, Mapping) or not all(isinstance(name, str) for name in value):
        raise ArgumentError(
            f"xacro_args is {value!r}, expected a dict; give for instance xacro_args={{'name': 'ur5e'}}."
        )
    return {name: str(text).lower() if isinstance(text, bool) else str(text) for name, text in value.items()}


def _folders(value: Any) -> tuple[Path, ...]:
    names = (value,) if isinstance(value, str | Path) else value
    if not isinstance(names, Iterable) or not all(isinstance(name, str | Path) for name in names):
        raise ArgumentError(f"package_dirs is {value!r}, expected folders; give for instance package_dirs=['ws/src'].")
    try:
        folders = tuple(Path(name).expanduser().resolve() for name in names)
        missing = [folder for folder in folders if not folder.is_dir()]
    except (OSError, ValueError, RuntimeError) as error:
        raise ArgumentError(f"package_dirs is {value!r}, which names no folders ({error}); correct it.") from error
    if missing:
        warnings.warn(f"package_dirs names {missing[0]}, which is no folder.", stacklevel=2)
    return folders


def _number(value: Any) -> bool:
    """Whether it is a number, infinite ones included."""
    if not isinstance(value, Real) or isinstance(value, bool):
        return False
    return abs(value) <= 1e300 or value in (math.inf, -math.inf)  # type: ignore[operator]


def _finite(value: Any) -> bool:
    return _number(value) and math.isfinite(value)


def _stored(value: Any) -> float | None:
    return None if value is None or math.isinf(value) else float(value)


_CONVERT: dict[str, Callable[[Any], Any]] = {
    "lock": _locked,
    "limits": _limits,
    "xacro_args": _arguments,
    "package_dirs": _folders,
    "payload": _payloads,
    "tool": _tool,
    "base_rpy": _three("base_rpy"),
    "base_xyz": _three("base_xyz"),
}
_ADDED = ("lock", "limits", "xacro_args", "payload", *DRIVE)
"""Arguments given by joint, link or name."""
