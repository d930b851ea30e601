"""`nbs-pin track`: an arm follows a motion; run, summary, picture and replay land in a folder."""

import dataclasses
import hashlib
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.console import Console

from nbs_pin.cli.folders import check_folder, default, folder_for, made
from nbs_pin.cli.tables import print_tracking
from nbs_pin.cli.values import (
    OptionError,
    configuration,
    controller_text,
    disturbance_text,
    integer,
    number,
    parse_disturbance,
    plain_numbers,
)


@dataclass(frozen=True)
class Track:
    """Let an arm follow a motion, and write run.npz, summary.json, tracking.png and replay.html.

    Example: nbs-pin track panda --start-error 0.3 --disturbance square:5@8 --out out/panda
    """

    robot: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="ROBOT")]
    """An arm by name (see nbs-pin robots) or a path to a .urdf or .xacro file."""
    plant: Literal["mujoco", "pinocchio"] = "mujoco"
    """What simulates the arm."""
    controller: Annotated[str, controller_text()] = "nbs"
    """The law by name, or a controller saved by nbs-pin train, with its own gains. nbs-paper is the paper's own on
    two_link, its networks with this arm's gains elsewhere."""
    reference: Annotated[str, tyro.conf.arg(metavar="MOTION")] = "sinusoid"
    """What to follow: sinusoid (fitted to the arm), paper, or a .csv or .npz file with t and the joints."""
    frequency: Annotated[float, number("--frequency", above=0.0, most=1000.0, unit="rad/s")] = 1.0
    """Frequency of the sinusoid [rad/s]."""
    duration: Annotated[
        float | None, number("--duration", above=0.0, most=100_000.0, unit="s"), default("10, or the file's length")
    ] = None
    """Simulated time, a whole number of periods [s]."""
    period: Annotated[float, number("--period", least=1e-5, most=0.1, unit="s")] = 0.001
    """Control period [s]."""
    bandwidth: Annotated[float, number("--bandwidth", above=0.0, most=10_000.0, unit="rad/s")] = 8.0
    """Rate at which errors decay [rad/s]; the paper's own law on two_link has none."""
    start_error: Annotated[float, number("--start-error", least=0.0, most=math.pi, unit="rad")] = 0.0
    """Added to every joint with alternating sign, the arm then starting at rest [rad]; 0 starts on the motion."""
    start: Annotated[str | None, configuration("--start"), default("on the motion")] = None
    """Where the arm starts at rest [rad], one number per joint: --start=-0.1,0.2."""
    disturbance: Annotated[str, disturbance_text()] = "none"
    """Torque on every joint [N·m]: none, constant:5, square:5@8, sine:5@8 (@ rad/s) or noise:0.5 (standard deviation).
    A comma list gives one per joint: constant:5,5,3."""
    joint_friction: Literal["drop", "keep"] = "drop"
    """Joint friction of the URDF: left out, or acting and fed forward by every law with a model."""
    effort_limit: Annotated[
        float | None, number("--effort-limit", above=0.0, most=1e9, unit="N·m"), default("the arm's")
    ] = None
    """Largest torque of every joint [N·m]."""
    no_effort_limit: bool = False
    """Let torques grow without limit."""
    integrator: Annotated[
        Literal["rk4", "euler", "implicitfast", "semi_implicit_euler"] | None,
        tyro.conf.arg(metavar="{rk4,euler,implicitfast,semi_implicit_euler}"),
        default("the plant's usual one"),
    ] = None
    """How the plant is integrated. mujoco: rk4, euler (semi-implicit), implicitfast; pinocchio: rk4, euler (explicit),
    semi_implicit_euler."""
    plant_step: Annotated[
        float | None, number("--plant-step", least=1e-6, most=0.1, unit="s"), default("at most 0.001")
    ] = None
    """Step of the plant, of which a period is a whole number [s]."""
    lookahead: Annotated[
        float | None, number("--lookahead", least=0.0, most=0.1, unit="s"), default("half a period")
    ] = None
    """How far ahead of the measured state the law is evaluated [s]; 0 is the plain sampled law."""
    seed: Annotated[int, integer("--seed", most=2**31 - 1)] = 0
    """Of network weights and noise."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR"), default("out/track-ROBOT")] = None
    """Folder for the results."""
    force: bool = False
    """Replace the results of another run in that folder."""

    def run(self, console: Console, notes: Console) -> None:
        """Tracks, writes and prints; raises NbsPinError or OSError."""
        if self.no_effort_limit and self.effort_limit is not None:
            raise OptionError("--effort-limit and --no-effort-limit were both given; choose one.")
        if self.start is not None and self.start_error:
            raise OptionError("--start and --start-error were both given; choose one.")
        with notes.status(f"loading {self.robot}"):
            from nbs_pin.base.versions import versions
            from nbs_pin.cli import tracking
            from nbs_pin.motions import by_name as motions
            from nbs_pin.robots.robot import load_robot

            robot = load_robot(self.robot)
        if self.no_effort_limit or self.effort_limit is not None:
            robot = robot.with_effort_limit(self.effort_limit or math.inf)
        motion, length = motions.motion_of(self.reference, robot, frequency=self.frequency, period=self.period)
        start = self._start(robot.nv)
        settings = self._settings(robot.source, self.duration or length)
        folder = folder_for(self.out, "track", robot.name)
        facts = {"settings": settings, "versions": versions(), "robot_sha256": robot.sha256}
        check_folder(folder, tracking.FILES, facts, self.force)
        with made(folder):
            run, wall_time = tracking.track(
                robot,
                plant=self.plant,
                controller=self.controller,
                reference=motion,
                duration=settings["duration"],
                period=self.period,
                bandwidth=self.bandwidth,
                start_error=self.start_error,
                start=start,
                disturbance=parse_disturbance(self.disturbance).build(robot.nv, self.period, self.seed),
                joint_friction=self.joint_friction,
                integrator=self.integrator,
                plant_step=self.plant_step,
                lookahead=self.lookahead,
                seed=self.seed,
                progress=True,
            )
            run.info.update(reference=self.reference, **facts)
            figures = tracking.figures(run, robot)
            with notes.status(f"drawing picture and replay into {folder}"):
                summary = facts | {"seed": self.seed, "wall_time_s": wall_time, "figures": figures}
                tracking.write_results(run, folder, robot, summary)
        print_tracking(console, f"{robot.name}, {self.controller} in {self.plant}", figures, wall_time)
        for name in tracking.FILES:
            console.print(str(folder / name), soft_wrap=True, highlight=False, markup=False)

    def _start(self, nv: int) -> list[float] | None:
        """The configuration to start from [rad], or None; raises OptionError for another number of joints."""
        start = None if self.start is None else plain_numbers(self.start)
        if start is not None and len(start) != nv:
            raise OptionError(f"--start '{self.start}' has {len(start)} numbers for {nv} joints; give one for each.")
        return start

    def _settings(self, robot: str, duration: float) -> dict[str, Any]:
        """Everything that decides the run, as JSON can store it."""
        settings = dataclasses.asdict(self) | {"robot": robot, "duration": duration}
        del settings["out"], settings["force"]
        for name in ("reference", "controller"):
            path = Path(settings[name])
            if path.is_file():
                settings[f"{name}_sha256"] = hashlib.sha256(path.read_bytes()).hexdigest()
        return settings
