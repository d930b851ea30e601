"""`nbs-pin certify`: what a controller promises before the arm moves, and the worst that an adversary finds."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from tyro.constructors import PrimitiveConstructorSpec

from nbs_pin.cli.values import OptionError, choice, default, integer, number, plain_numbers, positive_list, text
from nbs_pin.controllers.registry import LAWS


def torque_bounds() -> PrimitiveConstructorSpec[str]:
    """The text of torques ≥ 0 split by commas for tyro, read by `plain_numbers`; raises OptionError for any other."""

    def parse(words: list[str]) -> str:
        values = plain_numbers(words[0])
        if values is None or not all(0.0 <= value <= 1e6 for value in values):
            raise OptionError(
                f"--disturbance is '{words[0]}'; give the largest torque of every joint, or one for each split by "
                "commas, from 0 to 1e6 N·m: --disturbance 5,5,3."
            )
        return words[0]

    return text("D1,D2,…", parse)


def friction_text() -> PrimitiveConstructorSpec[str]:
    """The text urdf, or VISCOUS,COULOMB, for tyro; raises OptionError for any other."""

    def parse(words: list[str]) -> str:
        values = plain_numbers(words[0])
        usable = values is not None and len(values) == 2 and all(0.0 <= value <= 1e6 for value in values)
        if words[0] != "urdf" and not usable:
            raise OptionError(
                f"--friction is '{words[0]}'; give urdf, or the viscous and the Coulomb coefficient of every joint, "
                "N·m·s/rad and N·m: --friction 0.5,1."
            )
        return words[0]

    return text("urdf|B,C", parse)


@dataclass(frozen=True)
class Certify:
    """Certify a controller: how far the arm can stray under any disturbance that is bounded, and how that is known.

    Prints every constant, condition and bound with its label PROVED, VERIFIED, PROBABILISTIC or EMPIRICAL; writes
    certificate.png, run.npz (the worst motion found) and summary.json. --wanted turns it round: gains and a control
    period that certify an error, written to controller.nbs.

    Example: nbs-pin certify panda --disturbance 5 --attack
    """

    controller: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="CONTROLLER")]
    """A .nbs file with a controller; or an arm by name or path, for the one that `for_robot` makes for it."""
    law: Annotated[str, choice("--law", LAWS)] = "nbs"
    """The law to make for an arm; a .nbs file holds its own."""
    disturbance: Annotated[str | None, torque_bounds(), default("none beside the loads")] = None
    """Largest |τ_d,i| [N·m]: of every joint, or one for each joint, split by commas."""
    norm: bool = False
    """Take the number of --disturbance as the largest ‖τ_d‖ instead."""
    payload: Annotated[float | None, number("--payload", above=0.0, most=1e4, unit="kg"), default("none")] = None
    """A mass that the model knows nothing of [kg], as a disturbance along the reference."""
    link: Annotated[str | None, tyro.conf.arg(metavar="LINK"), default("the arm's end")] = None
    """The link that carries it."""
    friction: Annotated[str | None, friction_text(), default("none")] = None
    """Joint friction that nothing feeds forward, as a disturbance: urdf, or viscous and Coulomb coefficients."""
    gravity_error: Annotated[
        float | None, number("--gravity-error", above=0.0, most=100.0, unit="m/s²"), default("none")
    ] = None
    """How far gravity may differ from the model's, as a vector [m/s²]; a base tilted by α: 2·9.81·sin(α/2)."""
    margin: Annotated[float | None, number("--margin", least=1.0, most=100.0, unit=""), default("1.5")] = None
    """What the torques of payload, friction and gravity on the reference are multiplied with."""
    reference: Annotated[str, tyro.conf.arg(metavar="MOTION")] = "sinusoid"
    """sinusoid (fitted to the arm), paper, or a .csv or .npz file; the loads count along it."""
    frequency: Annotated[float, number("--frequency", above=0.0, most=1000.0, unit="rad/s")] = 1.0
    """Of the sinusoid [rad/s]."""
    start_error: Annotated[float, number("--start-error", least=0.0, most=math.pi, unit="rad")] = 0.0
    """Bound the error from a start at rest this far off, joints in turn up and down [rad]."""
    period: Annotated[
        float | None, number("--period", least=1e-5, most=0.1, unit="s"), default("0.001; with --wanted the longest")
    ] = None
    """Control period [s]."""
    bandwidth: Annotated[float, number("--bandwidth", above=0.0, most=10_000.0, unit="rad/s")] = 8.0
    """Rate ω of the controller made for an arm [rad/s]."""
    wanted: Annotated[str | None, positive_list("--wanted", most=10.0, unit="rad"), default("no design")] = None
    """Design a controller for the arm that certifies this ‖z1‖, or one |z1_i| for each joint, split by commas [rad]."""
    against: Annotated[str | None, tyro.conf.arg(metavar="ROBOT"), default("the model's own arm")] = None
    """The true arm; a model that is not exact is judged on closed loops with it (Theorem 4)."""
    trajectories: Annotated[int | None, integer("--trajectories", least=1, most=100_000), default("374")] = None
    """Closed loops that such a model is judged on; 374 make the bound on its error hold for 95 % of further ones."""
    attack: bool = False
    """Search the worst disturbance by gradients through the closed loop, and not by waves alone."""
    monitor: Annotated[Path | None, tyro.conf.arg(metavar="RUN.npz"), default("none")] = None
    """Hold this run against the certificate, and write monitor.png."""
    seed: Annotated[int, integer("--seed", most=2**31 - 1)] = 0
    """Of network weights, starts and disturbances."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR"), default("out/certify-ROBOT")] = None
    """Folder for the results."""
    force: bool = False
    """Replace the results of another certificate in that folder."""
