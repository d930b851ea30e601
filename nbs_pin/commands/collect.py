"""`nbs-pin collect`: motions of an arm in MuJoCo, as data for learning its dynamics."""

from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.text import Text

from nbs_pin.base.summaries import SUMMARY
from nbs_pin.base.units import by_quantity, column, percent, units_of
from nbs_pin.cli.collect import Collect
from nbs_pin.cli.values import OptionError
from nbs_pin.commands.results import Results, drawing, keywords, table, tell
from nbs_pin.identification.collect import collect
from nbs_pin.identification.datasets import Dataset
from nbs_pin.identification.excitation import torque_limits
from nbs_pin.identification.measurement import Noise
from nbs_pin.motions.reference_files import load_reference
from nbs_pin.reports.captions import chosen
from nbs_pin.reports.plotting import ACTUAL, LIMIT, TORQUE, Heading, picture, short_name
from nbs_pin.reports.verdicts import verdict_of
from nbs_pin.robots.robot import Robot, load_robot

FILES = ("data.npz", "coverage.png", SUMMARY)
"""The files that are written."""
_DOTS = 4000
_AT_LIMIT = 1.0 - 1e-9


def run(options: Collect, console: Console, notes: Console) -> None:
    """Collect, write and print; raises NbsPinError, OSError, and KeyboardInterrupt after an early end."""
    with notes.status(f"loading {options.robot}"):
        robot = load_robot(options.robot, **options.arm.given())
    if options.friction and not (robot.damping.any() or robot.friction.any()):
        raise OptionError(f"--friction was given, but the URDF of {robot.name} states none; omit it.")
    results = Results.of(options, robot.name, robot, robot=robot.source)
    results = results.check(FILES, options.force, whole={"interrupted": False}, whose="other data")
    given = keywords(options, collect) | {
        "noise": Noise(0.0 if options.encoder_bits is None else 2.0**-options.encoder_bits, options.torque_noise),
        "acceleration": "differentiated" if options.differentiated else None,
        "reference": None if options.reference is None else load_reference(options.reference, robot),
    }
    with results.made() as folder:
        data = collect(robot, options.recipe, options.samples, options.seed, **given, progress=True)
        with notes.status(f"writing into {folder}"):
            found, interrupted = figures(data, robot), bool(data.about["interrupted"])
            with results.replaced(FILES, found, interrupted=interrupted) as draft:
                data.save(draft / FILES[0])
            with drawing(folder / FILES[1]) as path:
                settings = chosen(results.facts["settings"], "torque_noise", "encoder_bits", "friction", "seed")
                verdict = verdict_of(found, interrupted=interrupted)
                plot_coverage(data, path, robot, Heading(f"{robot.name}: data, {options.recipe}", settings, verdict))
    _print(console, f"{robot.name}, {options.recipe}", found, interrupted, verbose=options.verbose)
    results.show(console, FILES, "learn", results.folder / FILES[0])
    if interrupted:
        raise KeyboardInterrupt


def figures(data: Dataset, robot: Robot) -> dict[str, Any]:
    """The range of the samples per joint, as JSON can store it; units in the keys, m and N for prismatic joints."""
    limit, (low, high) = torque_limits(robot), robot.sampling_range
    return {
        "samples": len(data),
        "trajectories": data.trajectories,
        "joints": list(robot.joint_names),
        "units": by_quantity(robot.prismatic),
        "q_least_rad": data.q.min(axis=0).tolist(),
        "q_most_rad": data.q.max(axis=0).tolist(),
        "covered_range_fraction": (np.ptp(data.q, axis=0) / (high - low)).tolist(),
        "rms_velocity_rad_per_s": _rms(data.v),
        "peak_velocity_rad_per_s": np.abs(data.v).max(axis=0).tolist(),
        "rms_acceleration_rad_per_s2": _rms(data.a),
        "rms_torque_Nm": _rms(data.tau),
        "peak_torque_Nm": np.abs(data.tau).max(axis=0).tolist(),
        "torque_limit_Nm": limit.tolist(),
        "at_torque_limit_fraction": (np.abs(data.tau) >= _AT_LIMIT * limit).mean(axis=0).tolist(),
    }


