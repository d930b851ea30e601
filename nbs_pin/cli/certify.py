"""`nbs-pin certify`: bounds of the tracking error before the arm moves, and the worst motion that a search finds."""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro
from tyro.constructors import PrimitiveConstructorSpec

from nbs_pin.cli.arm import ArmOptions, OfArm
from nbs_pin.cli.file_units import FileUnits
from nbs_pin.cli.reported import Reported
from nbs_pin.cli.tool_options import OfTool, ToolOptions
from nbs_pin.cli.values import (
    OptionError,
    Verbose,
    choice,
    default,
    integer,
    number,
    percentage,
    plain_numbers,
    positive_list,
    text,
)
from nbs_pin.controllers.registry import LAWS


def torque_bounds() -> PrimitiveConstructorSpec[str]:
    """A tyro parser of comma-separated torques ≥ 0, kept as text for `plain_numbers`; raises OptionError for others."""

    def parse(words: list[str]) -> str:
        values = plain_numbers(words[0])
        if values is None or not all(0.0 <= value <= 1e6 for value in values):
            raise OptionError(
                f"--disturbance is '{words[0]}'; give the largest torque, one for all joints or one per joint, "
                "separated by commas, from 0 to 1e6 N·m, or N where it slides: --disturbance 5,5,3."
            )
        return words[0]

    return text("D1,D2,…", parse)


def friction_text() -> PrimitiveConstructorSpec[str]:
    """A tyro parser of the text VISCOUS,COULOMB; raises OptionError for any other."""

    def parse(words: list[str]) -> str:
        values = plain_numbers(words[0])
        usable = values is not None and len(values) == 2 and all(0.0 <= value <= 1e6 for value in values)
        if not usable:
            raise OptionError(
                f"--friction is '{words[0]}'; give the viscous and the Coulomb coefficient of all joints, N·m·s/rad "
                "and N·m, or N·s/m and N where it slides: --friction 0.5,1."
            )
        return words[0]

    return text("B,C", parse)


