"""Whether data are of the arm that they are used for, or of the one that other data are of."""

from typing import NamedTuple

import numpy as np

from nbs_pin.identification.datasets import Dataset
from nbs_pin.robots.robot import Robot


def arm_fault(data: Dataset, robot: Robot) -> str:
    """Why the data cannot be of this arm, for a refusal, or an empty string.

    Their trees of joints must be the same. Their descriptions need not: the nominal arm of "residual" and "identified"
    is wrong by design, so a description from a file may differ in masses and lengths, and so may an arm of the data's
    own name. Two arms of the catalogue by different names, with different fingerprints (`Robot.sha256`, in which other
    effort limits do not count), are a mistake. Data that name no arm are judged by their tree.
    """
    parents, prismatic = robot.parents, robot.prismatic
    if robot.nv != data.nv:
        return f"the data have {data.nv} joints and {robot.name} {robot.nv}; give the arm they are of"
    if not (np.array_equal(data.parents, parents) and np.array_equal(data.prismatic, prismatic)):
        return (
            f"the joints of the data are {_joints(data.parents, data.prismatic)} and those of {robot.name} "
            f"{_joints(parents, prismatic)}; give the arm they are of, also to load_log"
        )
    said, given = _Arm.of_data(data), _Arm(robot.name, robot.source, robot.sha256)
    if said.in_catalogue and given.in_catalogue and said.differs(given):
        return f"the data are of {said.name}, not of {robot.name}; give the arm they are of"
    return ""


def other_data_fault(data: Dataset, other: Dataset, name: str) -> str:
    """Why the other data, called by that name, are not of the arm of these, or an empty string.

    Trees of joints must be the same; where both say of which arm they are, its name or its fingerprint must be too.
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
    """What is known of an arm; texts are empty where nothing is."""

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
        """An arm of a file has the path as its source."""
        return self.source == self.name

    def differs(self, other: "_Arm") -> bool:
        """By name and by fingerprint, all of which are known."""
        known = self.name and other.name and self.sha256 and other.sha256
        return bool(known) and self.name != other.name and self.sha256 != other.sha256


def _joints(parents: np.ndarray, prismatic: np.ndarray) -> str:
    """A tree of joints in words: what each is and what it hangs on."""
    kinds = ("sliding" if slides else "turning" for slides in prismatic)
    return ", ".join(
        f"{kind} on {f'joint {parent}' if parent else 'the base'}" for kind, parent in zip(kinds, parents, strict=True)
    )
