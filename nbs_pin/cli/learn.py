"""`nbs-pin learn`: a model of an arm from data, and its error on held-out motions."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from nbs_pin.cli.arm import ArmOptions, OfArm
from nbs_pin.cli.file_units import FileUnits
from nbs_pin.cli.reported import Reported
from nbs_pin.cli.values import Verbose, choice, default, integer, number
from nbs_pin.identification.registry import MODELS


@dataclass(frozen=True)
class Learn(FileUnits, Reported):
    """Learn a model of an arm from data, and write model.nbs, summary.json and learning.png.

    Ctrl-C ends the fit of a network early and keeps the best iteration. Compare the result with Pinocchio's model:
    nbs-pin compare out/learn-panda/model.nbs

    Example: nbs-pin learn out/collect-panda/data.npz --model chain --friction
    """

    data: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DATA")]
    """Data of nbs-pin collect, or a CSV or NPZ log with t, q, tau and optionally v and a."""
    model: Annotated[str, choice("--model", MODELS)] = "chain"
    """chain: a rigid tree, from the order of the joints alone. cholesky: M = LLᵀ + εI by a network.
    homogenised: a convex network made quadratic. picnn: the paper's convex network.
    unconstrained: a Lagrangian without structure. residual: a network that corrects the arm's URDF.
    identified: inertias by least squares, in the geometry of the URDF."""
    robot: Annotated[str | None, tyro.conf.arg(metavar="ROBOT"), default("the one named in the data")] = None
    """The arm by name or a path to a .urdf, .xacro or MJCF file; a log does not name it."""
    window: Annotated[float | None, number("--window", above=0.0, most=100.0, unit="s"), default("0.1")] = None
    """Width of the window in which a log without v and a is differentiated [s]."""
    resample: Annotated[float | None, number("--resample", least=1e-6, most=10.0, unit="s"), default("off")] = None
    """Interpolate a log whose rows are not evenly spaced to this step [s]."""
    friction: bool = False
    """Also learn viscous and Coulomb friction of every joint."""
    held_out: Annotated[float, number("--held-out", least=0.0, most=0.9, unit="")] = 0.2
    """Share of the trajectories to hold out; they select the iteration of a network."""
    loss: Literal["torque", "acceleration"] = "torque"
    """Quantity whose error a network minimises."""
    optimiser: Annotated[Literal["lm", "adam", "lbfgs"] | None, default("lm, lbfgs for more than 3500 parameters")] = (
        None
    )
    """Optimiser of a network: Levenberg–Marquardt, Adam, or L-BFGS after some steps of Adam."""
    iterations: Annotated[
        int | None, integer("--iterations", least=1, most=1_000_000), default("lm 30, adam 300, lbfgs 400")
    ] = None
    """Largest number of iterations."""
    seed: Annotated[int, integer("--seed", most=2**31 - 1)] = 0
    """Seed of the initial parameters and of the split."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR"), default("out/learn-ROBOT")] = None
    """Folder for the results."""
    force: bool = False
    """Overwrite another model in that folder."""
    verbose: Verbose = False
    """Also print the tables; summary.json always has every number."""
    arm: OfArm = field(default_factory=ArmOptions)
    """How the arm is read."""
