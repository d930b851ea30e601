"""Trees of rigid bodies in ball arithmetic: as a certificate file states them, and read from a URDF again."""

import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from defusedxml import ElementTree

from nbs_pin.base.exceptions import FileFormatError, NoSuchFile
from nbs_pin.verification.balls import Balls, arb, balls, certain, positive_definite, skew
from nbs_pin.verification.document import file_content

SAME = 1e-10
"""Largest difference between two arms, relative to the sizes of the arm and of its bodies."""

_POINT = 1e-4
"""Squared radius of gyration to which inertias are compared at least, relative to the size of the arm."""
_MOVING = ("continuous", "revolute", "prismatic")


class Link(NamedTuple):
    """A joint about or along the z axis of its body's frame, and the body behind it [SI units]."""

    parent: int
    """−1 for the base."""
    slides: bool
    rotation: Balls
    """Of the frame in the parent's at q = 0."""
    position: Balls
    mass: Any
    centre: Balls
    inertia: Balls
    """About the centre of mass, in the frame."""
    armature: Any
    travel: tuple[Any, Any] | None
    """Ends of the travel of a joint that slides; None for no ends."""


def stated_tree(joints: list[dict[str, Any]]) -> list[Link]:
    """The tree of a file; its rotations, rounded to floats, stand for the rotations next to them."""
    return [_stated(joint) for joint in joints]


def urdf_tree(path: Path, joints: list[dict[str, Any]]) -> list[Link]:
    """The tree of a URDF with the travel of the file, which must cover that of the URDF.

    Joints that the file does not name are held at zero. Raises FileFormatError if it is not a URDF with these joints.
    """
    try:
        return _Description(ElementTree.fromstring(file_content(path)), joints).links()
    except (NoSuchFile, FileFormatError):
        raise
    except (ValueError, KeyError, AttributeError, TypeError, SyntaxError, RecursionError) as error:
        raise FileFormatError(f"{path}: not the URDF of this certificate ({error}); give its own.") from error


def still_joints(path: Path, joints: list[dict[str, Any]]) -> list[str]:
    """The joints of a URDF that could move and that the file does not name."""
    named = {joint["name"] for joint in joints}
    elements = ElementTree.parse(path).getroot().findall("joint")
    return [x.get("name", "") for x in elements if x.get("type") in _MOVING and x.get("name") not in named]


def always_heavy(tree: list[Link]) -> bool:
    """Whether every body certainly has energy in every motion of its own, so that M ≻ 0 in every pose.

    Of the joints that move, the body of the first moves, and no body has less energy than none.
    """
    bodies = (certain(x.mass > 0, x.armature >= 0) and positive_definite(x.inertia) for x in tree)
    return all(bodies)


def differences(stated: list[Link], read: list[Link]) -> list[str]:
    """What differs between two trees at zero, seen from the base; angles of frames about their axes do not count."""
    faults: list[str] = []
    worlds: tuple[list[Any], list[Any]] = ([], [])
    size = sum((abs(x) for link in read for x in (*link.position, *link.centre)), arb(0))
    for i, pair in enumerate(zip(stated, read, strict=True)):
        seen = [_seen_from_base(link, world) for link, world in zip(pair, worlds, strict=True)]
        scales = (1, size, size, np.trace(pair[1].inertia) + _POINT * pair[1].mass * size**2, pair[1].mass, 1)
        names = ("axis", "position", "centre of mass", "inertia", "mass", "rotor inertia")
        for name, a, b, scale in zip(names, *seen, scales, strict=True):
            if not certain(abs(a - b) <= scale * SAME):
                faults.append(f"{name} of joint {i + 1}")
        faults += [f"kind of joint {i + 1}"] if pair[0][:2] != pair[1][:2] else []
    return faults


def _seen_from_base(link: Link, world: list[tuple[Balls, Balls]]) -> tuple[Balls, ...]:
    """Axis, position, centre of mass and inertia in the base frame; adds the frame to those before it."""
    turn, at = world[link.parent] if link.parent >= 0 else (balls(np.eye(3)), balls(np.zeros(3)))
    turn, at = turn @ link.rotation, at + turn @ link.position
    world.append((turn, at))
    return turn[:, 2], at, at + turn @ link.centre, turn @ link.inertia @ turn.T, balls(link.mass), balls(link.armature)


def _stated(joint: dict[str, Any]) -> Link:
    rotation = balls(joint["rotation"])
    nearest = _frame(rotation[0], rotation[1])
    if not certain(abs(nearest - rotation) <= 1e-12):
        raise FileFormatError(f"the placement of joint '{joint['name']}' is no rotation; write the file again.")
    inertia = balls(joint["inertia"])  # of which only the quadratic form counts
    body = (arb(joint["mass"]), balls(joint["centre"]), (inertia + inertia.T) / 2, arb(joint["armature"]))
    return Link(int(joint["parent"]), joint["prismatic"], nearest, balls(joint["position"]), *body, _travel(joint))


def _travel(joint: dict[str, Any]) -> tuple[Any, Any] | None:
    ends = joint["lower"], joint["upper"]
    return None if None in ends else (arb(ends[0]), arb(ends[1]))


