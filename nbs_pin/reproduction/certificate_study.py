"""Certificates against an adversary: how loose the bounds are, whether any is broken, and the paper's that is."""

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from nbs_pin.base.csv_files import write_csv
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
from nbs_pin.robots.robot import Robot, load_robot

FILES = ("certificates.csv", "certificates.png", certificate_poses.FILE)
"""What `reproduce_certificates` writes."""
ARMS = ("two_link", "ur5", "panda")
TORQUE = 5.0
"""Bound on the disturbance of every joint of an arm [N·m]."""
MODULI, DAMPINGS = (0.25, 0.5, 1.0, 2.0), (0.5, 1.0, 2.0)
"""μ = 2S [N·m/rad] and D [N·m·s/rad] of the laws for one joint."""
_BATCH = 250
_ONE_JOINT = (
    '<robot name="one_joint"><link name="base"/><link name="rotor"><inertial><mass value="1"/>'
    '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>'
    '<joint name="joint1" type="revolute"><parent link="base"/><child link="rotor"/><axis xyz="0 0 1"/>'
    '<limit lower="-3" upper="3" effort="100" velocity="10"/></joint></robot>\n'
)


@dataclass(frozen=True)
class Scale:
    """How much of everything."""

    arms: Sequence[str] = ARMS
    moduli: Sequence[float] = MODULI
    dampings: Sequence[float] = DAMPINGS
    random: int = 1_000
    """Random disturbances for every arm's laws and for the first of the laws for one joint."""
    family: int = 100
    """For every other law for one joint."""
    longest: int = 1_500
    """Periods of a random one, at most."""
    rounds: int = 8
    """Of ascent."""
    duration: float | None = None
    """Of the adversary's motions [s]; None takes what the law asks for."""
    fine: tuple[float, float] = (28.0, 0.002)
    """Duration and control period of the motion that breaks the paper's bound [s]."""
    poses: certificate_poses.Scale = field(default_factory=certificate_poses.Scale)


class Row(NamedTuple):
    """One law, its bound and what was tried against it."""

    arm: str
    law: str
    disturbance_Nm: float
    """Bound on every joint."""
    label: str
    certified_rad: float
    """Bound of ‖z1‖."""
    printed_rad: float
    """What the paper's Theorem 3 prints."""
    found_rad: float
    """The worst ‖z1‖ of adversary and random disturbances."""
    ratio: float
    """certified ÷ found."""
    random_rad: float
    """The worst of the random disturbances."""
    tried: int
    """Random disturbances."""
    violations: int
    """Motions in which ‖z1‖ or some |z1_i| exceeded its bound, the adversary's among them."""


class Case(NamedTuple):
    """A law to be certified and attacked."""

    arm: str
    law: str
    controller: NeuralBackstepping
    torque: float
    """Bound on every joint [N·m]."""
    period: float
    """[s]."""
    random: int
    """Random disturbances to try."""


def reproduce_certificates(
    folder: Path, seed: int = 0, progress: bool = False, scale: Scale | None = None
) -> list[Section]:
    """Runs everything, writes `FILES` into the folder and returns the sections of the page.

    seed: of networks, disturbances and poses. scale: None takes `Scale()`, some minutes on two cores.
    Raises OSError when a file cannot be written and KeyboardInterrupt on Ctrl-C.
    """
    scale = scale or Scale()
    cases = [*one_joint_cases(scale, seed), *arm_cases(scale, seed)]
    rows: list[Row] = []
    for case in tracked(cases, lambda: f"certificates: {cases[min(len(rows), len(cases) - 1)].law}", progress):
        rows.append(held(case, scale, seed))
    poses = certificate_poses.study(scale.poses, seed, progress)
    write_csv(folder / FILES[0], Row._fields, rows)
    _draw(rows, folder / FILES[1])
    certificate_poses.write(poses, folder)
    return [_section(rows, scale, seed), _counterexample(scale), certificate_poses.section(poses, scale.poses)]


