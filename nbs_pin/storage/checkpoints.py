"""Controllers and models in files: settings and weights, the arm they are for, and where a training stood.

A file holds `controller.json` (settings, arm, versions), `controller.safetensors` (the `state_dict`, float64) and, for
a training that can be resumed, `training.json` and `training.safetensors`, sealed as `base/archives.py` has it. No pickle.
"""

import json
import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import safetensors.torch
import torch
from safetensors import SafetensorError

from nbs_pin.base.archives import parse_json, read_archive, write_archive
from nbs_pin.base.exceptions import ArgumentError, FileFormatError, RobotError, RobotNotFound
from nbs_pin.base.versions import versions
from nbs_pin.robots.robot import Robot, load_robot
from nbs_pin.storage.descriptions import Settings, Stored, describe, described_robot, rebuild

FORMAT = "nbs_pin checkpoint 1"
"""What the manifest of a checkpoint says."""
_CONTROLLER, _TRAINING = "controller", "training"


@dataclass(frozen=True, eq=False)
class TrainingState:
    """What a training needs beside the controller to go on as if it had never stopped."""

    tensors: dict[str, torch.Tensor] = field(default_factory=dict)
    """Such as an optimiser's moments, of any kind of number."""
    facts: dict[str, Any] = field(default_factory=dict)
    """What JSON can store: epoch, best cost, history, random state as integers."""


class Checkpoint(NamedTuple):
    """What a checkpoint holds."""

    controller: Any
    """The same law or model with the same weights: a `Controller` or a `DynamicsProvider`."""
    training: TrainingState | None
    """Where its training stood, if it was written during one."""


def save(controller: Stored, path: str | Path, *, info: Mapping[str, Any] | None = None) -> None:
    """Write a controller or a model to one file, which `load` turns into one of bit for bit the same torques.

    The file holds the old one or the new one, whatever interrupts the writing; missing folders are made.
    info: free notes (seed, what it was trained for), stored as JSON and given back by `about`.
    Raises ArgumentError for one with parts from outside the package or weights that are not finite.
    """
    write_checkpoint(path, controller, info=info)


def load(path: str | Path, robot: Robot | None = None) -> Any:
    """The `Controller` or the `DynamicsProvider` that `save` wrote to the file; a model's report becomes a dict.

    robot: the arm it is for, with effort limits as wished; None loads it as it was loaded then, with the limits it had.
    A PID still saturates at its own `effort_limit`, and one built without an arm is for its number of joints alone.
    Raises FileNotFoundError for no file, FileFormatError for one that is damaged or no checkpoint, ArgumentError for
    another arm than the file is for, RobotNotFound when its description is no longer there, and RobotError when that
    has changed.
    """
    return read_checkpoint(path, robot).controller


def about(path: str | Path) -> dict[str, Any]:
    """What the file says of itself, nothing being built: `controller` (settings and arm), `versions` and `info`.

    Raises as `load` does for files that cannot be read.
    """
    return _document(path, read_archive(path, FORMAT))


def write_checkpoint(
    path: str | Path,
    controller: Stored,
    training: TrainingState | None = None,
    *,
    info: Mapping[str, Any] | None = None,
) -> None:
    """`save`, with where a training stands; raises ArgumentError for facts JSON cannot store or tensors not finite."""
    try:
        settings, tensors = describe(controller)
    except ArgumentError as error:
        raise ArgumentError(f"nothing was saved to {path}: {error}; correct that.") from error
    document = {"controller": settings, "versions": versions(), "info": dict(info or {})}
    entries = _entries(_CONTROLLER, document, tensors)
    if training is not None:
        copies = {name: x.detach().cpu().clone().contiguous() for name, x in training.tensors.items()}
        entries |= _entries(_TRAINING, training.facts, copies)
    write_archive(path, FORMAT, entries)


