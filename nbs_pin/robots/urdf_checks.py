"""Checks of a URDF: unique names, one tree, physical inertias, valid axes and limits.

Pinocchio and MuJoCo each accept descriptions that silently give a wrong model (a mass "nan", a zero axis, a link with
two parents). These checks run before either reads the file and raise RobotError with file, line and remedy.
"""

import math
import warnings
from collections import defaultdict
from dataclasses import dataclass
from typing import Literal, NamedTuple, TypeAlias, get_args

import numpy as np

from nbs_pin.robots.urdf_source import Node, shorten

MAX_JOINTS = 64
"""Largest number of moving joints of an arm."""
MAX_LINKS = 1000
"""Largest number of links of an arm, tool frames included."""
MAX_NAME = 128
"""Largest length of the name of a link or joint."""
ZeroLimits: TypeAlias = Literal["refuse", "unlimited"]
"""How to treat a zero effort, a zero velocity or an empty range at zero."""
ZERO_LIMITS: tuple[ZeroLimits, ...] = get_args(ZeroLimits)
MOVING = ("revolute", "continuous", "prismatic")
"""Supported joint types with one degree of freedom."""

_UNSUPPORTED = ("floating", "planar")
_ROUNDING = 1e-6
"""Relative tolerance for numbers that were rounded when the file was written."""
_POINT = 1e-9
"""Radius of gyration below which a body counts as a point mass [m]."""
_OPEN = ", or load it with zero_limits='unlimited' if 0 means no limit"
_INERTIA = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")


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


def check_tree(robot: Node, lock: tuple[str, ...]) -> list[Joint]:
    """The joints in file order, those in `lock` fixed; checks for unique names, known types and a single tree."""
    _check_name(robot, robot.text("name"))
    links = _unique(robot, "link")
    nodes = _unique(robot, "joint")
    unknown = [name for name in lock if name not in nodes]
    if unknown:
        raise robot.refuse(f"no joint '{unknown[0]}' to lock", f"the joints are {', '.join(nodes)}")
    joints = [_joint(node, name, name in lock) for name, node in nodes.items()]
    mimics = [joint for joint in joints if joint.moves and joint.node.element.find("mimic") is not None]
    if mimics:
        remedy = f"lock them (lock={[joint.name for joint in mimics]}) or remove <mimic>"
        raise mimics[0].node.need("mimic").refuse("mimic joints are not supported", remedy)
    _check_connected(links, joints)
    moving = sum(joint.moves for joint in joints)
    if moving == 0:
        raise robot.refuse("0 movable joints", "give an arm (a file with xacro macros must be expanded first)")
    for what, count, most in (("moving joints", moving, MAX_JOINTS), ("links", len(links), MAX_LINKS)):
        if count > most:
            raise robot.refuse(f"too large: {count} {what} (limit {most})", "give a smaller arm or fix joints")
    return joints


def check_bodies(robot: Node, joints: list[Joint]) -> None:
    """Check that every stated inertia is physical and that every moving joint carries mass.

    Links fixed to each other count as one body, so a tool frame or a flange of a massive link may have no mass.
    """
    above = {joint.child: joint for joint in joints}
    mass: dict[str, float] = defaultdict(float)
    for link in robot.named("link"):
        name = link.text("name")
        stated = _mass(link)
        while name in above and not above[name].moves:
            name = above[name].parent
        mass[name] += stated
    for joint in joints:
        if joint.moves and mass[joint.child] == 0.0:
            problem = f"moves link '{joint.child}', which has no mass (M would be singular)"
            raise joint.node.refuse(problem, f"give link '{joint.child}' an <inertial> with mass > 0 or lock the joint")


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
        place = f"{axis.label}:{axis.lines[axis.element]}: {axis.owner}"
        text = f"{place}: axis xyz '{axis.text('xyz')}' is not a unit vector; it was normalised."
        warnings.warn(text, stacklevel=2)
        axis.element.set("xyz", " ".join(repr(x / length) for x in xyz))


