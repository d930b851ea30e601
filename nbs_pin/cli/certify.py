"""`nbs-pin certify`: what a controller promises before the arm moves, and the worst that an adversary finds."""

import dataclasses
import hashlib
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console
from tyro.constructors import PrimitiveConstructorSpec

from nbs_pin.cli.certificate_tables import print_certificate
from nbs_pin.cli.folders import check_folder, default, folder_for, made
from nbs_pin.cli.values import SAVED, OptionError, integer, number, plain_numbers, positive_list


def torque_bounds() -> PrimitiveConstructorSpec[str]:
    """The text of torques ≥ 0 split by commas for tyro, read by `plain_numbers`; raises OptionError for any other."""

    def parse(words: list[str]) -> str:
        values = plain_numbers(words[0])
        if values is None or not all(0.0 <= value <= 1e6 for value in values):
            raise OptionError(
                f"--disturbance is '{words[0]}'; give the largest torque of every joint, or one for each split by "
                "commas, from 0 to 1e6 N·m: --disturbance 5,5,3."
            )
        return words[0]

    return _text("D1,D2,…", parse)


def friction_text() -> PrimitiveConstructorSpec[str]:
    """The text urdf, or VISCOUS,COULOMB, for tyro; raises OptionError for any other."""

    def parse(words: list[str]) -> str:
        values = plain_numbers(words[0])
        usable = values is not None and len(values) == 2 and all(0.0 <= value <= 1e6 for value in values)
        if words[0] != "urdf" and not usable:
            raise OptionError(
                f"--friction is '{words[0]}'; give urdf, or the viscous and the Coulomb coefficient of every joint, "
                "N·m·s/rad and N·m: --friction 0.5,1."
            )
        return words[0]

    return _text("urdf|B,C", parse)


def _text(metavar: str, parse: Any) -> PrimitiveConstructorSpec[str]:
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=metavar,
        instance_from_str=parse,
        is_instance=lambda value: True,
        str_from_instance=lambda value: [value or ""],
    )