def one_joint() -> Robot:
    """An arm of one joint with M = 1 kg·m² and without gravity torque."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "one_joint.urdf"
        path.write_text(_ONE_JOINT)
        return load_robot(path)


def constant_damping(robot: Robot, modulus: float, damping: float, *, quiet: bool, seed: int = 0) -> NeuralBackstepping:
    """The paper's kind of law: Λ = I, S = ½μI, D = dI + TᵀT; quiet: with ψ = 0 and T = 0, which makes it linear."""
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
    controller, n = case.controller, case.controller.nv
    admissible = Admissible.of(np.full(n, case.torque), n)
    certificate = certify(controller, admissible, period=case.period)
    reference = Hold(np.zeros(1)) if n == 1 else None
    worst = attack(
        controller,
        admissible,
        reference=reference,
        period=case.period,
        rounds=scale.rounds,
        seed=seed,
        duration=scale.duration,
    )
    steps = min(worst.disturbance.shape[0], scale.longest)
    rng, errors, joints = np.random.default_rng((seed, n)), [], []
    for first in range(0, case.random, _BATCH):
        count = min(_BATCH, case.random - first)
        torques = random_disturbances(admissible, steps, case.period, count, rng)
        peaks = worst_of(controller, torques, reference, period=case.period, seed=seed)
        errors.append(peaks.error)
        joints.append(peaks.joint_errors)
    error = np.concatenate([[worst.error], *errors])
    joint = np.concatenate([worst.joint_errors[None], *joints])
    broken = (error > certificate.error) | (joint > certificate.joint_errors).any(axis=1)
    return Row(
        case.arm,
        case.law,
        case.torque,
        str(certificate.label),
        certificate.error,
        certificate.printed_error,
        float(error.max()),
        certificate.error / float(error.max()),
        float(error[1:].max(initial=0.0)),
        case.random,
        int(broken.sum()),
    )


def _section(rows: Sequence[Row], scale: Scale, seed: int) -> Section:
    head = ["", "certified [rad]", "paper prints", "worst found", "certified ÷ found", "worst random", "violations"]
    tables = []
    for arm in dict.fromkeys(row.arm for row in rows):
        table = markdown_table(head, [_cells(row) for row in rows if row.arm == arm])
        torque = next(row.disturbance_Nm for row in rows if row.arm == arm)
        tables.append(f"**{arm}, up to {torque:g} N·m on every joint**\n\n{table}")
    broken, proved = sum(row.violations for row in rows), all(row.label == "PROVED" for row in rows)
    printed = [f"{row.arm}, {row.law}" for row in rows if row.printed_rad < row.found_rad]
    kept = "no motion" if not broken else f"{broken} motions"
    joined = "\n\n".join(tables)
    text = f"""
Bounds of ‖z1‖ that `certify` gives{", every one PROVED" if proved else ""}, beside the worst that was found from
z1 = z2 = 0: by the adversary (`attack`, {scale.rounds} rounds, on the arm's own reference and in seven postures) and in
{scale.random} random admissible disturbances ({scale.family} for most laws of one joint) of every kind: constant,
square waves, steps, switching, sines, sums of them, filtered noise. Control at 1 ms (one joint: 5 ms) with half a
period of look-ahead, no effort limits, seed {seed}. A violation is a motion in which ‖z1‖ or any |z1_i| exceeded its
bound: {kept} of {sum(row.tried + 1 for row in rows)}.

{joined}

The bound that the paper's Theorem 3 prints was exceeded by {"no law" if not printed else "; ".join(printed)}.

![Certified, printed and found](certificates.png)"""
    return Section("Certificates against an adversary", text, {"certificates": plain([row._asdict() for row in rows])})


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
    """A line per law: certified ÷ found, with the printed bound and the worst random one in the same measure."""
    with picture(path, 8.5, 1.3 + 0.24 * len(rows)) as figure:
        axes = figure.add_subplot()
        for y, row in enumerate(rows):
            axes.barh(y, row.ratio, height=0.62, color="#d5d9de")
            axes.plot(row.printed_rad / row.found_rad, y, "|", color=ERROR, markersize=9, markeredgewidth=1.8)
            axes.plot(row.random_rad / row.found_rad, y, "o", color=ACTUAL, markersize=4)
            beside = (max(row.ratio, row.printed_rad / row.found_rad), y)
            axes.annotate(f"{row.ratio:.2f}", beside, xytext=(4, 0), textcoords="offset points", va="center",
                          fontsize=7.5, color="#4a5562")  # fmt: skip
        axes.axvline(1.0, color=LIMIT, linewidth=0.9, linestyle=(0, (5, 3)))
        axes.set_yticks(range(len(rows)), [f"{row.arm}, {row.law}" for row in rows])
        axes.set(xlabel="÷ worst ‖z1‖ found", ylim=(len(rows) - 0.4, -0.6), xlim=(0.0, None))
        axes.grid(False, axis="y")
        axes.barh(np.nan, 0.0, color="#d5d9de", label="certified")
        axes.plot([], [], "|", color=ERROR, markersize=9, markeredgewidth=1.8, label="printed in the paper")
        axes.plot([], [], "o", color=ACTUAL, markersize=4, label="worst random disturbance")
        figure.legend(*axes.get_legend_handles_labels(), loc="outside upper right", ncols=3, frameon=False)
