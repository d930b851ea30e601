"""`nbs-pin learn`: a model of an arm from data, and its error on held-out motions."""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from nbs_pin.base.doors import own_arm
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.plain import plain
from nbs_pin.base.progress import heartbeat
from nbs_pin.base.summaries import SUMMARY
from nbs_pin.base.units import by_quantity, several, units
from nbs_pin.cli.learn import Learn
from nbs_pin.cli.log_options import numbers_of
from nbs_pin.cli.values import OptionError
from nbs_pin.commands.identified_files import FILES as IDENTIFIED, write_identified
from nbs_pin.commands.learned_tables import print_learned
from nbs_pin.commands.results import Results, drawing, sha256_of
from nbs_pin.dynamics.friction import DriveFriction, JointFriction
from nbs_pin.dynamics.identified import IdentifiedDynamics
from nbs_pin.dynamics.provider import DynamicsProvider
from nbs_pin.identification.coupling import Coupling
from nbs_pin.identification.datasets import Dataset
from nbs_pin.identification.fit import fit, split_data
from nbs_pin.identification.fit_report import FitReport, torque_errors
from nbs_pin.identification.logs import load_log
from nbs_pin.reports.captions import chosen
from nbs_pin.reports.plotting import ACTUAL, ERROR, LIMIT, REFERENCE, Heading, picture
from nbs_pin.reports.verdicts import verdict_of
from nbs_pin.robots.named import load_named
from nbs_pin.robots.robot import Robot, load_robot
from nbs_pin.storage.checkpoints import save

FILES = ("model.nbs", "learning.png", *IDENTIFIED, SUMMARY)
"""The files that are written, some for identified bodies alone."""
_ASKED = {"auto": None, "on": True, "off": False}


def run(options: Learn, console: Console, notes: Console) -> None:
    """Learn, write and print; raises NbsPinError, OSError, and KeyboardInterrupt after an early end."""
    if not options.data:
        raise OptionError("no DATA; give the path of a log, or of data of nbs-pin collect.")
    files = options.data[0] if len(options.data) == 1 else options.data
    with notes.status(f"loading {options.data[0]}"):
        if options.robot is None:
            options.arm.refuse_without_arm("give the arm with --robot")
        data, robot = data_and_arm(files, options.robot, options.read(), options.arm.given())
    name = options.data[0].stem if robot is None else robot.name
    # Data are identified by their fingerprint, not by their path.
    prints = [sha256_of(file) for file in options.data]
    results = Results.of(options, name, robot, data=None, data_sha256=prints[0] if len(prints) == 1 else prints)
    results = results.check(FILES, options.force, whole={"interrupted": False}, whose="another model")
    given = {name: getattr(options, name) for name in ("optimiser", "iterations")}
    given["loss"] = None if options.loss == "torque" else options.loss  # which every model minimises
    given = {name: value for name, value in given.items() if value is not None}
    data, held_out = _held_out(data, options)
    asked = {"friction": options.friction, "offset": options.offset, "rotor_inertia": options.rotors}
    drives = {name: _ASKED[choice] for name, choice in asked.items()}
    common: dict[str, Any] = {"held_out": held_out, "transition": options.transition, "progress": True} | drives
    common["coupling"] = _matrix(options.coupling, data.nv)
    with results.made() as folder:
        with heartbeat(f"learning {options.model}"):
            result = learn(data, options.model, robot, options.seed, **common, **given)
        interrupted = result.report.stopped == "interrupted"
        with notes.status(f"writing into {folder}"):
            found = figures(result)
            with results.replaced(FILES, found, interrupted=interrupted) as draft:
                if isinstance(result.model, IdentifiedDynamics):
                    write_identified(result.model, draft)
                save(result.model, draft / FILES[0], info={"learned": results.facts | {"interrupted": interrupted}})
            with drawing(folder / FILES[1]) as path:
                settings = chosen(results.facts["settings"], "loss", "optimiser", "held_out", "seed")
                verdict = verdict_of(found, interrupted=interrupted)
                plot_learning(result, path, Heading(f"{name}: {options.model}, learned", settings, verdict))
    print_learned(console, f"{name}, {options.model}", found, verbose=options.verbose, interrupted=interrupted)
    against = () if robot is not None else ("--against", "ROBOT")
    following = () if interrupted else ("compare", results.folder / FILES[0], *against)
    results.show(console, FILES, *following)
    if interrupted:
        raise KeyboardInterrupt


