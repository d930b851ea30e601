"""`nbs-pin excite`: a motion along which the parameters of an arm are identified well."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from nbs_pin.cli.arm import ArmOptions, OfArm
from nbs_pin.cli.reported import Reported
from nbs_pin.cli.values import Verbose, default, integer, number


@dataclass(frozen=True)
class Excite(Reported):
    """Find a motion that excites an arm well, within its limits and clear of itself; print its condition number.

    Write motion.csv for the controller, excitation.png and summary.json. Ctrl-C keeps the best motion so far.
    Record the arm along it, then: nbs-pin learn log.csv --robot ROBOT --model identified

    Example: nbs-pin excite panda --duration 15 --band 0.8
    """

    robot: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="ROBOT")]
    """An arm by name (see nbs-pin robots) or a path to a .urdf, .xacro or MJCF file."""
    duration: Annotated[float, number("--duration", above=0.0, most=1000.0, unit="s")] = 10.0
    """Length of the motion, the period of its lowest frequency [s]."""
    band: Annotated[float, number("--band", above=0.0, most=100.0, unit="Hz")] = 1.0
    """Highest frequency, below the elastic modes of the arm [Hz]; --duration times --band is 2 to 50."""
    share: Annotated[float, number("--share", above=0.0, most=1.0, unit="")] = 0.8
    """Largest share of position ranges and of limits of velocity, acceleration and torque that the motion uses."""
    acceleration: Annotated[
        float | None, number("--acceleration", above=0.0, most=1e6, unit="rad/s²"), default("none")
    ] = None
    """Acceleration limit of every joint [rad/s²]; without it torque, velocity and band limit it."""
    clearance: Annotated[float, number("--clearance", least=0.0, most=10.0, unit="m")] = 0.01
    """Least distance between bodies of the arm that no joint connects, as convex hulls [m]."""
    no_clearance: bool = False
    """Do not compare bodies. Surroundings are never known."""
    no_friction: bool = False
    """Joint friction is not to be identified."""
    no_offset: bool = False
    """Constant torques of the sensors are not to be identified."""
    no_rotor_inertia: bool = False
    """Rotor inertias are not to be identified."""
    starts: Annotated[int, integer("--starts", least=1, most=10_000)] = 24
    """Random starts of the search; more take longer and may find better."""
    period: Annotated[float, number("--period", least=1e-5, most=1.0, unit="s")] = 0.001
    """Time from row to row of motion.csv [s]."""
    seed: Annotated[int, integer("--seed", most=2**31 - 1)] = 0
    """Seed of the starts."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR"), default("out/excite-ROBOT")] = None
    """Folder for the results."""
    force: bool = False
    """Overwrite another motion in that folder."""
    verbose: Verbose = False
    """Also print the tables; summary.json always has every number."""
    arm: OfArm = field(default_factory=ArmOptions)
    """How the arm is read."""
