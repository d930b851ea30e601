"""Control on learned models: MuJoCo with gravity, every law beside the one on the exact model; the paper's Figure 5."""

from collections.abc import Iterator, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from nbs_pin.controllers.controller import Controller
from nbs_pin.controllers.gains import gains_for_robot, pd_gains
from nbs_pin.controllers.neural_backstepping import NeuralBackstepping
from nbs_pin.controllers.pd import PD
from nbs_pin.controllers.registry import build_law
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.dynamics.provider import DynamicsProvider
from nbs_pin.identification.collect import collect
from nbs_pin.identification.fit import fit
from nbs_pin.motions.disturbances import Disturbance, TorqueNoise
from nbs_pin.motions.references import Sinusoid
from nbs_pin.reports.markdown import Section, markdown_table, short
from nbs_pin.reports.plotting import ACTUAL, ERROR, picture
from nbs_pin.reproduction import figure5, passive_data
from nbs_pin.reproduction.study import NOISE, write_records
from nbs_pin.robots.robot import Robot, load_robot
from nbs_pin.simulation import metrics
from nbs_pin.simulation.mujoco_plant import MujocoPlant
from nbs_pin.simulation.processes import on_all_cores
from nbs_pin.simulation.simulate import simulate

FILES = ("learned_loop.csv", "learned_loop.png", *figure5.FILES, passive_data.FILE)
"""What `reproduce_learned` writes."""
ARMS = ("three_link", "panda")
FREQUENCIES = (0.1, 1.0)
"""ω of the references [rad/s]."""
BANDWIDTH, PERIOD, START_ERROR = 6.0, 0.001, 0.3
"""ω of every law [rad/s], control period [s], and start error of every joint, of alternating sign [rad]."""
EXACT, CLEAN, NOISY = "NBS, exact model", "NBS, chain from clean data", "NBS, chain from noisy data"
"""The laws that differ in their model alone."""


class Scale(NamedTuple):
    """How much of everything; the defaults take some minutes on two cores."""

    samples: int = 1_500
    """Samples of excited motions for the chain from clean data; that from noisy data has twice as many."""
    settle: float = 10.0
    """Time from which errors count [s]."""
    turns: float = 1.0
    """Periods of the reference that count."""
    seeds: int = 5
    """Seeds of the networks learned without torque."""
    swing: int = 10_000
    """Samples of the paper's swing."""
    epochs: int = 200
    """Epochs of training of the law of Figure 5."""
    duration: float = 100.0
    """Duration of the runs of Figure 5 [s]."""
    learners: Sequence[passive_data.Learner] = passive_data.LEARNERS


QUICK = Scale(samples=500, settle=4.0, turns=0.2, seeds=1, swing=2_000, epochs=10, duration=20.0)
"""To see the page in a minute; its figures are not those of the study."""


class Row(NamedTuple):
    """One law on one reference."""

    arm: str
    frequency_rad_per_s: float
    law: str
    rms_error_rad: float
    """RMS of ‖z1‖ once settled."""
    ratio: float
    """Relative to NBS on the exact model."""
    rms_error_noise_rad: float | None
    """The same under torque noise of the size of the sensor's on every joint; for the NBS laws only."""
    ratio_noise: float | None
    peak_torque_Nm: float


def reproduce_learned(
    folder: Path, seed: int = 0, progress: bool = False, scale: Scale | None = None
) -> Iterator[Section]:
    """Run the study, write `FILES` into the folder and yield the sections of the page, each once it is done."""
    scale = scale or Scale()
    studied = list(on_all_cores(_on_arm, [(name, scale, seed) for name in ARMS], "control on learned models", progress))
    rows, chains = [row for _, found in studied for row in found], studied[0][0]
    yield _section(rows, scale, seed, folder)
    seeds = range(seed, seed + scale.seeds)
    passive = passive_data.learn_passively(load_robot(ARMS[0]), seeds, scale.learners, scale.swing, progress)
    yield passive_data.section(passive, folder)
    learned = {
        "a chain, excited data": chains[CLEAN],
        "cholesky, the paper's swing": passive.models["cholesky", "one swing", seed],
    }
    runs = figure5.follow_again(learned, epochs=scale.epochs, duration=scale.duration, seed=seed, progress=progress)
    yield figure5.section(runs, folder)


