"""`nbs-pin train`: train a controller through the closed loop, and compare before and after on fresh starts."""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from nbs_pin.cli.arm import ArmOptions, OfArm
from nbs_pin.cli.reported import Reported
from nbs_pin.cli.values import SAVED, Verbose, choice, default, integer, number, positive_list
from nbs_pin.controllers.registry import LAWS


@dataclass(frozen=True)
class Train(Reported):
    """Train a controller through the closed loop, and write controller.nbs, summary.json and learning.png.

    Ctrl-C stops early and keeps the best epoch; --resume continues from there. Track with the result:
    nbs-pin track panda --controller out/train-panda/controller.nbs

    Example: nbs-pin train panda --epochs 200 --out out/panda
    """

    robot: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="ROBOT")]
    """An arm by name (see nbs-pin robots) or a path to a .urdf, .xacro or MJCF file."""
    controller: Annotated[str, choice("--controller", LAWS, SAVED)] = "nbs"
    """The law to start from, by name, or a .nbs file with a controller."""
    frequencies: Annotated[str, positive_list("--frequencies", most=1000.0, unit="rad/s")] = "0.5,1,2"
    """Frequencies of the sinusoids to follow [rad/s], separated by commas."""
    starts: Annotated[int, integer("--starts", least=1, most=100_000)] = 32
    """Training starts, divided among the frequencies; a quarter as many are held out to select the epoch."""
    start_error: Annotated[float, number("--start-error", above=0.0, most=math.pi, unit="rad")] = 0.3
    """Largest initial error of every joint, at rest [rad]."""
    duration: Annotated[float, number("--duration", above=0.0, most=1000.0, unit="s")] = 1.0
    """Length of the training motions, a whole number of periods [s]."""
    period: Annotated[float, number("--period", least=1e-4, most=0.1, unit="s")] = 0.005
    """Control period [s]."""
    epochs: Annotated[int, integer("--epochs", least=1, most=1_000_000)] = 80
    """Number of optimiser steps."""
    cost: Literal["torque-aware", "squared-error", "time-outside"] = "torque-aware"
    """Cost to minimise. torque-aware: error, its rate, and torque above the limits. squared-error: as in the paper.
    time-outside: time spent 0.1 rad or more away from the reference."""
    optimiser: Literal["adam-backtracking", "adam", "lbfgs"] = "adam-backtracking"
    """adam-backtracking: Adam that steps back and halves its step when the cost rises.
    adam: with the step halved after every fifth of the epochs, as in the paper. lbfgs: with line search."""
    learning_rate: Annotated[
        float | None, number("--learning-rate", above=0.0, most=100.0, unit=""), default("0.01, lbfgs 1")
    ] = None
    """Step size of the optimiser."""
    patience: Annotated[int | None, integer("--patience", least=1, most=1_000_000), default("all epochs")] = None
    """Stop after this many epochs without a lower held-out cost."""
    fixed_gains: bool = False
    """Train the networks only and keep every gain."""
    bandwidth: Annotated[float, number("--bandwidth", above=0.0, most=10_000.0, unit="rad/s")] = 8.0
    """Rate at which errors decay before training [rad/s]."""
    effort_limit: Annotated[
        float | None, number("--effort-limit", above=0.0, most=1e9, unit="N·m"), default("the arm's")
    ] = None
    """Effort limit of every joint that --limits does not name [N·m]."""
    no_effort_limit: bool = False
    """Do not limit the torques."""
    seed: Annotated[int, integer("--seed", most=2**31 - 1)] = 0
    """Seed of network weights and starts."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR"), default("out/train-ROBOT")] = None
    """Folder for the results."""
    resume: bool = False
    """Continue the training in that folder as if it had not been stopped."""
    force: bool = False
    """Overwrite the results of another training in that folder."""
    verbose: Verbose = False
    """Also print the tables; summary.json always has every number."""
    arm: OfArm = field(default_factory=ArmOptions)
    """How the arm is read."""
