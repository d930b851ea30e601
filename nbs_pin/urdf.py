"""A URDF file read once, checked, and brought to the form that every engine is given."""

import math
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class JointData:
    """One moving joint as the URDF states it; SI units, inf where the file states no limit."""

    name: str
    continuous: bool
    prismatic: bool
    lower: float
    upper: float
    effort: float
    velocity: float
    damping: float
    friction: float


@dataclass(frozen=True)
class Urdf:
    """A checked description: `xml` has locked joints fixed and continuous joints as unbounded revolute ones."""

    name: str
    path: Path
    xml: bytes
    joints: tuple[JointData, ...]


def read_urdf(path: Path, *, lock: tuple[str, ...] = (), zero_limits: str = "refuse") -> Urdf:
    """The checked description in the file `path`, with the joints in `lock` fixed at zero."""
    root = ET.fromstring(path.read_bytes())
    joints = []
    for element in root.findall("joint"):
        kind = element.get("type")
        if element.get("name") in set(lock):
            element.set("type", "fixed")
            for tag in ("mimic", "limit", "dynamics"):
                for child in element.findall(tag):
                    element.remove(child)
        if element.get("type") == "fixed":
            continue
        limit = element.find("limit")
        dynamics = element.find("dynamics")
        limits = {} if limit is None else limit.attrib
        stated = {key: float(limits.get(key, 0)) or math.inf for key in ("effort", "velocity")}
        continuous = kind == "continuous"
        if continuous:
            element.set("type", "revolute")
            limit = ET.SubElement(element, "limit") if limit is None else limit
            for key, value in {"lower": -1e9, "upper": 1e9, "effort": 1e9, "velocity": 1e9}.items():
                limit.set(key, limit.get(key, str(value)))
        joints.append(
            JointData(
                name=element.get("name", ""),
                continuous=continuous,
                prismatic=kind == "prismatic",
                lower=-math.inf if continuous else float(limits["lower"]),
                upper=math.inf if continuous else float(limits["upper"]),
                effort=stated["effort"],
                velocity=stated["velocity"],
                damping=0.0 if dynamics is None else float(dynamics.get("damping", 0)),
                friction=0.0 if dynamics is None else float(dynamics.get("friction", 0)),
            )
        )
    return Urdf(root.get("name", path.stem), path, ET.tostring(root), tuple(joints))
