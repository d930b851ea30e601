"""How a description is read where it leaves something open: locked joints, limits, packages, inertias."""

import math
import warnings
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from numbers import Real
from pathlib import Path
from typing import Any, Literal, TypeAlias, get_args

from nbs_pin.base.exceptions import ArgumentError

ZeroLimits: TypeAlias = Literal["refuse", "unlimited"]
"""How to treat limits that are left out, an effort or velocity that is not > 0 and an empty range at zero."""
ZERO_LIMITS: tuple[ZeroLimits, ...] = get_args(ZeroLimits)
InertiaFrom: TypeAlias = Literal["file", "shapes"]
"""Whether bodies without mass are refused, or filled with material."""
INERTIA_FROM: tuple[InertiaFrom, ...] = get_args(InertiaFrom)
LIMITS = ("lower", "upper", "effort", "velocity")
ALL = "*"
"""Stands for every joint in `limits`."""


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
        }


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
}
