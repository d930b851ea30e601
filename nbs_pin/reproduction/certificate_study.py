"""Certificates against an adversary: how loose the bounds are, and a violation of the paper's."""

import tempfile
from collections.abc import Iterator, Sequence
from itertools import groupby, product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from nbs_pin.base.plain import plain
from nbs_pin.base.progress import tracked
from nbs_pin.certificates.admissible import Admissible
from nbs_pin.certificates.attack import attack, random_disturbances, worst_of
from nbs_pin.certificates.certify import certify
from nbs_pin.controllers.damping import Damping
from nbs_pin.controllers.neural_backstepping import NeuralBackstepping
from nbs_pin.controllers.potential import Potential
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.motions.references import Hold
from nbs_pin.reports.markdown import Section, markdown_table, short
from nbs_pin.reports.plotting import ACTUAL, ERROR, LIMIT, picture
from nbs_pin.reproduction import certificate_poses
from nbs_pin.reproduction.study import write_records
from nbs_pin.robots.robot import Robot, load_robot

FILES = ("certificates.csv", "certificates.png", certificate_poses.FILE)
"""What `reproduce_certificates` writes."""
TORQUE = 5.0
"""Bound on the disturbance of every joint of an arm [N·m]."""
_BATCH = 250
_ONE_JOINT = (
    '<robot name="one_joint"><link name="base"/><link name="rotor"><inertial><mass value="1"/>'
    '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>'
    '<joint name="joint1" type="revolute"><parent link="base"/><child link="rotor"/><axis xyz="0 0 1"/>'
    '<limit lower="-3" upper="3" effort="100" velocity="10"/></joint></robot>\n'
)


class Scale(NamedTuple):
    """How much of everything; the defaults take some minutes on two cores."""

    arms: Sequence[str] = ("two_link", "ur5", "panda")
    moduli: Sequence[float] = (0.25, 0.5, 1.0, 2.0)
    """μ = 2S [N·m/rad] of the laws for one joint."""
    dampings: Sequence[float] = (0.5, 1.0, 2.0)
    """D [N·m·s/rad] of the laws for one joint."""
    random: int = 1_000
    """Random disturbances for every law of an arm and for the first of the laws for one joint."""
    family: int = 100
    """Random disturbances for every other law for one joint."""
    longest: int = 1_500
    """Largest number of periods of a random disturbance."""
    rounds: int = 8
    """Rounds of ascent of the adversary."""
    duration: float | None = None
    """Duration of the adversary's motions [s]; None takes that of `attack`."""
    fine: tuple[float, float] = (28.0, 0.002)
    """Duration and control period of the motion that breaks the paper's bound [s]."""
    poses: certificate_poses.Scale = certificate_poses.Scale()


QUICK = Scale(
    arms=("two_link",),
    moduli=(1.0,),
    dampings=(1.0,),
    random=50,
    family=20,
    longest=300,
    rounds=2,
    poses=certificate_poses.Scale(("two_link", "panda"), samples=2_000, climbs=6),
)
"""To see the page in a minute; its figures are not those of the study."""


class Row(NamedTuple):
    """One law, its bound and the worst errors found."""

    arm: str
    law: str
    disturbance_Nm: float
    """Bound on the disturbance of every joint."""
    label: str
    certified_rad: float
    """Bound of ‖z1‖."""
    printed_rad: float
    """Bound that the paper's Theorem 3 prints."""
    found_rad: float
    """The worst ‖z1‖ of adversary and random disturbances."""
    ratio: float
    """Certified ÷ found."""
    random_rad: float
    """The worst ‖z1‖ of the random disturbances."""
    tried: int
    """Number of random disturbances."""
    violations: int
    """Motions in which ‖z1‖ or some |z1_i| exceeded its bound, those of the adversary included."""


class Case(NamedTuple):
    """A law to be certified and attacked, with its bound on every joint [N·m] and its control period [s]."""

    arm: str
    law: str
    controller: NeuralBackstepping
    torque: float
    period: float
    random: int
    """Random disturbances to try."""


def reproduce_certificates(
    folder: Path, seed: int = 0, progress: bool = False, scale: Scale | None = None
) -> Iterator[Section]:
    """Run the study, write `FILES` into the folder and yield the sections of the page, each once it is done."""
    scale = scale or Scale()
    cases = [*one_joint_cases(scale, seed), *arm_cases(scale, seed)]
    rows: list[Row] = []
    for case in tracked(cases, lambda: f"certificates: {cases[min(len(rows), len(cases) - 1)].law}", progress):
        rows.append(held(case, scale, seed))
    yield _section(rows, scale, seed, folder)
    yield _counterexample(scale)
    poses = certificate_poses.study(scale.poses, seed, progress)
    yield certificate_poses.section(poses, scale.poses, folder)


