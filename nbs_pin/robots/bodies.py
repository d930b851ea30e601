"""Bodies of a description: masses and inertias that a rigid body can have, and what is taken where there is none."""

import warnings
import xml.etree.ElementTree as ET
from collections import defaultdict
from collections.abc import Iterable

import numpy as np
from jaxtyping import Float

from nbs_pin.base.doors import option
from nbs_pin.base.exceptions import RobotError
from nbs_pin.robots.packages import Packages
from nbs_pin.robots.urdf_checks import LONGEST_WAY, ROUNDING, Joint, check_origin, lock_too
from nbs_pin.robots.urdf_options import UrdfOptions
from nbs_pin.robots.urdf_source import Node

_POINT = 1e-9
"""Radius of gyration below which a body counts as a point mass [m]."""
_NEGLECTED = 1e-14
"""MuJoCo drops bodies below 1e-15 kg."""
_SMALLEST = 0.05
"""Least radius of a ball in place of a body [m]."""
_HEAVIEST = 1e6
"""Largest mass that an arm can have [kg]."""
_INERTIA = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")


def check_bodies(robot: Node, joints: list[Joint], options: UrdfOptions, packages: Packages) -> None:
    """Check that every inertia that moves is physical and that every moving joint carries mass.

    Links fixed to each other count as one body, so a tool frame or a flange of a massive link may have no mass; nor
    need a link without shapes between two joints, as where two axes cross: whether M(q) ≻ 0 is tested on the whole arm.
    What is welded to the world is not judged: an inertia there that no body has is taken away.
    """
    if options.inertia_from == "links":
        _put_balls(robot, joints)
        return
    above = {joint.child: joint for joint in joints}
    mass: dict[str, float] = defaultdict(float)
    links: dict[str, list[Node]] = defaultdict(list)
    for link in robot.named("link"):
        name = link.text("name")
        while name in above and not above[name].moves:
            name = above[name].parent
        mass[name] += _mass(link, welded=name not in above, repair=options.repair)
        links[name].append(link)
    empty = [joint for joint in joints if joint.moves and mass[joint.child] == 0.0]
    if options.inertia_from == "shapes":
        empty = _fill(empty, links, packages)
    bare = _without_mass_behind(empty, joints)
    empty = [joint for joint in empty if joint in bare or any(_has_shape(link) for link in links[joint.child])]
    if empty:
        joint, names = empty[0], [joint.name for joint in empty]
        why = "(M would be singular)" if joint in bare else "though it has a shape"
        problem = f"moves link '{joint.child}', which has no mass {why}"
        remedy = f"give link '{joint.child}' an <inertial> with mass > 0"
        if len(names) < sum(joint.moves for joint in joints):
            remedy += f", lock what moves none ({lock_too(options, names)})"
        if options.inertia_from != "shapes":
            remedy += f", take the inertia of its shapes as a guess ({option('inertia_from', 'shapes')})"
        remedy += f", or learn all bodies from a log ({option('inertia_from', 'links')})"
        raise joint.node.refuse(problem, remedy)


def _put_balls(robot: Node, joints: list[Joint]) -> None:
    """A ball of 1 kg in every link that a joint moves, midway to the joints behind it, in place of what is stated."""
    moved = {joint.child for joint in joints if joint.moves}
    for link in robot.named("link"):
        for stated in link.element.findall("inertial"):
            link.element.remove(stated)
        name = link.text("name")
        if name not in moved:
            continue
        behind = [np.array(_origin(joint)) for joint in joints if joint.parent == name]
        centre = 0.5 * np.mean(behind, axis=0) if behind else np.zeros(3)
        moment = 0.4 * max(float(np.linalg.norm(centre)), _SMALLEST) ** 2
        inertial = ET.SubElement(link.element, "inertial")
        ET.SubElement(inertial, "origin", {"xyz": " ".join(repr(float(x)) for x in centre)})
        ET.SubElement(inertial, "mass", {"value": "1.0"})
        equal = dict.fromkeys(("ixx", "iyy", "izz"), repr(moment))
        ET.SubElement(inertial, "inertia", equal | dict.fromkeys(("ixy", "ixz", "iyz"), "0.0"))
    text = "the bodies are balls of 1 kg along the links, as only the geometry of the file was to be taken"
    warnings.warn(f"{text}; learn them before anything else.", stacklevel=2)


def _origin(joint: Joint) -> tuple[float, ...]:
    origin = joint.node.child("origin")
    return (0.0, 0.0, 0.0) if origin is None else origin.numbers("xyz", 3, (0.0, 0.0, 0.0))


def _without_mass_behind(empty: list[Joint], joints: list[Joint]) -> list[Joint]:
    """Those of the joints that carry a body without mass behind which there is none with mass either."""
    bare, below = {joint.name for joint in empty}, defaultdict[str, list[Joint]](list)
    for joint in joints:
        below[joint.parent].append(joint)
    carry: set[str] = set()
    """Links that have mass behind a moving joint."""
    for joint in _from_the_tips(joints, below):
        if joint.child in carry or (joint.moves and joint.name not in bare):
            carry.add(joint.parent)
    return [joint for joint in empty if joint.child not in carry]


def _has_shape(link: Node) -> bool:
    return link.element.find("visual") is not None or link.element.find("collision") is not None


def _from_the_tips(joints: list[Joint], below: dict[str, list[Joint]]) -> list[Joint]:
    """The joints, each after those behind it."""
    children = {joint.child for joint in joints}
    order = [joint for joint in joints if joint.parent not in children]
    for joint in order:
        order.extend(below[joint.child])
    return order[::-1]


