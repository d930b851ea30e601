"""Checks of a URDF: unique names, one tree, valid axes and limits; joints locked as asked.

Pinocchio and MuJoCo each accept descriptions that silently give a wrong model (a mass "nan", a zero axis, a link with
two parents). These checks run before either reads the file and raise RobotError with file, line and remedy.
"""

import difflib
import math
import re
import warnings
import xml.etree.ElementTree as ET
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin

from nbs_pin.base.doors import BLANK, option
from nbs_pin.robots.urdf_options import ALL, DRIVE, UrdfOptions
from nbs_pin.robots.urdf_source import Node, shorten

MAX_JOINTS = 64
"""Largest number of moving joints of an arm."""
MAX_LINKS = 1000
"""Largest number of links of an arm, tool frames included."""
MAX_NAME = 128
"""Largest length of the name of a link or joint."""
MOVING = ("revolute", "continuous", "prismatic")
"""Supported joint types with one degree of freedom."""

_UNSUPPORTED = ("floating", "planar", "ball")
ROUNDING = 1e-6
"""Relative tolerance for numbers that were rounded when the file was written."""
LONGEST_WAY, MOST_TURNED = 100.0, 1e6
"""Largest distance [m] and angle [rad] in an origin or a position that an arm can have."""
_WHEEL = re.compile(r"wheel|caster", re.IGNORECASE)


@dataclass(frozen=True)
class Joint:
    """A joint of the tree: its element in the file, its type and the links that it connects."""

    node: Node
    name: str
    kind: str
    parent: str
    child: str

    @property
    def moves(self) -> bool:
        """True unless the joint is fixed."""
        return self.kind != "fixed"


def check_tree(robot: Node, options: UrdfOptions) -> list[Joint]:
    """The joints in file order, those to lock fixed; checks for unique names, known types and a single tree.

    Joints that mimic another are locked where they stand at the other's zero, with a warning that names them.
    """
    _check_name(robot, robot.text("name"))
    links = _unique(robot, "link")
    nodes = _unique(robot, "joint")
    for argument in ("lock", "limits", *DRIVE):
        unknown = [
            name for name in getattr(options, argument) if name not in nodes and (argument == "lock" or name != ALL)
        ]
        if unknown:
            near = difflib.get_close_matches(unknown[0], nodes, n=1)
            hint = f"did you mean {near[0]}? " if near else ""
            raise robot.refuse(f"no joint '{unknown[0]}' for {argument}", f"{hint}the joints are {', '.join(nodes)}")
    if len(links) > MAX_LINKS:
        raise robot.refuse(f"too large: {len(links)} links (limit {MAX_LINKS})", "give a smaller arm")
    mimics = _mimics(nodes, options)
    _check_kinds(nodes, options)
    joints = [_joint(node, name, (mimics | dict(options.lock)).get(name)) for name, node in nodes.items()]
    _check_connected(links, joints)
    moving = [joint.name for joint in joints if joint.moves]
    if not moving:
        raise robot.refuse("0 movable joints", "give an arm (a file with xacro macros must call them)")
    if len(moving) > MAX_JOINTS:
        problem = f"too large: {len(moving)} moving joints (limit {MAX_JOINTS})"
        raise robot.refuse(problem, f"lock {len(moving) - MAX_JOINTS} of them ({option('lock', [moving[-1], BLANK])})")
    wheels = [joint for joint in joints if joint.kind == "continuous" and _WHEEL.search(f"{joint.name} {joint.child}")]
    if wheels:
        names = [joint.name for joint in wheels]
        text = f"{wheels[0].node.place}: joints {', '.join(map(repr, names))} look like wheels, and the base is fixed"
        warnings.warn(f"{text}, so they spin in the air; lock them by {lock_too(options, names)}.", stacklevel=2)
    return joints


def lock_too(options: UrdfOptions, names: Iterable[str] | Mapping[str, float]) -> str:
    """`lock` as one gives it to lock further joints than those that are locked already."""
    places = {**options.lock, **(names if isinstance(names, Mapping) else dict.fromkeys(names, 0.0))}
    return option("lock", places if any(places.values()) else list(places))


