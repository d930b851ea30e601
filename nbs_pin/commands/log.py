"""`nbs-pin log`: what a log of an arm is, and what is wrong with it."""

import math
import warnings
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from nbs_pin.base.doors import BLANK, option
from nbs_pin.base.shown import joints_told
from nbs_pin.base.units import column, counted, units
from nbs_pin.cli.log import Log
from nbs_pin.cli.values import OptionError
from nbs_pin.commands.results import next_step, table, tell
from nbs_pin.identification.datasets import Dataset, trajectory_slices
from nbs_pin.identification.log_doubts import LogDoubts, log_doubts
from nbs_pin.identification.logs import load_log
from nbs_pin.robots.robot import Robot, load_robot


def run(options: Log, console: Console, notes: Console) -> None:
    """Read, print and perhaps write; raises NbsPinError or OSError."""
    if not options.data:
        raise OptionError("no FILE; give the path of a log.")
    if options.out is not None and (options.out.suffix != ".npz" or (options.out.exists() and not options.force)):
        fault = "exists; give --force to replace it" if options.out.suffix == ".npz" else "is no .npz file; call it so"
        raise OptionError(f"--out '{options.out}' {fault}.")
    with notes.status(f"loading {options.data[0]}"):
        if options.robot is None:
            options.arm.refuse_without_arm("give the arm with --robot")
        robot = None if options.robot is None else load_robot(options.robot, **options.arm.given())
        with warnings.catch_warnings(record=True) as said:  # printed below, in order
            warnings.simplefilter("always")
            data = load_log(options.data[0] if len(options.data) == 1 else options.data, robot=robot, **options.read())
        found = None if robot is None or not robot.has_bodies else log_doubts(data, robot)
    prefix = f"{options.data[0]}: "
    lines = [str(warning.message).removeprefix(prefix) for warning in said]
    if found is not None:  # of a saved dataset nothing was said
        lines += [f"{doubt}." for doubt in found.doubts if f"{doubt}." not in lines]
    tell(console, _verdict(options, data, found), [*_facts(data, found), *lines], [_joints(data, robot, found)],
         verbose=options.verbose)  # fmt: skip
    if options.out is not None:
        data.save(options.out)
        console.print(str(options.out), soft_wrap=True, highlight=False, markup=False)
    learnt: list[str | Path] = [
        options.out or options.data[0],
        *([] if options.robot is None else ["--robot", options.robot]),
    ]
    console.print(next_step("learn", *learnt), soft_wrap=True, highlight=False, markup=False)


def _verdict(options: Log, data: Dataset, found: LogDoubts | None) -> str:
    name = options.data[0].name if len(options.data) == 1 else f"{len(options.data)} logs"
    doubts = 0 if found is None else len(found.doubts)
    judged = "" if found is None else "; no doubts" if not doubts else f"; {counted(doubts, 'doubt')}"
    many = counted(data.trajectories, "trajectory", "trajectories")
    return f"{name}: {_seconds(data):.4g} s of motion of {joints_told(data.nv)} in {many}{judged}"


def _facts(data: Dataset, found: LogDoubts | None) -> list[str]:
    read = data.about.get("read")
    facts = []
    if isinstance(read, dict):
        least, usual, most = read["steps_s"]
        facts.append(f"{read['rows']} rows, usually {1.0 / usual:.4g} Hz, {least:.3g} to {most:.3g} s apart")
    if found is None:
        facts.append(f"units, signs and delays are questioned with {option('robot', BLANK)}")
    derived = " and ".join(data.about.get("differentiated", ()))
    facts.append(f"{len(data)} rows to learn from" + (f"; {derived} differentiated" if derived else ""))
    if found is not None and math.isfinite(found.delay):
        given = float((data.about.get("asked") or {}).get("delay") or 0.0)
        remedy = option("delay", round(found.delay + given, 3))
        late = f"torques late by {1e3 * found.delay:.0f} ms, which {remedy} undoes"
        facts.append(late if found.delay else "no delay of the torques is seen")
    return facts


def _joints(data: Dataset, robot: Robot | None, found: LogDoubts | None) -> Table:
    names = [f"joint {i + 1}" for i in range(data.nv)] if robot is None else list(robot.joint_names)
    columns = [
        column("position", [f"{x.min():.3g}…{x.max():.3g}" for x in data.q.T], units("position", data.prismatic)),
        column("speed", [f"{np.abs(x).max():.3g}" for x in data.v.T], units("velocity", data.prismatic)),
        column("torque", [f"{x.min():.3g}…{x.max():.3g}" for x in data.tau.T], units("torque", data.prismatic)),
    ]
    if found is not None:
        columns += [
            ("times\nURDF's", [f"{x:.3g}" if a > 0.8 else "" for x, a in zip(found.slope, found.alike, strict=True)]),
            column("constant", [f"{x:.2g}" for x in found.constant], units("torque", data.prismatic)),
        ]
    shown = table("joints", *(heading for heading, _ in columns))
    for name, *cells in zip(names, *(cells for _, cells in columns), strict=True):
        shown.add_row(Text(name), *cells)
    return shown


def _seconds(data: Dataset) -> float:
    return sum(float(data.t[rows.stop - 1] - data.t[rows.start]) for rows in trajectory_slices(data.trajectory))
