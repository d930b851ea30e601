"""Checks that data belong to a given arm, or to the same arm as other data."""

from typing import NamedTuple

import numpy as np

from nbs_pin.identification.datasets import Dataset
from nbs_pin.robots.robot import Robot


def arm_fault(data: Dataset, robot: Robot) -> str:
    """Why the data cannot belong to this arm, for an error message, or an empty string.

    The joint trees must be equal. Masses and lengths need not be if the arm is from a file or has the data's own name:
    the nominal arm of "residual" and "identified" is inaccurate by design. Two catalogue arms of different names and
    fingerprints (`Robot.sha256`, which ignores effort limits) do not match. Data that name no arm are judged by their
    joint tree.
    """
    parents, prismatic = robot.parents, robot.prismatic
    if robot.nv != data.nv:
        return f"the data have {data.nv} joints and {robot.name} {robot.nv}; give the arm they were recorded on"
    if not (np.array_equal(data.parents, parents) and np.array_equal(data.prismatic, prismatic)):
        return (
            f"the joints of the data are {_joints(data.parents, data.prismatic)} and those of {robot.name} "
            f"{_joints(parents, prismatic)}; give the arm they were recorded on, also when the log is read"
        )
    said, given = _Arm.of_data(data), _Arm(robot.name, robot.source, robot.sha256)
    if said.in_catalogue and given.in_catalogue and said.differs(given):
        return f"the data are of {said.name}, not of {robot.name}; give the arm they were recorded on"
    return ""


def other_data_fault(data: Dataset, other: Dataset, name: str) -> str:
    """Why `other`, called `name` in the message, does not belong to the arm of `data`, or an empty string.

    The joint trees must be equal; if both name their arm, the name or the fingerprint must be equal too.
    """
    if other.nv != data.nv:
        return f"{name} has {other.nv} joints and the data {data.nv}; give data of one arm"
    if not (np.array_equal(data.parents, other.parents) and np.array_equal(data.prismatic, other.prismatic)):
        joints = (_joints(x.parents, x.prismatic) for x in (other, data))
        return "the joints of {} are {} and those of the data {}; give data of one arm".format(name, *joints)
    first, second = _Arm.of_data(data), _Arm.of_data(other)
    if first.differs(second):
        return f"{name} is of {second.name} and the data of {first.name}; give data of one arm"
    return ""


class _Arm(NamedTuple):
    """What is known of an arm; unknown entries are empty."""

    name: str
    source: str
    sha256: str

    @classmethod
    def of_data(cls, data: Dataset) -> "_Arm":
        said = data.about.get("robot")
        known = said if isinstance(said, dict) else {}
        return cls(data.robot, str(known.get("source", "")), str(known.get("sha256", "")))

    @property
    def in_catalogue(self) -> bool:
        """Whether the arm is from the catalogue; the source of an arm from a file is its path."""
        return self.source == self.name

    def differs(self, other: "_Arm") -> bool:
        """Whether names and fingerprints are known and both differ."""
        known = self.name and other.name and self.sha256 and other.sha256
        return bool(known) and self.name != other.name and self.sha256 != other.sha256


def _joints(parents: np.ndarray, prismatic: np.ndarray) -> str:
    """A joint tree in words: the kind and the parent of each joint."""
    kinds = ("prismatic" if slides else "revolute" for slides in prismatic)
    return ", ".join(
        f"{kind} on {f'joint {parent}' if parent else 'the base'}" for kind, parent in zip(kinds, parents, strict=True)
    )
