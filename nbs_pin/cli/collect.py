"""`nbs-pin collect`: motions of an arm in MuJoCo, to learn its dynamics from."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from nbs_pin.cli.values import default, integer, number


@dataclass(frozen=True)
class Collect:
    """Collect motions of an arm in MuJoCo to learn from, and write data.npz, coverage.png and summary.json.

    Learn from the result: nbs-pin learn out/collect-panda/data.npz

    Example: nbs-pin collect panda --samples 3000 --encoder-bits 16 --torque-noise 0.5
    """

    robot: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="ROBOT")]
    """An arm by name (see nbs-pin robots) or a path to a .urdf or .xacro file."""
    recipe: Literal["excited", "reference", "passive", "uniform"] = "excited"
    """Random sums of sines in torque about a soft PD; tracking of sinusoids; one swing without torque from zero, as in
    the paper, which cannot tell the scale of the torque; or independent states at random, which no real arm gives."""
    samples: Annotated[int, integer("--samples", least=1, most=10_000_000)] = 10_000
    """How many samples."""
    sampling: Annotated[
        float | None, number("--sampling", least=0.001, most=10.0, unit="s"), default("0.01 to 0.05, passive 0.001")
    ] = None
    """Time between samples, a whole number of milliseconds [s]."""
    duration: Annotated[float, number("--duration", above=0.0, most=1000.0, unit="s")] = 3.0
    """Length of a trajectory [s]; passive and uniform have none."""
    speed: Annotated[float, number("--speed", above=0.0, most=100.0, unit="rad/s")] = 2.0
    """About how fast the joints move; peaks stay near their velocity limits [rad/s]."""
    friction: bool = False
    """Let the joint friction of the URDF act."""
    differentiated: bool = False
    """Take accelerations from the velocities, not from the simulator."""
    encoder_bits: Annotated[int | None, integer("--encoder-bits", least=4, most=40), default("exact")] = None
    """Round positions to 2^-BITS of a turn, and differentiate them for velocity and acceleration."""
    torque_noise: Annotated[float, number("--torque-noise", least=0.0, most=1e9, unit="N·m")] = 0.0
    """Standard deviation of noise on the torque [N·m]."""
    seed: Annotated[int, integer("--seed", most=2**31 - 1)] = 0
    """Of everything random."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR"), default("out/collect-ROBOT")] = None
    """Folder for the results."""
    force: bool = False
    """Replace other data in that folder."""
