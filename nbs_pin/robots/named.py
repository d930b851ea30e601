"""Arms that files name: a run, data or a controller say which arm they are of, and no more is done than loading it."""

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from nbs_pin.base.exceptions import ArgumentError, RobotError
from nbs_pin.robots.robot import Robot, load_robot

_OPTIONS: dict[str, Any] = {"gravity": (list, float, int), "lock": list, "zero_limits": str}
"""The options of `load_robot` as JSON stores them."""


def load_named(where: str, source: str, options: Mapping[str, Any]) -> Robot:
    """The arm of the name or path `source`, loaded with the options; both are what the file `where` says.

    A xacro file is not expanded: it can read the environment and other files into the arm, which the user has to want.

    Raises:
        ArgumentError: If the options are not those of `Robot.options`.
        RobotError: If it is a xacro file or would give a wrong model; as RobotNotFound, if it does not exist.
    """
    for key, value in options.items():
        texts = key != "lock" or (isinstance(value, list) and all(isinstance(name, str) for name in value))
        if not isinstance(value, _OPTIONS.get(key, ())) or not texts:
            raise ArgumentError(
                f"{where} loads the arm '{source:.200}' with options that this version does not know "
                f"({key}: {value!s:.100}); give it as robot=load_robot(…)."
            )
    if _is_xacro(source):
        raise RobotError(
            f"{where} is of the arm '{source:.200}', a xacro file, which can read the environment and other files when "
            "it is expanded; give it yourself if you trust it, as robot=load_robot(…) or --robot."
        )
    return load_robot(source, **options)


def _is_xacro(source: str) -> bool:
    path = Path(source)
    with suppress(OSError, RuntimeError, ValueError):  # nothing that could be loaded
        path = path.expanduser().resolve()
    return ".xacro" in (Path(source).suffix.lower(), path.suffix.lower())