def read_checkpoint(path: str | Path, robot: Robot | None = None) -> Checkpoint:
    """The controller that `write_checkpoint` wrote, and where its training stood; robot and errors as in `load`."""
    entries = read_archive(path, FORMAT)
    settings = _document(path, entries)["controller"]
    with _refusing(path):
        stored = described_robot(settings)
    arm = None if stored is None else _arm(path, stored, robot)
    with _refusing(path):
        controller = rebuild(settings, _tensors(path, _CONTROLLER, entries), arm)
    if robot is not None and robot.nv != controller.nv:
        raise ArgumentError(f"{path} is for {controller.nv} joints and {robot.name} has {robot.nv}; give its own arm.")
    if f"{_TRAINING}.json" not in entries:
        return Checkpoint(controller, None)
    facts = parse_json(path, f"{_TRAINING}.json", entries[f"{_TRAINING}.json"])
    return Checkpoint(controller, TrainingState(_tensors(path, _TRAINING, entries), facts))


def _entries(name: str, document: dict[str, Any], tensors: dict[str, torch.Tensor]) -> dict[str, bytes]:
    for key, x in tensors.items():
        if not torch.isfinite(x).all():
            raise ArgumentError(f"tensor '{key}' of the {name} is not finite, and nothing was saved; go back a step.")
    try:
        text = json.dumps(document, indent=1, allow_nan=False, ensure_ascii=False)
    except (TypeError, ValueError) as error:
        raise ArgumentError(
            f"the {name} cannot be stored as JSON ({error}); keep to finite numbers and text."
        ) from error
    return {f"{name}.json": text.encode(), f"{name}.safetensors": safetensors.torch.save(tensors)}


def _document(path: str | Path, entries: Mapping[str, bytes]) -> dict[str, Any]:
    """`controller.json`; raises FileFormatError unless the file has just the entries of a checkpoint."""
    expected = {f"{name}.{kind}" for name in (_CONTROLLER, _TRAINING) for kind in ("json", "safetensors")}
    if entries.keys() not in (expected, {name for name in expected if name.startswith(_CONTROLLER)}):
        raise FileFormatError(f"{path}: holds {', '.join(entries)}, not what a checkpoint holds; save it again.")
    document = parse_json(path, f"{_CONTROLLER}.json", entries[f"{_CONTROLLER}.json"])
    if document.keys() != {"controller", "versions", "info"}:
        raise FileFormatError(f"{path}: controller.json says {', '.join(document)}, not what we write; save it again.")
    return document


def _tensors(path: str | Path, name: str, entries: Mapping[str, bytes]) -> dict[str, torch.Tensor]:
    try:
        return safetensors.torch.load(entries[f"{name}.safetensors"])
    except (SafetensorError, ValueError, RuntimeError) as error:
        raise FileFormatError(f"{path}: '{name}.safetensors' is damaged ({error}); take an older copy.") from error


def _arm(path: str | Path, stored: Settings, given: Robot | None) -> Robot:
    """The arm that is described, with the effort limits of then, or the one given if it is the same."""
    robot = _loaded(path, stored) if given is None else given
    if robot.sha256 != stored["sha256"]:
        message = (
            f"{path} is for the arm '{stored['name']}' ({stored['source']}, {stored['sha256']:.12}), and {robot.name} "
            f"({robot.source}, {robot.sha256:.12}) has other links, joints, limits or gravity; "
        )
        if given is None:
            raise RobotError(f"{message}that file was changed: give the arm as it was then as robot=….")
        raise ArgumentError(f"{message}give that arm, or build a controller for this one.")
    limits = [math.inf if limit is None else limit for limit in stored["effort_limit"]]
    if given is not None or robot.effort_limit.tolist() == limits:
        return robot
    with _refusing(path):
        return robot.with_effort_limit(limits)


def _loaded(path: str | Path, stored: Settings) -> Robot:
    try:
        with _refusing(path):
            return load_robot(stored["source"], **stored["options"])
    except TypeError as error:
        raise FileFormatError(
            f"{path}: its arm is loaded with options that this version does not know ({error}); give it as robot=…."
        ) from error
    except RobotNotFound as error:
        raise RobotNotFound(
            f"{path} is for the arm '{stored['name']}' of {stored['source']}, which is not there; give it as "
            "robot=nbs.load_robot(…)."
        ) from error


@contextmanager
def _refusing(path: str | Path) -> Iterator[None]:
    """What is wrong with the contents is wrong with the file."""
    try:
        yield
    except ArgumentError as error:
        raise FileFormatError(f"{path}: {error}; save the controller again with this version.") from error
