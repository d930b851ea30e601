"""A model of an arm from its data, how well it explains them, and the files it goes into: behind `nbs-pin learn`."""

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.files import write_whole
from nbs_pin.base.pages import plain
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.dynamics.provider import DynamicsProvider
from nbs_pin.identification.datasets import Dataset
from nbs_pin.identification.fit import fit, parted
from nbs_pin.identification.fit_report import FitReport, torque_errors
from nbs_pin.identification.logs import load_log
from nbs_pin.reports.plotting import ACTUAL, LIMIT, REFERENCE, picture
from nbs_pin.robots.robot import Robot, load_robot
from nbs_pin.storage.checkpoints import save

FILES = ("model.nbs", "learning.png", "summary.json")
"""What `write_results` writes, the summary last."""


@dataclass(frozen=True, eq=False)
class Learned:
    """A model, and the data that it was and was not learned from."""

    model: DynamicsProvider
    report: FitReport
    friction: JointFriction | None
    train: Dataset
    test: Dataset | None
    joints: tuple[str, ...]
    prismatic: tuple[bool, ...]


def arm_of(data: Dataset) -> Robot | None:
    """The arm that the data say they are of, None where they say nothing.

    Raises ArgumentError when its description is another one today, RobotNotFound when it is gone.
    """
    said = data.about.get("robot")
    if not isinstance(said, dict) or not said.get("source"):
        return None
    robot = load_robot(said["source"], **said.get("options", {}))
    if robot.sha256 != said.get("sha256", robot.sha256):
        raise ArgumentError(
            f"{data!r}: the description {said['source']} has changed since; give the arm that they are of as it was."
        )
    return robot


def data_and_arm(path: str | Path, arm: str | None) -> tuple[Dataset, Robot | None]:
    """The data in a file (`load_log`) and the arm of that name or path, or the one they say they are of."""
    given = None if arm is None else load_robot(arm)
    data = load_log(path, robot=given)
    return data, given or arm_of(data)


def learn(data: Dataset, model: str, robot: Robot | None, seed: int = 0, **settings: Any) -> Learned:
    """The model that `fit` makes of the data, settings and errors as there, and the data it did not learn from."""
    train, test = parted(data, settings.pop("held_out", None), seed)
    found: Any = fit(train, model, seed, robot=robot, held_out=0.0 if test is None else test, **settings)
    joints = tuple(f"joint {i + 1}" for i in range(data.nv)) if robot is None else robot.joint_names
    return Learned(found, found.report, found.friction, train, test, joints, tuple(data.prismatic.tolist()))


def figures(result: Learned) -> dict[str, Any]:
    """How well the model explains the data, as JSON can store it; units in the keys, for sliding joints N.

    Per joint the root mean square of the torque error where it was learned and where it was held out, beside the
    deviation of the torque.
    """
    report = dataclasses.asdict(result.report)
    curves = {name: report.pop(name) for name in ("history", "held_out")}
    friction = result.friction
    return plain(
        report
        | {
            "trajectories": result.train.trajectories,
            "test_samples": 0 if result.test is None else len(result.test),
            "joints": result.joints,
            "rms_torque_error_Nm": _errors(result, result.train),
            "rms_test_torque_error_Nm": None if result.test is None else _errors(result, result.test),
            "torque_deviation_Nm": result.train.tau.std(axis=0),
            "viscous_friction": None if friction is None else friction.viscous,
            "coulomb_friction_Nm": None if friction is None else friction.coulomb,
            "curves": curves,
        }
    )


def write_results(result: Learned, folder: Path, facts: dict[str, Any]) -> dict[str, Any]:
    """Writes `FILES` into the folder, the model first; returns the figures.

    facts: what summary.json holds beside the figures. Raises OSError when they cannot be written.
    """
    numbers = figures(result)
    save(result.model, folder / "model.nbs", info={"learned": facts})
    plot_learning(result, folder / "learning.png")
    text = json.dumps(facts | {"figures": numbers}, indent=2, allow_nan=False, ensure_ascii=False) + "\n"
    write_whole(folder / "summary.json", text.encode())
    return numbers


def plot_learning(result: Learned, path: str | Path) -> Path:
    """Draws how the fit went and writes the picture (PNG); returns its path.

    Left: normalised mean squared residual by iteration, learned from and held out. Right: per joint the root mean
    square of the torque error on both, beside the deviation of the torque.
    """
    with picture(path, 11.0, 4.2) as figure:
        curve, bars = figure.subplots(1, 2)
        for name, values, colour in (
            ("learned from", result.report.history, ACTUAL),
            ("held out", result.report.held_out, REFERENCE),
        ):
            if values:
                curve.semilogy(values, color=colour, label=name)
        if not result.report.history:
            curve.text(0.5, 0.5, "solved without iterations", ha="center", transform=curve.transAxes, color=LIMIT)
        else:
            curve.legend(frameon=False)
        curve.set(xlabel="iteration")
        curve.set_title("residual, mean square over variance", loc="left")
        _draw_errors(bars, result)
    return Path(path)


def _draw_errors(axes: Any, result: Learned) -> None:
    place = np.arange(len(result.joints))
    axes.semilogy(place, result.train.tau.std(axis=0), "_", color=LIMIT, markersize=18, label="deviation of the torque")
    parts = (("learned from", result.train, ACTUAL, -0.12), ("held out", result.test, REFERENCE, 0.12))
    for name, data, colour, shift in parts:
        if data is not None:
            axes.semilogy(place + shift, _errors(result, data), "o", color=colour, markersize=5, label=name)
    axes.set_xticks(
        place, result.joints, rotation=30 if len(place) > 4 else 0, ha="right" if len(place) > 4 else "center"
    )
    unit = "N, N·m" if any(result.prismatic) else "N·m"
    axes.set_title(f"root mean square of the torque error [{unit}]", loc="left")
    axes.legend(frameon=False)


def _errors(result: Learned, data: Dataset) -> np.ndarray:
    return np.sqrt(np.square(torque_errors(result.model, data, result.friction)).mean(axis=0))
