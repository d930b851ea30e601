"""`nbs-pin learn`: a model of an arm from data, and its error on held-out motions."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from nbs_pin.cli.arm import ArmOptions, OfArm
from nbs_pin.cli.log_options import LogOptions, whole_numbers
from nbs_pin.cli.reported import Reported
from nbs_pin.cli.values import Verbose, choice, couplings, default, integer, number, several_of
from nbs_pin.identification.registry import MODELS


@dataclass(frozen=True)
class Learn(LogOptions, Reported):
    """Learn a model of an arm from data, and write model.nbs, summary.json and learning.png.

    Ctrl-C ends the fit of a network early and keeps the best iteration. Compare the result with Pinocchio's model:
    nbs-pin compare out/learn-panda/model.nbs

    Example: nbs-pin learn out/collect-panda/data.npz --model chain
    """

    data: Annotated[tuple[Path, ...], tyro.conf.Positional, several_of("DATA")]
    """Data of nbs-pin collect, or logs with t, q, tau and optionally v and a; see nbs-pin log."""
    model: Annotated[str, choice("--model", MODELS)] = "chain"
    """chain: a rigid tree, from the order of the joints alone. cholesky: M = LLᵀ + εI by a network.
    homogenised: a convex network made quadratic. picnn: the paper's convex network.
    unconstrained: a Lagrangian without structure. residual: a network that corrects the arm's URDF.
    identified: inertias by least squares, in the geometry of the URDF."""
    robot: Annotated[str | None, tyro.conf.arg(metavar="ROBOT"), default("the one named in the data")] = None
    """The arm by name or a path to a .urdf, .xacro or MJCF file; a log does not name it."""
    friction: Literal["auto", "on", "off"] = "auto"
    """Friction to learn: auto is what the data show of every joint, from none to Coulomb, viscous, asymmetric, Stribeck
    and load-dependent friction; on is viscous and Coulomb friction of every joint."""
    offset: Literal["auto", "on", "off"] = "auto"
    """Constant torques to learn, as of a sensor that is not zero at rest."""
    rotors: Literal["auto", "on", "off"] = "auto"
    """Rotor inertias to learn; networks without a URDF have them in M."""
    coupling: Annotated[str, couplings("--coupling")] = "auto"
    """Motors that turn with several joints: 6.5=1 where motor 6 also turns with joint 5; auto looks for such neighbours
    if the arm is known, off is none."""
    transition: Annotated[float, number("--transition", above=0.0, most=10.0, unit="rad/s")] = 0.01
    """Speed within which Coulomb friction changes its sign [rad/s]."""
    held_out: Annotated[float, number("--held-out", least=0.0, most=0.9, unit="")] = 0.2
    """Share of the trajectories, or of one long recording, to hold out; it selects the iteration of a network."""
    held_out_trajectories: Annotated[
        str | None, whole_numbers("--held-out-trajectories"), default("some of that share")
    ] = None
    """Numbers of the trajectories to hold out."""
    loss: Literal["torque", "acceleration"] = "torque"
    """Quantity whose error a network minimises."""
    optimiser: Annotated[
        Literal["lm", "adam", "lbfgs"] | None,
        tyro.conf.arg(metavar="{lm,adam,lbfgs}"),
        default("lm, lbfgs for more than 3500 parameters"),
    ] = None
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
