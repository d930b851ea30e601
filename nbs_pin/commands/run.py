"""`nbs-pin run`: move an arm in real time behind the guard; write run, summary, figure and replay."""

import contextlib
import threading
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from rich.console import Console
from rich.live import Live as Display
from rich.text import Text

from nbs_pin.base.doors import option
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.summaries import SUMMARY
from nbs_pin.base.units import percent
from nbs_pin.certificates.certificate import Certificate
from nbs_pin.certificates.certify import certify
from nbs_pin.cli.exit_codes import STOPPED
from nbs_pin.cli.payloads import TimedLoad
from nbs_pin.cli.run import Run
from nbs_pin.cli.values import OptionError
from nbs_pin.commands.inputs import law_of
from nbs_pin.commands.loads import check_times, kept, loaded, note
from nbs_pin.commands.results import Results, drawing, table, tell
from nbs_pin.controllers.controller import Controller
from nbs_pin.controllers.lyapunov_law import LyapunovLaw
from nbs_pin.motions.by_name import motion_of
from nbs_pin.motions.references import DesiredMotion
from nbs_pin.reports.live import LiveView
from nbs_pin.reports.plotting import plot_tracking
from nbs_pin.reports.replay import replay
from nbs_pin.reports.verdicts import verdict_of
from nbs_pin.robots.robot import Robot, configuration_difference, load_robot
from nbs_pin.runtime.arms import ArmInterface, PlantArm
from nbs_pin.runtime.drive import Driven, Live, drive, guard_for
from nbs_pin.runtime.franka_arm import FrankaArm
from nbs_pin.runtime.ur_arm import URArm
from nbs_pin.simulation import metrics, run_figures
from nbs_pin.simulation.mujoco_plant import MujocoPlant

FILES = ("run.npz", "tracking.png", "replay.html", SUMMARY)
"""The files that are written."""
_SHOWN, _DRAWN = 0.2, 0.04  # time between two displays of numbers, and of the arm [s]


def run(options: Run, console: Console, notes: Console) -> int:
    """Move, write and print; 4 if the guard stopped. Raises NbsPinError or OSError."""
    period = 1.0 / options.rate
    with notes.status(f"loading {options.robot}"):
        robot = load_robot(options.robot, **options.arm.given())
        settings = {**options.units(), **options.tool.given(), "duration": options.duration}
        motion, length = motion_of(options.reference, robot, frequency=options.frequency, period=period, **settings)
    duration = options.duration or length
    loads = _loads(options, duration)
    results = Results.of(options, robot.name, robot, robot=robot.source, duration=duration, **kept(loads))
    results = results.check(FILES, options.force)
    with notes.status("compiling the law"):
        law = law_of(options.controller, robot, bandwidth=options.bandwidth, period=period, friction=None, seed=0)
        law.compile()
        arm = arm_at(options.at, robot, motion, period, loads)
        limit = np.inf if options.external_limit is None else options.external_limit
        guard = guard_for(arm, robot, certificate=_bound(options, law, robot), external_limit=limit)
    with results.made() as folder, _watching(options, robot, notes) as latest:
        driven = drive(arm, law, robot, motion, duration, guard=guard, watch=latest.append, priority=options.priority)
        note(driven.run, loads)
        found = figures(driven, robot)
        driven.run.info.update(reference=options.reference, stopped=found["stopped"], **results.facts)
        with results.replaced(FILES, found) as draft:
            driven.run.save(draft / FILES[0])
    with drawing(folder / FILES[1]) as path:
        plot_tracking(driven.run, path, robot=robot)
    with drawing(folder / FILES[2]) as path:
        replay(driven.run, path, robot)
    _print(console, f"{robot.name}, {options.controller} at {options.at}", driven, found)
    results.show(console, FILES)
    return 0 if driven.report is None else STOPPED


def arm_at(
    text: str, robot: Robot, motion: DesiredMotion, period: float, loads: Sequence[TimedLoad] = ()
) -> ArmInterface:
    """The arm that --arm names; raises ArgumentError where it does not answer or has another rate.

    A simulated arm carries the loads at their times.
    """
    kind, _, host = text.partition(":")
    if kind == "mujoco":
        return PlantArm(loaded(robot, loads, MujocoPlant), np.asarray(motion(0.0).q), period=period)
    arm: ArmInterface = FrankaArm(host) if kind == "libfranka" else URArm(host)
    if abs(arm.period - period) > 1e-9:
        raise ArgumentError(f"this arm has {1.0 / arm.period:g} Hz; give {option('rate', round(1.0 / arm.period))}.")
    return arm


