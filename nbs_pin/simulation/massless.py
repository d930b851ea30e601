"""Joints behind links without mass, as MuJoCo takes them: several joints of one body."""

from typing import Any

import mujoco
import numpy as np

_COPIED = (
    "type", "range", "limited", "armature", "damping", "frictionloss", "actfrcrange", "actfrclimited",
    "solref_friction", "solimp_friction", "solref_limit",
)  # fmt: skip


def gather_joints(spec: Any) -> None:
    """Move the joint behind a moving body without mass to that body, in a spec of bodies with resolved poses.

    MuJoCo refuses such a body, but lets one body have several joints: with the pose X of the body behind,
    J₁(q₁) X J₂(q₂) = J₁(q₁) (X J₂(q₂) X⁻¹) X, where X J₂ X⁻¹ is the same joint about the axis and through the anchor
    that X moves. A body without mass that has several joints behind it is left, and MuJoCo refuses it.
    """
    for body in spec.bodies:
        while body.joints and not _has_mass(body):
            behind = _joints_behind(body, np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
            if len(behind) != 1:
                break
            joint, position, turn = behind[0]
            _copy(joint, body, position, turn)
            spec.delete(joint)


def _has_mass(body: Any) -> bool:
    """Whether a body or one that is fixed to it has mass."""
    return body.mass > 0.0 or any(_has_mass(child) for child in body.bodies if not child.joints)


def _joints_behind(body: Any, position: np.ndarray, turn: np.ndarray) -> list[tuple[Any, np.ndarray, np.ndarray]]:
    """The next joints behind a body whose pose is given, with the poses of their own bodies."""
    found: list[tuple[Any, np.ndarray, np.ndarray]] = []
    for child in body.bodies:
        there, turned = np.zeros(3), np.zeros(4)
        mujoco.mju_rotVecQuat(there, child.pos, turn)
        mujoco.mju_mulQuat(turned, turn, child.quat)
        there += position
        found += [(joint, there, turned) for joint in child.joints] or _joints_behind(child, there, turned)
    return found


def _copy(joint: Any, body: Any, position: np.ndarray, turn: np.ndarray) -> None:
    """Give a body the joint of another one, which has this pose in its frame."""
    anchor, axis, name = np.zeros(3), np.zeros(3), joint.name
    mujoco.mju_rotVecQuat(anchor, joint.pos, turn)
    mujoco.mju_rotVecQuat(axis, joint.axis, turn)
    joint.name = ""
    copy = body.add_joint(name=name, pos=anchor + position, axis=axis)
    for key in _COPIED:
        setattr(copy, key, getattr(joint, key))
