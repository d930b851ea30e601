"""`nbs-pin run`: move an arm in real time behind the guard; write run, summary, figure and replay."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from nbs_pin.cli.followed import Followed
from nbs_pin.cli.loaded_arm import LoadedArmOptions, OfLoadedArm
from nbs_pin.cli.reported import Reported
from nbs_pin.cli.tool_options import OfTool, ToolOptions
from nbs_pin.cli.values import SAVED, OptionError, choice, default, number, text
from nbs_pin.controllers.registry import LAWS

KINDS = ("mujoco", "libfranka", "ur")
"""Kinds of arms; all but the first have an address."""


def _read_arm(words: list[str]) -> str:
    kind, stated, host = words[0].partition(":")
    if kind not in KINDS or (kind == "mujoco") != (not stated) or (stated and not host):
        raise OptionError(f"--arm is '{words[0]}'; give mujoco, libfranka:HOST or ur:HOST.")
    return words[0]


@dataclass(frozen=True)
class Run(Followed, Reported):
    """Move an arm in real time behind the guard, a monitor and no safety function; from where it is, to the motion.

    Example: nbs-pin run panda --arm mujoco --duration 10
    """

    robot: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="ROBOT")]
    """An arm by name (see nbs-pin robots) or a path to a .urdf, .xacro or MJCF file."""
    at: Annotated[str, tyro.conf.arg(name="arm"), text("ARM", _read_arm)] = "mujoco"
    """What to move: mujoco (a simulation in real time), libfranka:HOST, or ur:HOST (not tested on hardware)."""
    controller: Annotated[str, choice("--controller", LAWS, SAVED)] = "nbs"
    """A law by name, or a .nbs file with a controller and its gains."""
    rate: Annotated[float, number("--rate", least=10.0, most=10_000.0, unit="Hz")] = 1000.0
    """Rate of the loop [Hz]; a Franka arm has 1000, a UR arm 500."""
    bandwidth: Annotated[float, number("--bandwidth", above=0.0, most=10_000.0, unit="rad/s")] = 8.0
    """Rate at which errors decay [rad/s]; unused by .nbs files."""
    certified: Annotated[
        float | None, number("--certified", above=0.0, most=1e9, unit="N·m"), default("0.5 rad for every joint")
    ] = None
    """Stop where an error passes the certified bound for disturbances up to this on every joint [N·m]."""
    external_limit: Annotated[
        float | None, number("--external-limit", above=0.0, most=1e9, unit="N·m"), default("none")
    ] = None
    """Stop where a torque from outside passes this on any joint [N·m], as the arm tells it or its momentum shows."""
    live: bool = False
    """Show the arm in the browser meanwhile, on this machine only."""
    priority: bool = True
    """A real-time priority is asked for, where the system grants it, unless --no-priority is given."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR"), default("out/run-ROBOT")] = None
    """Folder for the results."""
    force: bool = False
    """Overwrite the results of another run in that folder."""
    tool: OfTool = field(default_factory=ToolOptions)
    """How a path of the tool is followed."""
    arm: OfLoadedArm = field(default_factory=LoadedArmOptions)
    """How the arm is read."""
