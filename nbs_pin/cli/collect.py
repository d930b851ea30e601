"""`nbs-pin collect`: motions of an arm in MuJoCo, to learn its dynamics from."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from nbs_pin.cli.folders import check_folder, default, folder_for, made
from nbs_pin.cli.values import OptionError, integer, number


@dataclass(frozen=True)
class Collect:
    """Collect motions of an arm in MuJoCo to learn from, and write data.npz, coverage.png and summary.json.

    Learn from the result: nbs-pin learn out/collect-panda/data.npz

    Example: nbs-pin collect panda --samples 3000 --encoder-bits 16 --torque-noise 0.5
    """

    robot: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="ROBOT")]
    """An arm by name (see nbs-pin robots) or a path to a .urdf or .xacro file."""
    recipe: Literal["excited", "reference", "passive", "uniform"] = "excited"
    """Random sums of sines in torque about a soft PD; tracking of sinusoids; one swing without torque from zero, as in
    the paper, which cannot tell the scale of the torque; or independent states at random, which no real arm gives."""
    samples: Annotated[int, integer("--samples", least=1, most=10_000_000)] = 10_000
    """How many samples."""
    sampling: Annotated[
        float | None, number("--sampling", least=0.001, most=10.0, unit="s"), default("0.01 to 0.05, passive 0.001")
    ] = None
    """Time between samples, a whole number of milliseconds [s]."""
    duration: Annotated[float, number("--duration", above=0.0, most=1000.0, unit="s")] = 3.0
    """Length of a trajectory [s]; passive and uniform have none."""
    speed: Annotated[float, number("--speed", above=0.0, most=100.0, unit="rad/s")] = 2.0
    """About how fast the joints move; peaks stay near their velocity limits [rad/s]."""
    friction: bool = False
    """Let the joint friction of the URDF act."""
    differentiated: bool = False
    """Take accelerations from the velocities, not from the simulator."""
    encoder_bits: Annotated[int | None, integer("--encoder-bits", least=4, most=40), default("exact")] = None
    """Round positions to 2^-BITS of a turn, and differentiate them for velocity and acceleration."""
    torque_noise: Annotated[float, number("--torque-noise", least=0.0, most=1e9, unit="N·m")] = 0.0
    """Standard deviation of noise on the torque [N·m]."""
    seed: Annotated[int, integer("--seed", most=2**31 - 1)] = 0
    """Of everything random."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR"), default("out/collect-ROBOT")] = None
    """Folder for the results."""
    force: bool = False
    """Replace other data in that folder."""

    def run(self, console: Console, notes: Console) -> None:
        """Collects, writes and prints; raises NbsPinError and OSError."""
        with notes.status(f"loading {self.robot}"):
            from nbs_pin.base.versions import versions
            from nbs_pin.cli import collecting
            from nbs_pin.identification.collect import collect
            from nbs_pin.identification.measurement import Noise
            from nbs_pin.robots.robot import load_robot

            robot = load_robot(self.robot)
        if self.friction and not (robot.damping.any() or robot.friction.any()):
            raise OptionError(f"--friction was given, but the URDF of {robot.name} states none; leave it out.")
        folder = folder_for(self.out, "collect", robot.name)
        facts = {"settings": self._settings(robot.source), "versions": versions(), "robot_sha256": robot.sha256}
        check_folder(folder, collecting.FILES, facts, self.force, whose="other data")
        with made(folder):
            data = collect(
                robot,
                self.recipe,
                self.samples,
                self.seed,
                noise=Noise(0.0 if self.encoder_bits is None else 2.0**-self.encoder_bits, self.torque_noise),
                acceleration="differentiated" if self.differentiated else None,
                friction=self.friction,
                sampling=self.sampling,
                duration=self.duration,
                speed=self.speed,
                progress=True,
            )
            with notes.status(f"writing into {folder}"):
                figures = collecting.write_results(data, folder, robot, facts)
        _print(console, f"{robot.name}, {self.recipe}", figures)
        for name in collecting.FILES:
            console.print(str(folder / name), soft_wrap=True, highlight=False, markup=False)

    def _settings(self, robot: str) -> dict[str, Any]:
        """Everything that decides the data, as JSON can store it."""
        settings = dataclasses.asdict(self) | {"robot": robot}
        for name in ("out", "force"):
            del settings[name]
        return settings


def _print(console: Console, title: str, figures: dict[str, Any]) -> None:
    """A row per joint; `figures` as `studies.collecting.figures` gives them."""
    table = Table(title=Text(title), box=box.SIMPLE_HEAD, title_justify="left", title_style="bold")
    table.add_column("joint", overflow="fold")
    headings = ("q from\n[rad]", "to\n[rad]", "RMS v\n[rad/s]", "RMS acc.\n[rad/s²]", "RMS τ\n[N·m]", "at limit")
    for heading in headings:
        table.add_column(Text(heading), justify="right", no_wrap=True)
    columns = ("q_least_rad", "q_most_rad", "rms_velocity_rad_per_s", "rms_acceleration_rad_per_s2", "rms_torque_Nm")
    numbers = zip(*(figures[name] for name in columns), strict=True)
    for joint, row, saturated in zip(figures["joints"], numbers, figures["at_torque_limit_fraction"], strict=True):
        table.add_row(Text(joint), *(f"{x:.3g}" for x in row), f"{saturated:.1%}")
    console.print(table)
    plural = "trajectory" if figures["trajectories"] == 1 else "trajectories"
    console.print(f"{figures['samples']} samples of {figures['trajectories']} {plural}", highlight=False)
