"""A compiled MJCF description as the tree of a URDF: links, joints, inertias, numbers in shortest exact form.

A body of MJCF has any number of joints, each about an anchor in the frame of the body, and its coordinates start at a
reference value. In the URDF each becomes a joint at its anchor, turned back by that value, so that both mean the same
position by q; the links between joints of one body have no mass, and the last carries the body.
"""

import xml.etree.ElementTree as ET
from dataclasses import dataclass, field
from typing import Any

import mujoco
import numpy as np
import pinocchio as pin

from nbs_pin.base.exceptions import RobotError
from nbs_pin.robots.mjcf_files import MjcfFiles
from nbs_pin.robots.mjcf_joints import JointTerms
from nbs_pin.robots.rotations import about, from_quaternion, to_rpy
from nbs_pin.robots.urdf_checks import LONGEST_WAY, MOST_TURNED
from nbs_pin.robots.urdf_source import Place, shorten

_KINDS = {
    int(mujoco.mjtJoint.mjJNT_FREE): "floating",
    int(mujoco.mjtJoint.mjJNT_BALL): "ball",
    int(mujoco.mjtJoint.mjJNT_SLIDE): "prismatic",
    int(mujoco.mjtJoint.mjJNT_HINGE): "revolute",
}

_SAME_FRAME, _SAME_AXES = int(mujoco.mjtSameFrame.mjSAMEFRAME_BODY), int(mujoco.mjtSameFrame.mjSAMEFRAME_BODYROT)


@dataclass
class Tree:
    """The <robot> element that is built, and where its parts are written."""

    robot: ET.Element
    model: Any
    files: MjcfFiles
    is_tool: bool
    """Whether what is fixed to its world moves."""
    places: dict[ET.Element, Place]
    bodies: list[str] = field(default_factory=list)
    """The names of the bodies, those of the links in which their frames are."""
    taken: dict[str, set[str]] = field(default_factory=lambda: {"link": set(), "joint": set()})

    def add(self, parent: ET.Element, place: Place, tag: str, **attributes: str) -> ET.Element:
        """A new element; links and joints are given names that none has yet."""
        if tag in self.taken and parent is self.robot:
            attributes["name"] = free_name(attributes["name"], self.taken[tag])
            self.taken[tag].add(attributes["name"])
        element = ET.SubElement(parent, tag, attributes)
        self.places[element] = place
        return element

    def place(self, kind: str, name: str) -> Place:
        """Where an element of the description is written, or the root where this is not known.

        <attach> and <replicate> put something before and behind the names that are written.
        """
        written = [own for tag, own in self.files.places if tag == kind and own in name]
        return self.files.places[kind, max(written, key=len)] if written else self.places[self.robot]

    def rotation(self, kind: str, name: str, quaternion: np.ndarray) -> np.ndarray:
        """The rotation of a unit quaternion; raises RobotError for another one, which MuJoCo leaves as it is."""
        length = float(np.linalg.norm(quaternion))
        if not abs(length - 1.0) <= 1e-6:
            problem = f"its quaternion has the length {length:g}"
            raise RobotError(f"{self.place(kind, name)}: {kind} '{shorten(name)}': {problem}; give one of length 1.")
        return from_quaternion(quaternion)


def free_name(name: str, taken: set[str]) -> str:
    """The name, with as many underscores behind it as none has yet."""
    while name in taken:
        name += "_"
    return name


def names_of(model: Any, kind: str, prefix: str) -> list[str]:
    """The names of the elements of a kind, as "joint3" where the third has none."""
    accessor = getattr(model, kind)
    stated = [accessor(k).name for k in range({"body": model.nbody, "joint": model.njnt}[kind])]
    taken = set(stated)
    return [name or free_name(f"{prefix}{k + (kind == 'joint')}", taken) for k, name in enumerate(stated)]


def build_tree(tree: Tree, joints: list[JointTerms]) -> None:
    """Add the links and joints of a compiled model to the <robot> element of `tree`."""
    model, bodies = tree.model, names_of(tree.model, "body", "body")
    tree.bodies = bodies
    tree.taken["link"].update(bodies)
    tree.taken["joint"].update(joint.name for joint in joints)
    for body, name in enumerate(bodies):
        tree.taken["link"].discard(name)
        link = tree.add(tree.robot, tree.place("body", name), "link", name=name)
        far = float(np.abs(model.body_ipos[body]).max())
        if far > LONGEST_WAY:  # also of a body that does not move: MuJoCo computes about the centre of the tree
            problem = f"its centre of mass is {far:g} m away"
            raise RobotError(f"{tree.place('body', name)}: body '{shorten(name)}': {problem}; give a smaller arm.")
        if (tree.is_tool or model.body_weldid[body] != 0) and model.body_mass[body] != 0.0:
            _add_inertial(tree, link, body)
        if body:
            _add_joints(tree, body, name, bodies[model.body_parentid[body]], joints)


