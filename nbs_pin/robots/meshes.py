"""Mesh files of a robot's visual geometry, checked and split into parts of one colour.

The dynamics never need meshes; a file that cannot be drawn raises `MeshError`, and the caller decides what to do.
"""

import hashlib
import io
import logging
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import trimesh
from jaxtyping import Float, Int
from lxml import etree

from nbs_pin.base.doors import BLANK, option
from nbs_pin.base.exceptions import RobotError
from nbs_pin.robots.catalogue import example_robot_share
from nbs_pin.robots.mesh_cache import cached
from nbs_pin.robots.packages import MISSING, Packages, is_file
from nbs_pin.robots.urdf_source import shorten
from nbs_pin.robots.visual_checks import LARGEST

logging.getLogger("trimesh").addHandler(logging.NullHandler())  # else it prints tracebacks of faults that we tell
SUFFIXES = (".stl", ".obj", ".dae")
MAX_BYTES = 50_000_000
MAX_FACES = 1_000_000
MAX_COLORS = 32
_MAX_MATERIAL = 1_000_000
MAX_GROUPS = 2000
"""Largest number of named parts in a file; each costs milliseconds, however small it is."""
_GROUPS = {
    ".obj": rb"(?m)^[ \t]*(?:o|g|usemtl)\b",
    ".stl": rb"(?m)^[ \t]*solid\b",
    ".dae": rb"<(?:\w+:)?(?:node|instance_\w+|geometry|triangles|polylist|polygons|material|effect)\b",
}
CREASE = np.radians(40.0)
"""Edges with a larger angle between their faces are drawn sharp [rad]."""

Color = tuple[float, float, float, float]
"""Red, green, blue, opacity, each in [0, 1]."""


class MeshError(RobotError):
    """A mesh that cannot be drawn; names the reason and the remedy."""


@dataclass(frozen=True, eq=False)
class Part:
    """A triangle mesh of one colour; `color` is None if the file states none."""

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    color: Color | None


def find_mesh(uri: str, packages: Packages) -> Path:
    """The mesh file that `uri` refers to in a URDF, restricted to the folders that belong to the robot.

    These are the URDF's own folder, the ROS package around it, the package that a package:// address names
    (`Packages.find`), example-robot-data, and the folders given with `package_dirs`. Backslashes count as slashes.

    Raises:
        MeshError: For another scheme, suffix or folder, or a missing file.
    """
    scheme, _, rest = uri.replace("\\", "/").rpartition("://")
    if MISSING in rest:
        scheme, rest = "package", rest.partition(MISSING)[2]
    if scheme not in ("", "file", "package"):
        raise MeshError(f"mesh '{uri}' is not a file on this machine: give a relative or package:// path.")
    if Path(rest).suffix.lower() not in SUFFIXES:
        raise MeshError(f"mesh '{uri}' is a file of unknown kind: give one of {', '.join(SUFFIXES)}.")
    own = packages.file.parent
    roots = [own, packages.around, example_robot_share().resolve(), *packages.given]
    path = own / unquote(rest)
    if scheme == "package":
        name, _, inner = unquote(rest).partition("/")
        found, assumed = packages.find(name), packages.assume()
        if found is None and assumed is not None and is_file(assumed / inner):
            found = assumed
        if found is None:
            raise MeshError(
                f"package '{shorten(name)}' was not found near {packages.file} nor on ROS_PACKAGE_PATH or "
                f"AMENT_PREFIX_PATH: give the folder it lies in, {option('package_dirs', BLANK)}."
            )
        roots, path = [found.resolve(), *roots], found / inner
    try:
        resolved = path.resolve()
    except (OSError, ValueError) as error:
        raise MeshError(f"mesh '{shorten(uri)}' has no usable name ({error}): correct it.") from error
    if not any(resolved.is_relative_to(root) for root in roots) and not packages.holds(resolved):
        remedy = f"give the folder of its package, {option('package_dirs', BLANK)}"
        raise MeshError(f"mesh '{uri}' leaves the robot's folder {roots[0]}: {remedy}.")
    if not is_file(resolved):
        raise MeshError(f"mesh '{uri}' was not found at {resolved}: check the path or {option('package_dirs', BLANK)}.")
    return resolved


