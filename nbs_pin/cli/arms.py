"""What the arms known by name are, in a few figures."""

from typing import NamedTuple

from nbs_pin.robots.catalogue import ROBOT_NAMES
from nbs_pin.robots.robot import Robot, load_robot


class Arm(NamedTuple):
    """An arm in figures."""

    name: str
    joints: int
    least_effort: float
    """Smallest effort limit of its joints [N·m], inf for none."""
    most_effort: float
    """Largest effort limit of its joints [N·m], inf for none."""
    continuous: int
    """How many joints turn without end."""
    viscous_friction: bool
    coulomb_friction: bool


def known_arms() -> list[Arm]:
    """Every arm that `load_robot` knows by name, loaded and measured."""
    return [describe(name, load_robot(name)) for name in ROBOT_NAMES]


def describe(name: str, robot: Robot) -> Arm:
    """The figures of one arm."""
    effort = robot.effort_limit
    return Arm(
        name,
        robot.nv,
        float(effort.min()),
        float(effort.max()),
        int(robot.continuous.sum()),
        bool(robot.damping.any()),
        bool(robot.friction.any()),
    )
