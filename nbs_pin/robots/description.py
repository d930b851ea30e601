"""The <robot> element of a description in any format that is read: URDF, xacro or MJCF."""

from dataclasses import dataclass
from pathlib import Path

from nbs_pin.robots.packages import Packages
from nbs_pin.robots.urdf_options import UrdfOptions
from nbs_pin.robots.urdf_source import Node, read_source


@dataclass(frozen=True)
class Description:
    """A description as a <robot> element, and what only its format says."""

    robot: Node
    is_mjcf: bool = False
    """Whether it was MJCF, in which a limit that is left out is none."""
    gravity: tuple[float, float, float] | None = None
    """The acceleration that it states [m/s²], which URDF cannot."""


def read_description(path: Path, options: UrdfOptions, packages: Packages, *, is_tool: bool = False) -> Description:
    """The description in a file, expanded by xacro or compiled by MuJoCo where it must be.

    The format is that of the root element, <robot> or <mujoco>, whatever the ending of the file. The joints of a tool
    count as locked, and the arguments of xacro are the arm's.

    Raises:
        RobotNotFound: If the file does not exist.
        RobotError: If it cannot be read, parsed, expanded or compiled.
        MissingExtra: If it must be expanded and the extra `xacro` is not installed.
    """
    source = read_source(path, {} if is_tool else options.xacro_args, packages)
    if source.element.tag != "mujoco":
        return Description(source)
    from nbs_pin.robots.mjcf import as_urdf  # MuJoCo takes time to import, and URDF files do not need it

    robot, gravity = as_urdf(path, source, options, is_tool=is_tool)
    return Description(robot, True, gravity)
