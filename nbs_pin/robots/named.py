"""Arms that files name: a run, data or a controller say which arm they are of, and no more is done than loading it."""

import inspect
from collections.abc import Mapping
from typing import Any

from nbs_pin.base.doors import as_loaded, own_arm
from nbs_pin.base.exceptions import ArgumentError, RobotNotFound
from nbs_pin.base.records import Run
from nbs_pin.robots.robot import Robot, load_robot
from nbs_pin.robots.xacro_source import refusing


def load_named(where: str, source: str, options: Mapping[str, Any]) -> Robot:
    """The arm of the name or path `source`, loaded with the options; both are what the file `where` says.

    A xacro file is not expanded: it can read the environment and other files into the arm, which the user has to want.

    Raises:
        ArgumentError: If the options are not those of `load_robot`.
        RobotError: If it is a xacro file or would give a wrong model; as RobotNotFound, if it does not exist.
    """
    unknown = options.keys() - inspect.signature(load_robot).parameters.keys()
    if unknown:
        raise ArgumentError(
            f"{where} loads the arm '{source:.200}' with options that this version does not know "
            f"({', '.join(sorted(unknown)):.200}); give it as {own_arm()}."
        )
    because = (
        f"{where} is of the arm '{source:.200}', a xacro file, which can read the environment and other files when it "
        f"is expanded; give it yourself if you trust it, as {own_arm()}."
    )
    try:
        with refusing(because):
            return load_robot(source, **options)
    except RobotNotFound as error:
        raise RobotNotFound(
            f"{where} is of the arm {as_loaded(source, options)}, which is not there; put it back, or give it as "
            f"{own_arm()}."
        ) from error


def robot_of(run: Run) -> Robot:
    """The robot that the run names; raises ArgumentError unless it is still the one that ran."""
    if not run.robot:
        raise ArgumentError(f"the run names no robot: give it as {own_arm()}.")
    robot = load_named("the run", run.robot, run.robot_options)
    if robot.sha256 != run.robot_sha256:
        raise ArgumentError(
            f"'{run.robot}' is not the arm that ran (description or gravity differ: {robot.sha256[:12]} now, "
            f"{run.robot_sha256[:12] or 'nothing'} in the run): give the one that ran as {own_arm()}."
        )
    return robot