def read_limits(joint: Joint, zero_limits: ZeroLimits) -> Limits:
    """The limits that a joint states.

    A continuous joint has no position limits and may omit the others; every other moving joint must state all four.
    `zero_limits`: "refuse" a zero effort or velocity and an empty range, or read these zeros as "unlimited".
    """
    none = Limits(-math.inf, math.inf, math.inf, math.inf)
    limit = joint.node.child("limit")
    if limit is None:
        if joint.kind != "continuous":
            remedy = "add <limit lower=… upper=… effort=… velocity=…/> or make the joint continuous"
            raise joint.node.refuse(f"{joint.kind} joint without <limit>", remedy)
        return none
    strength = [_strength(limit, key, joint.kind, zero_limits) for key in ("effort", "velocity")]
    if joint.kind == "continuous":
        return Limits(-math.inf, math.inf, *strength)
    lower, upper = limit.number("lower"), limit.number("upper")
    if zero_limits == "unlimited" and lower == upper == 0.0:
        return Limits(-math.inf, math.inf, *strength)
    if lower >= upper:
        sign = ">" if lower > upper else "="
        remedy = "give lower < upper or make the joint fixed" + (_OPEN if lower == upper == 0.0 else "")
        raise limit.refuse(f"limit lower {lower:g} {sign} upper {upper:g}", remedy)
    return Limits(lower, upper, *strength)


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
        origin.numbers("xyz", 3, (0.0, 0.0, 0.0))
        origin.numbers("rpy", 3, (0.0, 0.0, 0.0))


def _unique(robot: Node, tag: str) -> dict[str, Node]:
    """The links or joints by name; raises RobotError unless names are valid and unique."""
    nodes: dict[str, Node] = {}
    for node in robot.named(tag):
        name = node.text("name")
        _check_name(node, name)
        if name in nodes:
            lines = f"lines {nodes[name].lines[nodes[name].element]} and {node.lines[node.element]}"
            raise node.refuse(f"the name '{name}' is used twice ({lines})", f"rename one {tag}")
        nodes[name] = node
    return nodes


def _check_name(node: Node, name: str) -> None:
    """Raise RobotError for a name that is empty, too long, unprintable or Pinocchio's reserved "universe"."""
    if not 0 < len(name) <= MAX_NAME or not name.isprintable() or name == "universe":
        problem = f"the name '{shorten(name)}' is empty, reserved, unprintable or longer than {MAX_NAME} characters"
        raise node.refuse(problem, f"rename the {node.element.tag}")


def _joint(node: Node, name: str, locked: bool) -> Joint:
    """The joint of an element, fixed if `locked`; a fixed joint keeps only its parent, child and origin."""
    kind = node.text("type")
    allowed = (*MOVING, "fixed", *(_UNSUPPORTED if locked else ()))
    if kind not in allowed:
        remedy = "use revolute, continuous, prismatic or fixed"
        remedy += f", or lock it: lock=['{name}']" if kind in _UNSUPPORTED else ""
        raise node.refuse(f"type '{shorten(kind)}' is not supported", remedy)
    kind = "fixed" if locked else kind
    node.element.set("type", kind)
    if kind == "fixed":
        for child in list(node.element):
            if child.tag not in ("parent", "child", "origin"):
                node.element.remove(child)
    check_origin(node)
    return Joint(node, name, kind, node.need("parent").text("link"), node.need("child").text("link"))


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


def _mass(link: Node) -> float:
    """The mass of a link [kg], 0 if none is stated; raises RobotError unless a rigid body can have its inertia.

    Principal moments of a rigid body are ≥ 0 and none exceeds the sum of the other two. Point masses (all zero) and
    rods (one zero) are allowed; M(q) ≻ 0 is tested on the whole arm.
    """
    inertial = link.child("inertial")
    if inertial is None:
        return 0.0
    check_origin(inertial)
    mass = inertial.need("mass").number("value", least=0.0)
    node = inertial.need("inertia")
    xx, xy, xz, yy, yz, zz = (node.number(key) for key in _INERTIA)
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    if mass == 0.0 and inertia.any():
        raise inertial.need("mass").refuse("mass value '0' is not > 0 though inertia is stated", "fix <mass value=…>")
    small, middle, large = moments = np.linalg.eigvalsh(inertia)
    slack = _ROUNDING * large + _POINT**2 * mass
    for wrong, problem in (
        (small < -slack, "inertia is not positive definite"),
        (small + middle < large - slack, "not a physical body, principal moments a + b < c"),
    ):
        if wrong:
            stated = ", ".join(f"{moment:.4g}" for moment in moments)
            raise node.refuse(f"{problem} ({stated} kg·m²)", "fix <inertia …>")
    return mass


def _strength(limit: Node, key: str, kind: str, zero_limits: ZeroLimits) -> float:
    """The effort or velocity limit: > 0, or inf if there is none."""
    value = limit.number(key, math.inf if kind == "continuous" else None)
    if value == 0.0 and zero_limits == "unlimited":
        return math.inf
    if value <= 0.0:
        remedy = f"state the drive's {key} in <limit {key}=…>" + (_OPEN if value == 0.0 else "")
        raise limit.refuse(f"limit {key} '{value:g}' is not > 0", remedy)
    return value
