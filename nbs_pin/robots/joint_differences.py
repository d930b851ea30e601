"""Whether two descriptions are of one arm: the same joints at the same places, whatever its links weigh."""

import numpy as np
import pinocchio as pin

from nbs_pin.robots.robot import Robot

_NEAR, _TURNED = 0.02, 0.1
"""Joints of two models of one arm are at most this far apart [m] and turned [rad]: calibration stays below."""


def difference_of_joints(one: Robot, other: Robot, whose: str) -> str:
    """How the joints of one arm differ from those of the other, which the text calls `whose`; empty if they do not.

    Both arms have the same number of joints.
    """
    if one.joint_names != other.joint_names:
        return f"its joints are {', '.join(one.joint_names)}, those of {whose} {', '.join(other.joint_names)}"
    for i in range(1, other.nv + 1):
        if not _alike(one.model, other.model, i):
            return f"joint '{other.joint_names[i - 1]}' is of another kind, or lies elsewhere on its link"
    return ""


def _alike(one: pin.Model, other: pin.Model, joint: int) -> bool:
    """Whether the joint is at the same place on the same link, about or along the same axis.

    Of joints on the base only kind and axis are compared: how an arm is mounted is not part of it.
    """
    axes = [np.asarray(model.createData().joints[joint].S).ravel() for model in (one, other)]
    if one.parents[joint] != other.parents[joint]:
        return False
    if one.parents[joint] == 0:
        return bool(np.abs(axes[0] - axes[1]).max() <= _TURNED)
    apart = one.jointPlacements[joint].actInv(other.jointPlacements[joint])
    turned = np.abs(axes[0] - apart.action @ axes[1]).max() > _TURNED
    return bool(np.linalg.norm(apart.translation) <= _NEAR and not turned)