class _Description:
    """A URDF; places are (body, rotation, position), with body −1 for the base."""

    def __init__(self, root: Any, joints: list[dict[str, Any]]) -> None:
        self.root, self.joints = root, joints
        self.above = {joint.find("child").get("link"): joint for joint in root.findall("joint")}
        named = {joint.get("name"): joint for joint in self.above.values()}
        missing = [joint["name"] for joint in joints if joint["name"] not in named]
        if missing:
            raise ValueError(f"it has no joint '{missing[0]}'")
        self.elements = [named[joint["name"]] for joint in joints]
        self.axes = [_axes(element) for element in self.elements]

    def links(self) -> list[Link]:
        """The moving joints, each with all that is fixed to it."""
        places = [self.placed(element, element.find("parent").get("link")) for element in self.elements]
        mass, first = balls(np.zeros(len(places))), balls(np.zeros((len(places), 3)))
        second = balls(np.zeros((len(places), 3, 3)))
        for link in self.root.findall("link"):
            inertial = link.find("inertial")
            if inertial is None or self.body_of(link.get("name"))[0] < 0:
                continue
            i, rotation, centre = self.placed(inertial, link.get("name"))
            m, stated = arb(inertial.find("mass").get("value")), inertial.find("inertia")
            xx, xy, xz, yy, yz, zz = (stated.get(key) for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"))
            about = rotation @ balls([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ rotation.T
            mass[i], first[i], second[i] = (
                mass[i] + m,
                first[i] + m * centre,
                second[i] + about - m * skew(centre) @ skew(centre),
            )
        found = []
        for i, (parent, rotation, position) in enumerate(places):
            if parent >= i:
                raise ValueError(f"joint {i + 1} comes before its parent")
            centre, slides = first[i] / mass[i], self.elements[i].get("type") == "prismatic"
            self.check_kind(self.elements[i], self.joints[i])
            body = (mass[i], centre, second[i] + mass[i] * skew(centre) @ skew(centre), _rotor(self.elements[i]))
            found.append(Link(parent, slides, rotation @ self.axes[i], position, *body, _travel(self.joints[i])))
        return found

    def check_kind(self, element: Any, joint: dict[str, Any]) -> None:
        """Raise ValueError if the file wraps another kind of joint, or gives it less travel than the URDF."""
        name, kind, limit = joint["name"], element.get("type"), element.find("limit")
        if joint["continuous"] != (kind == "continuous") or kind not in ("continuous", "revolute", "prismatic"):
            raise ValueError(f"joint '{name}' is {kind}")
        if kind == "prismatic":
            low, high = -math.inf if joint["lower"] is None else joint["lower"], joint["upper"]
            travel = float(limit.get("lower")), float(limit.get("upper"))
            if not (low <= travel[0] <= travel[1] <= (math.inf if high is None else high)):
                raise ValueError(f"joint '{name}' has more travel")

    def body_of(self, link: str) -> tuple[int, Balls, Balls]:
        """The place of a link's frame in its body's."""
        joint = self.above.get(link)
        if joint is None:
            return -1, balls(np.eye(3)), balls(np.zeros(3))
        if joint in self.elements:
            i = self.elements.index(joint)
            return i, self.axes[i].T, balls(np.zeros(3))
        return self.placed(joint, joint.find("parent").get("link"))

    def placed(self, element: Any, link: str) -> tuple[int, Balls, Balls]:
        """The place of an element with an origin in the frame of a link."""
        (i, rotation, position), origin = self.body_of(link), element.find("origin")
        turn = balls(np.eye(3))
        for axis, angle in zip((2, 1, 0), _words(origin, "rpy", "0 0 0")[::-1], strict=True):
            about = balls(np.eye(3)[axis])
            turn = turn @ (np.outer(about, about) + angle.sin() * skew(about) - angle.cos() * skew(about) @ skew(about))
        return i, rotation @ turn, position + rotation @ _words(origin, "xyz", "0 0 0")


def _rotor(joint: Any) -> Any:
    """The rotor inertia that a joint feels [kg·m², kg]: what <dynamics> states, or its motor's behind its gear."""
    stated = {} if joint.find("dynamics") is None else joint.find("dynamics").attrib
    behind_gear = arb(stated.get("motor_inertia", "0")) * arb(stated.get("gear_ratio", "1")) ** 2
    return arb(stated["armature"]) if "armature" in stated else behind_gear


def _words(element: Any, key: str, default: str) -> Balls:
    return balls((default if element is None else element.get(key, default)).split())


def _axes(element: Any) -> Balls:
    """A rotation that takes z to the axis of a joint."""
    axis = _words(element.find("axis"), "xyz", "1 0 0")
    away = np.eye(3)[np.argmin([abs(float(x.mid())) for x in axis])]
    x = skew(balls(away)) @ axis
    return _frame(x, skew(axis) @ x).T


def _frame(a: Balls, b: Balls) -> Balls:
    """The rotation with rows along a, along the part of b across a, and along a × b."""
    x = a / (a @ a).sqrt()
    y = b - x * (x @ b)
    y = y / (y @ y).sqrt()
    return np.stack([x, y, skew(x) @ y])
