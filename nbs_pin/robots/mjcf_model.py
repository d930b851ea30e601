"""MuJoCo's own model of an MJCF file, compiled without what the dynamics do not need.

Textures, height fields, sensors and keyframes are left out, and meshes are read only where a mass is inferred from
them: an arm loads without its mesh files. A geom of a mesh that is not read stays as a small sphere, in its frame.
"""

import logging
import math
import re
import threading
import warnings
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float

from nbs_pin.base.exceptions import RobotError
from nbs_pin.robots.meshes import MAX_BYTES
from nbs_pin.robots.mjcf_files import MjcfFiles
from nbs_pin.robots.packages import is_file
from nbs_pin.robots.urdf_source import shorten
from nbs_pin.robots.visual_checks import LARGEST

_LOGGER = logging.getLogger("nbs_pin.mujoco")
_LINE = re.compile(r"line (\d+)", re.ASCII)
_lock = threading.Lock()
"""Filters of warnings belong to the process: one thread at a time may change them."""
_UNUSED = (
    "keys", "sensors", "tuples", "numerics", "texts", "skins", "hfields", "textures", "pairs", "excludes", "lights",
    "cameras",
)  # fmt: skip
_MESH, _HFIELD, _SDF = (getattr(mujoco.mjtGeom, f"mjGEOM_{kind}") for kind in ("MESH", "HFIELD", "SDF"))
_FROM_GEOMS = mujoco.mjtInertiaFromGeom
_DOT = 1e-3
"""Radius of the spheres that stand for meshes that are not read [m]."""


@dataclass(frozen=True)
class MeshShape:
    """A mesh as the file states it, for drawings."""

    file: Path
    scale: tuple[float, ...]
    position: tuple[float, ...]
    """refpos: what is subtracted from the vertices [m]."""
    quaternion: tuple[float, ...]
    """refquat: the rotation whose inverse is applied to them."""


@dataclass(frozen=True)
class MjcfModel:
    """A compiled description."""

    model: Any
    """The mujoco.MjModel."""
    name: str
    meshes: dict[int, MeshShape | None]
    """The mesh of each geom that shows one, None where it has no file."""
    lines: dict[tuple[str, int], int]
    """The lines of joints and bodies in the main file, by "joint" or "body" and number."""


def compile_mjcf(files: MjcfFiles, *, is_tool: bool = False) -> MjcfModel:
    """The model of a description whose files were scanned; of a tool also what is fixed to its world weighs.

    Raises:
        RobotError: If MuJoCo cannot read or compile it, or a mesh is missing from which a mass is inferred.
    """
    # A thread of its own: a failure within MuJoCo 4.0 leaves the handler of warnings of its thread in a loop, in which
    # the next file with a warning would never end.
    with ThreadPoolExecutor(max_workers=1) as thread:
        return thread.submit(_compiled, files, is_tool).result()


def _compiled(files: MjcfFiles, is_tool: bool) -> MjcfModel:
    mujoco.set_mju_user_warning(_LOGGER.info)  # else MuJoCo writes a file in the working directory
    try:
        with _lock, warnings.catch_warnings(record=True) as said:  # about the form of the file, in MuJoCo's words
            warnings.simplefilter("always")
            spec = mujoco.MjSpec.from_file(str(files.main))
            shown = _lean(spec, files, is_tool)
            model = spec.compile()
    except RobotError:
        raise
    except (ValueError, RuntimeError, MemoryError, mujoco.FatalError) as error:  # whatever MuJoCo makes of a failure
        reason = " ".join(str(error).replace("XML Error: ", "").split())
        raise RobotError(f"{files.main}: MuJoCo cannot read it ({_shortened(reason)}); correct the file.") from error
    for warning in said:
        _LOGGER.info("%s: %s", files.main, warning.message)
    written = [("joint", joint) for joint in spec.joints] + [("body", body) for body in spec.bodies]
    found = [(kind, element.id, _LINE.fullmatch(element.info)) for kind, element in written]
    lines = {(kind, k): int(line[1]) for kind, k, line in found if line}
    return MjcfModel(model, spec.modelname, {geom.id: mesh for geom, mesh in shown}, lines)


def _shortened(text: str) -> str:
    """MuJoCo's words for use in a sentence."""
    safe = "".join(letter if letter.isprintable() else "\N{REPLACEMENT CHARACTER}" for letter in text).rstrip(". ")
    return safe if len(safe) <= 300 else safe[:297] + "..."


