"""The arms that `load_robot` knows by name."""

import difflib
import importlib.metadata
from dataclasses import dataclass
from pathlib import Path

from nbs_pin.base.exceptions import RobotError, RobotNotFound
from nbs_pin.robots.urdf_options import ZeroLimits


@dataclass(frozen=True)
class Entry:
    """The file of an arm and the settings to load it with."""

    name: str
    path: Path
    lock: tuple[str, ...] = ()
    gravity: float = 9.81
    zero_limits: ZeroLimits = "refuse"


_OUR_FILES = ("two_link", "three_link", "fr3", "ur3e", "ur5e", "ur10e", "gen3", "iiwa14")
_GRAVITY = {"two_link": 9.8}  # the paper's
_FINGERS = ("panda_finger_joint1", "panda_finger_joint2")
_EXAMPLES: dict[str, tuple[str, tuple[str, ...], ZeroLimits]] = {
    "panda": ("panda_description/urdf/panda.urdf", _FINGERS, "refuse"),
    "ur3": ("ur_description/urdf/ur3_robot.urdf", (), "refuse"),
    "ur5": ("ur_description/urdf/ur5_robot.urdf", (), "refuse"),
    "ur10": ("ur_description/urdf/ur10_robot.urdf", (), "refuse"),
    "xarm7": ("xarm_description/urdf/xarm7.urdf", (), "refuse"),
    "z1": ("z1_description/urdf/z1.urdf", (), "refuse"),
    "kinova": ("kinova_description/robots/kinova.urdf", (), "refuse"),
    "so100": ("so_arm_description/urdf/so100.urdf", (), "refuse"),
    "so101": ("so_arm_description/urdf/so101.urdf", (), "refuse"),
    "talos_left_arm": ("talos_data/robots/talos_left_arm.urdf", (), "refuse"),
    "double_pendulum": ("double_pendulum_description/urdf/double_pendulum.urdf", (), "unlimited"),
}
_SUFFIXES = (".urdf", ".xacro")
ROBOT_NAMES: tuple[str, ...] = (*_OUR_FILES, *_EXAMPLES)
"""Names of all arms that `load_robot` knows."""


def example_robot_share() -> Path:
    """The `share` folder of the installed example-robot-data, to which `package://example-robot-data/…` refers."""
    share = importlib.metadata.distribution("example-robot-data").locate_file("cmeel.prefix/share")
    return Path(str(share))


def find(name_or_path: str) -> Entry:
    """The catalogue's entry for a name, or an entry with default settings for a path.

    Raises RobotNotFound, with the nearest names, if it is neither, and RobotError if the path cannot be read.
    """
    if name_or_path in _OUR_FILES:
        folder = Path(__file__).parent.parent / "_urdf"
        folder = folder if folder.is_dir() else Path(__file__).parent.parent.parent / "urdf"
        return Entry(name_or_path, folder / f"{name_or_path}.urdf", gravity=_GRAVITY.get(name_or_path, 9.81))
    if name_or_path in _EXAMPLES:
        path, lock, zero_limits = _EXAMPLES[name_or_path]
        robots = example_robot_share() / "example-robot-data" / "robots"
        return Entry(name_or_path, robots / path, lock, zero_limits=zero_limits)
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
        return Entry("", path.resolve())
    names = ", ".join(ROBOT_NAMES)
    if path.is_dir():
        inside = ", ".join(sorted(file.name for file in path.iterdir() if file.suffix in _SUFFIXES)[:10])
        raise RobotNotFound(f"'{path}' is a directory; give one file in it ({inside or 'it contains no .urdf'}).")
    if path.suffix in _SUFFIXES or len(path.parts) > 1:
        raise RobotNotFound(f"no file '{path}' (current folder {Path.cwd()}); give a file or one of {names}.")
    near = difflib.get_close_matches(path.name, ROBOT_NAMES)
    hint = f" did you mean {' or '.join(near)}?" if near else ""
    raise RobotNotFound(f"no robot '{path}':{hint} give a file or one of {names}.")
