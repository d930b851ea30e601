"""`nbs-pin excite`: a motion along which the parameters of an arm are identified well."""

from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.text import Text

from nbs_pin.base.summaries import SUMMARY
from nbs_pin.base.units import by_quantity, column, percent, units_of
from nbs_pin.cli.excite import Excite
from nbs_pin.commands.results import Results, drawing, keywords, table, tell
from nbs_pin.identification.excitation import torque_limits
from nbs_pin.identification.excitation_problem import demand
from nbs_pin.identification.exciting_motion import ExcitingMotion, exciting_motion
from nbs_pin.reports.captions import chosen
from nbs_pin.reports.plotting import ACTUAL, LIMIT, TORQUE, Heading, picture
from nbs_pin.reports.verdicts import verdict_of
from nbs_pin.robots.robot import Robot, load_robot

FILES = ("motion.csv", "excitation.png", SUMMARY)
"""The files that are written."""
_ROWS = 2001
"""Instants of the figures and curves."""
_VELOCITY = "#7b3fa0"


def run(options: Excite, console: Console, notes: Console) -> None:
    """Find, write and print; raises NbsPinError, OSError, and KeyboardInterrupt after an early end."""
    with notes.status(f"loading {options.robot}"):
        robot = load_robot(options.robot, **options.arm.given())
    results = Results.of(options, robot.name, robot, robot=robot.source)
    results = results.check(FILES, options.force, whole={"interrupted": False}, whose="another motion")
    given = keywords(options, exciting_motion) | {
        "clearance": None if options.no_clearance else options.clearance,
        "friction": not options.no_friction,
        "offset": not options.no_offset,
        "rotor_inertia": not options.no_rotor_inertia,
    }
    with results.made() as folder:
        motion = exciting_motion(robot, **given, progress=True)
        with notes.status(f"writing into {folder}"):
            found = figures(motion, robot)
            with results.replaced(FILES, found, interrupted=motion.interrupted) as draft:
                motion.save(draft / FILES[0], period=options.period)
            verdict = verdict_of(found, interrupted=motion.interrupted)
            with drawing(folder / FILES[1]) as path:
                settings = chosen(results.facts["settings"], "duration", "band", "share", "starts", "seed")
                plot_excitation(motion, path, robot, Heading(f"{robot.name}: exciting motion", settings, verdict))
    _print(console, robot.name, found, motion.interrupted, verbose=options.verbose)
    results.show(console, FILES, "track", options.robot, *options.arm.typed(), "--reference", results.folder / FILES[0])
    if motion.interrupted:
        raise KeyboardInterrupt


def figures(motion: ExcitingMotion, robot: Robot) -> dict[str, Any]:
    """What the motion is and takes of the arm, as JSON can store it; m and N for prismatic joints."""
    moved, effort = motion(np.linspace(0.0, motion.duration, _ROWS)), torque_limits(robot)
    lower, upper = robot.one_turn_range
    velocity, acceleration, torque = (np.abs(x).max(axis=0) for x in (moved.v, moved.a, demand(robot, moved)))
    return {
        "condition_number": motion.condition if np.isfinite(motion.condition) else None,
        "unknowns": motion.unknowns,
        "duration_s": motion.duration,
        "band_hz": motion.band,
        "joints": list(robot.joint_names),
        "units": by_quantity(robot.prismatic),
        "used_range_fraction": (np.ptp(moved.q, axis=0) / (upper - lower)).tolist(),
        "q_least_rad": moved.q.min(axis=0).tolist(),
        "q_most_rad": moved.q.max(axis=0).tolist(),
        "peak_velocity_rad_per_s": velocity.tolist(),
        "peak_velocity_fraction": (velocity / robot.velocity_limit).tolist(),
        "peak_acceleration_rad_per_s2": acceleration.tolist(),
        "peak_torque_Nm": torque.tolist(),
        "peak_torque_fraction": (torque / effort).tolist(),
        "clearance_m": motion.clearance if np.isfinite(motion.clearance) else None,
        "nearest": list(motion.nearest or ()),
    }


def plot_excitation(motion: ExcitingMotion, path: str | Path, robot: Robot, heading: Heading | None = None) -> Path:
    """Plot position, velocity and torque of every joint with its own limits and write the picture; returns its path.

    The torque is M v̇ + C v + G and its joint friction added, which bounds it from above in size.
    """
    t = np.linspace(0.0, motion.duration, _ROWS)
    moved = motion(t)
    curves = [
        (moved.q, ACTUAL, robot.lower, robot.upper),
        (moved.v, _VELOCITY, -robot.velocity_limit, robot.velocity_limit),
        (demand(robot, moved), TORQUE, np.full(robot.nv, np.nan), robot.effort_limit),
    ]
    with picture(path, 13.0, 1.15 + 1.4 * robot.nv, heading=heading) as figure:
        grid = figure.subplots(robot.nv, len(curves), squeeze=False, sharex=True)
        for joint, (row, of) in enumerate(zip(grid, units_of(robot.prismatic), strict=True)):
            kinds = (f"q [{of.position}]", f"v [{of.velocity}]", f"|τ| [{of.torque}]")
            for axes, kind, (curve, color, low, high) in zip(row, kinds, curves, strict=True):
                axes.plot(t, curve[:, joint], color=color)
                axes.set_ylabel(kind)
                for bound in (low[joint], high[joint]):
                    if np.isfinite(bound):
                        axes.axhline(bound, color=LIMIT, linewidth=0.9, linestyle=(0, (5, 3)))
            row[0].set_title(robot.joint_names[joint].replace("$", r"\$"), loc="left", fontsize=8.5)
        for axes in grid[-1]:
            axes.set_xlabel("t [s]")
    return Path(path)


def _print(console: Console, arm: str, figures: dict[str, Any], interrupted: bool, *, verbose: bool) -> None:
    """Print what the motion is worth, and a row per joint; `figures` from the function of that name."""
    quantities = {
        "peak v": ("peak_velocity_rad_per_s", "velocity"),
        "peak acc.": ("peak_acceleration_rad_per_s2", "acceleration"),
        "peak τ": ("peak_torque_Nm", "torque"),
    }
    columns = [
        column(name, [f"{x:.3g}" for x in figures[key]], figures["units"][of]) for name, (key, of) in quantities.items()
    ]
    shares = {"of q": "used_range_fraction", "of v": "peak_velocity_fraction", "of τ": "peak_torque_fraction"}
    columns += [(name, [percent(share) for share in figures[key]]) for name, key in shares.items()]
    title = f"{arm}, exciting motion"
    shown = table(title, *(heading for heading, _ in columns))
    for joint, *row in zip(figures["joints"], *(cells for _, cells in columns), strict=True):
        shown.add_row(Text(joint), *row)
    verdict = verdict_of(figures, interrupted=interrupted)
    tell(console, f"{title}: {verdict.said}", verdict.more, [shown], verbose=verbose)