@dataclass(frozen=True, eq=False)
class Learned:
    """A learned model, with its training and test data."""

    model: DynamicsProvider
    report: FitReport
    friction: JointFriction | None
    train: Dataset
    test: Dataset | None
    joints: tuple[str, ...]
    prismatic: tuple[bool, ...]


def arm_of(data: Dataset) -> Robot | None:
    """The arm that the data name, if any.

    Raises:
        ArgumentError: If its description has changed.
        RobotNotFound: If its description is gone.
    """
    said = data.about.get("robot")
    if not isinstance(said, dict) or not said.get("source"):
        return None
    options = said.get("options", {})
    robot = load_named("the data", str(said["source"]), options if isinstance(options, dict) else {"options": options})
    if robot.sha256 != said.get("sha256", robot.sha256):
        raise ArgumentError(
            f"the data: the description {said['source']} has changed since; give the arm of then as {own_arm()}."
        )
    return robot


def _matrix(typed: str, n: int) -> np.ndarray | bool | None:
    """The coupling that was typed."""
    if typed in ("auto", "off"):
        return False if typed == "off" else None
    matrix = np.eye(n)
    for entry in typed.split(","):
        place, _, turns = entry.partition("=")
        motor, joint = (int(k) for k in place.split("."))
        if motor > n or joint > n or motor == joint:
            raise OptionError(f"--coupling has {place}, expected the numbers of a motor and another joint up to {n}.")
        matrix[motor - 1, joint - 1] = float(turns)
    return matrix


def _held_out(data: Dataset, options: Learn) -> tuple[Dataset, Dataset | float]:
    """The data without the trajectories to hold out, and these, or the share to hold out of all."""
    if options.held_out_trajectories is None:
        return data, options.held_out if data.can_be_split else 0.0
    numbers = numbers_of(options.held_out_trajectories)
    absent = [k for k in numbers if k not in data.trajectory]
    out = np.isin(data.trajectory, numbers)
    if absent or out.all():
        known = ", ".join(map(str, np.unique(data.trajectory)))
        raise OptionError(f"--held-out-trajectories has {(absent or numbers)[0]}; give some of {known:.200}, not all.")
    return data.take(~out), data.take(out)


def data_and_arm(
    path: str | Path | Sequence[Path], arm: str | None, read: Mapping[str, Any], load: Mapping[str, Any] | None = None
) -> tuple[Dataset, Robot | None]:
    """The data in a file and the arm of that name or path, or else the one that the data name.

    `read` has further arguments of `load_log`, `load` of `load_robot`.
    """
    given = None if arm is None else load_robot(arm, **(load or {}))
    data = load_log(path, robot=given, **read)
    return data, given or arm_of(data)


def learn(data: Dataset, model: str, robot: Robot | None, seed: int = 0, **settings: Any) -> Learned:
    """The model that `fit` learns from the data, with its settings and errors, and the data held out as a test."""
    train, test = split_data(data, settings.pop("held_out", None), seed)
    found = fit(train, model, seed, robot=robot, held_out=0.0 if test is None else test, **settings)
    coupled = Coupling.of_plain(found.report.details)
    if coupled is not None and coupled.at_motors:
        train, test = coupled.of_joints(train), None if test is None else coupled.of_joints(test)
    joints = tuple(f"joint {i + 1}" for i in range(data.nv)) if robot is None else robot.joint_names
    return Learned(found, found.report, found.friction, train, test, joints, tuple(data.prismatic.tolist()))


