"""Limits of an arm less margins: what is left of them for a motion that has to keep a distance."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from nbs_pin.base.arguments import check_fields, checked, joints
from nbs_pin.base.checks import PerJoint
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.units import percent, units
from nbs_pin.robots.robot import ARM, Robot
from nbs_pin.robots.urdf import JointData


@dataclass(frozen=True, eq=False)
class Margins:
    """What a motion leaves of the limits of each joint: one number for all joints, or one per joint.

    Where the errors of a controller are bounded, a reference that leaves these bounds as margins keeps the arm within
    its own limits: |z1_i| of positions, the bound of |v − v_d| of velocities, that of the feedback torque of efforts.

    Example:
        >>> import nbs_pin as nbs
        >>> nbs.Margins(position=0.05, effort=[10.0, 5.0]).of(nbs.load_robot("two_link")).effort_limit
        array([90., 95.])
    """

    position: PerJoint = 0.0
    """Distance from position limits [rad, m]."""
    velocity: PerJoint = 0.0
    """Of the velocity limits [rad/s, m/s]."""
    effort: PerJoint = 0.0
    """Of the effort limits [N·m, N]."""

    def __post_init__(self) -> None:
        check_fields(self, **dict.fromkeys(("position", "velocity", "effort"), joints(least=0.0)))

    @checked(robot=ARM)
    def of(self, robot: Robot) -> Robot:
        """The arm with the limits that are left; its dynamics stay.

        Raises:
            ArgumentError: If nothing is left of a limit, or there is not one margin for each joint.
        """
        left = {}
        for name in ("position", "velocity", "effort"):
            margin = np.asarray(getattr(self, name), dtype=float)
            if margin.shape not in ((), (1,), (robot.nv,)):
                raise ArgumentError(
                    f"{margin.size} margins of {name} for the {robot.nv} joints of {robot.name}; give one, or one each."
                )
            left[name] = np.broadcast_to(margin, (robot.nv,))
        reduced = {
            joint.name: _less(joint, *(float(left[name][i]) for name in ("position", "velocity", "effort")))
            for i, joint in enumerate(robot.joints)
        }
        urdf = replace(robot.urdf, joints=tuple(reduced.get(joint.name, joint) for joint in robot.urdf.joints))
        # which also sets the limits of the model to those of the description
        return replace(robot, urdf=urdf).with_effort_limit([reduced[name].effort for name in robot.joint_names])


def _less(joint: JointData, position: float, velocity: float, effort: float) -> JointData:
    """The joint with its limits less the margins; raises ArgumentError if nothing is left of one."""
    sizes = {
        "position": (0.5 * (joint.upper - joint.lower), position),
        "velocity": (joint.velocity, velocity),
        "torque": (joint.effort, effort),
    }
    for what, (limit, margin) in sizes.items():
        if not margin < limit:
            (unit,) = units(what, [joint.prismatic])
            name = {"position": "half of the range", "velocity": "the velocity limit", "torque": "the effort limit"}
            raise ArgumentError(
                f"the margin {margin:.4g} {unit} takes {percent(margin / limit)} of {name[what]} of joint "
                f"'{joint.name}', {limit:.4g} {unit}; give a smaller one."
            )
    changed: dict[str, Any] = {
        "lower": joint.lower + position,
        "upper": joint.upper - position,
        "velocity": joint.velocity - velocity,
        "effort": joint.effort - effort,
    }
    return replace(joint, **changed)
