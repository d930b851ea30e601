"""`nbs-pin robots`: the arms known by name, or what is known of one arm."""

import math
from typing import NamedTuple

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from nbs_pin.base.units import TURNING, column, counted, units
from nbs_pin.cli.robots import Robots
from nbs_pin.commands.results import next_step
from nbs_pin.robots.catalogue import ROBOT_NAMES
from nbs_pin.robots.robot import Robot, load_robot


class Arm(NamedTuple):
    """Figures of an arm."""

    name: str
    joints: int
    efforts: dict[str, tuple[float, float]]
    """Smallest and largest effort limit of its joints, inf without limits, by unit: N·m, and N of those that slide."""
    continuous: int
    """Number of continuous joints."""
    viscous_friction: bool
    coulomb_friction: bool


def run(options: Robots, console: Console, notes: Console) -> None:
    """Print the table of all arms, or those of one; raises NbsPinError if an arm cannot be loaded."""
    if options.robot is not None:
        _show(load_robot(options.robot, **options.arm.given()), console)
        return
    shown = Table(box=box.SIMPLE_HEAD)
    shown.add_column("name", no_wrap=True)
    for heading in ("joints", "effort [N·m]", "continuous", "friction"):
        shown.add_column(Text(heading), justify="right", no_wrap=True)
    with notes.status("loading every arm"):
        for arm in known_arms():
            shown.add_row(*_cells(arm))
    console.print(shown)
    console.print(
        "ROBOT may also be a path to a .urdf or MJCF .xml file, or .xacro with the extra nbs-pin[xacro]:\n"
        "with a fixed base and at most 64 moving joints, whose limits a .urdf states.",
        highlight=False,
        markup=False,
    )
    console.print(next_step("track", "panda"), highlight=False)


def _show(robot: Robot, console: Console) -> None:
    """Print the joints of an arm with limits, friction and rotor inertia, and the frames that a tool path can lead."""
    shown = Table(box=box.SIMPLE_HEAD, show_edge=False, padding=(0, 1, 0, 0))
    shown.add_column("joint", no_wrap=True)
    ends = [_range(joint.continuous, joint.lower, joint.upper) for joint in robot.joints]
    columns = {
        ("range", "position"): ends,
        ("speed", "velocity"): _texts(robot.velocity_limit),
        ("effort", "torque"): _texts(robot.effort_limit),
        ("viscous", "damping"): _texts(robot.damping),
        ("Coulomb", "torque"): _texts(robot.friction),
        ("rotor", "inertia"): _texts(robot.armature),
    }
    cells = []
    for (heading, quantity), texts in columns.items():
        head, told = column(heading, texts, units(quantity, robot.prismatic))
        shown.add_column(Text(head), justify="right", no_wrap=True)
        cells.append(told)
    for name, *row in zip(robot.joint_names, *cells, strict=True):
        shown.add_row(Text(name), *row)
    console.print(shown)
    mass = sum(body.mass for body in robot.model.inertias)
    mounted = ", ".join(f"{x:.4g}" for x in robot.gravity_vector)
    lines = (
        f"{robot.name}: {counted(robot.nv, 'joint that moves', 'joints that move')}, {mass:.4g} kg of moving parts, "
        f"gravity {mounted} m/s².",
        f"Frames (--frame): {', '.join(robot.frames)}.",
    )
    for line in lines:
        console.print(line, highlight=False, markup=False, soft_wrap=True)


def _range(is_continuous: bool, lower: float, upper: float) -> str:
    return "none" if is_continuous else f"{lower:.3g} to {upper:.3g}"


def _texts(values: np.ndarray) -> list[str]:
    return ["none" if math.isinf(value) else f"{value:.4g}" for value in values.tolist()]


def known_arms() -> list[Arm]:
    """The figures of every arm that `load_robot` knows by name."""
    return [describe(name, load_robot(name)) for name in ROBOT_NAMES]


def describe(name: str, robot: Robot) -> Arm:
    """The figures of one arm."""
    forces, limits = np.array(units("torque", robot.prismatic)), robot.effort_limit
    efforts = {str(unit): limits[forces == unit] for unit in dict.fromkeys(forces.tolist())}
    return Arm(
        name,
        robot.nv,
        {unit: (float(effort.min()), float(effort.max())) for unit, effort in efforts.items()},
        int(robot.continuous.sum()),
        bool(robot.damping.any()),
        bool(robot.friction.any()),
    )


def _span(least: float, most: float, unit: str) -> str:
    """Effort limits, with their unit unless it is that of the heading."""
    if math.isinf(least):
        return "none"
    span = f"{least:g} to {most:g}" if most > least else f"{least:g}"
    return span if unit == TURNING.torque else f"{span} {unit}"


def _cells(arm: Arm) -> tuple[str, ...]:
    """The cells of an arm's row."""
    effort = ", ".join(_span(*ends, unit) for unit, ends in arm.efforts.items())
    frictions = {"viscous": arm.viscous_friction, "Coulomb": arm.coulomb_friction}
    kinds = [kind for kind, present in frictions.items() if present]
    return arm.name, str(arm.joints), effort, str(arm.continuous), ", ".join(kinds) or "no"
