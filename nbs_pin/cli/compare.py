"""`nbs-pin compare`: how far a model of an arm is from Pinocchio's."""

import dataclasses
import hashlib
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text
from tyro.constructors import PrimitiveConstructorSpec

from nbs_pin.cli.folders import check_folder, default, folder_for, made
from nbs_pin.cli.values import SAVED, OptionError, integer, number


def joint_pair() -> PrimitiveConstructorSpec[str]:
    """The text of two joint numbers for tyro, as in 2,4; raises OptionError for any other."""

    def parse(words: list[str]) -> str:
        parts = words[0].split(",")
        if len(parts) != 2 or not all(re.fullmatch(r"[1-9][0-9]{0,8}", part) for part in parts):
            raise OptionError(f"--joints is '{words[0]}'; give two joints by number, the first is 1: --joints 2,4.")
        return words[0]

    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="I,J",
        instance_from_str=parse,
        is_instance=lambda value: True,
        str_from_instance=lambda value: [value or ""],
    )


@dataclass(frozen=True)
class Compare:
    """Hold a model of an arm against Pinocchio's, and write errors.png, errors.csv and summary.json.

    The errors of M, C v, G, torque and acceleration over a box of states, how they grow with speed and outside the box,
    the eigenvalues of M, energy in free motion, the scale of the torque, and the mismatch along a closed loop with the
    bound it keeps.

    Example: nbs-pin compare out/learn-panda/model.nbs --samples 5000 --out out/errors
    """

    model: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="MODEL")]
    """A .nbs file with a model, or with a controller that has one; or an arm by name or path, to compare two URDFs."""
    against: Annotated[str | None, tyro.conf.arg(metavar="ROBOT"), default("the model's own arm")] = None
    """The true arm, by name or a path to a .urdf or .xacro file."""
    samples: Annotated[int, integer("--samples", least=2, most=1_000_000)] = 2_000
    """Uniform states to compare at."""
    speed: Annotated[
        float | None, number("--speed", above=0.0, most=1000.0, unit="rad/s"), default("2, or the data's")
    ] = None
    """Largest speed of every joint in them [rad/s]."""
    data: Annotated[Path | None, tyro.conf.arg(metavar="DATA.npz"), default("the position limits")] = None
    """Look where these data of nbs-pin collect lie: the box from their least to their greatest positions and speeds."""
    joints: Annotated[str | None, joint_pair(), default("where the error varies most")] = None
    """Joints to draw the maps over, counted from 1."""
    trajectories: Annotated[int, integer("--trajectories", most=100_000)] = 374
    """Random starts of the closed loop; 374 make the bound hold for 95 % of further ones, 0 leaves it out."""
    frequency: Annotated[float, number("--frequency", above=0.0, most=1000.0, unit="rad/s")] = 1.0
    """Of the sinusoid that the closed loop follows [rad/s]."""
    along: Annotated[Path | None, tyro.conf.arg(metavar="RUN.npz"), default("a simulated one")] = None
    """Take this run of the true arm as the closed loop."""
    seed: Annotated[int, integer("--seed", most=2**31 - 1)] = 1
    """Of states and starts."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR"), default("out/compare-ROBOT")] = None
    """Folder for the results."""
    force: bool = False
    """Replace the results of another comparison in that folder."""

    def run(self, console: Console, notes: Console) -> None:
        """Compares, writes and prints; raises NbsPinError and OSError."""
        with notes.status(f"loading {self.model}"):
            from nbs_pin.base.records import Run
            from nbs_pin.base.versions import versions
            from nbs_pin.cli import comparing as comparison

            model = comparison.model_of(self.model)
            robot = self._arm(model)
            region = self._region(robot)
            run = None if self.along is None else Run.load(self.along)
        folder = folder_for(self.out, "compare", robot.name)
        facts = {"settings": self._settings(robot.source), "versions": versions(), "robot_sha256": robot.sha256}
        check_folder(folder, comparison.FILES, facts, self.force, whose="another comparison")
        with made(folder):
            result = comparison.compare_models(
                model,
                robot,
                samples=self.samples,
                **region,
                seed=self.seed,
                joints=None if self.joints is None else self._pair(robot.nv),
                run=run,
                trajectories=self.trajectories,
                frequency=self.frequency,
                progress=True,
            )
            title = f"{Path(self.model).name} against {robot.name}"
            with notes.status(f"drawing the page into {folder}"):
                figures = comparison.write_results(result, robot, folder, facts, title)
        _print(console, title, figures)
        for name in comparison.FILES:
            console.print(str(folder / name), soft_wrap=True, highlight=False, markup=False)

    def _arm(self, model: Any) -> Any:
        """The true arm; raises OptionError when neither the file nor the options name one."""
        from nbs_pin.robots.robot import load_robot

        if self.against is not None:
            return load_robot(self.against)
        if model.robot is None or not self.model.endswith(SAVED):
            raise OptionError(f"'{self.model}' does not say what to compare with; give --against ROBOT, the true arm.")
        return model.robot

    def _region(self, robot: Any) -> dict[str, Any]:
        """Where to compare: the box of the data, or the arm's."""
        if self.data is None:
            return {"speed": 2.0 if self.speed is None else self.speed}
        from nbs_pin.identification.datasets import load_dataset

        data = load_dataset(self.data)
        if data.nv != robot.nv:
            raise OptionError(f"--data '{self.data}' has {data.nv} joints and {robot.name} {robot.nv}; give its own.")
        lower, upper, fastest = data.q.min(axis=0), data.q.max(axis=0), abs(data.v).max(axis=0)
        return {"box": (lower, upper), "speed": fastest if self.speed is None else self.speed}

    def _pair(self, nv: int) -> tuple[int, int]:
        """The joints of the maps, counted from 0."""
        first, second = (int(part) for part in str(self.joints).split(","))
        if first == second or max(first, second) > nv:
            raise OptionError(f"--joints is '{self.joints}'; give two different ones of 1 to {nv}.")
        return first - 1, second - 1

    def _settings(self, robot: str) -> dict[str, Any]:
        """Everything that decides the figures, as JSON can store it."""
        settings = dataclasses.asdict(self) | {"against": robot}
        for name in ("out", "force"):
            del settings[name]
        for name in ("model", "data", "along"):
            path = Path(str(settings[name]))
            settings[name] = None if settings[name] is None else str(settings[name])
            if path.is_file():
                settings[f"{name}_sha256"] = hashlib.sha256(path.read_bytes()).hexdigest()
        return settings


