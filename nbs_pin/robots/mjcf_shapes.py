"""The geoms of an MJCF description as <visual> elements, for drawings."""

import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping
from typing import Any

import mujoco
import numpy as np
import pinocchio as pin

from nbs_pin.robots.mjcf_model import MeshShape
from nbs_pin.robots.mjcf_tree import Tree, add_origin, numbers
from nbs_pin.robots.rotations import from_quaternion
from nbs_pin.robots.visual_checks import UNIT_SPHERE

_BOX, _SPHERE, _ELLIPSOID, _CYLINDER, _CAPSULE, _IS_MESH = (
    int(getattr(mujoco.mjtGeom, f"mjGEOM_{kind}"))
    for kind in ("BOX", "SPHERE", "ELLIPSOID", "CYLINDER", "CAPSULE", "MESH")
)
_SHOWN = 2
"""Largest group that viewers show by default; others are for collisions."""
_Piece = tuple[str, dict[str, str], pin.SE3]


def add_shapes(tree: Tree, meshes: Mapping[int, MeshShape | None]) -> None:
    """Add a <visual> for every geom that viewers show to the links of `tree`, which are in the order of the bodies.

    A capsule becomes a cylinder and two spheres. Planes, height fields and meshes without a file are left out.
    """
    model = tree.model
    links = {link.get("name"): link for link in tree.robot.iterfind("link")}
    for geom in range(model.ngeom):
        color = model.geom_rgba[geom] if model.geom_matid[geom] < 0 else model.mat_rgba[model.geom_matid[geom]]
        if model.geom_group[geom] > _SHOWN or color[3] <= 0.0:
            continue
        link = links[tree.bodies[model.geom_bodyid[geom]]]
        mesh = meshes.get(geom)
        pieces = list(_mesh(model, geom, mesh)) if geom in meshes else list(_pieces(model, geom))
        for tag, attributes, pose in pieces:
            _add_visual(tree, link, tag, attributes, pose, color)


def _add_visual(tree: Tree, link: ET.Element, tag: str, attributes: dict[str, str], pose: pin.SE3, color: Any) -> None:
    place = tree.places[link]
    visual = tree.add(link, place, "visual")
    add_origin(tree, visual, pose)
    geometry = tree.add(visual, place, "geometry")
    tree.add(geometry, place, tag, **attributes)
    material = tree.add(visual, place, "material", name=" ".join(f"{x:.3g}" for x in color))
    tree.add(material, place, "color", rgba=numbers(*np.clip(color, 0.0, 1.0)))


def _pose(model: Any, geom: int) -> pin.SE3:
    return pin.SE3(from_quaternion(model.geom_quat[geom]), model.geom_pos[geom].copy())


def _pieces(model: Any, geom: int) -> Iterator[_Piece]:
    """The shapes of URDF that make up a primitive."""
    kind, size, pose = int(model.geom_type[geom]), model.geom_size[geom], _pose(model, geom)
    if kind == _BOX:
        yield "box", {"size": numbers(*(2.0 * size))}, pose
    elif kind == _SPHERE:
        yield "sphere", {"radius": numbers(size[0])}, pose
    elif kind == _ELLIPSOID:
        yield "mesh", {"filename": UNIT_SPHERE, "scale": numbers(*size)}, pose
    elif kind in (_CYLINDER, _CAPSULE):
        yield "cylinder", {"radius": numbers(size[0]), "length": numbers(2.0 * size[1])}, pose
        for end in (-size[1], size[1]) if kind == _CAPSULE else ():
            yield "sphere", {"radius": numbers(size[0])}, pose * pin.SE3(np.eye(3), np.array([0.0, 0.0, end]))


def _mesh(model: Any, geom: int, mesh: MeshShape | None) -> Iterator[_Piece]:
    """A mesh in the frame of its file: MuJoCo moves it to its centre of mass and principal axes.

    The vertices are x ↦ S Rᵀ(x − p) with the scale S and refpos and refquat, which URDF can state if R and S commute.
    """
    if mesh is None:
        return
    pose, data = _pose(model, geom), int(model.geom_dataid[geom])
    if int(model.geom_type[geom]) == _IS_MESH:
        centre = pin.SE3(from_quaternion(model.mesh_quat[data]), model.mesh_pos[data].copy())
        pose = pose * centre.inverse()
    turn, scale = from_quaternion(np.array(mesh.quaternion)).T, np.array(mesh.scale)
    if np.abs(turn * scale - scale[:, None] * turn).max() > 1e-9 * np.abs(scale).max():
        return
    pose = pose * pin.SE3(turn, -turn @ (scale * np.array(mesh.position)))
    yield "mesh", {"filename": str(mesh.file).replace("%", "%25"), "scale": numbers(*scale)}, pose