def figures(driven: Driven, robot: Robot) -> dict[str, Any]:
    """What a run on an arm came to, as JSON stores it."""
    work = 1e6 * driven.times.work
    report = driven.report
    values = run_figures.figures(driven.run, robot) if len(driven.run.t) > 2 else {}
    return values | {
        "stopped": None if report is None else {"code": report.code.name, "time_s": report.time, "why": report.message},
        **driven.counters._asdict(),
        "missed_share": driven.times.missed_share,
        "work_p50_us": float(np.percentile(work, 50)),
        "work_p99_us": float(np.percentile(work, 99)),
        "work_max_us": float(work.max()),
        "real_time_priority": driven.times.priority,
    }


def _loads(options: Run, duration: float) -> tuple[TimedLoad, ...]:
    """The loads that appear meanwhile; raises OptionError if the arm is none in simulation, or it ends before."""
    loads = options.arm.loads()
    if loads and options.at != "mujoco":
        raise OptionError(
            f"--payload is '{loads[0].words}', a load that appears in a simulated arm, but --arm is '{options.at}'; "
            "leave the times out if the arm carries it, or give --arm mujoco."
        )
    check_times(loads, duration)
    return loads


def _bound(options: Run, law: Controller, robot: Robot) -> Certificate | None:
    if options.certified is None:
        return None
    if not isinstance(law, LyapunovLaw):
        raise ArgumentError(f"'{options.controller}' has no certificate; omit {option('certified', 5)}.")
    return certify(law, np.full(robot.nv, options.certified))


class _Latest:
    """What was seen last, written by the loop and read by displays: one reference, replaced in one piece."""

    def __init__(self) -> None:
        self.seen: Live | None = None

    def append(self, seen: Live) -> None:
        """Replace it."""
        self.seen = seen


@contextlib.contextmanager
def _watching(options: Run, robot: Robot, notes: Console) -> Iterator[_Latest]:
    """Displays of the loop in threads of their own, which the loop does not wait for."""
    latest, over = _Latest(), threading.Event()
    threads = []
    with contextlib.ExitStack() as stack:
        if options.live:
            view = stack.enter_context(LiveView(robot))
            notes.print(f"live view: {view.url}")
            threads.append(threading.Thread(target=_draw, args=(view, latest, over), daemon=True))
        if notes.is_terminal:
            display = stack.enter_context(Display(console=notes, auto_refresh=False, transient=True))
            threads.append(threading.Thread(target=_tell, args=(display, robot, latest, over), daemon=True))
        for thread in threads:
            thread.start()
        try:
            yield latest
        finally:
            over.set()
            for thread in threads:
                thread.join(timeout=2.0)


def _draw(view: LiveView, latest: _Latest, over: threading.Event) -> None:
    while not over.wait(_DRAWN):
        if latest.seen is not None and np.isfinite(latest.seen.sample.q).all():
            view.show(latest.seen.sample.q)


def _tell(display: Display, robot: Robot, latest: _Latest, over: threading.Event) -> None:
    while not over.wait(_SHOWN):
        if latest.seen is None:
            continue
        seen, counters = latest.seen, latest.seen.counters
        error = np.abs(configuration_difference(seen.sample.q, seen.aim.q, robot.continuous)).max()
        load = np.abs(seen.tau / robot.effort_limit).max()
        display.update(
            Text(
                f"t {seen.sample.t:8.3f} s  {seen.mode.name}  largest error {error:.2e}  effort {percent(load):>5}  "
                f"held {counters.held}  late {counters.late}  overruns {counters.overruns}"
            ),
            refresh=True,
        )


def _print(console: Console, title: str, driven: Driven, found: dict[str, Any]) -> None:
    shown = table(title, "peak error", "peak torque", "limit")
    error = np.abs(metrics.error(driven.run)).max(axis=0)
    peaks = np.abs(driven.run.tau).max(axis=0)
    for name, e, peak, most in zip(driven.run.joint_names, error, peaks, driven.run.effort_limit, strict=True):
        shown.add_row(Text(name), f"{e:.2e}", f"{peak:.4g}", f"{most:.4g}")
    verdict = verdict_of(found)
    lines = [
        *verdict.more,
        f"guard: {driven.mode.name}" + ("" if driven.report is None else f", {driven.report}"),
        f"held {found['held']}, late {found['late']}, overruns {found['overruns']}, saturated {found['saturated']}",
        f"periods missed {percent(found['missed_share'], 3)}; work p50 {found['work_p50_us']:.0f} µs, p99 "
        f"{found['work_p99_us']:.0f} µs, longest {found['work_max_us']:.0f} µs"
        + (", with real-time priority" if found["real_time_priority"] else ""),
    ]
    tell(console, f"{title}: {verdict.said}", lines, [shown], verbose=True)