def numbers(*values: float) -> str:
    """Numbers in their shortest exact form."""
    return " ".join(repr(float(x) + 0.0) for x in values)


def add_origin(tree: Tree, element: ET.Element, pose: pin.SE3) -> None:
    """Add an <origin> to an element."""
    xyz, rpy = numbers(*pose.translation), numbers(*to_rpy(pose.rotation))
    tree.add(element, tree.places[element], "origin", xyz=xyz, rpy=rpy)


def _add_inertial(tree: Tree, link: ET.Element, body: int) -> None:
    """The inertia of a body in its principal axes; those that MuJoCo takes to be the body's own within 1e-6 are so."""
    model, place = tree.model, tree.places[link]
    turn, centre = tree.rotation("body", tree.bodies[body], model.body_iquat[body]), model.body_ipos[body].copy()
    same = int(model.body_sameframe[body])
    turn = np.eye(3) if same in (_SAME_FRAME, _SAME_AXES) else turn
    centre = np.zeros(3) if same == _SAME_FRAME else centre
    inertial = tree.add(link, place, "inertial")
    add_origin(tree, inertial, pin.SE3(turn, centre))
    tree.add(inertial, place, "mass", value=numbers(model.body_mass[body]))
    xx, yy, zz = (numbers(x) for x in model.body_inertia[body])
    tree.add(inertial, place, "inertia", ixx=xx, ixy="0.0", ixz="0.0", iyy=yy, iyz="0.0", izz=zz)


def _add_joints(tree: Tree, body: int, name: str, parent: str, joints: list[JointTerms]) -> None:
    """The joints of a body and the links between them; a fixed joint if it has none, or if the last has an anchor."""
    model, above = tree.model, parent
    pose = pin.SE3(tree.rotation("body", name, model.body_quat[body]), model.body_pos[body].copy())
    first = int(model.body_jntadr[body])
    for k in range(first, first + int(model.body_jntnum[body])):
        kind, axis, anchor = _KINDS[int(model.jnt_type[k])], model.jnt_axis[k].copy(), model.jnt_pos[k].copy()
        reference = float(model.qpos0[model.jnt_qposadr[k]])
        most = LONGEST_WAY if kind == "prismatic" else MOST_TURNED
        if not abs(reference) <= most:
            place = tree.place("joint", joints[k].name)
            raise RobotError(f"{place}: joint '{joints[k].name}': ref {reference:g} is beyond ±{most:g}; fix ref.")
        moved = pin.SE3.Identity()
        if kind == "prismatic":
            pose = pose * pin.SE3(np.eye(3), -reference * axis)
        elif kind == "revolute":
            pose = pose * pin.SE3(about(axis, -reference), anchor)
            moved = pin.SE3(np.eye(3), -anchor)
        is_last = k == first + int(model.body_jntnum[body]) - 1 and not moved.translation.any()
        below = name if is_last else free_name(f"{name}_{joints[k].name}", tree.taken["link"])
        if not is_last:
            tree.add(tree.robot, tree.place("joint", joints[k].name), "link", name=below)
        _add_joint(tree, joints[k], kind, pose, axis, above, below)
        above, pose = below, moved
    if above != name:
        place = tree.place("body", name)
        fixed = tree.add(tree.robot, place, "joint", name=f"{name}_fixed", type="fixed")
        _connect(tree, fixed, pose, above, name)


def _add_joint(
    tree: Tree, terms: JointTerms, kind: str, pose: pin.SE3, axis: np.ndarray, above: str, below: str
) -> None:
    place = tree.place("joint", terms.name)
    is_endless = kind == "revolute" and terms.range is None
    tree.taken["joint"].discard(terms.name)
    joint = tree.add(tree.robot, place, "joint", name=terms.name, type="continuous" if is_endless else kind)
    _connect(tree, joint, pose, above, below)
    if kind not in ("revolute", "prismatic"):
        return
    tree.add(joint, place, "axis", xyz=numbers(*axis))
    limits = {} if terms.effort is None else {"effort": numbers(terms.effort)}
    if not is_endless:
        limits["lower"], limits["upper"] = map(numbers, terms.range or (-1e16, 1e16))
    if limits:
        tree.add(joint, place, "limit", **limits)
    stated = {"damping": terms.damping, "friction": terms.friction, "armature": terms.armature}
    tree.add(joint, place, "dynamics", **{key: numbers(value) for key, value in stated.items()})
    if terms.follows is not None:
        source, multiplier, offset = terms.follows
        tree.add(joint, place, "mimic", joint=source, multiplier=numbers(multiplier), offset=numbers(offset))


def _connect(tree: Tree, joint: ET.Element, pose: pin.SE3, above: str, below: str) -> None:
    add_origin(tree, joint, pose)
    tree.add(joint, tree.places[joint], "parent", link=above)
    tree.add(joint, tree.places[joint], "child", link=below)