def _on_arm(name: str, scale: Scale, seed: int) -> tuple[dict[str, DynamicsProvider], list[Row]]:
    """The chains learned of an arm, and how laws do on it."""
    robot = load_robot(name)
    learned = learn_chains(robot, scale.samples, seed)
    return learned, follow_all(robot, learned, scale)


def learn_chains(robot: Robot, samples: int, seed: int) -> dict[str, DynamicsProvider]:
    """The chains of `CLEAN` and `NOISY`, from excited motions of the arm."""
    clean = collect(robot, samples=samples, seed=seed)
    noisy = collect(robot, samples=2 * samples, seed=seed, noise=NOISE)
    return {name: fit(data, "chain", seed, robot=robot) for name, data in ((CLEAN, clean), (NOISY, noisy))}


def laws(robot: Robot, learned: dict[str, DynamicsProvider]) -> dict[str, Controller]:
    """Every law of the table; all NBS laws have the gains and the networks of the one on the exact model."""
    truth, tuning = PinocchioDynamics(robot), {"bandwidth": BANDWIDTH, "period": PERIOD}
    gains, (kp, kd) = gains_for_robot(robot, truth, **tuning), pd_gains(robot, truth, **tuning)
    models = {EXACT: truth, **learned}
    return {
        **{name: NeuralBackstepping.for_robot(robot, model, gains=gains) for name, model in models.items()},
        "computed torque, exact model": build_law("computed-torque", robot, **tuning),
        "PD+, exact model": build_law("pd-plus", robot, **tuning),
        "PD with G, exact model": build_law("pd-gravity", robot, **tuning),
        "PD, no model": PD(figure5.Weightless(truth), feedforward="gravity", kp=kp, kd=kd),
    }


def follow_all(robot: Robot, learned: dict[str, DynamicsProvider], scale: Scale) -> list[Row]:
    """A row per reference and law."""
    rows, chosen = [], laws(robot, learned)
    noise = TorqueNoise(np.full(robot.nv, NOISE.torque), PERIOD)
    for frequency in FREQUENCIES:
        calm = {name: _followed(robot, law, frequency, scale) for name, law in chosen.items()}
        shaken = {name: _followed(robot, chosen[name], frequency, scale, noise)[0] for name in (EXACT, CLEAN, NOISY)}
        for name, (error, peak) in calm.items():
            row = Row(robot.name, frequency, name, error, error / calm[EXACT][0], None, None, peak)
            if name in shaken:
                row = row._replace(rms_error_noise_rad=shaken[name], ratio_noise=shaken[name] / shaken[EXACT])
            rows.append(row)
    return rows


def _followed(
    robot: Robot, law: Controller, frequency: float, scale: Scale, disturbance: Disturbance | None = None
) -> tuple[float, float]:
    """RMS error once settled [rad] and peak torque [N·m], in MuJoCo with gravity and the arm's effort limits."""
    reference = Sinusoid.for_robot(robot, frequency)
    duration = round(scale.settle + scale.turns * 2.0 * np.pi / frequency, 2)
    start = reference(0.0).q + START_ERROR * (-1.0) ** np.arange(robot.nv)
    run = simulate(MujocoPlant(robot), law, reference, duration, PERIOD, q0=start, disturbance=disturbance)
    return float(np.linalg.norm(metrics.rms_error(run, scale.settle))), float(metrics.peak_torque(run))


