"""Visual geometry, mimic joints and transmissions of a URDF.

Pinocchio drops these. yourdfpy reads them here from the checked bytes; it never reads the dynamics.
"""

import io
import warnings
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
import trimesh
import yourdfpy
from jaxtyping import Float, Int
from lxml import etree

from nbs_pin.base.exceptions import RobotError
from nbs_pin.robots.meshes import Color, MeshError, Part, find_mesh, read_mesh, shaded
from nbs_pin.robots.packages import Packages
from nbs_pin.robots.robot import Robot
from nbs_pin.robots.visual_checks import UNIT_SPHERE, material_faults, visual_fault

MAX_SHAPES = 2000
"""Links with further shapes than this many in all are drawn as capsules."""
STEEL: Color = (0.35, 0.45, 0.60, 1.0)
BRASS: Color = (0.80, 0.60, 0.25, 1.0)
GREY: Color = (0.70, 0.72, 0.75, 1.0)


@dataclass(frozen=True, eq=False)
class Visual:
    """A triangle mesh of one colour, fixed to a link."""

    link: str
    placement: Float[np.ndarray, "4 4"]
    """Pose of the mesh in the link frame."""
    vertices: Float[np.ndarray, "v 3"]
    """Vertex positions [m]."""
    faces: Int[np.ndarray, "f 3"]
    """Vertex indices of the triangles, counter-clockwise seen from outside."""
    color: Color


class Tip(NamedTuple):
    """The end of a branch: its farthest link frame, or its centre of mass if all frames are at the last joint."""

    name: str
    """The link, or the joint that moves it."""
    joint: int
    """Index of that joint in Pinocchio's model."""
    point: Float[np.ndarray, "3"]
    """Where it is in the frame of the joint [m]."""


@dataclass(frozen=True)
class Mimic:
    """`joint` is coupled to `source`: q = multiplier · q_source + offset."""

    joint: str
    source: str
    multiplier: float
    offset: float


@dataclass(frozen=True)
class Transmission:
    """A gearbox between an actuator and joints; `reduction` is the number of motor turns per joint turn."""

    name: str
    joints: tuple[str, ...]
    reduction: float


@dataclass(frozen=True)
class Couplings:
    """Mimic joints and transmissions of a description."""

    mimics: tuple[Mimic, ...]
    transmissions: tuple[Transmission, ...]


def read_couplings(robot: Robot) -> Couplings:
    """The mimic joints, except locked ones, and the transmissions that the URDF states."""
    root = _root(robot)
    for link in root.iterfind("link"):
        for child in [*link]:
            link.remove(child)
    description = _described(robot, root)
    mimics = tuple(
        Mimic(joint.name, joint.mimic.joint, joint.mimic.multiplier, joint.mimic.offset)
        for joint in description.robot.joints
        if joint.mimic is not None
    )
    try:
        return Couplings(mimics, tuple(_transmission(element) for element in root.iterfind("transmission")))
    except ValueError as error:
        raise RobotError(f"{robot.urdf.path}: a mechanicalReduction is no number ({error}): correct it.") from error


def link_visuals(robot: Robot, package_dirs: Iterable[str | Path] = ()) -> tuple[Visual, ...]:
    """The visual geometry of all links; rigid bodies without any are drawn as capsules from joint to joint.

    So are links with a visual that cannot be drawn, whatever is wrong with it: a warning names link and fault. Meshes
    may also be read from `package_dirs`.
    """
    visuals, faults = _shapes(robot, _root(robot), package_dirs)
    for reason in dict.fromkeys(faults.values()):
        links = [name for name, fault in faults.items() if fault == reason]
        several = f"links {', '.join(map(repr, links[:5]))}{' …' * (len(links) > 5)} are drawn as capsules"
        warnings.warn(
            f"{several if len(links) > 1 else f'link {links[0]!r} is drawn as a capsule'}: {reason}", stacklevel=2
        )
    return (*visuals, *_capsules(robot, {visual.link for visual in visuals}, set(faults)))


