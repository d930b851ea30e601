"""`nbs-pin track`: simulate an arm that follows a motion; write run, summary, figure and replay."""

from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from nbs_pin.base.doors import option
from nbs_pin.base.records import Run
from nbs_pin.base.shown import joints_told
from nbs_pin.base.units import column
from nbs_pin.cli.track import Track
from nbs_pin.cli.values import OptionError, parse_disturbance, plain_numbers
from nbs_pin.commands.following import not_simulated, track
from nbs_pin.commands.inputs import arm_of
from nbs_pin.commands.loads import check_times, kept
from nbs_pin.commands.results import Results, drawing, keywords, table, tell
from nbs_pin.commands.track_laws import FILES, LEARNED, PICTURE, files_in, track_laws
from nbs_pin.motions.by_name import motion_of
from nbs_pin.reports.estimate_charts import plot_estimates
from nbs_pin.reports.plotting import plot_tracking
from nbs_pin.reports.replay import replay
from nbs_pin.reports.verdicts import verdict_of
from nbs_pin.robots.robot import Robot

_NOTICEABLE = 3.0  # compilation times above this are printed [s]; machine code from disk takes less


def run(options: Track, console: Console, notes: Console) -> None:
    """Track, write and print; raises NbsPinError, OSError, and KeyboardInterrupt after an early end."""
    if options.start is not None and options.start_error:
        raise OptionError("--start and --start-error were both given; choose one.")
    with notes.status(f"loading {options.robot}"):
        robot = arm_of(options)
    settings = {**options.units(), **options.tool.given(), "duration": options.duration}
    with notes.status(f"planning {options.reference}"):
        motion, length = motion_of(
            options.reference, robot, frequency=options.frequency, period=options.period, **settings
        )
    duration = options.duration or length
    loads = options.arm.loads()
    check_times(loads, duration)
    results = Results.of(options, robot.name, robot, robot=robot.source, duration=duration, **kept(loads))
    given = keywords(options, track) | {
        "reference": motion,
        "duration": duration,
        "loads": loads,
        "start": _start(options, robot.nv),
        "disturbance": parse_disturbance(options.disturbance).build(robot.nv, options.period, options.seed),
    }
    if "," in options.controller:
        track_laws(options, robot, given, results, console, notes)
        return
    results = results.check((*FILES, PICTURE, LEARNED), options.force, whole={"interrupted": False})
    with results.made() as folder:
        tracked = track(robot, **given, progress=True)
        recorded, compile_time, wall_time, interrupted, _ = tracked
        recorded.info.update(reference=options.reference, interrupted=interrupted, **results.facts)
        found = tracked.figures(robot) | {"joint_stops": options.joint_stops}
        found["not_simulated"] = not_simulated(robot, options.joint_friction)
        with notes.status(f"writing run, picture and replay into {folder}"):
            times = {"compile_time_s": compile_time, "wall_time_s": wall_time}
            write_results(recorded, results, robot, found, seed=options.seed, interrupted=interrupted, **times)
    title = f"{robot.name}, {options.controller} in {options.plant}"
    verdict = verdict_of(found, interrupted=interrupted)
    lines = (*verdict.more, *_lines(found, compile_time, wall_time))
    tell(console, f"{title}: {verdict.said}", lines, [_table(title, found)], verbose=options.verbose)
    learned = (LEARNED,) if recorded.estimates is not None else ()
    results.show(console, (*FILES[:2], *learned, *FILES[2:]), "replay", results.folder, "--open")
    if interrupted:
        raise KeyboardInterrupt


def write_results(run: Run, results: Results, robot: Robot, figures: dict[str, Any], **more: Any) -> None:
    """Write `track_laws.FILES`, the run and summary.json first; a picture that cannot be drawn is told in a warning.

    `more` are further entries of summary.json. Raises OSError if something cannot be written.
    """
    folder = results.folder
    with results.replaced(files_in(folder), figures, **more) as draft:
        run.save(draft / FILES[0])
    with drawing(folder / FILES[1]) as path:
        plot_tracking(run, path, robot=robot)
    if run.estimates is not None:
        with drawing(folder / LEARNED) as path:
            plot_estimates(run, path)
    with drawing(folder / FILES[2]) as path:
        replay(run, path, robot)


def _start(options: Track, nv: int) -> list[float] | None:
    """The configuration to start from [rad], or None; raises OptionError if the number of joints differs."""
    start = None if options.start is None else plain_numbers(options.start)
    if start is not None and len(start) != nv:
        raise OptionError(
            f"--start '{options.start}' has {len(start)} numbers for {joints_told(nv)}; give one per joint."
        )
    return start


def _table(title: str, figures: dict[str, Any]) -> Table:
    """A row per joint; `figures` from the function of that name."""
    lengths, forces = figures["units"]["position"], figures["units"]["torque"]
    errors = {
        "RMS error": "rms_error_rad",
        f"after {figures['late_after_s']:g} s": "rms_error_late_rad",
        "last 30 %": "rms_error_last_30_percent_rad",
    }
    columns = [column(name, [f"{e:.2e}" for e in figures[key]], lengths) for name, key in errors.items()]
    columns += [
        column("peak", [f"{peak:.4g}" for peak in figures["joint_peak_torque_Nm"]], forces),
        column("limit", ["none" if x is None else f"{x:.4g}" for x in figures["effort_limit_Nm"]], forces),
    ]
    shown = table(title, *(heading for heading, _ in columns))
    for joint, *cells in zip(figures["joints"], *(cells for _, cells in columns), strict=True):
        shown.add_row(Text(joint), *cells)
    return shown


def _lines(figures: dict[str, Any], compile_time: float, wall_time: float) -> list[str]:
    """What was left out of the simulation, and the time that it took."""
    outside = figures["joint_stops"] == "drop" and any(figures["outside_position_range_rad"])
    return [
        *([f"joints left their ranges, as none stops them: {option('joint_stops', 'keep')} does"] if outside else []),
        *([f"not simulated: {'; '.join(figures['not_simulated'])}"] if figures["not_simulated"] else []),
        *([f"compiled kernels for this machine in {compile_time:.1f} s, once"] if compile_time > _NOTICEABLE else []),
        f"simulated {figures['duration_s']:g} s in {wall_time:.1f} s",
    ]