def _section(rows: Sequence[Row], scale: Scale, seed: int, folder: Path) -> Section:
    """Tables and picture of all laws, with their files in the folder."""
    figures = write_records(folder / FILES[0], rows)
    _draw(rows, folder / FILES[1])
    head = ["", "RMS ‖z1‖ [rad]", "÷ exact NBS", "under torque noise [rad]", "÷ exact NBS", "peak torque [N·m]"]
    tables = "\n\n".join(
        f"**{arm}, ω = {frequency:g} rad/s**\n\n{markdown_table(head, list(map(_cells, group)))}"
        for (arm, frequency), group in groupby(rows, key=lambda row: (row.arm, row.frequency_rad_per_s))
    )
    worst = max(row.ratio for row in rows if row.law == CLEAN)
    noisy = [row for row in rows if row.law == NOISY]
    shaken = max(row.ratio_noise or np.nan for row in noisy)
    text = f"""
MuJoCo with gravity, Ĝ in the law, control at {1e3 * PERIOD:g} ms with half a period of look-ahead, the arm's own effort
limits, from rest {START_ERROR} rad off the reference (`Sinusoid.for_robot`). RMS of ‖z1‖ from {scale.settle:g} s on,
over {scale.turns:g} period of the reference. Every NBS law has the same gains and the same untrained networks; only its
model differs. The chains are learned by `fit(data, "chain")` from {scale.samples} clean samples of excited motions, and
from {2 * scale.samples} with encoders of 2^-16 of a turn, v and v̇ differentiated from them, and {NOISE.torque:g} N·m
of torque noise (seed {seed}). In the columns under torque noise, white noise of the same size,
held for 1 ms, acts on every joint. Peak torque is that of the run without it, including the start.

{tables}

On the chain from clean data the law's error is at most {worst:.6f} times that on the exact model. On the one from
noisy data it is up to {short(max(row.rms_error_rad for row in noisy))} rad, and up to
{short(max(row.ratio for row in noisy))} times that of the exact model where nothing else disturbs,
since the exact law then errs by rounding and sampling alone; under the torque noise it is at most {shaken:.3f} times
as large.

![Steady error of every law](learned_loop.png)"""
    return Section("Control on learned models", text, {"learned_loop": figures})


def _cells(row: Row) -> list[str]:
    noise = ["", ""]
    if row.rms_error_noise_rad is not None and row.ratio_noise is not None:
        noise = [short(row.rms_error_noise_rad), f"{row.ratio_noise:.3f}"]
    ratio = f"{row.ratio:.6f}" if row.ratio < 10.0 else short(row.ratio)
    return [row.law, short(row.rms_error_rad), ratio, *noise, short(row.peak_torque_Nm)]


def _draw(rows: Sequence[Row], path: Path) -> None:
    """A panel per arm, a line per law, a dot per reference; hollow ones under torque noise."""
    names = list(dict.fromkeys(row.law for row in rows))
    look: dict[str, Any] = {"linestyle": "", "marker": "o", "markersize": 5.5}
    with picture(path, 11.0, 3.8) as figure:
        panels = figure.subplots(1, len(ARMS), squeeze=False, sharey=True, sharex=True)[0]
        for axes, arm in zip(panels, ARMS, strict=True):
            for frequency, colour, shift in zip(FREQUENCIES, (ACTUAL, ERROR), (-0.13, 0.13), strict=True):
                own = [row for row in rows if (row.arm, row.frequency_rad_per_s) == (arm, frequency)]
                y = [names.index(row.law) + shift for row in own]
                axes.plot([row.rms_error_rad for row in own], y, color=colour, label=f"ω = {frequency:g} rad/s", **look)
                shaken = [np.nan if row.rms_error_noise_rad is None else row.rms_error_noise_rad for row in own]
                axes.plot(shaken, y, color=colour, mfc="white", **look)
            axes.set(xscale="log", xlabel="RMS of ‖z1‖ once settled [rad]", ylim=(len(names) - 0.5, -0.5))
            axes.set_yticks(range(len(names)), names)
            axes.set_title(arm, loc="left")
        panels[0].plot([], [], mfc="white", color="#5d6b7a", label=f"with torque noise of {NOISE.torque:g} N·m", **look)
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper right", ncols=3, frameon=False)