def collision_shapes(robot: Robot) -> tuple[tuple[Visual, ...], dict[str, str]]:
    """The collision shapes of all links, the visual ones of links without; and what is wrong with others, by link."""
    root = _root(robot)
    for link in root.iterfind("link"):
        if link.find("collision") is not None:
            for visual in link.findall("visual"):
                link.remove(visual)
            for shape in link.findall("collision"):
                shape.tag = "visual"
    visuals, faults = _shapes(robot, root)
    return tuple(visuals), faults


def _shapes(robot: Robot, root: Any, package_dirs: Iterable[str | Path] = ()) -> tuple[list[Visual], dict[str, str]]:
    """The shapes of the visuals in the description, and the faults of those that cannot be drawn, by link."""
    packages = Packages(robot.urdf.path, (*package_dirs, *robot.options.get("package_dirs", ())))
    faults = _without_faulty_visuals(root)
    description = _described(robot, root)
    materials = {material.name: material.color for material in description.robot.materials if material.color}
    visuals: list[Visual] = []
    for link in description.robot.links:
        for visual in link.visuals:
            try:
                visuals += _drawn(link.name, visual, _parts(visual.geometry, packages), materials)
            except MeshError as error:
                faults.setdefault(link.name, str(error))
    return visuals, faults


def tips(robot: Robot) -> tuple[Tip, ...]:
    """The end of every branch of the arm, that of the last joint last."""
    model, parents = robot.model, set(robot.model.parents)
    found = []
    for joint in range(1, model.njoints):
        if joint not in parents:
            body = [frame for frame in model.frames if frame.type == pin.FrameType.BODY and frame.parentJoint == joint]
            point = _far_end(model.inertias[joint].lever, body)
            names = [frame.name for frame in body if np.array_equal(frame.placement.translation, point)]
            found.append(Tip(next(iter(names), model.names[joint]), joint, point))
    return tuple(found)


def _root(robot: Robot) -> Any:
    """The description as an lxml element, without comments."""
    parser = etree.XMLParser(resolve_entities=False, no_network=True, remove_comments=True, remove_pis=True)
    try:
        return etree.fromstring(robot.urdf.xml, parser)
    except etree.XMLSyntaxError as error:  # yourdfpy would try to repair it
        raise RobotError(f"{robot.urdf.path} is not well-formed XML ({error}): correct it.") from error


def _transmission(element: Any) -> Transmission:
    joints = tuple(joint.get("name", "") for joint in element.iterfind("joint"))
    return Transmission(element.get("name", ""), joints, float(element.findtext(".//mechanicalReduction", "1")))


def _without_faulty_visuals(root: Any) -> dict[str, str]:
    """Remove from the description what is not drawn, and visuals that cannot be; the faults of these by link."""
    materials, shapes = material_faults(root), 0
    faults: dict[str, str] = {}
    for child in [*root]:
        if child.tag not in ("link", "material") or (child.tag == "material" and child.get("name", "") in materials):
            root.remove(child)
    for link in root.iterfind("link"):
        for child in [*link]:
            fault = visual_fault(child, materials) if child.tag == "visual" else "not drawn"
            shapes += not fault
            if not fault and shapes > MAX_SHAPES:
                fault = f"the arm has more than {MAX_SHAPES} shapes"
            if fault:
                link.remove(child)
            if fault and child.tag == "visual":
                faults.setdefault(link.get("name", ""), f"{fault}: correct it.")
    return faults


def _described(robot: Robot, root: Any) -> yourdfpy.URDF:
    """The description as yourdfpy reads it."""
    try:
        return yourdfpy.URDF.load(io.BytesIO(etree.tostring(root)), build_scene_graph=False, load_meshes=False)
    except (ValueError, KeyError, TypeError, IndexError) as error:
        message = f"{robot.urdf.path}: a mimic or limit element is malformed ({error}): correct it."
        raise RobotError(message) from error