def _mimics(nodes: dict[str, Node], options: UrdfOptions) -> dict[str, float]:
    """Where the joints that mimic another stand when the others are at zero, or where these are locked [rad, m].

    A joint whose range excludes zero counts as being at the nearer end.
    """
    coupled = {name: node.child("mimic") for name, node in nodes.items() if node.element.get("type") in MOVING}
    mimics = {name: node for name, node in coupled.items() if node is not None and name not in options.lock}
    found: dict[str, float] = {}
    for name, node in mimics.items():
        factor, place, seen = 1.0, 0.0, {name}
        while True:
            source, place = node.text("joint"), place + factor * node.number("offset", 0.0)
            factor *= node.number("multiplier", 1.0)
            if source not in nodes:
                raise node.refuse(f"mimics joint '{shorten(source)}', which is not defined", "fix <mimic joint=…>")
            if source not in mimics or source in seen:
                break
            seen.add(source)
            node = mimics[source]
        at = 0.0 if source in seen else options.lock.get(source, nearest_to_zero(nodes[source]))
        found[name] = place + factor * at
    if found:
        stated = ", ".join(f"'{name}' (of '{mimics[name].text('joint')}', at {x:g})" for name, x in found.items())
        text = f"{next(iter(mimics.values())).place}: joints that mimic another are locked: {stated}"
        remedy = lock_too(options, dict.fromkeys(found, BLANK))
        warnings.warn(f"{text}; lock them elsewhere by {remedy}.", stacklevel=2)
    return found


def _stated_range(node: Node) -> tuple[float, float]:
    """The position limits in a joint's element [rad, m], none where it states no range."""
    limit = node.child("limit")
    if limit is None or node.element.get("type") == "continuous":
        return -math.inf, math.inf
    lower, upper = limit.number("lower", 0.0), limit.number("upper", 0.0)
    return (lower, upper) if lower < upper else (-math.inf, math.inf)


def nearest_to_zero(node: Node) -> float:
    """The position nearest to zero within the range that a joint's element states [rad, m]."""
    lower, upper = _stated_range(node)
    return min(max(0.0, lower), upper)


def check_axis(joint: Joint) -> None:
    """Check that the axis has a direction; normalise it, with a warning, if it is not a unit vector."""
    axis = joint.node.child("axis")
    if axis is None:
        return
    xyz = axis.numbers("xyz", 3)
    length = math.hypot(*xyz)
    if length < 1e-9:
        raise axis.refuse(f"axis xyz '{axis.text('xyz')}' has zero length", "fix <axis xyz=…>")
    if abs(length - 1.0) > ROUNDING:
        text = f"{axis.place}: {axis.owner}: axis xyz '{axis.text('xyz')}' is not a unit vector; it was normalised."
        warnings.warn(text, stacklevel=2)
        axis.element.set("xyz", " ".join(repr(x / length) for x in xyz))


def check_origin(node: Node) -> None:
    """Check that the placement of a joint or inertia, where stated, is six finite numbers."""
    origin = node.child("origin")
    if origin is not None:
        for key, most, unit in (("xyz", LONGEST_WAY, "m"), ("rpy", MOST_TURNED, "rad")):
            values = origin.numbers(key, 3, (0.0, 0.0, 0.0))
            if max(map(abs, values)) > most:
                raise origin.refuse(
                    f"origin {key} '{origin.text(key)}' is beyond ±{most:g} {unit}", f"fix <origin {key}=…>"
                )


def _unique(robot: Node, tag: str) -> dict[str, Node]:
    """The links or joints by name; raises RobotError unless names are valid and unique."""
    nodes: dict[str, Node] = {}
    for node in robot.named(tag):
        name = node.text("name")
        _check_name(node, name)
        if name in nodes:
            lines = node.lines(nodes[name].element)
            raise node.refuse(f"the name '{name}' is used twice ({lines})", f"rename one {tag}")
        nodes[name] = node
    return nodes


def _check_name(node: Node, name: str) -> None:
    """Raise RobotError for a name that is empty, too long, unprintable or Pinocchio's reserved "universe"."""
    if not 0 < len(name) <= MAX_NAME or not name.isprintable() or name == "universe":
        problem = f"the name '{shorten(name)}' is empty, reserved, unprintable or longer than {MAX_NAME} characters"
        raise node.refuse(problem, f"rename the {node.element.tag}")


