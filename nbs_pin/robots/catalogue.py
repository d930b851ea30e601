"""The arms that `load_robot` knows by name."""

import difflib
import importlib.metadata
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from nbs_pin.base.exceptions import RobotError, RobotNotFound
from nbs_pin.robots.arm_file import read_arm_file
from nbs_pin.robots.public_descriptions import PREFIX, find_public
from nbs_pin.robots.urdf_options import layered


@dataclass(frozen=True)
class Entry:
    """The file of an arm and the settings to load it with."""

    name: str
    """The catalogue's name, empty for a file."""
    path: Path
    """The description."""
    source: Path
    """What was given: the description, the `.toml` file that names it, or a name in robot_descriptions."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """Arguments of `load_robot` where none are given."""


_OUR_FILES: dict[str, Mapping[str, Any]] = {
    "two_link": {"gravity": 9.8},
    **{name: {} for name in ("three_link", "fr3", "ur3e", "ur5e", "ur10e", "gen3", "iiwa14")},
}
_FINGERS = ("panda_finger_joint1", "panda_finger_joint2")
_EXAMPLES: dict[str, tuple[str, Mapping[str, Any]]] = {
    "panda": ("panda_description/urdf/panda.urdf", {"lock": _FINGERS}),
    "ur3": ("ur_description/urdf/ur3_robot.urdf", {}),
    "ur5": ("ur_description/urdf/ur5_robot.urdf", {}),
    "ur10": ("ur_description/urdf/ur10_robot.urdf", {}),
    "xarm7": ("xarm_description/urdf/xarm7.urdf", {}),
    "z1": ("z1_description/urdf/z1.urdf", {}),
    "kinova": ("kinova_description/robots/kinova.urdf", {}),
    "so100": ("so_arm_description/urdf/so100.urdf", {}),
    "so101": ("so_arm_description/urdf/so101.urdf", {}),
    "talos_left_arm": ("talos_data/robots/talos_left_arm.urdf", {}),
    "double_pendulum": ("double_pendulum_description/urdf/double_pendulum.urdf", {"zero_limits": "unlimited"}),
}
_SUFFIXES = (".urdf", ".xacro", ".xml", ".toml")
ROBOT_NAMES: tuple[str, ...] = (*_OUR_FILES, *_EXAMPLES)
"""Names of all arms that `load_robot` knows."""


def example_robot_share() -> Path:
    """The `share` folder of the installed example-robot-data, to which `package://example-robot-data/…` refers."""
    share = importlib.metadata.distribution("example-robot-data").locate_file("cmeel.prefix/share")
    return Path(str(share))


def find(name_or_path: str) -> Entry:
    """The catalogue's entry for a name, or an entry with default settings for a path.

    "robot_descriptions:NAME" is a description of that package. Raises RobotNotFound, with the nearest names, if it is
    none of these, and RobotError if the path cannot be read.
    """
    if name_or_path in _OUR_FILES:
        folder = Path(__file__).parent.parent / "_urdf"
        folder = folder if folder.is_dir() else Path(__file__).parent.parent.parent / "urdf"
        path = folder / f"{name_or_path}.urdf"
        return Entry(name_or_path, path, path, _OUR_FILES[name_or_path])
    if name_or_path in _EXAMPLES:
        within, options = _EXAMPLES[name_or_path]
        path = example_robot_share() / "example-robot-data" / "robots" / within
        return Entry(name_or_path, path, path, options)
    if name_or_path.startswith(PREFIX):
        path, options = find_public(name_or_path.removeprefix(PREFIX))
        return Entry("", path, Path(name_or_path), options)
    try:
        file = Path(name_or_path).expanduser()
    except RuntimeError as error:  # a user who is not there
        raise RobotNotFound(f"cannot read '{name_or_path:.200}': {error} Give the whole path.") from error
    try:
        return _entry_of_file(file)
    except OSError as error:
        if isinstance(error, RobotNotFound):
            raise
        raise RobotError(f"cannot read '{name_or_path:.200}': {error.strerror}; check the path.") from error


def _entry_of_file(path: Path) -> Entry:
    """An entry with default settings for a file; raises RobotNotFound with suggestions if there is none."""
    if path.is_file():
        path = path.resolve()
        return _entry_of_toml(path) if path.suffix == ".toml" else Entry("", path, path)
    names = ", ".join(ROBOT_NAMES)
    if path.is_dir():
        inside = ", ".join(sorted(file.name for file in path.iterdir() if file.suffix in _SUFFIXES)[:10])
        raise RobotNotFound(f"'{path}' is a directory; give one file in it ({inside or 'it contains no .urdf'}).")
    if path.suffix in _SUFFIXES or len(path.parts) > 1:
        raise RobotNotFound(f"no file '{path}' (current folder {Path.cwd()}); give a file or one of {names}.")
    near = difflib.get_close_matches(path.name, ROBOT_NAMES)
    hint = f" did you mean {' or '.join(near)}?" if near else ""
    raise RobotNotFound(f"no robot '{path}':{hint} give a file or one of {names}.")


def _entry_of_toml(path: Path) -> Entry:
    """The entry of the description that a `.toml` file names, with the file's options over the catalogue's."""
    description, options = read_arm_file(path)
    if Path(description).suffix == ".toml":
        raise RobotError(f"{path}: its description '{description:.200}' is a .toml file too; name a URDF or an arm.")
    entry = find(description)
    return Entry("", entry.path, path, layered(entry.options, options))