def _lean(spec: Any, files: MjcfFiles, is_tool: bool) -> list[tuple[Any, MeshShape | None]]:
    """Remove what is not needed; the geoms that show meshes, with these."""
    for material in spec.materials:
        material.textures = [""] * len(material.textures)
    for kind in _UNUSED:
        for element in list(getattr(spec, kind)):
            spec.delete(element)
    for name in dir(spec):
        if name.startswith("nuser_"):
            setattr(spec, name, -1)
    spec.nkey = spec.nuserdata = 0
    spec.compiler.fusestatic = spec.compiler.discardvisual = False
    spec.compiler.usethread = False
    spec.compiler.LRopt.mode = mujoco.mjtLRMode.mjLRMODE_NONE
    meshes = {mesh.name: mesh for mesh in spec.meshes}
    shown, read = [], set()
    for geom in list(spec.geoms):
        geom.contype = geom.conaffinity = 0
        if geom.type not in (_MESH, _SDF, _HFIELD) and not geom.meshname:
            continue
        mesh = meshes.get(geom.meshname)
        is_fitted = geom.type not in (_MESH, _SDF)
        shown.append((geom, None if mesh is None or is_fitted else _shape(spec, mesh, files)))
        if geom.type != _HFIELD and _weighs(spec, geom, is_tool):
            _check_mesh(spec, geom, mesh, files)
            read.add(geom.meshname)
        else:
            geom.type, geom.meshname, geom.hfieldname = mujoco.mjtGeom.mjGEOM_SPHERE, "", ""
            geom.size, geom.mass = [_DOT, 0.0, 0.0], 0.0
    for name, mesh in meshes.items():
        if name not in read:
            spec.delete(mesh)
    return shown


def _weighs(spec: Any, geom: Any, is_tool: bool) -> bool:
    """Whether the mass of what moves depends on a geom."""
    body, compiler = geom.parent, geom.parent.compiler or spec.compiler
    inferred = compiler.inertiafromgeom == _FROM_GEOMS.mjINERTIAFROMGEOM_TRUE or (
        compiler.inertiafromgeom == _FROM_GEOMS.mjINERTIAFROMGEOM_AUTO and not body.explicitinertial
    )
    least, most = compiler.inertiagrouprange
    weightless = geom.mass == 0.0 or (math.isnan(geom.mass) and geom.density == 0.0)
    if not inferred or weightless or not least <= geom.group <= most:
        return False
    if is_tool or spec.compiler.settotalmass > 0.0:
        return body.name != "world"
    while body is not None:
        if body.joints:
            return True
        body = body.parent
    return False


def _is_flat(vertices: Float[np.ndarray, "v 3"]) -> bool:
    """Whether vertices that a description states enclose next to nothing, or are too far away."""
    if len(vertices) < 4:
        return False
    if not np.abs(vertices).max() <= LARGEST:
        return True
    sizes = np.linalg.svd(vertices - vertices.mean(axis=0), compute_uv=False)
    return bool(sizes[-1] <= 1e-6 * sizes[0])


def _shape(spec: Any, mesh: Any, files: MjcfFiles) -> MeshShape | None:
    """The file of a mesh as it is to be drawn; None if it has none."""
    path = _path(spec, mesh, files)
    numbers = (tuple(map(float, x)) for x in (mesh.scale, mesh.refpos, mesh.refquat))
    return None if path is None else MeshShape(path, *numbers)


def _path(spec: Any, mesh: Any, files: MjcfFiles) -> Path | None:
    """Where MuJoCo looks for the file of a mesh; None for one that is stated in the description."""
    if not mesh.file:
        return None
    name, folder = (PurePosixPath(text.replace("\\", "/")) for text in (mesh.file, mesh.compiler.meshdir))
    name = PurePosixPath(name.name) if spec.strippath else name
    places = [root / folder / name for root in files.folders]
    return next((path for path in places if is_file(path)), places[0])


def _check_mesh(spec: Any, geom: Any, mesh: Any, files: MjcfFiles) -> None:
    """Raise RobotError if the file of a mesh that weighs is missing or too large."""
    path, body = None if mesh is None else _path(spec, mesh, files), f"body '{shorten(geom.parent.name)}'"
    if mesh is not None and _is_flat(np.array(mesh.uservert).reshape(-1, 3)):  # qhull would print that
        problem = f"its mass is that of mesh '{shorten(mesh.name)}', which encloses no volume of an arm"
    elif path is None:  # stated in the description, or not at all, which MuJoCo refuses
        return
    elif not is_file(path):
        problem = f"its mass is that of mesh '{shorten(mesh.file)}', which was not found at {path}"
    elif path.stat().st_size > MAX_BYTES:
        problem = f"its mass is that of mesh '{shorten(mesh.file)}', which has more than {MAX_BYTES} bytes"
    else:
        return
    raise RobotError(f"{files.main}: {body}: {problem}; give the file, or the body an <inertial>.")
