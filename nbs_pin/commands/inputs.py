"""Inputs of several commands: an arm with its limits, a law by name or from a file."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.shown import joints_told
from nbs_pin.certificates.admissible import Admissible
from nbs_pin.cli.export_run import ExportRun
from nbs_pin.cli.replay import Replay
from nbs_pin.cli.track import Track
from nbs_pin.cli.train import Train
from nbs_pin.cli.values import SAVED, OptionError, plain_numbers
from nbs_pin.controllers.controller import Controller
from nbs_pin.controllers.registry import build_law
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.robots.robot import Robot, load_robot
from nbs_pin.robots.urdf_options import ALL
from nbs_pin.storage.checkpoints import load


def arm_of(options: Track | Train) -> Robot:
    """The arm with the effort limits of the options, that of --limits for the joints it names.

    Raises OptionError if they contradict each other.
    """
    if options.no_effort_limit and options.effort_limit is not None:
        raise OptionError("--effort-limit and --no-effort-limit were both given; choose one.")
    given = options.arm.given()
    if options.no_effort_limit or options.effort_limit is not None:
        limits = given.get("limits", {})
        if "effort" in limits.get(ALL, {}):
            raise OptionError(f"--limits {ALL}.effort and --effort-limit or --no-effort-limit were given; choose one.")
        effort = {"effort": options.effort_limit or math.inf}
        given["limits"] = {**limits, ALL: {**limits.get(ALL, {}), **effort}}
    return load_robot(options.robot, **given)


def run_file(given: Path) -> Path:
    """The file of a run, or that in a folder of results."""
    return given / "run.npz" if given.is_dir() else given


def arm_that_ran(options: Replay | ExportRun) -> Robot | None:
    """The arm that --robot names, None for that of the run; raises OptionError for options of an arm without it."""
    if options.robot is None:
        options.arm.refuse_without_arm("the run names its arm; give it with --robot")
        return None
    return load_robot(options.robot, **options.arm.given())


def law_of(name: str, robot: Robot, **settings: Any) -> Controller:
    """The law of that name (`build_law`), or the controller in a .nbs file, which ignores the settings.

    Raises:
        ArgumentError: If the name is unknown or the file has a model or is for another arm; errors of `load` otherwise.
    """
    if not name.endswith(SAVED):
        return build_law(name, robot, **settings)
    stored = load(name, robot)
    if not isinstance(stored, Controller):
        raise ArgumentError(f"{name} contains a {type(stored).__name__}, a model; give a file with a controller.")
    return stored


def stated_friction(text: str | None, robot: Robot) -> JointFriction | None:
    """The joint friction that --friction states, None for the URDF's."""
    if text is None:
        return None
    viscous, coulomb = plain_numbers(text) or [0.0, 0.0]
    return JointFriction(np.full(robot.nv, viscous), np.full(robot.nv, coulomb))


def box_or_ball(numbers: list[float], nv: int, *, norm: bool) -> Admissible:
    """The box |τ_d,i| ≤ numbers, one for all joints or one per joint, or the ball ‖τ_d‖ ≤ number [N·m].

    Raises:
        ArgumentError: If there are too many or too few numbers.
    """
    if norm:
        if len(numbers) != 1:
            raise ArgumentError(f"a norm is one number and {len(numbers)} were given; give one, or omit --norm.")
        return Admissible.of(numbers[0], nv)
    if len(numbers) not in (1, nv):
        raise ArgumentError(
            f"{len(numbers)} torques were given for {joints_told(nv)}; give one for all joints, or one per joint "
            "[N·m, N where it slides]."
        )
    return Admissible.of(np.full(nv, numbers, dtype=float), nv)
