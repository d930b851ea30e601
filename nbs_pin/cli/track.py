"""`nbs-pin track`: simulate an arm that follows a motion; write run, summary, figure and replay."""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from nbs_pin.cli.followed import Followed
from nbs_pin.cli.loaded_arm import LoadedArmOptions, OfLoadedArm
from nbs_pin.cli.reported import Reported
from nbs_pin.cli.tool_options import OfTool, ToolOptions
from nbs_pin.cli.values import (
    SAVED,
    Verbose,
    choice,
    choices,
    configuration,
    default,
    disturbance_text,
    integer,
    number,
)
from nbs_pin.controllers.registry import LAWS
from nbs_pin.simulation.registry import INTEGRATOR_NAMES, PLANTS


@dataclass(frozen=True)
class Track(Followed, Reported):
    """Simulate an arm that follows a motion, and write run.npz, summary.json, tracking.png and replay.html.

    With several laws, write a run of each, comparison.png and summary.json. Ctrl-C keeps what was simulated.

    Example: nbs-pin track panda --start-error 0.3 --disturbance square:5@8 --out out/panda
    """

    robot: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="ROBOT")]
    """An arm by name (see nbs-pin robots) or a path to a .urdf, .xacro or MJCF file."""
    plant: Annotated[str, choice("--plant", PLANTS)] = "mujoco"
    """Simulator of the arm."""
    controller: Annotated[str, choices("--controller", LAWS, SAVED)] = "nbs"
    """A law by name, or a .nbs file with a controller and its gains; several, separated by commas, are compared.
    nbs-paper: the paper's controller on two_link, its networks with gains for the arm on any other.
    adaptive: nbs with a model that learns a load at the arm's end, friction and rotor inertia while it moves; writes
    estimates.png, too. --payload 2@5 gives it something to learn."""
    period: Annotated[float, number("--period", least=1e-5, most=0.1, unit="s")] = 0.001
    """Control period [s]."""
    bandwidth: Annotated[float, number("--bandwidth", above=0.0, most=10_000.0, unit="rad/s")] = 8.0
    """Rate at which errors decay [rad/s]; unused by nbs-paper on two_link and by .nbs files."""
    start_error: Annotated[float, number("--start-error", least=0.0, most=math.pi, unit="rad")] = 0.0
    """Initial error of every joint, with alternating sign, at rest [rad]; 0 starts on the motion."""
    start: Annotated[str | None, configuration("--start"), default("on the motion")] = None
    """Configuration to start from at rest [rad], one number per joint: --start=-0.1,0.2."""
    disturbance: Annotated[str, disturbance_text()] = "none"
    """Torque on every joint [N·m]: none, constant:5, square:5@8, sine:5@8 (@ rad/s) or noise:0.5 (standard deviation).
    A comma-separated list has one per joint: constant:5,5,3."""
    joint_friction: Literal["drop", "keep"] = "drop"
    """Joint friction of the URDF: not simulated, or simulated and fed forward by every law with a model."""
    joint_stops: Literal["drop", "keep"] = "drop"
    """Position limits of the joints: not simulated, or stops at which they are held (mujoco)."""
    effort_limit: Annotated[
        float | None, number("--effort-limit", above=0.0, most=1e9, unit="N·m"), default("the arm's")
    ] = None
    """Effort limit of every joint that --limits does not name [N·m]."""
    no_effort_limit: bool = False
    """Do not limit the torques."""
    integrator: Annotated[str | None, choice("--integrator", INTEGRATOR_NAMES), default("the plant's usual one")] = None
    """Integrator of the plant. mujoco: rk4, euler (semi-implicit), implicitfast.
    pinocchio: rk4, euler (explicit), semi_implicit_euler."""
    plant_step: Annotated[
        float | None, number("--plant-step", least=1e-6, most=0.1, unit="s"), default("at most 0.001")
    ] = None
    """Step of the plant, a whole fraction of the period [s]."""
    lookahead: Annotated[
        float | None, number("--lookahead", least=0.0, most=0.1, unit="s"), default("half a period")
    ] = None
    """How far ahead of the measured state the law is evaluated [s]; 0 is the plain sampled law."""
    seed: Annotated[int, integer("--seed", most=2**31 - 1)] = 0
    """Seed of network weights and noise."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR"), default("out/track-ROBOT")] = None
    """Folder for the results."""
    force: bool = False
    """Overwrite the results of another run in that folder."""
    verbose: Verbose = False
    """Also print the tables; summary.json always has every number."""
    tool: OfTool = field(default_factory=ToolOptions)
    """How a path of the tool is followed."""
    arm: OfLoadedArm = field(default_factory=LoadedArmOptions)
    """How the arm is read."""
