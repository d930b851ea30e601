"""Conversion of controllers and models to JSON settings and tensors, and back.

Every part is stored as its class and its constructor arguments. The class states where each argument is found
(`base/storable.py`): plain settings and further parts in the description, arrays among the tensors of the `state_dict`.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from operator import attrgetter
from typing import Any, TypeAlias, cast

import numpy as np
import torch
from torch import nn

from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.storable import RECIPES, Recipe, Tensors
from nbs_pin.controllers.controller import Controller
from nbs_pin.controllers.registry import LAWS
from nbs_pin.dynamics.provider import DynamicsProvider
from nbs_pin.dynamics.registry import NETWORKS, PROVIDERS
from nbs_pin.robots.robot import Robot

LARGEST_WEIGHT = 1e12
"""Largest gain or weight in size: products of those of a few layers stay finite."""

Settings: TypeAlias = dict[str, Any]
"""A part in JSON: its `kind`, its settings by name, and its own parts."""

Stored: TypeAlias = Controller | DynamicsProvider
"""What files hold: a controller or a dynamics model."""


def describe(stored: Stored) -> tuple[Settings, Tensors]:
    """JSON settings and copies of the `state_dict` tensors, from which `rebuild` makes the same controller or model.

    Raises ArgumentError if a part is not `@storable`, or a number is not finite.
    """
    settings = cast(Settings, _described(stored))
    state = stored.state_dict() if isinstance(stored, nn.Module) else {}
    tensors = Tensors({name: x.detach().cpu().clone().contiguous() for name, x in state.items()})
    robot = attrgetter("dynamics.robot" if "dynamics" in settings else "robot")(stored)
    copy = rebuild(settings, tensors, robot)
    for mine, theirs in zip(_modules(stored), _modules(copy), strict=True):
        if type(mine) is not type(theirs):
            raise ArgumentError(f"a {type(mine).__name__} cannot be stored in place of a {type(theirs).__name__}")
    return settings, tensors


def described_robot(description: Any) -> Settings | None:
    """The description of the arm that a controller or model is for, or None if it has no arm.

    Raises ArgumentError for a description that `describe` would not produce.
    """
    if not issubclass(cast(type, _kind_of(description).make), Controller | DynamicsProvider):
        raise ArgumentError(f"a {description['kind']} is neither a controller nor a model")
    robot = _robot_in(description)
    if robot is None:
        return None
    if _kind_of(robot).make is not Robot:
        raise ArgumentError(f"the arm is a {robot['kind']}, not a Robot")
    kinds = {"name": str, "source": str, "options": dict, "sha256": str, "effort_limit": list}
    wrong = [name for name, kind in kinds.items() if not isinstance(robot[name], kind)]
    if wrong:
        raise ArgumentError(f"'{wrong[0]}' of the arm is {robot[wrong[0]]!r}")
    return robot


def _robot_in(description: Any) -> Any:
    """The described arm: of a law that of its model, of a law or model about another that of the other."""
    kind = _kind_of(description)
    if "robot" in kind.parts:
        return description["robot"]
    inner = [description[name] for name in ("dynamics", "network", "nominal", "law") if name in kind.parts]
    return _robot_in(inner[0]) if inner else None


def rebuild(description: Settings, tensors: Mapping[str, torch.Tensor], robot: Robot | None) -> Stored:
    """The controller or model that `describe` described, with these tensors as `state_dict` and `robot` as its arm.

    Raises ArgumentError if a setting or tensor is missing, superfluous, of another shape or type, or out of range.
    """
    try:
        stored = _rebuild(description, Tensors(tensors), robot)
    except (AttributeError, TypeError, ValueError, RuntimeError) as error:  # from constructors given wrong arguments
        raise ArgumentError(f"settings and tensors do not form a controller or model: {error}") from error
    module = stored if isinstance(stored, nn.Module) else nn.Module()
    _check_tensors(tensors, module)
    module.load_state_dict(tensors)
    return stored


def _modules(stored: Stored) -> list[nn.Module]:
    return list(stored.modules()) if isinstance(stored, nn.Module) else []


def _described(part: Any) -> Settings | None:
    """The part in JSON, None for None."""
    if part is None:
        return None
    kind = RECIPES.get(type(part).__name__)
    if kind is None or kind.make is not type(part):
        known = ", ".join(_recipes())
        raise ArgumentError(f"a {type(part).__name__} cannot be stored, only {known}, without subclasses")
    settings = {name: _plain(attrgetter(place)(part)) for name, place in kind.settings.items()}
    parts = {name: _described(attrgetter(place)(part)) for name, place in kind.parts.items()}
    return {"kind": type(part).__name__, **settings, **parts}


def _rebuild(description: Any, tensors: Tensors, robot: Robot | None) -> Any:
    if description is None:
        return None
    kind = _kind_of(description)
    if kind.make is Robot:
        return robot
    given = {name: description[name] for name in kind.settings}
    settings = {name: _revived(x, kind.sequence) if isinstance(x, list) else x for name, x in given.items()}
    parts = {name: _rebuild(description[name], tensors.below(f"{place}."), robot) for name, place in kind.parts.items()}
    return kind.make(**settings, **parts, **kind.arrays(tensors))


def _kind_of(description: Any) -> Recipe:
    """The recipe of a described part; raises ArgumentError unless it is known and has exactly its settings."""
    name = description.get("kind") if isinstance(description, dict) else None
    kind = RECIPES.get(str(name)) or _recipes().get(str(name))
    if kind is None:
        raise ArgumentError(f"kind {name!r} is unknown; this version knows {', '.join(_recipes())}")
    wrong = description.keys() ^ {"kind", *kind.settings, *kind.parts}
    if wrong:
        raise ArgumentError(f"'{min(wrong)}' of {name} is {'unknown' if min(wrong) in description else 'missing'}")
    return kind


def _check_tensors(tensors: Mapping[str, torch.Tensor], module: nn.Module) -> None:
    """Raises ArgumentError unless the tensors are a `state_dict` of the module, with its own buffers."""
    expected, fixed = module.state_dict(), dict(module.named_buffers())
    wrong = sorted(tensors.keys() ^ expected.keys())
    if wrong:
        raise ArgumentError(f"tensor '{wrong[0]}' is {'superfluous' if wrong[0] in tensors else 'missing'}")
    for name, x in expected.items():
        found = tensors[name]
        if (found.shape, found.dtype) != (x.shape, x.dtype):
            stated = [f"{tuple(t.shape)} {t.dtype}" for t in (found, x)]
            raise ArgumentError(f"tensor '{name}' is {stated[0]}, expected {stated[1]}")
        bad = int((~(found.double().abs() <= LARGEST_WEIGHT)).sum())
        if bad:
            raise ArgumentError(f"tensor '{name}' has {bad} numbers that are not finite or beyond {LARGEST_WEIGHT:g}")
        if name in fixed and not torch.equal(found, x):
            raise ArgumentError(f"tensor '{name}' is not what its constructor makes")


def _plain(value: Any) -> Any:
    """Numbers, text, lists and records for JSON; null stands for infinity, which JSON lacks."""
    if is_dataclass(value) and not isinstance(value, type):
        return {f.name: _plain(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, Mapping):
        return {name: _plain(x) for name, x in value.items()}
    if isinstance(value, np.ndarray | tuple):
        return [_plain(x) for x in value]
    if isinstance(value, np.generic):
        return _plain(value.item())
    return None if value == math.inf else value


def _revived(values: list[Any], sequence: Callable[[list[Any]], Any]) -> Any:
    return sequence([math.inf if x is None else x for x in values])


def _recipes() -> dict[str, Recipe]:
    """The recipes of all laws, models and networks by name, after importing their modules."""
    for entry in (*LAWS.values(), *PROVIDERS.values(), *NETWORKS.values()):
        entry.load()
    return RECIPES
