"""Visual elements of a URDF, checked before they are drawn: what is wrong with one, in words.

The dynamics never need them, so a fault is told and the link drawn as a capsule; nothing is refused.
"""

import math
from collections.abc import Mapping
from pathlib import PurePosixPath
from typing import Any

LARGEST = 1e5
"""Largest size, offset or scale that is drawn [m]: meshes in millimetres without a scale stay below it."""
LONGEST_NAME = 255
"""Longest file name that file systems hold [bytes]."""
LONGEST_PATH = 4000
"""Longest path of a mesh [bytes]."""
_SIZES = {"box": {"size": 3}, "cylinder": {"radius": 1, "length": 1}, "sphere": {"radius": 1}}
SHAPES = (*_SIZES, "mesh")
UNIT_SPHERE = "nbs_pin:///unit_sphere"
"""Name of the mesh of a sphere with radius 1 m, which a scale makes an ellipsoid."""


def material_faults(root: Any) -> dict[str, str]:
    """What is wrong with the materials of a <robot>, by name; those without a fault are left out."""
    found = {material.get("name", ""): _color_fault(material) for material in root.iterfind("material")}
    return {name: fault for name, fault in found.items() if fault}


def visual_fault(visual: Any, materials: Mapping[str, str]) -> str:
    """What is wrong with a <visual>, empty if it can be drawn; `materials` from `material_faults`."""
    geometry, origin, material = (visual.find(tag) for tag in ("geometry", "origin", "material"))
    shape = None if geometry is None or len(geometry) == 0 else geometry[0]
    if shape is None or shape.tag not in SHAPES:
        return f"its visual has {'no geometry' if shape is None else f'geometry {_quoted(shape.tag)}'}"
    fault = _mesh_fault(shape) if shape.tag == "mesh" else _size_fault(shape)
    if not fault and origin is not None:
        fault = _fault(origin, "xyz", 3, default="0 0 0") or _fault(
            origin, "rpy", 3, default="0 0 0", largest=math.inf, unit="rad"
        )
    if not fault and material is not None:
        stated = material.find("color") is not None
        fault = _color_fault(material) if stated else materials.get(material.get("name", ""), "")
    return fault


def _size_fault(shape: Any) -> str:
    for key, count in _SIZES[shape.tag].items():
        fault = _fault(shape, key, count, positive=True)
        if fault:
            return fault
    return ""


def _mesh_fault(mesh: Any) -> str:
    name = mesh.get("filename", "")
    longest = max((len(part.encode()) for part in PurePosixPath(name).parts), default=0)
    if not name or "\0" in name:
        return "its mesh has no filename"
    if longest > LONGEST_NAME or len(name.encode()) > LONGEST_PATH:
        return f"its mesh {_quoted(name)} has a file name of {max(longest, len(name.encode()))} bytes"
    words = mesh.get("scale", "1").split()
    return _fault(mesh, "scale", 1 if len(words) == 1 else 3, default="1")


def _color_fault(material: Any) -> str:
    color = material.find("color")
    if color is None:
        return ""
    fault = _fault(color, "rgba", 4, default="1 1 1 1", unit="")
    return f"{fault} in material {_quoted(material.get('name', ''))}" if fault else ""


def _fault(
    element: Any,
    key: str,
    count: int,
    *,
    default: str = "",
    positive: bool = False,
    largest: float = LARGEST,
    unit: str = "m",
) -> str:
    """What is wrong with an attribute that is to hold `count` numbers of at most `largest` in size."""
    text = element.get(key, default)
    numbers = [_number(word) for word in text.split()]
    low = 0.0 if positive else -math.inf
    if len(numbers) == count and all(math.isfinite(x) and abs(x) <= largest and x > low for x in numbers):
        return ""
    wanted = f"{count} finite numbers" if count > 1 else "a finite number"
    above = " above 0" if positive else ""
    most = f" of at most {largest:g} {unit}".rstrip() if math.isfinite(largest) else ""
    return f"its <{element.tag} {key}={_quoted(text)}> is not {wanted}{above}{most}"


def _number(word: str) -> float:
    try:
        return float(word) if word.isascii() and "_" not in word else math.nan
    except ValueError:
        return math.nan


def _quoted(text: Any) -> str:
    safe = "".join(character if character.isprintable() else "�" for character in str(text))
    return f"'{safe if len(safe) <= 60 else safe[:57] + '...'}'"
