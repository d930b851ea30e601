"""`nbs-pin export`: a law as C for a controller without Python."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from nbs_pin.cli.arm import ArmOptions, OfArm
from nbs_pin.cli.certify import torque_bounds
from nbs_pin.cli.values import choice, default, integer, number
from nbs_pin.controllers.registry import LAWS


@dataclass(frozen=True)
class Export:
    """Write a law as C99 without heap and globals: header, source, self-test, Makefile, a ros2_control controller.

    Files and functions are called after the folder. make test in it compiles the law and compares it with Python.

    Example: nbs-pin export panda --rate-limit 999 --without-gravity --out out/panda_law
    """

    controller: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="CONTROLLER")]
    """A .nbs file with a controller, or an arm by name or path to build --law for."""
    law: Annotated[str, choice("--law", LAWS)] = "nbs"
    """The law to build for an arm; a .nbs file has its own."""
    bandwidth: Annotated[float, number("--bandwidth", above=0.0, most=10_000.0, unit="rad/s")] = 8.0
    """Rate at which errors decay, of a law built for an arm [rad/s]."""
    period: Annotated[float, number("--period", least=1e-5, most=0.1, unit="s")] = 0.001
    """Control period [s]."""
    feed_friction: bool = False
    """Feed the joint friction of the description forward in a law built for an arm."""
    precision: Literal["double", "float"] = "double"
    """The type of numbers in C."""
    rate_limit: Annotated[float | None, number("--rate-limit", above=0.0, most=1e9, unit="N·m/s"), default("none")] = (
        None
    )
    """Largest change of every torque per second [N·m/s, N/s]; a Franka arm takes 1000."""
    without_gravity: bool = False
    """Leave G(q) out, for an arm that adds it itself, as Franka's do."""
    disturbance: Annotated[str | None, torque_bounds(), default("no certificate")] = None
    """Certify for this largest |τ_d,i| [N·m] in continuous time, as nbs-pin certify does, and state the bounds in the
    header: one number for all joints, or one per joint, separated by commas."""
    seed: Annotated[int, integer("--seed", most=2**31 - 1)] = 0
    """Seed of network weights of a law built for an arm."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR"), default("out/export-ROBOT")] = None
    """Folder for the files, after which they are called."""
    force: bool = False
    """Overwrite another law in that folder."""
    arm: OfArm = field(default_factory=ArmOptions)
    """How the arm is read."""
