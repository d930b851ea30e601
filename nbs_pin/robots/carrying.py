"""Loads that an arm carries besides what its description and its options state."""

import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping

import numpy as np
from jaxtyping import Float

from nbs_pin.robots.catalogue import find
from nbs_pin.robots.robot import Robot
from nbs_pin.robots.urdf_options import Payload, layered, read_options


def carrying(robot: Robot, loads: Iterable[tuple[str, Payload]]) -> Robot:
    """The arm with more loads, each at a link ("" is the last), which add up with those that it has there.

    Raises:
        RobotError: If there is no such link, or "" is given and there are several last ones.
    """
    own = read_options(layered(find(robot.source).options, robot.options)).payload
    last, carried, changed = _last_link(robot, own), dict(own), dict[str, None]()
    for link, load in loads:
        # "" and the name of the last link are two keys for one place.
        at = next((key for key in carried if (key or last) == (link or last)), link)
        carried[at] = _together(carried[at], load) if at in carried else load
        changed[at] = None
    for at in changed:
        robot = robot.with_payload(at, carried[at].mass, carried[at].com, _matrix(carried[at]))
    return robot


def _last_link(robot: Robot, own: Mapping[str, Payload]) -> str:
    """The only link without a child, apart from the payloads; "" if there are several."""
    arm = ET.fromstring(robot.urdf.xml)
    joints = [(joint.find("parent"), joint.find("child")) for joint in arm.iterfind("joint")]
    bound = [(parent.get("link", ""), child.get("link", "")) for parent, child in joints
             if parent is not None and child is not None]  # fmt: skip
    loads = {child for parent, child in bound if child == f"payload_{parent}"} if own else set()
    parents = {parent for parent, child in bound if child not in loads}
    ends = {link.get("name", "") for link in arm.iterfind("link")} - parents - loads
    return ends.pop() if len(ends) == 1 else ""


def _together(one: Payload, other: Payload) -> Payload:
    """Both as one body, by Steiner's theorem."""
    mass, centres = one.mass + other.mass, np.array([one.com, other.com])
    com = (one.mass * centres[0] + other.mass * centres[1]) / mass
    inertia = np.zeros((3, 3))
    for load, arm in zip((one, other), centres - com, strict=True):
        inertia += _matrix(load) + load.mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    x, y, z = com.tolist()
    return Payload(mass, (x, y, z), tuple(inertia[np.triu_indices(3)].tolist()))


def _matrix(load: Payload) -> Float[np.ndarray, "3 3"]:
    """The inertia about the centre of mass [kg·m²]."""
    matrix = np.zeros((3, 3))
    matrix[np.triu_indices(3)] = load.inertia
    return matrix + np.triu(matrix, 1).T
