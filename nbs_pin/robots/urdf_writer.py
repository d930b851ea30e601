"""A URDF of an arm with other bodies, rotors and friction than its own description states."""

import math
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pinocchio as pin

from nbs_pin.base.files import write_whole
from nbs_pin.robots.joint_drive import Drive
from nbs_pin.robots.robot import Robot
from nbs_pin.robots.urdf import JointData
from nbs_pin.robots.urdf_options import LIMITS

_INERTIA = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}


def write_urdf(robot: Robot, path: str | Path, model: pin.Model, drives: Mapping[str, Drive]) -> Path:
    """Write the description of the arm with the bodies of `model` and these drives by joint; returns its path.

    The frame of a joint in Pinocchio is that of its child link, which therefore gets the whole body; links that are
    fixed to it lose their inertia, which is part of that body. Links that do not move keep theirs.
    """
    description = ET.fromstring(robot.urdf.xml)
    joints = {str(joint.get("name")): joint for joint in description.findall("joint")}
    links = {str(link.get("name")): link for link in description.findall("link")}
    for joint in robot.joints:
        child = _end(joints[joint.name], "child")
        for name in (child, *_fixed_to(child, list(joints.values()))):
            for stated in links[name].findall("inertial"):
                links[name].remove(stated)
        links[child].insert(0, _inertial(model.inertias[model.getJointId(joint.name)]))
        _settle(joints[joint.name], joint, drives[joint.name])
    ET.indent(description)
    return write_whole(path, ET.tostring(description, encoding="utf-8", xml_declaration=True))


def _inertial(body: pin.Inertia) -> ET.Element:
    inertial = ET.Element("inertial")
    ET.SubElement(inertial, "origin", {"xyz": _text(body.lever), "rpy": "0 0 0"})
    ET.SubElement(inertial, "mass", {"value": repr(float(body.mass))})
    ET.SubElement(inertial, "inertia", {name: repr(float(body.inertia[at])) for name, at in _INERTIA.items()})
    return inertial


def _settle(element: ET.Element, joint: JointData, drive: Drive) -> None:
    """State the limits that the arm has and the drive; a joint without position limits is continuous again.

    Effort and velocity limits that were taken away stay as in the description: URDF states one of each.
    """
    limit = element.find("limit")
    limit = ET.SubElement(element, "limit") if limit is None else limit
    for key in LIMITS:
        value = getattr(joint, key)
        if math.isfinite(value):
            limit.set(key, repr(value))
    if joint.continuous:
        element.set("type", "continuous")
        for key in ("lower", "upper"):
            limit.attrib.pop(key, None)
    for stated in element.findall("dynamics"):
        element.remove(stated)
    ET.SubElement(element, "dynamics", {name: repr(float(value)) for name, value in drive._asdict().items()})


def _fixed_to(link: str, joints: list[ET.Element]) -> list[str]:
    """The links that are fixed to a link, directly or by others."""
    ends = [_end(joint, "child") for joint in joints if joint.get("type") == "fixed" and _end(joint, "parent") == link]
    return [name for end in ends for name in (end, *_fixed_to(end, joints))]


def _end(joint: ET.Element, which: str) -> str:
    end = joint.find(which)
    assert end is not None  # the description has been checked
    return str(end.get("link"))


def _text(numbers: np.ndarray) -> str:
    return " ".join(repr(float(number)) for number in numbers)