@dataclass(frozen=True)
class Certify(FileUnits, Reported):
    """Certify a controller: bound its tracking error under any bounded disturbance, and say how each bound is known.

    Print the bound of the error with its label PROVED, VERIFIED, PROBABILISTIC or EMPIRICAL, with -v every constant and
    condition, too, and write certificate.png, run.npz (the worst motion found) and summary.json. The exit code is 3 if
    nothing is promised. With --json, also write certificate.json, which
    nbs-pin verify checks again. With --wanted, also design gains and a control
    period that certify an error, and write controller.nbs.

    Example: nbs-pin certify panda --disturbance 5 --attack
    """

    controller: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="CONTROLLER")]
    """A .nbs file with a controller, or an arm by name or path to build --law for."""
    law: Annotated[str, choice("--law", LAWS)] = "nbs"
    """The law to build for an arm; a .nbs file has its own. The bound of adaptive is for every load that it may learn,
    beside what the law with a fixed model does."""
    disturbance: Annotated[str | None, torque_bounds(), default("none besides the loads")] = None
    """Largest |τ_d,i| [N·m]: one number for all joints, or one per joint, separated by commas."""
    norm: bool = False
    """Take the number of --disturbance as the largest ‖τ_d‖ [N·m]."""
    unknown_payload: Annotated[
        float | None, number("--unknown-payload", above=0.0, most=1e4, unit="kg"), default("none")
    ] = None
    """Mass that the model does not include, unlike --payload [kg], as a disturbance along the reference; of a law that
    adapts, the largest that it may learn, by default all that it can."""
    payload_radius: Annotated[
        float | None, number("--payload-radius", least=0.0, most=100.0, unit="m"), default("all that it can learn")
    ] = None
    """For a law that adapts: all of that load lies within this distance of the frame that carries it [m]."""
    link: Annotated[str | None, tyro.conf.arg(metavar="LINK"), default("the arm's end")] = None
    """Link that carries the payload; of a law that adapts, the load."""
    inertia_within: Annotated[float | None, percentage("--inertia-within", below=100.0), default("the model's own")] = (
        None
    )
    """Certify for every arm with masses, centres of mass and inertias within this share of the model's, as in 5%."""
    friction: Annotated[str | None, friction_text(), default("the URDF's")] = None
    """Joint friction of the arm, viscous and Coulomb [N·m·s/rad, N·m]; what the law does not feed forward counts."""
    feed_friction: bool = False
    """Feed that friction forward in a law built for an arm."""
    gravity_error: Annotated[
        float | None, number("--gravity-error", above=0.0, most=100.0, unit="m/s²"), default("none")
    ] = None
    """Largest error of the gravity vector [m/s²]; a base tilted by α has 2·9.81·sin(α/2)."""
    margin: Annotated[float | None, number("--margin", least=1.0, most=100.0, unit=""), default("1.5")] = None
    """Factor on the torques of payload and gravity error along the reference."""
    reference: Annotated[str, tyro.conf.arg(metavar="MOTION")] = "sinusoid"
    """Motion for loads and limits: sinusoid (fitted to the arm), paper, a .csv or .npz file, or a path of the tool, as
    in nbs-pin track."""
    frequency: Annotated[float, number("--frequency", above=0.0, most=1000.0, unit="rad/s")] = 1.0
    """Frequency of the sinusoid [rad/s]."""
    start_error: Annotated[float, number("--start-error", least=0.0, most=math.pi, unit="rad")] = 0.0
    """Bound the overshoot from a start at rest with this error of every joint, of alternating sign [rad]."""
    period: Annotated[
        float | None, number("--period", least=1e-5, most=0.1, unit="s"), default("0.001; the longest for --wanted")
    ] = None
    """Control period, for which every torque is held [s]."""
    delay: Annotated[float, number("--delay", least=0.0, most=0.1, unit="s")] = 0.0
    """From the reading of a state to the beginning of the hold of its torque [s], at most a period; the search for the
    worst motion acts at once."""
    encoder_bits: Annotated[int | None, integer("--encoder-bits", least=1, most=64), default("exact states")] = None
    """Bits per turn of the encoders; velocities are then differences of readings over a period. The search for the
    worst motion reads exactly."""
    bandwidth: Annotated[float, number("--bandwidth", above=0.0, most=10_000.0, unit="rad/s")] = 8.0
    """Rate ω of a law built for an arm [rad/s]."""
    wanted: Annotated[str | None, positive_list("--wanted", most=10.0, unit="rad"), default("no design")] = None
    """Design a controller that certifies this ‖z1‖, or one |z1_i| per joint, separated by commas [rad]."""
    against: Annotated[str | None, tyro.conf.arg(metavar="ROBOT"), default("the model's own arm")] = None
    """The true arm; the error of an inexact model is bounded on closed loops with it (Theorem 4)."""
    trajectories: Annotated[int | None, integer("--trajectories", least=1, most=100_000), default("374")] = None
    """Closed loops that bound the error of an inexact model; with 374 the bound holds for 95 % of further ones."""
    json: bool = False
    """Write certificate.json, with every number behind the bounds, for nbs-pin verify."""
    attack: bool = False
    """Search for the worst disturbance along gradients through the closed loop, not only among waves; for a law that
    adapts, for the worst load, start and disturbance in 1,000 runs, of which Ctrl-C keeps what was found."""
    monitor: Annotated[Path | None, tyro.conf.arg(metavar="RUN.npz"), default("none")] = None
    """Check this run against the certificate, or the bound of a law that adapts; write monitor.png and monitor.csv."""
    seed: Annotated[int, integer("--seed", most=2**31 - 1)] = 0
    """Seed of network weights, starts and disturbances."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR"), default("out/certify-ROBOT")] = None
    """Folder for the results."""
    force: bool = False
    """Overwrite the results of another certificate in that folder."""
    verbose: Verbose = False
    """Also print the tables; summary.json always has every number."""
    tool: OfTool = field(default_factory=ToolOptions)
    """How a path of the tool is followed."""
    arm: OfArm = field(default_factory=ArmOptions)
    """How the arm is read."""
