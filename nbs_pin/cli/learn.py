"""`nbs-pin learn`: a model of an arm from its data, and how well it explains motions that it never saw."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from nbs_pin.cli.values import choice, default, integer, number
from nbs_pin.identification.registry import MODELS


@dataclass(frozen=True)
class Learn:
    """Learn a model of an arm from data, and write model.nbs, summary.json and learning.png.

    Ctrl-C ends the fit of a network early and keeps the best. Hold the result against Pinocchio with
    nbs-pin compare out/learn-panda/model.nbs

    Example: nbs-pin learn out/collect-panda/data.npz --model chain --friction
    """

    data: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DATA")]
    """Data of nbs-pin collect, or a log: CSV or NPZ with t, q, tau and, if there are any, v and a."""
    model: Annotated[str, choice("--model", MODELS)] = "chain"
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
