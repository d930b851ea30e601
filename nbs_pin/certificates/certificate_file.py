"""Certificates as files for an independent checker, with every number behind the bounds (docs/certificates.md §11).

`verification/` reads them and shares no code with this module; its `certificate.schema.json` states keys and types.
"""

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np

from nbs_pin.base.arguments import checked, writable
from nbs_pin.base.claims import Claim, Group
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.files import write_whole
from nbs_pin.base.plain import plain
from nbs_pin.base.rounding import down
from nbs_pin.base.versions import versions
from nbs_pin.certificates.certificate import CERTIFICATE, Certificate
from nbs_pin.certificates.comparison_system import polygon, reach
from nbs_pin.certificates.constants import rigid_arm
from nbs_pin.certificates.error_bounds import radians
from nbs_pin.certificates.held_torque import HeldTorque
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.dynamics.rigid_tree import RigidTree
from nbs_pin.robots.robot import Robot

FORMAT = "nbs_pin certificate 1"
"""Format name; another one for every change of meaning."""
_FORMS = (("D0", "largest"), ("D0", "least"), ("I", "largest"), ("I", "least"))
"""Weight and side of the four bounds of the inertia."""
_CHANGING = ("armature", "rotor_inertia", "payload", "tool", "base_rpy", "base_xyz", "repair", "inertia_from")
"""Arguments of `load_robot` after which the arm is another than its file states."""
_PREMISES = (Group.LOADS, Group.FRICTION, Group.MODEL_ERROR, Group.STRUCTURE)


@checked(certificate=CERTIFICATE, path=writable)
def write_certificate(certificate: Certificate, path: str | Path) -> Path:
    """Write a certificate with all constants, multipliers, edges and conditions to a JSON file, for `verify`.

    Args:
        certificate: The certificate, of a law that has not been changed since.
        path: The file, replaced atomically; missing folders are created.

    Example:
        >>> import tempfile
        >>> import nbs_pin as nbs
        >>> bound = nbs.certify(nbs.NeuralBackstepping.for_robot(nbs.load_robot("two_link")), [5.0, 5.0])
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     found = nbs.verify(nbs.write_certificate(bound, f"{folder}/certificate.json"))
        >>> found.confirmed
        True
    """
    document = certificate_document(certificate)
    text = json.dumps(document | {"sha256": seal(document)}, indent=1, allow_nan=False, ensure_ascii=False)
    return write_whole(path, (text + "\n").encode())


def seal(document: dict[str, Any]) -> str:
    """SHA-256 of everything but `sha256`; it shows edits and damage and does not authenticate an author."""
    content = {key: value for key, value in document.items() if key != "sha256"}
    return hashlib.sha256(json.dumps(content, sort_keys=True, ensure_ascii=True).encode()).hexdigest()


def certificate_document(certificate: Certificate) -> dict[str, Any]:
    """The content of the file without its SHA-256: JSON values, floats that round-trip, None for infinity."""
    k, friction, constants = certificate.comparison, certificate.friction, certificate.constants
    if certificate.bodies is not None:
        raise ArgumentError("a certificate for uncertain bodies has no file format; give one without `uncertainty`.")
    if friction.gap.is_shared:
        raise ArgumentError("friction known to a share has no file format; give a certificate without `uncertainty`.")
    # Held torques have bounds of their own; those of continuous time stand beside them.
    held = certificate.held if certificate.held is not None and certificate.held.is_proved else None
    potential = certificate.potential if held is None else reach(k, certificate.storage)
    size, joints = radians(certificate.stiffness, potential)
    closer = certificate.error < size
    start, overshoot, none = certificate.start, certificate.overshoot, np.zeros(certificate.controller.nv)
    fed = certificate.controller.friction or JointFriction(none, none)
    cut = polygon(k, certificate.storage)
    document = {
        "format": FORMAT,
        "versions": versions(),
        "label": str(certificate.label),
        "arm": _arm(certificate),
        "law": {
            "kind": type(certificate.controller).__name__,
            "stiffness": constants.stiffness,
            "rate": constants.rate,
            "floor": constants.floor,
            "omega": constants.omega,
            "coupling": constants.coupling,
        },
        "disturbance": {"box": certificate.admissible.box, "radius": certificate.admissible.radius},
        "friction": {
            "viscous": friction.gap.arm.viscous,
            "coulomb": friction.gap.arm.coulomb,
            "fed_viscous": fed.viscous,
            "fed_coulomb": fed.coulomb,
            "transition": friction.gap.width,
            "speed": friction.speed,
        },
        "model_error": {
            "t": certificate.model_error.t,
            "alpha": certificate.model_error.alpha,
            "beta": certificate.model_error.beta,
        },
        "constants": {key: getattr(k, key) for key in ("rho", "delta", "kappa", "nu", "t", "alpha", "beta", "power")},
        "inertia": _inertia(certificate),
        "level": {"c": certificate.level.c, "storage": certificate.storage, "rate": down(certificate.rate)},
        "polygon": None if cut is None else cut._asdict(),
        "bounds": {"potential": potential, "error": size, "joint_errors": joints},
        "linear": {"error": certificate.error, "joint_errors": certificate.joint_errors} if closer else None,
        "held": None if held is None else _held(certificate, held),
        "start": None,
        "conditions": [condition.plain() for condition in certificate.conditions],
        "claims": [line.plain() for line in certificate.lines if line.group in _PREMISES],
        "assumptions": [{"assumption": text, "checked": checked} for text, checked in certificate.assumptions],
    }
    if start is not None and overshoot is not None:
        reached = radians(certificate.stiffness, max(start.storage, potential))
        document["start"] = {"storage": start.storage, "error": reached[0], "joint_errors": reached[1]}
    plained: dict[str, Any] = plain(document)
    return plained


