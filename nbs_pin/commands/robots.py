"""`nbs-pin robots`: the arms known by name."""

import math
from typing import NamedTuple

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from nbs_pin.cli.robots import Robots
from nbs_pin.robots.catalogue import ROBOT_NAMES
from nbs_pin.robots.robot import Robot, load_robot


class Arm(NamedTuple):
    """Figures of an arm."""

    name: str
    joints: int
    least_effort: float
    """Smallest effort limit of its joints [N·m], inf without limits."""
    most_effort: float
    """Largest effort limit of its joints [N·m], inf without limits."""
    continuous: int
    """Number of continuous joints."""
    viscous_friction: bool
    coulomb_friction: bool


def run(options: Robots, console: Console, notes: Console) -> None:
    """Print the table; raises NbsPinError if an arm cannot be loaded."""
    shown = Table(box=box.SIMPLE_HEAD)
    shown.add_column("name", no_wrap=True)
    for heading in ("joints", "effort [N·m]", "continuous", "friction"):
        shown.add_column(Text(heading), justify="right", no_wrap=True)
    with notes.status("loading every arm"):
        for arm in known_arms():
            shown.add_row(*_cells(arm))
    console.print(shown)
    console.print(
        "ROBOT may also be a path to a .urdf file, or .xacro with the extra nbs-pin[xacro]:\n"
        "with a fixed base and at most 64 moving joints, whose limits are stated.",
        highlight=False,
        markup=False,
    )


def known_arms() -> list[Arm]:
    """The figures of every arm that `load_robot` knows by name."""
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


def _cells(arm: Arm) -> tuple[str, ...]:
    """The cells of an arm's row."""
    span = f"{arm.least_effort:g}" + (f" to {arm.most_effort:g}" if arm.most_effort > arm.least_effort else "")
    effort = "none" if math.isinf(arm.least_effort) else span
    frictions = {"viscous": arm.viscous_friction, "Coulomb": arm.coulomb_friction}
    kinds = [kind for kind, present in frictions.items() if present]
    return arm.name, str(arm.joints), effort, str(arm.continuous), ", ".join(kinds) or "no"
