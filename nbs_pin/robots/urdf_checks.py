"""Checks of a URDF: unique names, one tree, valid axes and limits; joints locked as asked.

Pinocchio and MuJoCo each accept descriptions that silently give a wrong model (a mass "nan", a zero axis, a link with
two parents). These checks run before either reads the file and raise RobotError with file, line and remedy.
"""

import math
import re
import warnings
import xml.etree.ElementTree as ET
from collections import defaultdict
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from nbs_pin.base.doors import BLANK, option
from nbs_pin.robots.urdf_options import ALL, LIMITS, UrdfOptions
from nbs_pin.robots.urdf_source import Node, shorten

MAX_JOINTS = 64
"""Largest number of moving joints of an arm."""
MAX_LINKS = 1000
"""Largest number of links of an arm, tool frames included."""
MAX_NAME = 128
"""Largest length of the name of a link or joint."""
MOVING = ("revolute", "continuous", "prismatic")
"""Supported joint types with one degree of freedom."""

_UNSUPPORTED = ("floating", "planar")
_ROUNDING = 1e-6
"""Relative tolerance for numbers that were rounded when the file was written."""
_FARTHEST, _MOST_TURNED = 100.0, 1e6
"""Largest distance [m] in an origin, and largest angle or position limit [rad, m], that an arm can have."""
_WHEEL = re.compile(r"wheel|caster", re.IGNORECASE)
_ENDLESS, _MOST = 1e9, 1e39
"""Position limits between these are read as none: exporters write 1e16, or the largest number of single precision."""


class Limits(NamedTuple):
    """Position [rad, m], effort [N·m, N] and velocity [rad/s, m/s] limits of a joint, inf where none is stated."""

    lower: float
    upper: float
    effort: float
    velocity: float


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
    for argument, names in (("lock", list(options.lock)), ("limits", list(options.limits))):
        unknown = [name for name in names if name not in nodes and (argument, name) != ("limits", ALL)]
        if unknown:
            raise robot.refuse(f"no joint '{unknown[0]}' for {argument}", f"the joints are {', '.join(nodes)}")
    mimics = _mimics(nodes, options)
    joints = [_joint(node, name, (mimics | dict(options.lock)).get(name)) for name, node in nodes.items()]
    _check_connected(links, joints)
    moving = sum(joint.moves for joint in joints)
    if moving == 0:
        raise robot.refuse("0 movable joints", "give an arm (a file with xacro macros must call them)")
    for what, count, most in (("moving joints", moving, MAX_JOINTS), ("links", len(links), MAX_LINKS)):
        if count > most:
            names = [joint.name for joint in joints if joint.moves][most:]
            remedy = f"lock some ({option('lock', names)})" if what == "moving joints" else "give a smaller arm"
            raise robot.refuse(f"too large: {count} {what} (limit {most})", remedy)
    wheels = [joint for joint in joints if joint.kind == "continuous" and _WHEEL.search(f"{joint.name} {joint.child}")]
    if wheels:
        names = [joint.name for joint in wheels]
        text = f"{wheels[0].node.place}: joints {', '.join(map(repr, names))} look like wheels, and the base is fixed"
        warnings.warn(f"{text}, so they spin in the air; lock them by {option('lock', names)}.", stacklevel=2)
    return joints


def _mimics(nodes: dict[str, Node], options: UrdfOptions) -> dict[str, float]:
    """Where the joints that mimic another stand when the others are at zero, or where these are locked [rad, m]."""
    coupled = {name: node.child("mimic") for name, node in nodes.items() if node.element.get("type") in MOVING}
    mimics = {name: node for name, node in coupled.items() if node is not None and name not in options.lock}
    places = dict(options.lock)

    def place(name: str, seen: tuple[str, ...] = ()) -> float:
        if name not in mimics or name in seen:
            return places.get(name, 0.0)
        node = mimics[name]
        return node.number("multiplier", 1.0) * place(node.text("joint"), (*seen, name)) + node.number("offset", 0.0)

    found = {name: place(name) for name in mimics}
    if found:
        stated = ", ".join(f"'{name}' (of '{node.text('joint')}', at {found[name]:g})" for name, node in mimics.items())
        place_text = next(iter(mimics.values())).place
        text = f"{place_text}: joints that mimic another are locked: {stated}"
        warnings.warn(f"{text}; lock them elsewhere by {option('lock', found)}.", stacklevel=2)
    return found


def check_axis(joint: Joint) -> None:
    """Check that the axis has a direction; normalise it, with a warning, if it is not a unit vector."""
    axis = joint.node.child("axis")
    if axis is None:
        return
    xyz = axis.numbers("xyz", 3)
    length = math.hypot(*xyz)
    if length < 1e-9:
        raise axis.refuse(f"axis xyz '{axis.text('xyz')}' has zero length", "fix <axis xyz=…>")
    if abs(length - 1.0) > _ROUNDING:
        text = f"{axis.place}: {axis.owner}: axis xyz '{axis.text('xyz')}' is not a unit vector; it was normalised."
        warnings.warn(text, stacklevel=2)
        axis.element.set("xyz", " ".join(repr(x / length) for x in xyz))


