"""`nbs-pin learn`: a model of an arm from its data, and how well it explains motions that it never saw."""

import dataclasses
import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from nbs_pin.cli.folders import check_folder, default, folder_for, made
from nbs_pin.cli.values import integer, number


@dataclass(frozen=True)
class Learn:
    """Learn a model of an arm from data, and write model.nbs, summary.json and learning.png.

    Ctrl-C ends the fit of a network early and keeps the best. Hold the result against Pinocchio with
    nbs-pin compare out/learn-panda/model.nbs

    Example: nbs-pin learn out/collect-panda/data.npz --model chain --friction
    """

    data: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DATA")]
    """Data of nbs-pin collect, or a log: CSV or NPZ with t, q, tau and, if there are any, v and a."""
    model: Literal["chain", "cholesky", "homogenised", "picnn", "unconstrained", "residual", "identified"] = "chain"
    """A rigid tree found from the order of the joints alone; M = LLᵀ + εI by a network; a convex network made
    quadratic; the paper's convex network; a Lagrangian without structure; a network that corrects the arm's URDF; or
    inertias by least squares in the geometry of the URDF."""
    robot: Annotated[str | None, tyro.conf.arg(metavar="ROBOT"), default("the one that the data name")] = None
    """The arm by name or a path to a .urdf or .xacro file; a log names none."""
    friction: bool = False
    """Learn viscous and Coulomb friction of every joint too."""
    held_out: Annotated[float, number("--held-out", least=0.0, most=0.9, unit="")] = 0.2
    """Share of the trajectories that are not learned from, and choose the iteration of a network."""
    loss: Literal["torque", "acceleration"] = "torque"
    """What a network is to explain."""
    optimiser: Annotated[Literal["lm", "adam", "lbfgs"] | None, default("lm, lbfgs for more than 3500 parameters")] = (
        None
    )
    """How a network is fitted: Levenberg–Marquardt, Adam, or L-BFGS after some of it."""
    iterations: Annotated[
        int | None, integer("--iterations", least=1, most=1_000_000), default("lm 30, adam 300, lbfgs 400")
    ] = None
    """Iterations of it at most."""
    seed: Annotated[int, integer("--seed", most=2**31 - 1)] = 0
    """Of first parameters and of what is held out."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR"), default("out/learn-ROBOT")] = None
    """Folder for the results."""
    force: bool = False
    """Replace another model in that folder."""

    def run(self, console: Console, notes: Console) -> None:
        """Learns, writes and prints; raises NbsPinError, OSError, and KeyboardInterrupt after an early end."""
        with notes.status(f"loading {self.data}"):
            from nbs_pin.base.versions import versions
            from nbs_pin.cli import learning

            data, robot = learning.data_and_arm(self.data, self.robot)
        name = self.data.stem if robot is None else robot.name
        folder = folder_for(self.out, "learn", name)
        sha = None if robot is None else robot.sha256
        facts = {"settings": self._settings(), "versions": versions(), "robot_sha256": sha}
        check_folder(folder, learning.FILES, facts | {"interrupted": False}, self.force, whose="another model")
        given = {name: getattr(self, name) for name in ("optimiser", "iterations")}
        given["loss"] = None if self.loss == "torque" else self.loss  # which every model minimises
        with made(folder):
            result = learning.learn(
                data,
                self.model,
                robot,
                self.seed,
                held_out=self.held_out,
                friction=self.friction,
                progress=True,
                **{name: value for name, value in given.items() if value is not None},
            )
            interrupted = result.report.stopped == "interrupted"
            with notes.status(f"writing into {folder}"):
                figures = learning.write_results(result, folder, facts | {"interrupted": interrupted})
        _print(console, f"{name}, {self.model}", figures)
        for file in learning.FILES:
            console.print(str(folder / file), soft_wrap=True, highlight=False, markup=False)
        if interrupted:
            raise KeyboardInterrupt

    def _settings(self) -> dict[str, Any]:
        """Everything that decides the model, as JSON can store it."""
        settings = dataclasses.asdict(self) | {"data_sha256": hashlib.sha256(self.data.read_bytes()).hexdigest()}
        for name in ("data", "out", "force"):
            del settings[name]
        return settings


def _print(console: Console, title: str, figures: dict[str, Any]) -> None:
    """A row per joint, then what counts for the whole arm."""
    table = Table(title=Text(title), box=box.SIMPLE_HEAD, title_justify="left", title_style="bold")
    table.add_column("joint", overflow="fold")
    for heading in ("torque\ndeviation [N·m]", "error [N·m]", "error, held\nout [N·m]", "friction\n[N·m·s, N·m]"):
        table.add_column(Text(heading), justify="right", no_wrap=True)
    for i, joint in enumerate(figures["joints"]):
        test, viscous = figures["rms_test_torque_error_Nm"], figures["viscous_friction"]
        table.add_row(
            Text(joint),
            f"{figures['torque_deviation_Nm'][i]:.4g}",
            f"{figures['rms_torque_error_Nm'][i]:.2e}",
            "none" if test is None else f"{test[i]:.2e}",
            "none" if viscous is None else f"{viscous[i]:.3g}, {figures['coulomb_friction_Nm'][i]:.3g}",
        )
    console.print(table)
    for line in _lines(figures):
        console.print(line, highlight=False, markup=False, soft_wrap=True)


def _lines(figures: dict[str, Any]) -> list[str]:
    train, test = (figures[name] for name in ("train_nmse", "test_nmse"))
    ended = {"held out": "no better on what was held out", "iterations": "all iterations done"}
    shown, more = figures["unexcited"][:3], len(figures["unexcited"]) - 3
    return [
        f"mean square of the torque error over the torque's variance: {_short(train)} on {figures['samples']} samples"
        + ("" if test is None else f", {_short(test)} on {figures['test_samples']} of trajectories held out"),
        f"{figures['parameters']} numbers learned in {figures['seconds']:.1f} s "
        f"({ended.get(figures['stopped'], figures['stopped'])})",
        *(f"the data leave open: {text}" for text in shown),
        *([f"… and {more} more in summary.json"] if more > 0 else []),
    ]


def _short(value: float | None) -> str:
    return "none" if value is None else f"{value:.2e}"