@dataclass(frozen=True)
class Certify:
    """Certify a controller: how far the arm can stray under any disturbance that is bounded, and how that is known.

    Prints every constant, condition and bound with its label PROVED, VERIFIED, PROBABILISTIC or EMPIRICAL; writes
    certificate.png, run.npz (the worst motion found) and summary.json. --wanted turns it round: gains and a control
    period that certify an error, written to controller.nbs.

    Example: nbs-pin certify panda --disturbance 5 --attack
    """

    controller: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="CONTROLLER")]
    """A .nbs file with a controller; or an arm by name or path, for the one that `for_robot` makes for it."""
    disturbance: Annotated[str | None, torque_bounds(), default("none beside the loads")] = None
    """Largest |τ_d,i| [N·m]: of every joint, or one for each joint, split by commas."""
    norm: bool = False
    """Take the number of --disturbance as the largest ‖τ_d‖ instead."""
    payload: Annotated[float | None, number("--payload", above=0.0, most=1e4, unit="kg"), default("none")] = None
    """A mass that the model knows nothing of [kg], as a disturbance along the reference."""
    link: Annotated[str | None, tyro.conf.arg(metavar="LINK"), default("the arm's end")] = None
    """The link that carries it."""
    friction: Annotated[str | None, friction_text(), default("none")] = None
    """Joint friction that nothing feeds forward, as a disturbance: urdf, or viscous and Coulomb coefficients."""
    gravity_error: Annotated[
        float | None, number("--gravity-error", above=0.0, most=100.0, unit="m/s²"), default("none")
    ] = None
    """How far gravity may differ from the model's, as a vector [m/s²]; a base tilted by α: 2·9.81·sin(α/2)."""
    margin: Annotated[float | None, number("--margin", least=1.0, most=100.0, unit=""), default("1.5")] = None
    """What the torques of payload, friction and gravity on the reference are multiplied with."""
    reference: Annotated[str, tyro.conf.arg(metavar="MOTION")] = "sinusoid"
    """sinusoid (fitted to the arm), paper, or a .csv or .npz file; the loads count along it."""
    frequency: Annotated[float, number("--frequency", above=0.0, most=1000.0, unit="rad/s")] = 1.0
    """Of the sinusoid [rad/s]."""
    start_error: Annotated[float, number("--start-error", least=0.0, most=math.pi, unit="rad")] = 0.0
    """Bound the error from a start at rest this far off, joints in turn up and down [rad]."""
    period: Annotated[
        float | None, number("--period", least=1e-5, most=0.1, unit="s"), default("0.001; with --wanted the longest")
    ] = None
    """Control period [s]."""
    bandwidth: Annotated[float, number("--bandwidth", above=0.0, most=10_000.0, unit="rad/s")] = 8.0
    """Rate ω of the controller made for an arm [rad/s]."""
    wanted: Annotated[str | None, positive_list("--wanted", most=10.0, unit="rad"), default("no design")] = None
    """Design a controller for the arm that certifies this ‖z1‖, or one |z1_i| for each joint, split by commas [rad]."""
    against: Annotated[str | None, tyro.conf.arg(metavar="ROBOT"), default("the model's own arm")] = None
    """The true arm; a model that is not exact is judged on closed loops with it (Theorem 4)."""
    trajectories: Annotated[int | None, integer("--trajectories", least=1, most=100_000), default("374")] = None
    """Closed loops that such a model is judged on; 374 make the bound on its error hold for 95 % of further ones."""
    attack: bool = False
    """Search the worst disturbance by gradients through the closed loop, and not by waves alone."""
    monitor: Annotated[Path | None, tyro.conf.arg(metavar="RUN.npz"), default("none")] = None
    """Hold this run against the certificate, and write monitor.png."""
    seed: Annotated[int, integer("--seed", most=2**31 - 1)] = 0
    """Of network weights, starts and disturbances."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR"), default("out/certify-ROBOT")] = None
    """Folder for the results."""
    force: bool = False
    """Replace the results of another certificate in that folder."""

    def run(self, console: Console, notes: Console) -> None:
        """Certifies, writes and prints; raises NbsPinError and OSError."""
        if self.wanted is not None and self.controller.endswith(SAVED):
            raise OptionError(f"--wanted designs a controller for an arm, and '{self.controller}' is one; give an arm.")
        with notes.status(f"loading {self.controller}"):
            from nbs_pin.base.records import Run
            from nbs_pin.base.versions import versions
            from nbs_pin.cli import certifying

            controller = self._controller()
            task = self._task(controller)
            robot = certifying.arm_of(controller, task)
            run = None if self.monitor is None else Run.load(self.monitor)
        folder = folder_for(self.out, "certify", robot.name)
        facts = {"settings": self._settings(robot.source), "versions": versions(), "robot_sha256": robot.sha256}
        names = (*certifying.FILES, certifying.MONITOR, certifying.DESIGNED)
        check_folder(folder, names, facts, self.force, whose="another certificate")
        with made(folder):
            proposal = None
            if self.wanted is not None:
                wanted = plain_numbers(self.wanted) or []
                error = wanted[0] if len(wanted) == 1 else wanted
                proposal = certifying.design(robot, task, error, period=self.period)
                controller, task = proposal.controller, dataclasses.replace(task, period=proposal.period)
            result = certifying.certify_controller(
                controller, task, thorough=self.attack, run=run, proposal=proposal, progress=True
            )
            with notes.status(f"drawing the picture into {folder}"):
                figures, written = certifying.write_results(result, folder, facts)
        law = Path(self.controller).name if self.controller.endswith(SAVED) else "a law made for it"
        print_certificate(console, f"{robot.name}, {law}", figures)
        for path in written:
            console.print(str(path), soft_wrap=True, highlight=False, markup=False)

    def _controller(self) -> Any:
        """The one to certify; with --wanted one whose arm counts alone."""
        from nbs_pin.cli.certifying import controller_of

        return controller_of(self.controller, bandwidth=self.bandwidth, period=self.period or 0.001, seed=self.seed)

    def _task(self, controller: Any) -> Any:
        """Where and against what to certify; raises OptionError for options that do not fit each other."""
        from nbs_pin.certificates.loads import MARGIN
        from nbs_pin.certificates.model_structure import is_exact
        from nbs_pin.cli.certifying import TRAJECTORIES, Task, arm_of, box_or_ball
        from nbs_pin.motions.by_name import motion_of
        from nbs_pin.robots.robot import load_robot

        self._check_options()
        period = self.period or 0.001
        truth = None if self.against is None else load_robot(self.against)
        blank = Task(reference=_no_motion, truth=truth)
        robot = arm_of(controller, blank)
        if self.trajectories is not None and is_exact(controller.dynamics, robot):
            raise OptionError(
                f"--trajectories is about a model that is not exact, and this one is that of {robot.name} itself; "
                "leave it out, or give the true arm with --against."
            )
        motion, duration = motion_of(self.reference, robot, frequency=self.frequency, period=period)
        coefficients = None if self.friction in (None, "urdf") else plain_numbers(str(self.friction)) or []
        numbers = None if self.disturbance is None else plain_numbers(self.disturbance) or []
        return dataclasses.replace(
            blank,
            reference=motion,
            duration=duration,
            period=period,
            disturbance=None if numbers is None else box_or_ball(numbers, robot.nv, norm=self.norm),
            payload=self.payload,
            link=self.link,
            friction=self.friction if coefficients is None else (coefficients[0], coefficients[1]),
            gravity_error=self.gravity_error,
            margin=MARGIN if self.margin is None else self.margin,
            start_error=self.start_error,
            trajectories=self.trajectories or TRAJECTORIES,
            seed=self.seed,
        )

    def _check_options(self) -> None:
        """Raises OptionError for options about others that were not given."""
        loads = {"--payload": self.payload, "--friction": self.friction, "--gravity-error": self.gravity_error}
        if self.norm and self.disturbance is None:
            raise OptionError("--norm is about --disturbance; give that too.")
        if self.link is not None and self.payload is None:
            raise OptionError("--link is about --payload; give that too.")
        if self.margin is not None and all(load is None for load in loads.values()):
            raise OptionError(f"--margin is about {', '.join(loads)}; give one of them too.")

    def _settings(self, robot: str) -> dict[str, Any]:
        """Everything that decides the figures, as JSON can store it."""
        settings = dataclasses.asdict(self) | {"against": robot}
        for name in ("out", "force"):
            del settings[name]
        for name in ("controller", "monitor", "reference"):
            path = Path(str(settings[name]))
            settings[name] = None if settings[name] is None else str(settings[name])
            if path.is_file():
                settings[f"{name}_sha256"] = hashlib.sha256(path.read_bytes()).hexdigest()
        return settings


def _no_motion(t: Any) -> Any:
    raise OptionError("no reference was chosen; give --reference.")
