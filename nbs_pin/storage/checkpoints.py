"""Checkpoints: controllers and models in files, with their settings, weights and arm, and the state of a training.

A file holds `controller.json` (settings, arm, versions), `controller.safetensors` (the `state_dict`, float64) and, for
a training that can be resumed, `training.json` and `training.safetensors`, sealed by `base/archives.py`. No pickle.
"""

import json
import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import safetensors.torch
import torch
from safetensors import SafetensorError

from nbs_pin.base.archives import parse_json, read_archive, write_archive
from nbs_pin.base.arguments import a, checked, mapping, maybe, readable, writable
from nbs_pin.base.doors import as_loaded, own_arm
from nbs_pin.base.exceptions import ArgumentError, FileFormatError, RobotError
from nbs_pin.base.records import Reference
from nbs_pin.base.shown import joints_told
from nbs_pin.base.versions import versions
from nbs_pin.controllers.controller import Controller
from nbs_pin.dynamics.provider import DynamicsProvider
from nbs_pin.robots.named import load_named
from nbs_pin.robots.robot import ARM, Robot
from nbs_pin.storage.descriptions import Settings, Stored, describe, described_robot, rebuild

FORMAT = "nbs_pin checkpoint 1"
"""Format name in the manifest of a checkpoint."""
_CONTROLLER, _TRAINING = "controller", "training"


@dataclass(frozen=True, eq=False)
class TrainingState:
    """What a training needs, besides the controller, to resume bit for bit."""

    tensors: dict[str, torch.Tensor] = field(default_factory=dict)
    """Such as the moments of an optimiser, of any dtype."""
    facts: dict[str, Any] = field(default_factory=dict)
    """JSON values: epoch, best cost, history, random state as integers."""


STORABLE = a((Controller, DynamicsProvider), "a control law or a model of an arm")
"""The check of an argument that can be stored."""


class Checkpoint(NamedTuple):
    """Contents of a checkpoint."""

    controller: Any
    """The stored `Controller` or `DynamicsProvider`."""
    training: TrainingState | None
    """State of the training during which it was written, or None."""


@checked(controller=STORABLE, path=writable, info=maybe(mapping))
def save(controller: Stored, path: str | Path, *, info: Mapping[str, Any] | None = None) -> None:
    """Write a controller or a model to one file, from which `load` restores the same torques bit for bit.

    Args:
        controller: A controller or a dynamics model, all of whose parts are `@storable`.
        path: The file, replaced atomically; missing folders are created.
        info: Notes, such as the seed, stored as JSON and returned by `about`.

    Raises:
        ArgumentError: If a part is not `@storable` or cannot be stored, or a weight is not finite.

    Example:
        >>> import tempfile
        >>> import nbs_pin as nbs
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     nbs.save(nbs.PD.for_robot(nbs.load_robot("two_link")), f"{folder}/pd.nbs")
        ...     nbs.load(f"{folder}/pd.nbs").kd.round(1)
        array([81.6, 36.5])
    """
    write_checkpoint(path, controller, info=info)


@checked(path=readable, robot=maybe(ARM))
def load(path: str | Path, robot: Robot | None = None) -> Any:
    """The `Controller` or `DynamicsProvider` that `save` wrote to the file; the report of a model becomes a dict.

    Args:
        path: The file.
        robot: The arm that it is for, with any effort limits (a PID keeps its own); None loads the arm as stored.

    Raises:
        FileNotFoundError: If there is no such file.
        FileFormatError: If the file is damaged or not a checkpoint.
        ArgumentError: If robot is not the arm of the file or, if that has none, has another number of joints.
        RobotError: If the description of the arm has changed or, as RobotNotFound, no longer exists.

    Example:
        >>> import tempfile
        >>> import nbs_pin as nbs
        >>> robot = nbs.load_robot("two_link")
        >>> law, aim = nbs.NeuralBackstepping.for_robot(robot, seed=3), nbs.Hold([0.3, 0.2])(0.0)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     nbs.save(law, f"{folder}/law.nbs")
        ...     again = nbs.load(f"{folder}/law.nbs")
        >>> bool((again.torque(aim.q, aim.v, *aim) == law.torque(aim.q, aim.v, *aim)).all())
        True
    """
    return read_checkpoint(path, robot).controller


@checked(path=readable, robot=ARM)
def load_with(path: str | Path, robot: Robot) -> Any:
    """`load` for an arm that need not be that of the file: another is left out, and the file's own is loaded."""
    with _refusing(path):
        stored = described_robot(_document(path, read_archive(path, FORMAT))["controller"])
    own = stored is not None and stored["sha256"] == robot.sha256
    return read_checkpoint(path, robot if own else None).controller


@checked(path=readable)
def about(path: str | Path) -> dict[str, Any]:
    """`controller` (settings, arm), `versions` and `info` of a file, without building anything; raises as `load`.

    Example:
        >>> import tempfile
        >>> import nbs_pin as nbs
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     nbs.save(nbs.PD.for_robot(nbs.load_robot("two_link")), f"{folder}/pd.nbs", info={"seed": 0})
        ...     sorted(nbs.about(f"{folder}/pd.nbs")), nbs.about(f"{folder}/pd.nbs")["info"]
        (['controller', 'info', 'versions'], {'seed': 0})
    """
    return _document(path, read_archive(path, FORMAT))


