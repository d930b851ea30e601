"""Arms of the package robot_descriptions, which fetches public descriptions from their repositories."""

import difflib
import importlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from nbs_pin.base.exceptions import MissingExtra, RobotError, RobotNotFound

PREFIX = "robot_descriptions:"
"""Begins the name of an arm of that package."""


def find_public(name: str) -> tuple[Path, Mapping[str, Any]]:
    """The file of a description by its name in robot_descriptions, and the arguments of `load_robot` that it needs.

    The package keeps what it has fetched; MJCF is taken where a description has several formats.

    Raises:
        MissingExtra: If the extra `descriptions` is not installed.
        RobotNotFound: If there is no such description.
        RobotError: If it cannot be fetched, or has no file that can be read.
    """
    try:
        known = importlib.import_module("robot_descriptions").DESCRIPTIONS
    except ModuleNotFoundError as error:
        raise MissingExtra(
            f"'{PREFIX}{name:.100}' needs robot_descriptions: pip install 'nbs-pin[descriptions]'."
        ) from error
    if name not in known:
        near = [other for other in known if name in other] or difflib.get_close_matches(name, known) or sorted(known)
        names = ", ".join(near[:3])
        raise RobotNotFound(f"no description '{name:.100}' in robot_descriptions; give one such as {names}.")
    try:
        module = importlib.import_module(f"robot_descriptions.{name}")
    except Exception as error:  # git, the network and the file system raise whatever they like
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise RobotError(
            f"robot_descriptions cannot fetch '{name}' ({reason}); connect to the network once, or give the path of "
            "its file."
        ) from error
    for attribute in ("MJCF_PATH", "URDF_PATH", "XACRO_PATH"):
        path = Path(getattr(module, attribute, ""))
        if path.is_file():
            arguments = getattr(module, "XACRO_ARGS", {}) if attribute == "XACRO_PATH" else {}
            return path.resolve(), {"xacro_args": dict(arguments)} if arguments else {}
    raise RobotError(f"'{name}' of robot_descriptions has no file in MJCF, URDF or xacro; give another description.")