def read_mesh(path: Path, scale: Float[np.ndarray, "3"]) -> tuple[Part, ...]:
    """The parts of a mesh file, scaled, with sharp edges split so that smooth shading looks right.

    Raises MeshError if the file is too large, unreadable or empty, or if a vertex is not finite.
    """
    try:
        content = _content(path)
        materials = _materials(path, content)
        key = _digest(path, content, materials, scale)
        return cached(key, lambda: _read(path, content, materials, scale), _arrays, _parts)
    except MeshError:
        raise
    except Exception as error:  # mesh parsers may raise any exception, at once or when the mesh is used
        raise MeshError(f"mesh {path} cannot be read ({type(error).__name__}: {error}): export it again.") from error


def _materials(path: Path, content: bytes) -> dict[str, bytes]:
    """The material files in its own folder that an OBJ file names; those of more than 1 MB are left out."""
    if path.suffix.lower() != ".obj":
        return {}
    own = path.parent.resolve()
    named = (file for file in sorted(own.glob("*.[mM][tT][lL]")) if os.fsencode(file.name) in content)
    read = (file for file in named if is_file(file) and file.resolve().parent == own)
    return {file.name: file.read_bytes() for file in read if file.stat().st_size <= _MAX_MATERIAL}


def _digest(path: Path, content: bytes, materials: Mapping[str, bytes], scale: Float[np.ndarray, "3"]) -> str:
    """What the parts of a mesh file depend on: its content, materials and scale, and what reads it."""
    reader = repr((trimesh.__version__, path.suffix.lower(), scale.tolist())).encode()
    texts = [part for name, text in materials.items() for part in (name.encode(), text)]
    digest = hashlib.sha256()
    for part in (Path(__file__).read_bytes(), reader, content, *texts):
        digest.update(len(part).to_bytes(8))
        digest.update(part)
    return digest.hexdigest()


def _arrays(parts: tuple[Part, ...]) -> dict[str, np.ndarray]:
    colors = {"colored": np.array([part.color is not None for part in parts])}
    colors["colors"] = np.array([part.color or (0.0,) * 4 for part in parts])
    shapes = {f"vertices {k}": part.vertices for k, part in enumerate(parts)}
    return colors | shapes | {f"faces {k}": part.faces for k, part in enumerate(parts)}


def _parts(arrays: Mapping[str, np.ndarray]) -> tuple[Part, ...]:
    """The inverse of `_arrays`; raises KeyError or ValueError for arrays of anything else."""
    parts = []
    for k, (color, colored) in enumerate(zip(arrays["colors"].tolist(), arrays["colored"], strict=True)):
        vertices, faces = arrays[f"vertices {k}"], arrays[f"faces {k}"]
        is_inside = not faces.size or 0 <= faces.min() <= faces.max() < len(vertices)
        if vertices.shape[1:] != (3,) or faces.shape[1:] != (3,) or not is_inside:
            raise ValueError("the arrays are of no mesh")
        parts.append(Part(vertices, faces, tuple(color) if colored else None))
    return tuple(parts)


def _read(
    path: Path, content: bytes, materials: Mapping[str, bytes], scale: Float[np.ndarray, "3"]
) -> tuple[Part, ...]:
    _check_parts(path, content)
    kind = path.suffix.lower().removeprefix(".")
    # It reads no other file. `shaded` merges vertices.
    beside = trimesh.resolvers.ZipResolver(dict(materials))
    scene = trimesh.load_scene(io.BytesIO(content), file_type=kind, resolver=beside, process=False)
    _check_scene(path, scene)
    meshes = [mesh for mesh in scene.dump() if isinstance(mesh, trimesh.Trimesh)]
    if not any(len(mesh.faces) for mesh in meshes):
        raise MeshError(f"mesh {path} has no faces: export it again.")
    if not all((np.abs(mesh.vertices * scale) <= LARGEST).all() for mesh in meshes):
        raise MeshError(f"mesh {path} has vertices that are not finite or beyond {LARGEST:g} m: export it again.")
    pieces: dict[Color | None, list[trimesh.Trimesh]] = {}
    for mesh in meshes:
        for color, faces in _by_color(mesh):
            pieces.setdefault(color, []).append(trimesh.Trimesh(mesh.vertices, faces, process=False))
    return tuple(shaded(trimesh.util.concatenate(group), color, scale) for color, group in pieces.items())