def _print(console: Console, title: str, figures: dict[str, Any]) -> None:
    """Errors over the box and along the run side by side, then what counts for the whole model."""
    table = Table(title=Text(title), box=box.SIMPLE_HEAD, title_justify="left", title_style="bold")
    table.add_column("relative error of")
    along = figures["along_run"]
    for heading in ("box", *([] if along is None else ["closed loop"])):
        table.add_column(heading, justify="right", no_wrap=True)
    names = {"mass_matrix": "M", "coriolis": "C v", "gravity": "G", "inverse": "torque", "forward": "acceleration"}
    for key, name in names.items():
        values = (figures["relative_error"], *([] if along is None else [along]))
        table.add_row(name, *(_number(of[key]) for of in values))
    console.print(table)
    low, high = figures["mass_ratio"]
    for line in (
        f"torque nMSE {_number(figures['torque_nmse'])}; least eigenvalue of the model's M "
        f"{_number(figures['eigenvalue_margin_kgm2'])} kg·m²; {_number(low)} M ≤ model's M ≤ {_number(high)} M",
        f"torque × {figures['scale_factor']:.6g} fits best, and leaves a relative error of "
        f"{_number(figures['scale_error'])}",
        f"free motion: true energy drifts by {_number(figures['energy_drift'])} of the kinetic energy "
        f"(integrator alone {_number(figures['energy_drift_floor'])})",
        *_mismatch_lines(figures),
    ):
        console.print(line, highlight=False, markup=False, soft_wrap=True)


def _mismatch_lines(figures: dict[str, Any]) -> list[str]:
    found = figures["mismatch"]
    if found is None:
        return [" ".join(figures["no_closed_loop_because"].split())]
    constants = (_number(found[name]) for name in ("a_Nm_per_rad", "b_Nms_per_rad", "c_Nm"))
    bound = "closed loop: ‖δ‖ ≤ {} ‖q‖ + {} ‖v‖ + {} N·m".format(*constants)
    if found["violation_chance"] >= 1.0:
        return [f"{bound} on this run; {found['trajectories']} starts say nothing of further ones"]
    return [
        f"{bound} on {found['trajectories']} starts; a further one breaks it with a chance of at most "
        f"{found['violation_chance']:.2%}, confidence 1 − {found['doubt']:g} (probabilistic, for starts drawn alike)"
    ]


def _number(value: float | None) -> str:
    return "not finite" if value is None else f"{value:.3g}"