def write_checkpoint(
    path: str | Path,
    controller: Stored,
    training: TrainingState | None = None,
    *,
    info: Mapping[str, Any] | None = None,
) -> None:
    """`save` with the state of a training; ArgumentError also for facts that JSON cannot store."""
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
    """The controller and training state that `write_checkpoint` wrote; robot and errors as in `load`."""
    entries = read_archive(path, FORMAT)
    settings = _document(path, entries)["controller"]
    with _refusing(path):
        stored = described_robot(settings)
    arm = None if stored is None else _arm(path, stored, robot)
    with _refusing(path):
        controller = rebuild(settings, _tensors(path, _CONTROLLER, entries), arm)
    if robot is not None and robot.nv != controller.nv:
        raise ArgumentError(
            f"{path} is for {joints_told(controller.nv)} and {robot.name} has {robot.nv}; give its own arm."
        )
    _check_finite(path, controller)
    if f"{_TRAINING}.json" not in entries:
        return Checkpoint(controller, None)
    facts = parse_json(path, f"{_TRAINING}.json", entries[f"{_TRAINING}.json"])
    return Checkpoint(controller, TrainingState(_tensors(path, _TRAINING, entries), facts))


def _entries(name: str, document: dict[str, Any], tensors: dict[str, torch.Tensor]) -> dict[str, bytes]:
    for key, x in tensors.items():
        if not torch.isfinite(x).all():
            raise ArgumentError(f"tensor '{key}' of the {name} is not finite, nothing was saved; use an earlier one.")
    try:
        text = json.dumps(document, indent=1, allow_nan=False, ensure_ascii=False)
    except (TypeError, ValueError) as error:
        raise ArgumentError(f"the {name} cannot be stored as JSON ({error}); use finite numbers and text.") from error
    return {f"{name}.json": text.encode(), f"{name}.safetensors": safetensors.torch.save(tensors)}


def _document(path: str | Path, entries: Mapping[str, bytes]) -> dict[str, Any]:
    """`controller.json`; raises FileFormatError unless the file has exactly the entries of a checkpoint."""
    expected = {f"{name}.{kind}" for name in (_CONTROLLER, _TRAINING) for kind in ("json", "safetensors")}
    if entries.keys() not in (expected, {name for name in expected if name.startswith(_CONTROLLER)}):
        raise FileFormatError(f"{path}: holds {', '.join(entries)}, not the entries of a checkpoint; save it again.")
    document = parse_json(path, f"{_CONTROLLER}.json", entries[f"{_CONTROLLER}.json"])
    if document.keys() != {"controller", "versions", "info"}:
        raise FileFormatError(f"{path}: controller.json has {', '.join(document)}, expected other keys; save it again.")
    return document


def _tensors(path: str | Path, name: str, entries: Mapping[str, bytes]) -> dict[str, torch.Tensor]:
    try:
        return safetensors.torch.load(entries[f"{name}.safetensors"])
    except (SafetensorError, ValueError, RuntimeError) as error:
        raise FileFormatError(f"{path}: '{name}.safetensors' is damaged ({error}); use an older copy.") from error


def _check_finite(path: str | Path, stored: Stored) -> None:
    """Raises FileFormatError if settings and weights, each of them acceptable, give no finite torques together."""
    n = stored.nv
    try:
        found = _torques(stored, n)
    except (TypeError, ValueError, RuntimeError) as error:
        raise FileFormatError(f"{path}: its torques cannot be computed ({error}); save it again.") from error
    if not np.isfinite(np.asarray(found)).all():
        raise FileFormatError(
            f"{path}: its torques are not finite near rest, as numbers in it overflow; train it again."
        )


def _torques(stored: Stored, n: int) -> Any:
    """The torques near rest and at a larger error."""
    with torch.no_grad(), np.errstate(all="ignore"):
        q, v = (torch.stack([torch.full((n,), near), torch.ones(n)]).double() for near in (0.1, 0.01))
        if isinstance(stored, Controller):
            return stored.step(stored.initial_memory(q), q, v, Reference(0.0 * q, 0.5 * v, 0.5 * v), 1e-3)[0]
        return stored.reference_torque(q, v, v, v)


def _arm(path: str | Path, stored: Settings, given: Robot | None) -> Robot:
    """The arm described, with its stored effort limits, or `given` if that is the same arm."""
    robot = _loaded(path, stored) if given is None else given
    if robot.sha256 != stored["sha256"]:
        message = (
            f"{path} is for the arm '{stored['name']}', {as_loaded(stored['source'], stored['options'])} "
            f"({stored['sha256']:.12}), and {as_loaded(robot.source, robot.options)} ({robot.sha256:.12}) has other "
            "links, joints, limits or gravity; "
        )
        if given is None:
            raise RobotError(f"{message}that file was changed: give the original arm as {own_arm()}.")
        raise ArgumentError(f"{message}give that arm, or build a controller for this one.")
    limits = [math.inf if limit is None else limit for limit in stored["effort_limit"]]
    if given is not None or robot.effort_limit.tolist() == limits:
        return robot
    with _refusing(path):
        return robot.with_effort_limit(limits)


def _loaded(path: str | Path, stored: Settings) -> Robot:
    with _refusing(path):
        return load_named(str(path), stored["source"], stored["options"])


@contextmanager
def _refusing(path: str | Path) -> Iterator[None]:
    """Turns an ArgumentError about the contents into a FileFormatError about the file."""
    try:
        yield
    except ArgumentError as error:
        fault = str(error).rstrip(".")
        raise FileFormatError(f"{path}: {fault}; save the controller again with this version.") from error