def _drawn(link: str, visual: Any, parts: tuple[Part, ...], materials: dict[str, Any]) -> list[Visual]:
    """The parts of a visual, placed and coloured."""
    placement = np.eye(4) if visual.origin is None else np.asarray(visual.origin, dtype=float)
    stated = _stated_color(visual.material, materials)
    return [Visual(link, placement, part.vertices, part.faces, part.color or stated or GREY) for part in parts]


def _parts(geometry: Any, packages: Packages) -> tuple[Part, ...]:
    """A URDF geometry as triangle meshes."""
    if geometry.mesh is not None:
        scale = np.ones(3) if geometry.mesh.scale is None else np.broadcast_to(geometry.mesh.scale, (3,)).astype(float)
        if geometry.mesh.filename == UNIT_SPHERE:
            return (shaded(trimesh.creation.uv_sphere(1.0, count=[24, 48]), None, scale),)
        return read_mesh(find_mesh(geometry.mesh.filename, packages), scale)
    if geometry.box is not None:
        return (shaded(trimesh.creation.box(geometry.box.size), None),)
    if geometry.cylinder is not None:
        shape = trimesh.creation.cylinder(geometry.cylinder.radius, geometry.cylinder.length, sections=48)
        return (shaded(shape, None),)
    return (shaded(trimesh.creation.uv_sphere(geometry.sphere.radius, count=[24, 48]), None),)


def _stated_color(material: Any, named: dict[str, Any]) -> Color | None:
    """The colour of a material, stated in it or by the material of the same name."""
    if material is None:
        return None
    color = material.color or named.get(material.name)
    if color is None:
        return None
    red, green, blue, alpha = (float(channel) for channel in color.rgba)
    return red, green, blue, alpha


def _capsules(robot: Robot, drawn: set[str], bare: set[str]) -> list[Visual]:
    """Capsules for the rigid bodies of which nothing is drawn or a mesh could not be drawn."""
    model = robot.model
    frames = [frame for frame in model.frames if frame.type == pin.FrameType.BODY]
    reach = sum(float(np.linalg.norm(placement.translation)) for placement in model.jointPlacements)
    radius = max(0.04 * reach, 1e-2)
    capsules: list[Visual] = []
    for joint in range(model.njoints):
        body = [frame for frame in frames if frame.parentJoint == joint]
        names = {frame.name for frame in body}
        if not body or (names & drawn and not names & bare):
            continue
        to_link = body[0].placement.inverse().homogeneous
        ends = [model.jointPlacements[child].translation for child in range(1, model.njoints)
                if model.parents[child] == joint]  # fmt: skip
        ends = ends or [_far_end(model.inertias[joint].lever, body)]
        shapes = [(trimesh.creation.icosphere(subdivisions=3, radius=1.25 * radius), BRASS)]
        shapes += [(_capsule(np.asarray(end), radius), STEEL) for end in ends if np.linalg.norm(end) > radius]
        for shape, color in shapes:
            part = shaded(shape, color)
            capsules.append(Visual(body[0].name, to_link, part.vertices, part.faces, color))
    return capsules


def _far_end(lever: Float[np.ndarray, "3"], body: list[Any]) -> Float[np.ndarray, "3"]:
    """The body's farthest link frame [m], or its centre of mass if all frames are at the joint."""
    points = [np.asarray(frame.placement.translation) for frame in body]
    far = max(points, key=lambda point: float(np.linalg.norm(point)))
    return far if np.linalg.norm(far) > 1e-3 else np.asarray(lever)


def _capsule(end: Float[np.ndarray, "3"], radius: float) -> trimesh.Trimesh:
    """A capsule from the origin to `end`."""
    length = float(np.linalg.norm(end))
    capsule = trimesh.creation.capsule(height=length, radius=radius, count=[32, 32])
    turn = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), end).matrix()
    capsule.apply_transform(pin.SE3(turn, 0.5 * end).homogeneous)
    return capsule
