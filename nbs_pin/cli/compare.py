"""`nbs-pin compare`: errors of a model of an arm against Pinocchio's."""

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro
from tyro.constructors import PrimitiveConstructorSpec

from nbs_pin.cli.arm import ArmOptions, OfArm
from nbs_pin.cli.reported import Reported
from nbs_pin.cli.values import OptionError, Verbose, default, integer, number, text


def joint_pair() -> PrimitiveConstructorSpec[str]:
    """A tyro parser of two joint numbers, such as 2,4; raises OptionError for any other text."""

    def parse(words: list[str]) -> str:
        parts = words[0].split(",")
        if len(parts) != 2 or not all(re.fullmatch(r"[1-9][0-9]{0,8}", part) for part in parts):
            raise OptionError(f"--joints is '{words[0]}'; give two joints by number, counted from 1: --joints 2,4.")
        return words[0]

    return text("I,J", parse)


@dataclass(frozen=True)
class Compare(Reported):
    """Compare a model of an arm with Pinocchio's, and write errors.png, errors.csv and summary.json.

    They show the errors of M, C v, G, torque and acceleration over a box of states, their growth with speed and outside
    the box, the eigenvalues of M, energy in free motion, the scale of the torque, and the mismatch along a closed loop
    with its bound.

    Example: nbs-pin compare out/learn-panda/model.nbs --samples 5000 --out out/errors
    """

    model: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="MODEL")]
    """A .nbs file with a model, or with a controller that has one; or an arm by name or path, to compare two URDFs."""
    against: Annotated[str | None, tyro.conf.arg(metavar="ROBOT"), default("the model's own arm")] = None
    """The true arm, by name or a path to a .urdf, .xacro or MJCF file."""
    samples: Annotated[int, integer("--samples", least=2, most=1_000_000)] = 2_000
    """Number of uniformly distributed states."""
    speed: Annotated[
        float | None, number("--speed", above=0.0, most=1000.0, unit="rad/s"), default("2, or the data's")
    ] = None
    """Largest speed of every joint [rad/s]."""
    data: Annotated[Path | None, tyro.conf.arg(metavar="DATA.npz"), default("the position limits")] = None
    """Compare in the box of positions and speeds that these data of nbs-pin collect span."""
    joints: Annotated[str | None, joint_pair(), default("where the error varies most")] = None
    """Joints over which the error maps are drawn, counted from 1."""
    trajectories: Annotated[int, integer("--trajectories", most=100_000)] = 374
    """Random starts of the closed loop; with 374 the bound holds for 95 % of further ones, 0 omits it."""
    frequency: Annotated[float, number("--frequency", above=0.0, most=1000.0, unit="rad/s")] = 1.0
    """Frequency of the sinusoid that the closed loop follows [rad/s]."""
    along: Annotated[Path | None, tyro.conf.arg(metavar="RUN.npz"), default("a simulated one")] = None
    """Use this run of the true arm as the closed loop."""
    seed: Annotated[int, integer("--seed", most=2**31 - 1)] = 1
    """Seed of states and starts."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR"), default("out/compare-ROBOT")] = None
    """Folder for the results."""
    force: bool = False
    """Overwrite the results of another comparison in that folder."""
    verbose: Verbose = False
    """Also print the tables; summary.json always has every number."""
    arm: OfArm = field(default_factory=ArmOptions)
    """How the arm is read."""
