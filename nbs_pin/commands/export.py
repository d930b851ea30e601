"""`nbs-pin export`: a law as C for a controller without Python."""

import math
from pathlib import Path
from typing import Any

from rich.console import Console

from nbs_pin.base.summaries import SUMMARY, summary_text
from nbs_pin.certificates.certify import certify
from nbs_pin.cli.export import Export
from nbs_pin.cli.values import SAVED, OptionError, plain_numbers
from nbs_pin.commands.inputs import law_of
from nbs_pin.commands.results import Results
from nbs_pin.controllers.controller import Controller
from nbs_pin.controllers.lyapunov_law import LyapunovLaw
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.robots.robot import Robot, load_robot
from nbs_pin.storage.checkpoints import load


def run(options: Export, console: Console, notes: Console) -> None:
    """Export, write and print; raises NbsPinError or OSError."""
    with notes.status(f"loading {options.controller}"):
        controller = _controller(options)
    model: Any = getattr(controller, "dynamics", controller)
    robot: Robot | None = model.robot
    name = Path(options.controller).stem if robot is None else robot.name
    results = Results.of(options, name, robot).check((SUMMARY,), options.force, whose="another law")
    with results.made() as folder:
        with notes.status("certifying"):
            certificate = _certificate(options, controller)
        with notes.status(f"writing into {folder}"):
            header = controller.export(
                folder,
                precision=options.precision,
                gravity=not options.without_gravity,
                rate_limit=options.rate_limit or math.inf,
                period=options.period,
                certificate=certificate,
            )
            (folder / SUMMARY).write_text(summary_text(results.facts), encoding="utf-8")
    results.show(console, (header.name, f"{header.stem}.c", "README.md"))


def _controller(options: Export) -> Controller:
    """The controller in a .nbs file, or the law built for an arm."""
    name = options.controller
    if name.endswith(SAVED):
        if options.feed_friction:
            raise OptionError(f"--feed-friction is for a law built here, and '{name}' holds one; omit it.")
        options.arm.refuse_without_arm(f"'{name}' names its arm; omit it")
        stored = load(name)
        if not isinstance(stored, Controller):
            raise OptionError(f"'{name}' contains a {type(stored).__name__}, a model; give a file with a controller.")
        return stored
    robot = load_robot(name, **options.arm.given())
    friction = JointFriction.of(robot) if options.feed_friction else None
    if options.feed_friction and friction is None:
        raise OptionError(f"--feed-friction was given, but the description of {robot.name} states none; omit it.")
    settings = {"bandwidth": options.bandwidth, "period": options.period, "seed": options.seed, "friction": friction}
    return law_of(options.law, robot, **settings)


def _certificate(options: Export, controller: Controller) -> Any:
    """The certificate whose bounds the header states, or None."""
    if options.disturbance is None:
        return None
    if not isinstance(controller, LyapunovLaw):
        raise OptionError(
            f"--disturbance is for a law with a Lyapunov function, and the law is {type(controller).__name__}; omit it."
        )
    torques = plain_numbers(options.disturbance) or []
    return certify(controller, torques * controller.nv if len(torques) == 1 else torques)