def one_joint() -> Robot:
    """An arm of one joint with M = 1 kg·m² and without gravity torque."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "one_joint.urdf"
        path.write_text(_ONE_JOINT)
        return load_robot(path)


def constant_damping(robot: Robot, modulus: float, damping: float, *, quiet: bool, seed: int = 0) -> NeuralBackstepping:
    """A law as the paper's: Λ = I, S = ½μI, D = dI + TᵀT; quiet: with ψ = 0 and T = 0, which makes it linear."""
    n = robot.nv
    potential = Potential(0.5 * modulus * np.eye(n), seed=seed)
    law = NeuralBackstepping(PinocchioDynamics(robot), potential, Damping(n, floor=damping * np.eye(n), seed=seed + 1))
    if quiet:
        with torch.no_grad():
            for part in (law.potential.network, law.damping.diagonal, law.damping.lower):
                for parameter in part.parameters():
                    parameter.zero_()
    return law


def one_joint_cases(scale: Scale, seed: int) -> Iterator[Case]:
    """The one-joint family, linear and with fresh networks."""
    robot = one_joint()
    for quiet, modulus, damping in product((True, False), scale.moduli, scale.dampings):
        law = constant_damping(robot, modulus, damping, quiet=quiet, seed=seed)
        name = f"μ = {modulus:g}, D = {damping:g}{'' if quiet else ', networks'}"
        is_first = (modulus, damping) == (scale.moduli[0], scale.dampings[0])
        yield Case("one joint", name, law, 0.1, 0.005, scale.random if is_first else scale.family)


def arm_cases(scale: Scale, seed: int) -> Iterator[Case]:
    """Laws shaped by the inertia and laws with constant D, of every arm."""
    for name in scale.arms:
        robot = load_robot(name)
        for bandwidth in (8.0, 20.0):
            law = NeuralBackstepping.for_robot(robot, bandwidth=bandwidth, seed=seed)
            yield Case(name, f"inertia-shaped, ω = {bandwidth:g}", law, TORQUE, 0.001, scale.random)
        law = constant_damping(robot, 8.0, 4.0, quiet=False, seed=seed)
        yield Case(name, "constant D = 4, μ = 8", law, TORQUE, 0.001, scale.random)


def held(case: Case, scale: Scale, seed: int) -> Row:
    """The certificate of one law, against the adversary and random disturbances."""
    law, n, period = case.controller, case.controller.nv, case.period
    admissible = Admissible.of(np.full(n, case.torque), n)
    certificate = certify(law, admissible, period=period)
    motion: dict[str, Any] = {"reference": Hold(np.zeros(1)) if n == 1 else None, "period": period, "seed": seed}
    worst = attack(law, admissible, rounds=scale.rounds, duration=scale.duration, **motion)
    steps = min(worst.disturbance.shape[0], scale.longest)
    rng, errors, joints = np.random.default_rng((seed, n)), [np.array([worst.error])], [worst.joint_errors[None]]
    for first in range(0, case.random, _BATCH):
        torques = random_disturbances(admissible, steps, period, min(_BATCH, case.random - first), rng)
        peaks = worst_of(law, torques, **motion)
        errors.append(peaks.error)
        joints.append(peaks.joint_errors)
    error = np.concatenate(errors)
    broken = (error > certificate.error) | (np.concatenate(joints) > certificate.joint_errors).any(axis=1)
    found = float(error.max())
    return Row(
        *(case.arm, case.law, case.torque, str(certificate.label)),
        *(certificate.error, certificate.printed_error, found, certificate.error / found),
        *(float(error[1:].max(initial=0.0)), case.random, int(broken.sum())),
    )