def _check_kinds(nodes: dict[str, Node], options: UrdfOptions) -> None:
    """Raise RobotError for joints of other types than those supported, unless they are locked."""
    kinds = {name: node.text("type") for name, node in nodes.items()}
    other = [name for name, kind in kinds.items() if kind in _UNSUPPORTED and name not in options.lock]
    for name, kind in kinds.items():
        if kind not in (*MOVING, "fixed", *_UNSUPPORTED) or name in other:
            remedy = "use revolute, continuous, prismatic or fixed"
            remedy += f", or lock it: {lock_too(options, other)}" if name in other else ""
            raise nodes[name].refuse(f"type '{shorten(kind)}' is not supported", remedy)


def _joint(node: Node, name: str, locked: float | None) -> Joint:
    """The joint of an element, fixed if it is `locked` somewhere; a fixed one keeps only parent, child and origin."""
    kind = node.text("type")
    check_origin(node)
    joint = Joint(node, name, kind, node.need("parent").text("link"), node.need("child").text("link"))
    if locked:
        _move(joint, locked)
    kind = "fixed" if locked is not None else kind
    node.element.set("type", kind)
    if kind == "fixed":
        for child in list(node.element):
            if child.tag not in ("parent", "child", "origin"):
                node.element.remove(child)
    return replace(joint, kind=kind)


def _move(joint: Joint, place: float) -> None:
    """Turn or shift the origin of a joint to its position `place` [rad, m]."""
    if joint.kind not in MOVING:
        remedy = f"lock it at 0 ({option('lock', [joint.name])})"
        raise joint.node.refuse(f"a joint of type '{joint.kind}' cannot be locked at {place:g}", remedy)
    lower, upper = _stated_range(joint.node)
    most = LONGEST_WAY if joint.kind == "prismatic" else MOST_TURNED
    if not abs(place) <= most:
        raise joint.node.refuse(f"it is locked at {place:g}", f"lock it within ±{most:g}")
    if not lower <= place <= upper:
        text = f"{joint.node.place}: {joint.node.owner}: it is locked at {place:g}"
        warnings.warn(f"{text}, outside its range of [{lower:g}, {upper:g}].", stacklevel=2)
    check_axis(joint)
    axis = joint.node.child("axis")
    direction = np.array([1.0, 0.0, 0.0] if axis is None else axis.numbers("xyz", 3))
    direction /= np.linalg.norm(direction)
    origin = joint.node.child("origin")
    xyz, rpy = (np.zeros(3) if origin is None else np.array(origin.numbers(k, 3, (0.0,) * 3)) for k in ("xyz", "rpy"))
    frame = pin.SE3(pin.rpy.rpyToMatrix(*rpy), xyz)
    slides = joint.kind == "prismatic"
    shift = pin.SE3(np.eye(3), place * direction) if slides else pin.SE3(pin.exp3(place * direction), np.zeros(3))
    moved = frame * shift
    element = ET.SubElement(joint.node.element, "origin") if origin is None else origin.element
    element.set("xyz", " ".join(map(repr, moved.translation.tolist())))
    element.set("rpy", " ".join(map(repr, pin.rpy.matrixToRpy(moved.rotation).tolist())))


def _check_connected(links: dict[str, Node], joints: list[Joint]) -> None:
    """Check that joints connect defined links, no link has two parent joints, and all links descend from one root."""
    above: dict[str, Joint] = {}
    below: dict[str, list[str]] = defaultdict(list)
    for joint in joints:
        for role, name in (("parent", joint.parent), ("child", joint.child)):
            if name not in links:
                raise joint.node.refuse(f"{role} link '{shorten(name)}' is not defined", f"add it or fix <{role}>")
        if joint.child in above:
            problem = f"not a tree: link '{joint.child}' is also the child of joint '{above[joint.child].name}'"
            raise joint.node.refuse(problem, "give each link one parent joint")
        above[joint.child] = joint
        below[joint.parent].append(joint.child)
    reached = [name for name in links if name not in above]
    if len(reached) > 1:
        names = ", ".join(f"'{name}'" for name in reached[:5])
        raise links[reached[1]].refuse(f"not a tree: links {names} have no parent", "give all but one a parent")
    for name in reached:
        reached.extend(below[name])
    connected = set(reached)
    lost = [joint for joint in joints if joint.child not in connected]
    if lost:
        names = ", ".join(f"'{joint.name}'" for joint in lost[:5])
        raise lost[0].node.refuse(f"not a tree: joints {names} form a cycle or follow one", "fix their <parent>")
