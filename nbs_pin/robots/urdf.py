"""A URDF file, checked and brought to the form from which every engine builds its model."""

import math
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path

from nbs_pin.robots.attachments import attach
from nbs_pin.robots.bodies import check_bodies
from nbs_pin.robots.description import read_description
from nbs_pin.robots.joint_drive import Drive, read_drives, without_rotor
from nbs_pin.robots.packages import Packages
from nbs_pin.robots.urdf_checks import Joint, check_axis, check_tree
from nbs_pin.robots.urdf_limits import Limits, read_limits
from nbs_pin.robots.urdf_options import LIMITS, UrdfOptions

_UNLIMITED = 1e9
"""Value of an absent limit in the XML, because no engine reads "inf"."""
_DYNAMIC = {"link": ("inertial",), "joint": ("origin", "parent", "child", "axis", "limit", "dynamics")}


@dataclass(frozen=True)
class JointData:
    """One moving joint as stated in the URDF, in SI units; inf where the file states no limit."""

    name: str
    continuous: bool
    prismatic: bool
    lower: float
    upper: float
    effort: float
    velocity: float
    damping: float
    friction: float
    armature: float


@dataclass(frozen=True)
class Urdf:
    """A checked description; in `xml`, locked joints are fixed and continuous joints are unbounded revolute joints.

    `xml` has every number of the dynamics in its shortest exact form and absent limits as ±1e9. Visuals, materials and
    transmissions are those of the file, unchecked.
    """

    name: str
    path: Path
    xml: bytes
    joints: tuple[JointData, ...]
    gravity: tuple[float, float, float] | None = None
    """Gravitational acceleration that the file states [m/s²], as MJCF does."""
    without_rotor: tuple[str, ...] = ()
    """Joints whose transmission states a reduction, while no rotor inertia is known."""

    def without_geometry(self) -> bytes:
        """The dynamics alone: links with inertias and joints, without visual, collision, material or extension."""
        source = ET.fromstring(self.xml)
        robot = ET.Element("robot", {"name": self.name})
        for part in source:
            if part.tag in _DYNAMIC:
                copy = ET.SubElement(robot, part.tag, part.attrib)
                copy.extend(_bare(child) for child in part if child.tag in _DYNAMIC[part.tag])
        return ET.tostring(robot)


def read_urdf(path: Path, options: UrdfOptions | None = None) -> Urdf:
    """The checked description in the `.urdf`, `.xacro` or MJCF file `path`, read as `options` say.

    An arm without a name, which drawing tools refuse, is named after its file.

    Raises:
        RobotError: If the description would give a wrong model; names file, line, element, value and remedy.
        RobotNotFound: If the file does not exist.
        MissingExtra: If it is a `.xacro` file and the extra `xacro` is not installed.
    """
    options = UrdfOptions() if options is None else options
    packages = Packages(path, options.package_dirs)
    source = read_description(path, options, packages)
    robot = source.robot
    robot.element.set("name", robot.element.get("name", path.stem))
    options = attach(robot, options, packages)
    joints = check_tree(robot, options)
    check_bodies(robot, joints, options, packages)
    limits = read_limits(joints, options, left_out="unlimited" if source.is_mjcf else "refuse")
    drives = read_drives(robot, joints, options)
    moving = tuple(_settle(joint, limits[joint.name], drives[joint.name], options) for joint in joints if joint.moves)
    bare = without_rotor(robot, drives, options)
    return Urdf(robot.text("name"), path, ET.tostring(robot.element), moving, source.gravity, bare)


def _settle(joint: Joint, limits: Limits, drive: Drive, options: UrdfOptions) -> JointData:
    """The data of a moving joint; its element becomes a revolute or prismatic joint that states all limits.

    An effort or velocity limit given in place of the file's is not written into it: the description, and with it
    `Robot.sha256`, stays that of the file.
    """
    check_axis(joint)
    element = joint.node.element
    stated = element.find("limit")
    stated = ET.SubElement(element, "limit") if stated is None else stated
    for key, value in zip(LIMITS, limits, strict=True):
        replaced = key in ("effort", "velocity") and options.limit(joint.name, key) is not None
        if not replaced or not float(stated.get(key, "0")) > 0.0:
            stated.set(key, repr(value if math.isfinite(value) else math.copysign(_UNLIMITED, value)))
    element.set("type", "prismatic" if joint.kind == "prismatic" else "revolute")
    wrapped = joint.kind == "continuous" and math.isinf(limits.lower) and math.isinf(limits.upper)
    return JointData(joint.name, wrapped, joint.kind == "prismatic", *limits, *drive)


def _bare(element: ET.Element) -> ET.Element:
    """A copy without the whitespace of the file, so that equal dynamics give equal bytes."""
    copy = ET.Element(element.tag, element.attrib)
    copy.extend(_bare(child) for child in element)
    return copy