def _held(certificate: Certificate, held: HeldTorque) -> dict[str, Any]:
    return {
        "period": held.readings.period,
        "lookahead": held.readings.lookahead,
        "delay": held.readings.delay,
        "encoder_steps": held.readings.steps,
        "level": held.level,
        "error": certificate.error,
        "joint_errors": certificate.joint_errors,
    }


def _arm(certificate: Certificate) -> dict[str, Any] | None:
    """The tree that the bounds of the inertia are about; None for a model that is no rigid tree."""
    model, robot = certificate.controller.dynamics, certificate.robot
    arm = rigid_arm(model)
    if arm is None:
        return None
    tree, names = RigidTree.of(arm), certificate.joint_names
    exact = type(model) is PinocchioDynamics and certificate.mismatch is None
    described = robot if isinstance(arm, Robot) and exact else None
    continuous = np.zeros(tree.nv, dtype=bool) if robot is None else robot.continuous
    return {
        "name": "a model without an arm" if robot is None else robot.name,
        "sha256": None if robot is None else robot.sha256,
        "urdf": None if described is None or not is_in_its_file(described) else str(described.urdf.path.absolute()),
        "joints": [_joint(tree, i, names[i], bool(continuous[i])) for i in range(tree.nv)],
    }


def is_in_its_file(robot: Robot) -> bool:
    """Whether a URDF file states the tree of the arm: nothing was attached to it, locked off zero or replaced in it."""
    options, source = robot.options, robot.urdf.path
    changed = any(options.get(name) for name in _CHANGING)
    moved = isinstance(options.get("lock"), dict)  # a list locks at zero
    return source.suffix == ".urdf" and not robot.source.endswith(".toml") and not changed and not moved


def _joint(tree: RigidTree, i: int, name: str, continuous: bool) -> dict[str, Any]:
    slides = bool(tree.prismatic[i])
    return {
        "name": name,
        "parent": tree.parents[i],
        "prismatic": slides,
        "continuous": continuous,
        "rotation": tree.rotation[i],
        "position": tree.position[i],
        "mass": tree.mass[i],
        "centre": tree.centre[i],
        "inertia": tree.inertia[i],
        "armature": tree.armature[i],
        "lower": tree.lower[i] if slides else None,
        "upper": tree.upper[i] if slides else None,
    }


def _inertia(certificate: Certificate) -> list[dict[str, Any]]:
    """The four bounds of the inertia with the multipliers that prove them, None where another method was used."""
    a2, a1, largest, least = (line for line in certificate.constants.lines if line.group is Group.INERTIA)
    return [_bound(*form, line) for form, line in zip(_FORMS, (largest, least, a2, a1), strict=True)]


def _bound(weight: str, side: str, claim: Claim) -> dict[str, Any]:
    return {
        "weight": weight,
        "side": side,
        "value": claim.value,
        "label": str(claim.label),
        "because": claim.because,
        "multipliers": claim.evidence,
    }
