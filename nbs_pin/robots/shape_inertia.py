"""Inertia of a link from its shapes, filled with material of one density: a guess where a file states none."""

import xml.etree.ElementTree as ET

import numpy as np
import pinocchio as pin
import trimesh

from nbs_pin.robots.meshes import MeshError, find_mesh, read_mesh
from nbs_pin.robots.packages import Packages
from nbs_pin.robots.urdf_checks import LONGEST_WAY, check_origin
from nbs_pin.robots.urdf_source import Node

DENSITY = 1000.0
"""Density that MuJoCo fills shapes with as well [kg/m³]."""


def solid(link: Node, packages: Packages) -> ET.Element | None:
    """An <inertial> with the inertia of the collision shapes of a link, else of its visual ones; None without shapes.

    Meshes that are not watertight count as their convex hull; overlapping parts count twice.
    """
    for tag in ("collision", "visual"):
        bodies = [body for node in link.named(tag) for body in _bodies(node, packages)]
        if bodies:
            return _element(sum(bodies[1:], bodies[0]))
    return None


def _bodies(shape: Node, packages: Packages) -> list[pin.Inertia]:
    check_origin(shape)
    origin, geometry = shape.child("origin"), shape.child("geometry")
    if geometry is None:
        return []
    zero = (0.0, 0.0, 0.0)
    xyz, rpy = (zero if origin is None else origin.numbers(key, 3, zero) for key in ("xyz", "rpy"))
    frame = pin.SE3(pin.rpy.rpyToMatrix(*rpy), np.array(xyz))
    return [frame.act(_inertia(mesh)) for mesh in _meshes(geometry, packages)]


def _meshes(geometry: Node, packages: Packages) -> list[trimesh.Trimesh]:
    """The shapes of a <geometry>; those of a mesh file with its scale."""
    box, cylinder, sphere, mesh = (geometry.child(tag) for tag in ("box", "cylinder", "sphere", "mesh"))
    if box is not None:
        return [trimesh.creation.box([_size(box, "size", x) for x in box.numbers("size", 3)])]
    if cylinder is not None:
        radius, length = (_size(cylinder, key, cylinder.number(key)) for key in ("radius", "length"))
        return [trimesh.creation.cylinder(radius, length, sections=96)]
    if sphere is not None:
        return [trimesh.creation.icosphere(subdivisions=5, radius=_size(sphere, "radius", sphere.number("radius")))]
    if mesh is None:
        return []
    scale = np.array(mesh.numbers("scale", 3, (1.0, 1.0, 1.0)))
    try:
        parts = read_mesh(find_mesh(mesh.text("filename"), packages), scale)
    except MeshError as error:
        raise mesh.refuse(
            f"its inertia cannot be guessed: {str(error).rstrip('.')}", "give the link an <inertial>"
        ) from error
    counts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = np.concatenate([part.faces + first for part, first in zip(parts, counts, strict=False)])
    whole = trimesh.Trimesh(np.concatenate([part.vertices for part in parts]), faces)
    if (
        not np.abs(whole.vertices).max() <= LONGEST_WAY
        or np.linalg.matrix_rank(np.ptp(whole.vertices, axis=0) * np.eye(3)) < 3
    ):
        raise mesh.refuse("its inertia cannot be guessed: it is flat or too large", "give the link an <inertial>")
    return [whole if whole.is_volume else whole.convex_hull]


def _size(shape: Node, key: str, value: float) -> float:
    """The size of a shape; raises RobotError unless it encloses a volume that an arm can have."""
    if not 0.0 < value <= LONGEST_WAY:
        raise shape.refuse(f"{key} {value:g} m encloses no volume of an arm", "give the link an <inertial>")
    return value


def _inertia(mesh: trimesh.Trimesh) -> pin.Inertia:
    mesh.density = DENSITY
    return pin.Inertia(float(mesh.mass), np.array(mesh.center_mass), np.array(mesh.moment_inertia))


def _element(body: pin.Inertia) -> ET.Element:
    inertial = ET.Element("inertial")
    ET.SubElement(inertial, "origin", {"xyz": " ".join(map(repr, body.lever.tolist())), "rpy": "0.0 0.0 0.0"})
    ET.SubElement(inertial, "mass", {"value": repr(float(body.mass))})
    moments = body.inertia[np.triu_indices(3)].tolist()
    names = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    ET.SubElement(inertial, "inertia", {key: repr(x) for key, x in zip(names, moments, strict=True)})
    return inertial