def plot_coverage(data: Dataset, path: str | Path, robot: Robot, heading: Heading | None = None) -> Path:
    """Plot the states that the samples cover and write the picture (`plotting.picture`); returns its path.

    Each column shows velocity against position with the range of a joint, and torque against acceleration with its
    limits where they are within the panel. At most 4000 samples, evenly picked, are drawn.
    """
    shown = np.unique(np.linspace(0, len(data) - 1, _DOTS).astype(int))
    q, v, a, tau = (x[shown] for x in (data.q, data.v, data.a, data.tau))
    with picture(path, 1.0 + 2.4 * data.nv, 4.8, heading=heading) as figure:
        grid = figure.subplots(2, data.nv, squeeze=False)
        for joint, (states, torques) in enumerate(grid.T):
            info, limit = robot.joints[joint], robot.effort_limit[joint]
            states.plot(q[:, joint], v[:, joint], ".", color=ACTUAL, markersize=1.5, alpha=0.5)
            torques.plot(a[:, joint], tau[:, joint], ".", color=TORQUE, markersize=1.5, alpha=0.5)
            for bound in (info.lower, info.upper):
                if np.isfinite(bound):
                    states.axvline(bound, color=LIMIT, linewidth=0.9, linestyle=(0, (5, 3)))
            shown_range = torques.get_ylim()
            for bound in (-limit, limit) if np.isfinite(limit) else ():
                torques.axhline(bound, color=LIMIT, linewidth=0.9, linestyle=(0, (5, 3)))
            torques.set_ylim(shown_range)
            (of,) = units_of([info.prismatic])
            states.set_title(short_name(info.name), loc="left", fontsize=8.5, pad=12)
            share = float(np.ptp(data.q[:, joint]) / (info.upper - info.lower))
            if share > 0.0:
                states.annotate(f"{percent(share)} of its range", (1.0, 1.0), xycoords="axes fraction", ha="right",
                                va="bottom", fontsize=7, color=LIMIT)  # fmt: skip
            states.set(xlabel=f"q [{of.position}]", ylabel=f"v [{of.velocity}]")
            told = f"limit ±{limit:.4g}" if np.isfinite(limit) else "no limit"
            torques.annotate(told, (1.0, 1.0), xycoords="axes fraction", ha="right", va="bottom",
                             fontsize=7, color=LIMIT)  # fmt: skip
            torques.set(xlabel=f"acceleration [{of.acceleration}]", ylabel=f"τ [{of.torque}]")
    return Path(path)


def _rms(x: np.ndarray) -> list[float]:
    return np.sqrt((x**2).mean(axis=0)).tolist()


def _print(console: Console, title: str, figures: dict[str, Any], interrupted: bool, *, verbose: bool) -> None:
    """Print what was recorded, and a row per joint; `figures` from the function of that name."""
    names = {
        "q from": ("q_least_rad", "position"),
        "to": ("q_most_rad", "position"),
        "RMS v": ("rms_velocity_rad_per_s", "velocity"),
        "RMS acc.": ("rms_acceleration_rad_per_s2", "acceleration"),
        "RMS τ": ("rms_torque_Nm", "torque"),
    }
    columns = [
        column(name, [f"{x:.3g}" for x in figures[key]], figures["units"][of]) for name, (key, of) in names.items()
    ]
    columns.append(("at limit", [percent(share, 1) for share in figures["at_torque_limit_fraction"]]))
    shown = table(title, *(heading for heading, _ in columns))
    for joint, *row in zip(figures["joints"], *(cells for _, cells in columns), strict=True):
        shown.add_row(Text(joint), *row)
    verdict = verdict_of(figures, interrupted=interrupted)
    tell(console, f"{title}: {verdict.said}", verdict.more, [shown], verbose=verbose)