def nearest_body(inertia: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """The inertia about the centre of mass of the body that is nearest to the one stated [kg·m²].

    A body has an inertia I exactly if its second moments Σ = ½ tr(I)·1 − I are positive semidefinite: this is the
    condition on its pseudo-inertia for a given mass and centre. Σ is projected to the nearest positive semidefinite
    matrix in the Frobenius norm, and kept off the boundary by 3e-5 of its largest eigenvalue: six digits suffice.
    """
    second = 0.5 * np.trace(inertia) * np.eye(3) - inertia
    values, vectors = np.linalg.eigh(second)
    second = (vectors * np.maximum(values, 3e-5 * max(values[-1], 0.0))) @ vectors.T
    return np.asarray(np.trace(second) * np.eye(3) - second)


def _mass(link: Node, *, welded: bool, repair: bool) -> float:
    """The mass of a link [kg], 0 if none is stated; raises RobotError unless a rigid body can have its inertia.

    Principal moments of a rigid body are ≥ 0 and none exceeds the sum of the other two. Point masses (all zero) and
    rods (one zero) are allowed; M(q) ≻ 0 is tested on the whole arm.
    """
    inertial = link.child("inertial")
    if inertial is None:
        return 0.0
    if welded and not _sound(inertial):
        link.element.remove(inertial.element)
        return 0.0
    mass, inertia = _stated(inertial)
    node, problem = inertial.need("inertia"), _fault(mass, inertia)
    if mass == 0.0 and inertia.any():
        problem = "mass value '0' is not > 0 though inertia is stated"
        if not repair:
            remedy = f"fix <mass value=…>, or leave the inertia out ({option('repair', True)})"
            raise inertial.need("mass").refuse(problem, remedy)
        warnings.warn(f"{node.place}: {node.owner}: {problem}; the inertia is left out.", stacklevel=2)
        link.element.remove(inertial.element)
        return 0.0
    if 0.0 < mass < _NEGLECTED or mass > _HEAVIEST or np.abs(inertia).max() > _HEAVIEST * LONGEST_WAY**2:
        stated = f"mass {mass:g} kg with inertia up to {np.abs(inertia).max():g} kg·m² is none that an arm can have"
        raise inertial.need("mass").refuse(
            stated, f"give a mass from {_NEGLECTED:g} to {_HEAVIEST:g} kg, or 0 for none"
        )
    if problem:
        nearest = nearest_body(inertia)
        digits = [f"{value:.6g}" for value in nearest[np.triu_indices(3)]]
        listed = " ".join(f'{key}="{text}"' for key, text in zip(_INERTIA, digits, strict=True))
        if not repair or not nearest.any():
            remedy = f"the nearest body has <inertia {listed}/>: write it, or take it ({option('repair', True)})"
            raise node.refuse(problem, remedy if nearest.any() else "fix <inertia …>")
        warnings.warn(f"{node.place}: {node.owner}: {problem}; taken as <inertia {listed}/>.", stacklevel=2)
        for key, text in zip(_INERTIA, digits, strict=True):
            node.element.set(key, repr(float(text)))
    return mass


def _stated(inertial: Node) -> tuple[float, Float[np.ndarray, "3 3"]]:
    """Mass [kg] and inertia [kg·m²] of an <inertial>."""
    check_origin(inertial)
    mass, node = inertial.need("mass").number("value", least=0.0), inertial.need("inertia")
    xx, xy, xz, yy, yz, zz = (node.number(key) for key in _INERTIA)
    return mass, np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def _sound(inertial: Node) -> bool:
    """Whether engines take an inertia."""
    try:
        mass, inertia = _stated(inertial)
    except RobotError:
        return False
    return not _fault(mass, inertia) and (mass >= _NEGLECTED or not (mass or inertia.any())) and mass <= _HEAVIEST


def _fault(mass: float, inertia: Float[np.ndarray, "3 3"]) -> str:
    """Why no rigid body has this inertia, or nothing."""
    moments = np.linalg.eigvalsh(inertia)
    small, middle, large = moments.tolist()
    slack = ROUNDING * abs(large) + _POINT**2 * mass
    stated = f"({', '.join(f'{moment:.4g}' for moment in moments)} kg·m²)"
    if small < -slack:
        return f"inertia is not positive definite {stated}"
    if small + middle < large - slack:
        return f"not a physical body, principal moments a + b < c {stated}"
    return ""


def _fill(empty: Iterable[Joint], links: dict[str, list[Node]], packages: Packages) -> list[Joint]:
    """Give the links of bodies without mass the inertia of their shapes; returns the joints that still move none."""
    from nbs_pin.robots.shape_inertia import DENSITY, solid  # trimesh is slow to import, and few arms need it

    guessed, left = [], []
    for joint in empty:
        found = [(link, solid(link, packages)) for link in links[joint.child]]
        left += [] if any(inertial is not None for _, inertial in found) else [joint]
        for link, inertial in found:
            stated = link.child("inertial")
            if inertial is not None:
                if stated is not None:
                    link.element.remove(stated.element)
                link.element.append(inertial)
                guessed.append(link.text("name"))
    if guessed:
        names = ", ".join(f"'{name}'" for name in guessed)
        text = f"the inertias of links {names} are guessed from their shapes, filled with {DENSITY:g} kg/m³"
        warnings.warn(f"{text}; a tracking error or a bound is as good as this guess.", stacklevel=2)
    return left