def _content(path: Path) -> bytes:
    """The bytes of a mesh file; raises MeshError if they are too many or cannot be read."""
    try:
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise MeshError(f"mesh {path} has {size} bytes, at most {MAX_BYTES} are drawn: simplify it.")
        return path.read_bytes()
    except OSError as error:
        raise MeshError(f"mesh {path} cannot be read ({error.strerror}): check its permissions.") from error


def _check_parts(path: Path, content: bytes) -> None:
    """Raises MeshError for a file of too many parts."""
    groups = sum(1 for _ in re.finditer(_GROUPS[path.suffix.lower()], content))
    if path.suffix.lower() == ".dae" and groups <= MAX_GROUPS:
        groups = _placed(content)
    if groups > MAX_GROUPS:
        raise MeshError(f"mesh {path} has {groups} parts, at most {MAX_GROUPS} are drawn: join them.")


def _placed(collada: bytes) -> int:
    """How many meshes the scenes of a COLLADA file place; nodes that place nodes can multiply beyond any memory."""
    root = etree.fromstring(collada, etree.XMLParser(resolve_entities=False, no_network=True))
    nodes = list(root.iter("{*}node"))
    named = {f"#{node.get('id')}": node for node in nodes}
    known: dict[Any, int] = {}

    def count(node: Any) -> int:
        if node not in known:
            known[node] = MAX_GROUPS + 1  # what a node that places itself finds
            inner = [*node.iterfind("{*}node")]
            inner += [named[link.get("url")] for link in node.iterfind("{*}instance_node") if link.get("url") in named]
            known[node] = len(node.findall("{*}instance_geometry")) + sum(count(child) for child in inner)
        return known[node]

    return sum(count(node) for node in root.iterfind(".//{*}visual_scene/{*}node"))


def _check_scene(path: Path, scene: Any) -> None:
    """Raises MeshError if the meshes, counted as often as they are placed, have too many parts or faces."""
    placed = [scene.geometry[scene.graph[node][1]] for node in scene.graph.nodes_geometry]
    if len(placed) > MAX_GROUPS:
        raise MeshError(f"mesh {path} places {len(placed)} parts, at most {MAX_GROUPS} are drawn: join them.")
    count = sum(len(getattr(geometry, "faces", ())) for geometry in placed)
    if count > MAX_FACES:
        raise MeshError(f"mesh {path} has {count} faces, at most {MAX_FACES} are drawn: simplify it.")


def shaded(mesh: Any, color: Color | None, scale: Float[np.ndarray, "3"] | None = None) -> Part:
    """A trimesh as a `Part`, its vertices merged and then split along sharp edges."""
    mesh = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    mesh.merge_vertices()
    mesh = trimesh.graph.smooth_shade(mesh, angle=CREASE, facet_minarea=None)
    vertices = np.asarray(mesh.vertices, dtype=float) * (1.0 if scale is None else scale)
    mirrored = scale is not None and np.prod(scale) < 0.0
    faces = np.asarray(mesh.faces, dtype=np.int64)
    return Part(vertices, faces[:, ::-1] if mirrored else faces, color)


def _by_color(mesh: Any) -> list[tuple[Color | None, Int[np.ndarray, "f 3"]]]:
    """The faces of a mesh by colour, None if the file states none."""
    faces = np.asarray(mesh.faces, dtype=np.int64)
    visual = mesh.visual
    if visual.kind is None or len(faces) == 0:
        return [(None, faces)]
    if visual.kind == "texture":
        return [(_color(visual.material.main_color), faces)]
    colors, index = np.unique(visual.face_colors, axis=0, return_inverse=True)
    if len(colors) > MAX_COLORS:
        return [(_color(visual.main_color), faces)]
    return [(_color(color), faces[index.ravel() == k]) for k, color in enumerate(colors)]


def _color(rgba: Any) -> Color:
    red, green, blue, alpha = (float(channel) / 255.0 for channel in rgba)
    return red, green, blue, alpha