def figures(result: Learned) -> dict[str, Any]:
    """The results of the fit as JSON can store them; units in the keys, N for prismatic joints.

    Each joint has the RMS torque error on training and test data, and the standard deviation of its torque.
    """
    report = dataclasses.asdict(result.report)
    curves = {name: report.pop(name) for name in ("history", "held_out")}
    report["details"] = {k: x for k, x in report["details"].items() if not k.endswith("deviations")}  # in a table
    friction = result.friction
    return plain(
        report
        | {
            "doubts": list(result.train.about.get("doubts", ())),
            "trajectories": result.train.trajectories,
            "test_samples": 0 if result.test is None else len(result.test),
            "joints": result.joints,
            "units": by_quantity(result.prismatic),
            "rms_torque_error_Nm": _errors(result, result.train),
            "rms_test_torque_error_Nm": None if result.test is None else _errors(result, result.test),
            "torque_deviation_Nm": result.train.tau.std(axis=0),
            "viscous_friction": None if friction is None else friction.viscous,
            "coulomb_friction_Nm": None if friction is None else friction.coulomb,
            "rotor_inertia": _rotors(result.model),
            "coupling": report["details"].get("coupling"),
            **_others(friction),
            "curves": curves,
        }
    )


def _others(friction: JointFriction | None) -> dict[str, Any]:
    """Offsets and the terms of friction besides viscous and Coulomb friction, as far as some joint has them."""
    if not isinstance(friction, DriveFriction):
        return {}
    terms = {
        "offset_Nm": friction.offset,
        "viscous_asymmetry": friction.asymmetry,
        "stribeck_friction_Nm": friction.stribeck,
        "load_friction_share": friction.load,
    }
    found = {name: value for name, value in terms.items() if value.any()}
    return found | ({"stribeck_speed": friction.stribeck_speed} if friction.stribeck.any() else {})


def _rotors(model: DynamicsProvider) -> np.ndarray | None:
    """The rotor inertias that were learned beside bodies, None where they are part of M."""
    found = getattr(model, "motor_inertia", getattr(model, "rotor_inertia", None))
    network = getattr(model, "network", None)
    if found is None and network is not None and hasattr(network, "rotors"):
        found = network.rotors.detach().numpy(force=True) ** 2
    return found if found is not None and np.any(found) else None


def plot_learning(result: Learned, path: str | Path, heading: Heading | None = None) -> Path:
    """Plot the course of the fit and write the picture (`plotting.picture`); returns its path.

    Left: normalised mean squared residual by iteration, on training and held-out data. Right: RMS torque error of each
    joint on both, between the standard deviation of its torque and the noise in the data, where that is known. Of a
    model that was solved without iterations only the latter.
    """
    curves = (("training", result.report.history, ACTUAL), ("held out", result.report.held_out, REFERENCE))
    width = 11.0 if result.report.history else 7.0
    with picture(path, width, 4.2, heading=heading) as figure:
        if not result.report.history:
            _draw_errors(figure.subplots(), result)
            return Path(path)
        curve, bars = figure.subplots(1, 2)
        for name, values, colour in curves:
            if values:
                curve.semilogy(values, color=colour, label=name)
        curve.legend(frameon=False)
        curve.set(xlabel="iteration")
        curve.set_title("residual, mean square over variance", loc="left")
        _draw_errors(bars, result)
    return Path(path)


def _draw_errors(axes: Any, result: Learned) -> None:
    place = np.arange(len(result.joints))
    noise = result.report.details.get("noise_Nm")
    axes.semilogy(place, result.train.tau.std(axis=0), "_", color=LIMIT, markersize=26, label="standard deviation")
    if noise is not None:
        axes.semilogy(place, noise, "_", color=ERROR, markersize=26, label="noise in the data")
    parts = (("training", result.train, ACTUAL, -0.12), ("held out", result.test, REFERENCE, 0.12))
    for name, data, colour, shift in parts:
        if data is not None:
            axes.semilogy(place + shift, _errors(result, data), "o", color=colour, markersize=5, label=name)
    low, high = axes.get_ylim()
    axes.set_ylim(10.0 ** np.floor(np.log10(low)), 10.0 ** np.ceil(np.log10(high)))  # so that two powers are written
    axes.set_xticks(
        place, result.joints, rotation=30 if len(place) > 4 else 0, ha="right" if len(place) > 4 else "center"
    )
    axes.set_title(f"RMS torque error [{several(units('torque', result.prismatic))}]", loc="left")
    axes.legend(frameon=False)


def _errors(result: Learned, data: Dataset) -> np.ndarray:
    return np.sqrt(np.square(torque_errors(result.model, data, result.friction)).mean(axis=0))