def _section(rows: Sequence[Row], scale: Scale, seed: int, folder: Path) -> Section:
    """Tables and picture of all laws, with their files in the folder."""
    figures = write_records(folder / FILES[0], rows)
    _draw(rows, folder / FILES[1])
    head = ["", "certified [rad]", "paper prints", "worst found", "certified ÷ found", "worst random", "violations"]
    tables = "\n\n".join(
        f"**{arm}, up to {torque:g} N·m on every joint**\n\n{markdown_table(head, list(map(_cells, group)))}"
        for (arm, torque), group in groupby(rows, key=lambda row: (row.arm, row.disturbance_Nm))
    )
    broken, proved = sum(row.violations for row in rows), all(row.label == "PROVED" for row in rows)
    printed = [f"{row.arm}, {row.law}" for row in rows if row.printed_rad < row.found_rad]
    text = f"""
Bounds of ‖z1‖ that `certify` gives{", every one PROVED" if proved else ""}, beside the worst that was found from
z1 = z2 = 0: by the adversary (`attack`, {scale.rounds} rounds, on the arm's own reference and in seven postures) and in
{scale.random} random admissible disturbances ({scale.family} for most laws of one joint) of every kind: constant,
square waves, steps, switching, sines, sums of them, filtered noise. Control at 1 ms (one joint: 5 ms) with half a
period of look-ahead, no effort limits, seed {seed}. A violation is a motion in which ‖z1‖ or any |z1_i| exceeded its
bound: {f"{broken} motions" if broken else "no motion"} of {sum(row.tried + 1 for row in rows)}.

{tables}

The bound that the paper's Theorem 3 prints was exceeded by {"; ".join(printed) or "no law"}.

![Certified, printed and found](certificates.png)"""
    return Section("Certificates against an adversary", text, {"certificates": figures})


def _cells(row: Row) -> list[str]:
    numbers = [short(x) for x in (row.certified_rad, row.printed_rad, row.found_rad)]
    return [row.law, *numbers, f"{row.ratio:.2f}", short(row.random_rad), f"{row.violations} of {row.tried + 1}"]


def _counterexample(scale: Scale) -> Section:
    """One joint on which Theorem 3 as printed fails."""
    law = constant_damping(one_joint(), 0.5, 0.5, quiet=True)
    # The loop is linear: one disturbance that climbs becomes the exact worst case at once.
    d, (duration, period) = 0.01, scale.fine
    found = attack(law, [np.sqrt(d)], reference=Hold(np.zeros(1)), duration=duration, period=period, rounds=2, starts=1)
    certificate = certify(law, [np.sqrt(d)])
    gradient, error = (0.5 * found.error) ** 2 / d, found.error**2 / d
    certified = certificate.error**2 / d
    text = f"""
One joint, M = 1, G = 0, S = ¼, D = ½, ψ = 0 and T = 0 (docs/theory.md §5). The paper's Theorem 3 prints
limsup ‖∇Φ‖² ≤ ½ d and so z1² ≤ 2 d. Under the switching torque that the adversary finds ({found.found_by}),
**‖∇Φ‖² reaches {gradient:.3f} d and z1² {error:.3f} d**. `certify` gives z1² ≤ {certified:.3f} d."""
    figures = {"gradient_squared_over_d": gradient, "error_squared_over_d": error, "certified_over_d": certified}
    return Section("One joint breaks the printed bound", text, {"counterexample": plain(figures)})


def _draw(rows: Sequence[Row], path: Path) -> None:
    """A bar per law: certified ÷ found, with the printed bound and the worst random error ÷ found."""
    lines, found = np.arange(len(rows)), [row.found_rad for row in rows]
    certified, printed, random = np.array([(r.certified_rad, r.printed_rad, r.random_rad) for r in rows]).T / found
    with picture(path, 8.5, 1.3 + 0.24 * len(rows)) as figure:
        axes = figure.add_subplot()
        axes.barh(lines, certified, height=0.62, color="#d5d9de", label="certified")
        axes.plot(printed, lines, "|", color=ERROR, ms=9, mew=1.8, label="printed in the paper")
        axes.plot(random, lines, "o", color=ACTUAL, ms=4, label="worst random disturbance")
        for y, right in enumerate(np.maximum(certified, printed)):
            axes.annotate(f"{rows[y].ratio:.2f}", (right, y), xytext=(4, 0), textcoords="offset points", va="center",
                          fontsize=7.5, color="#4a5562")  # fmt: skip
        axes.axvline(1.0, color=LIMIT, linewidth=0.9, linestyle=(0, (5, 3)))
        axes.set_yticks(lines, [f"{row.arm}, {row.law}" for row in rows])
        axes.set(xlabel="÷ worst ‖z1‖ found", ylim=(len(rows) - 0.4, -0.6), xlim=(0.0, None))
        axes.grid(False, axis="y")
        figure.legend(*axes.get_legend_handles_labels(), loc="outside upper right", ncols=3, frameon=False)
