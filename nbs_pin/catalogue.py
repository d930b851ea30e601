"""The arms that `load_robot` knows by name."""

import importlib.metadata
from dataclasses import dataclass
from pathlib import Path

from nbs_pin.exceptions import RobotNotFound


@dataclass(frozen=True)
class Entry:
    """Where an arm's file is and how it is to be read."""

    name: str
    path: Path
    lock: tuple[str, ...] = ()
    gravity: float = 9.81
    zero_limits: str = "refuse"


_BUNDLED = {"two_link": 9.8, "three_link": 9.81}
_FINGERS = ("panda_finger_joint1", "panda_finger_joint2")
_EXAMPLES: dict[str, tuple[str, tuple[str, ...], str]] = {
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
ROBOT_NAMES: tuple[str, ...] = (*_BUNDLED, *_EXAMPLES)
"""Every name `load_robot` knows."""


def example_robot_share() -> Path:
    """The `share` folder of the installed example-robot-data, whose meshes are `package://example-robot-data/…`."""
    share = importlib.metadata.distribution("example-robot-data").locate_file("cmeel.prefix/share")
    return Path(str(share))


def find(name_or_path: str) -> Entry:
    """The catalogue's entry for a name, or a plain entry for a path; raises RobotNotFound for neither."""
    if name_or_path in _BUNDLED:
        folder = Path(__file__).parent / "_urdf"
        folder = folder if folder.is_dir() else Path(__file__).parent.parent / "urdf"
        return Entry(name_or_path, folder / f"{name_or_path}.urdf", gravity=_BUNDLED[name_or_path])
    if name_or_path in _EXAMPLES:
        path, lock, zero_limits = _EXAMPLES[name_or_path]
        robots = example_robot_share() / "example-robot-data" / "robots"
        return Entry(name_or_path, robots / path, lock, zero_limits=zero_limits)
    if Path(name_or_path).is_file():
        return Entry("", Path(name_or_path).resolve())
    raise RobotNotFound(f"no robot '{name_or_path}': give a file or one of {', '.join(ROBOT_NAMES)}.")
