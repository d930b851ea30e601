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


def run(options: Robots, console: Console, notes: Console) -> None:
    """Prints the table; raises NbsPinError when an arm cannot be loaded."""
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
        "one fixed base, at most 64 moving joints, their limits stated.",
        highlight=False,
        markup=False,
    )


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


def _cells(arm: Arm) -> tuple[str, ...]:
    """The columns of an arm."""
    span = f"{arm.least_effort:g}" + (f" to {arm.most_effort:g}" if arm.most_effort > arm.least_effort else "")
    effort = "none" if math.isinf(arm.least_effort) else span
    frictions = {"viscous": arm.viscous_friction, "Coulomb": arm.coulomb_friction}
    kinds = [kind for kind, present in frictions.items() if present]
    return arm.name, str(arm.joints), effort, str(arm.continuous), ", ".join(kinds) or "no"
