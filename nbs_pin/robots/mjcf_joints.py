"""What an MJCF description says of each joint: range, friction, rotor inertia, and the effort of its actuators."""

import math
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

_AT_JOINT = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
_SCALAR = (int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_HINGE))
_PLAIN = tuple(map(int, (mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_NONE, mujoco.mjtDyn.mjDYN_NONE)))
"""Gain, bias and dynamics of a motor."""
_OFF = mujoco.mjtDisableBit


@dataclass(frozen=True)
class JointTerms:
    """One joint of a description, in SI units; zeros and None for one that is neither hinge nor slide."""

    name: str
    scalar: bool
    """Whether it has one coordinate."""
    range: tuple[float, float] | None
    """Position limits [rad, m], None where there are none."""
    effort: float | None
    """Largest |τ| [N·m, N], None where the description limits none."""
    damping: float
    """[N·m·s/rad]"""
    friction: float
    """[N·m]"""
    armature: float
    """Rotor inertia at the joint [kg·m²]: its own, and that of its actuators times the square of their gears."""
    follows: tuple[str, float, float] | None = None
    """The joint that it follows, with multiplier and offset."""


def is_off(model: Any, *names: str) -> bool:
    """Whether the description switches off one of these parts of the dynamics."""
    return any(int(model.opt.disableflags) & int(getattr(_OFF, f"mjDSBL_{name}")) for name in names)


def actuators_of(model: Any, joint: int) -> list[int]:
    """The actuators that act at a joint."""
    acting = np.isin(model.actuator_trntype, _AT_JOINT) & (model.actuator_trnid[:, 0] == joint)
    return [int(k) for k in np.flatnonzero(acting)]


def read_joint(model: Any, joint: int, name: str, follows: tuple[str, float, float] | None) -> JointTerms:
    """The terms of one joint of a compiled model."""
    if model.jnt_type[joint] not in _SCALAR:
        return JointTerms(name, False, None, None, 0.0, 0.0, 0.0)
    dof, acting = int(model.jnt_dofadr[joint]), actuators_of(model, joint)
    lower, upper = model.jnt_range[joint].tolist()
    squares = model.actuator_gear[acting, 0] ** 2
    armature = model.dof_armature[dof] + squares @ model.actuator_armature[acting]
    damping = 0.0 if is_off(model, "DAMPER") else model.dof_damping[dof] + squares @ model.actuator_damping[acting]
    friction = 0.0 if is_off(model, "FRICTIONLOSS", "CONSTRAINT") else model.dof_frictionloss[dof]
    limits = (lower, upper) if model.jnt_limited[joint] else None
    effort = _effort(model, joint, acting)
    return JointTerms(name, True, limits, effort, float(damping), float(friction), float(armature), follows)


def _effort(model: Any, joint: int, acting: list[int]) -> float | None:
    """The largest torque of both signs that the actuators of a joint can give, and that it takes."""
    total = math.inf
    if acting:
        total = sum(abs(float(model.actuator_gear[k, 0])) * _force(model, k) for k in acting)
    if model.jnt_actfrclimited[joint]:
        total = min(total, _both_signs(model.jnt_actfrcrange[joint]))
    return None if math.isinf(total) else float(total)


def _force(model: Any, k: int) -> float:
    """The largest force of both signs that an actuator can give before its gear."""
    force = _both_signs(model.actuator_forcerange[k]) if model.actuator_forcelimited[k] else math.inf
    kinds = (model.actuator_gaintype[k], model.actuator_biastype[k], model.actuator_dyntype[k])
    control, is_motor = int(model.actuator_ctrladr[k]), tuple(map(int, kinds)) == _PLAIN
    if is_motor and model.actuator_ctrllimited[control] and not is_off(model, "CLAMPCTRL"):
        gain = float(model.actuator_gainprm[k, 0])
        force = min(force, _both_signs(np.sort(gain * model.actuator_ctrlrange[control])))
    return force


def _both_signs(ends: np.ndarray) -> float:
    """The largest x with −x and x between the ends; negative or zero where there is none."""
    return min(-float(ends[0]), float(ends[1]))
