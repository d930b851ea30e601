"""`nbs-pin collect`: motions of an arm in MuJoCo, as data for learning its dynamics."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from nbs_pin.cli.arm import ArmOptions, OfArm
from nbs_pin.cli.reported import Reported
from nbs_pin.cli.values import Verbose, default, integer, number


@dataclass(frozen=True)
class Collect(Reported):
    """Record motions of an arm in MuJoCo for learning its dynamics; write data.npz, coverage.png and summary.json.

    Learn from the result: nbs-pin learn out/collect-panda/data.npz

    Example: nbs-pin collect panda --samples 3000 --encoder-bits 16 --torque-noise 0.5
    """

    robot: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="ROBOT")]
    """An arm by name (see nbs-pin robots) or a path to a .urdf, .xacro or MJCF file."""
    recipe: Literal["excited", "reference", "passive", "uniform"] = "excited"
    """excited: random multisine torques about a soft PD. reference: tracking of --reference, or of sinusoids.
    passive: one swing without torque from q = 0, as in the paper; it does not determine the scale of the torque.
    uniform: independent random states, which no real arm provides."""
    samples: Annotated[int, integer("--samples", least=1, most=10_000_000)] = 10_000
    """Number of samples."""
    sampling: Annotated[
        float | None, number("--sampling", least=0.001, most=10.0, unit="s"), default("0.01 to 0.05, passive 0.001")
    ] = None
    """Sampling time, a whole number of milliseconds [s]."""
    duration: Annotated[
        float | None, number("--duration", above=0.0, most=1000.0, unit="s"), default("3, or the reference's")
    ] = None
    """Length of an excited or reference trajectory [s]."""
    reference: Annotated[Path | None, tyro.conf.arg(metavar="FILE"), default("random sinusoids")] = None
    """Motion that --recipe reference follows, a .csv or .npz file as nbs-pin excite writes it."""
    speed: Annotated[float, number("--speed", above=0.0, most=100.0, unit="rad/s")] = 2.0
    """Typical joint speed; peaks stay near the velocity limits [rad/s]."""
    friction: bool = False
    """Simulate the joint friction of the URDF."""
    differentiated: bool = False
    """Differentiate velocities for the accelerations instead of taking the simulator's."""
    encoder_bits: Annotated[int | None, integer("--encoder-bits", least=4, most=40), default("exact")] = None
    """Round positions to 2^-BITS of a turn, and differentiate them for velocities and accelerations."""
    torque_noise: Annotated[float, number("--torque-noise", least=0.0, most=1e9, unit="N·m")] = 0.0
    """Standard deviation of the torque noise [N·m]."""
    seed: Annotated[int, integer("--seed", most=2**31 - 1)] = 0
    """Seed of everything random."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR"), default("out/collect-ROBOT")] = None
    """Folder for the results."""
    force: bool = False
    """Overwrite other data in that folder."""
    verbose: Verbose = False
    """Also print the tables; summary.json always has every number."""
    arm: OfArm = field(default_factory=ArmOptions)
    """How the arm is read."""