def read_limits(joint: Joint, options: UrdfOptions) -> Limits:
    """The limits of a joint: those given in `options.limits`, else those that it states.

    A continuous joint has no position limits and may omit the others; every other moving joint must state all four.
    `zero_limits`: "refuse" no limits, an effort or velocity ≤ 0 and an empty range at zero, or read these as
    "unlimited". URDF reads a lower or upper limit that is left out as 0.
    """
    given = {key: options.limit(joint.name, key) for key in LIMITS}
    limit = joint.node.child("limit")
    if limit is None:
        if joint.kind == "continuous" or options.zero_limits == "unlimited":
            return _checked(joint.node, joint, given, Limits(-math.inf, math.inf, math.inf, math.inf), options)
        if None in given.values():
            remedy = f"add <limit …/>, or give them ({_example(joint, dict.fromkeys(LIMITS))})"
            raise joint.node.refuse(f"{joint.kind} joint without <limit>", remedy + _open("it has none"))
        return _checked(joint.node, joint, given, Limits(0.0, 0.0, 0.0, 0.0), options)
    effort, velocity = (_strength(limit, key, joint, given[key], options) for key in ("effort", "velocity"))
    if joint.kind == "continuous":
        return _checked(limit, joint, given, Limits(-math.inf, math.inf, effort, velocity), options)
    lower, upper = (limit.number(key, 0.0) for key in ("lower", "upper"))
    return _checked(limit, joint, given, Limits(lower, upper, effort, velocity), options)


def _checked(node: Node, joint: Joint, given: dict[str, float | None], stated: Limits, options: UrdfOptions) -> Limits:
    """The limits given, else stated; raises RobotError unless the range is one."""
    limits = Limits(*(x if given[key] is None else given[key] for key, x in zip(LIMITS, stated, strict=True)))  # type: ignore[arg-type]
    endless = -_MOST <= limits.lower <= -_ENDLESS and _ENDLESS <= limits.upper <= _MOST
    lower, upper = (-math.inf, math.inf) if endless else (limits.lower, limits.upper)
    if options.zero_limits == "unlimited" and lower == upper == 0.0:
        return Limits(-math.inf, math.inf, limits.effort, limits.velocity)
    if lower >= upper:
        absent = [key for key in ("lower", "upper") if key not in node.element.attrib]
        sign = ">" if lower > upper else "="
        problem = f"limit lower {lower:g} {sign} upper {upper:g}"
        problem += f" ({' and '.join(absent)} left out, which URDF reads as 0)" if absent else ""
        locked = option("lock", {joint.name: lower} if lower == upper != 0.0 else [joint.name])
        remedy = (
            f"give lower < upper ({_example(joint, {'lower': -3.14, 'upper': 3.14})}), or lock the joint ({locked})"
        )
        raise node.refuse(problem, remedy + (_open("0 means no limit") if lower == upper == 0.0 else ""))
    for key, value in (("lower", lower), ("upper", upper)):
        if key not in node.element.attrib and given[key] is None and math.isfinite(value):
            text = f"{node.place}: {joint.node.owner}: <limit> states no {key}, which URDF reads as 0"
            warnings.warn(f"{text}; if it is another, give it: {_example(joint, {key: None})}.", stacklevel=2)
        if math.isfinite(value) and abs(value) > _MOST_TURNED:
            remedy = f"state the joint's range ({_example(joint, {key: math.copysign(3.14, value)})})"
            raise node.refuse(f"limit {key} {value:g} is beyond ±{_MOST_TURNED:g}", remedy)
    return Limits(lower, upper, limits.effort, limits.velocity)


def _example(joint: Joint, limits: dict[str, float | None]) -> str:
    """`limits` as one would give them for a joint, with placeholders for those that are not known."""
    return option("limits", {joint.name: {key: BLANK if x is None else x for key, x in limits.items()}})


def _open(because: str) -> str:
    return f", or {option('zero_limits', 'unlimited')} if {because}"


def read_friction(joint: Joint) -> tuple[float, float]:
    """Viscous damping [N·m·s/rad] and Coulomb friction [N·m] of the joint, zero where not stated."""
    dynamics = joint.node.child("dynamics")
    if dynamics is None:
        return 0.0, 0.0
    return dynamics.number("damping", 0.0, least=0.0), dynamics.number("friction", 0.0, least=0.0)


def check_origin(node: Node) -> None:
    """Check that the placement of a joint or inertia, where stated, is six finite numbers."""
    origin = node.child("origin")
    if origin is not None:
        for key, most, unit in (("xyz", _FARTHEST, "m"), ("rpy", _MOST_TURNED, "rad")):
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


def _joint(node: Node, name: str, locked: float | None) -> Joint:
    """The joint of an element, fixed if it is `locked` somewhere; a fixed one keeps only parent, child and origin."""
    kind = node.text("type")
    allowed = (*MOVING, "fixed", *(_UNSUPPORTED if locked is not None else ()))
    if kind not in allowed:
        remedy = "use revolute, continuous, prismatic or fixed"
        remedy += f", or lock it: {option('lock', [name])}" if kind in _UNSUPPORTED else ""
        raise node.refuse(f"type '{shorten(kind)}' is not supported", remedy)
    check_origin(node)
    joint = Joint(node, name, kind, node.need("parent").text("link"), node.need("child").text("link"))
    if locked and kind != "fixed":
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
    check_axis(joint)
    axis = joint.node.child("axis")
    direction = np.array([1.0, 0.0, 0.0] if axis is None else axis.numbers("xyz", 3))
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


def _strength(limit: Node, key: str, joint: Joint, given: float | None, options: UrdfOptions) -> float:
    """The effort or velocity limit: > 0, or inf if there is none."""
    free = joint.kind == "continuous" or options.zero_limits == "unlimited" or given is not None
    value = limit.number(key, math.inf if free else None)
    if given is not None or (value <= 0.0 and options.zero_limits == "unlimited"):
        return math.inf if given is None else given
    if value <= 0.0:
        remedy = f"state the drive's {key} ({_example(joint, {key: None})})"
        raise limit.refuse(f"limit {key} '{value:g}' is not > 0", remedy + _open(f"{value:g} means no limit"))
    return value
