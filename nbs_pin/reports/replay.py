"""Replays of runs in the browser: one self-contained page with the arm and a translucent reference arm.

The page contains meshcat's viewer, the arm as a sequence of meshcat commands, the poses of its bodies by Pinocchio's
forward kinematics, which a script moves, and the run's signals, which uPlot draws. No server is started, and the page's
content security policy forbids every connection. Without WebGL it has the charts and numbers alone.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from nbs_pin.base.arguments import checked, count, maybe, paths, writable
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.files import write_whole
from nbs_pin.base.records import RUN, Run
from nbs_pin.reports.captions import law_in_words, settings_in_words
from nbs_pin.reports.pages import page
from nbs_pin.reports.plotting import one_start
from nbs_pin.reports.scene import scene_of
from nbs_pin.reports.signals import MAX_ROWS, signals_of
from nbs_pin.robots.named import robot_of
from nbs_pin.robots.robot import ARM, Robot


@checked(run=RUN, path=writable, robot=maybe(ARM), start=count(0), package_dirs=paths)
def replay(
    run: Run, path: str | Path, robot: Robot | None = None, *, start: int = 0, package_dirs: Iterable[str | Path] = ()
) -> Path:
    """Write a page that plays the run in any browser without a network; returns its path.

    A mesh that cannot be drawn is named in a warning.

    Args:
        run: The run.
        path: The HTML file.
        robot: The arm to draw. None loads the one that the run names.
        start: Which start of a batched run to show.
        package_dirs: Further folders that meshes may be read from.

    Raises:
        ArgumentError: If the run is not finite, its robot is missing or has changed, or `robot` or `start` do not fit.

    Example:
        >>> import tempfile
        >>> import nbs_pin as nbs
        >>> robot = nbs.load_robot("two_link")
        >>> law, reference = nbs.NeuralBackstepping.for_robot(robot), nbs.Sinusoid.for_robot(robot)
        >>> run = nbs.simulate(nbs.MujocoPlant(robot), law, reference, 0.1, 0.001)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     print(nbs.replay(run, f"{folder}/replay.html").name)
        replay.html
    """
    robot = robot_of(run) if robot is None else robot
    shown = shown_run(run, robot, start, package_dirs)
    return write_whole(path, page("replay.html", f"{robot.name}: {law_in_words(run)}, replay", {"runs": [shown]}))


def shown_run(
    run: Run, robot: Robot, start: int = 0, package_dirs: Iterable[str | Path] = (), most: int = MAX_ROWS
) -> dict[str, Any]:
    """What a page shows of one start of a run, with about `most` rows; raises ArgumentError as `replay` does."""
    if robot.joint_names != run.joint_names:
        raise ArgumentError(
            f"the run moves joints {', '.join(run.joint_names)} but {robot.name} has {', '.join(robot.joint_names)}: "
            "give the robot that ran."
        )
    one = one_start(run, start)
    limits = [None if limit == float("inf") else limit for limit in run.effort_limit.tolist()]
    return {
        "name": robot.name,
        "law": law_in_words(run),
        "notes": settings_in_words(run),
        "joints": [
            {"name": name, **of._asdict(), "limit": limit}
            for name, of, limit in zip(run.joint_names, run.units, limits, strict=True)
        ],
        "scene": scene_of(one, robot, package_dirs),
        "signals": signals_of(one, robot, most),
    }
