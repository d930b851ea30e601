"""Inputs of several commands: an arm with its limits, a law by name or from a file."""

import math
from typing import Any

from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.cli.track import Track
from nbs_pin.cli.train import Train
from nbs_pin.cli.values import SAVED, OptionError
from nbs_pin.controllers.controller import Controller
from nbs_pin.controllers.registry import build_law
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
