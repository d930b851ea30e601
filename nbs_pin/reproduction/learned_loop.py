"""Control on learned models: MuJoCo with gravity, every law beside the one on the exact model; the paper's Figure 5."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import NamedTuple

import joblib
import numpy as np

from nbs_pin.base.csv_files import write_csv
from nbs_pin.base.plain import plain
from nbs_pin.base.progress import tracked
from nbs_pin.controllers.computed_torque import ComputedTorque
from nbs_pin.controllers.controller import Controller
from nbs_pin.controllers.gains import gains_for_robot
from nbs_pin.controllers.neural_backstepping import NeuralBackstepping
from nbs_pin.controllers.pd import PD
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.dynamics.provider import DynamicsProvider
from nbs_pin.identification.collect import collect
from nbs_pin.identification.fit import fit
from nbs_pin.identification.measurement import Noise
from nbs_pin.kernels.threads import cores
from nbs_pin.motions.disturbances import Disturbance, TorqueNoise
from nbs_pin.motions.references import Sinusoid
from nbs_pin.reports.markdown import Section, markdown_table, short
from nbs_pin.reports.plotting import ACTUAL, ERROR, picture
from nbs_pin.reproduction import figure5, passive_data
from nbs_pin.robots.robot import Robot, load_robot
from nbs_pin.simulation import metrics
from nbs_pin.simulation.mujoco_plant import MujocoPlant
from nbs_pin.simulation.simulate import simulate

FILES = ("learned_loop.csv", "learned_loop.png", *figure5.FILES, passive_data.FILE)
"""What `reproduce_learned` writes."""
ARMS = ("three_link", "panda")
FREQUENCIES = (0.1, 1.0)
"""Of the references [rad/s]."""
BANDWIDTH, PERIOD, START_ERROR = 6.0, 0.001, 0.3
"""Of every law [rad/s], control period [s], and how far off every joint starts, in turn up and down [rad]."""
NOISE = Noise(encoder=2.0**-16, torque=0.5)
"""What the instruments of the noisy data do: a share of a turn, and N·m."""
EXACT, CLEAN, NOISY = "NBS, exact model", "NBS, chain from clean data", "NBS, chain from noisy data"
"""The laws that are the same but for their model."""


@dataclass(frozen=True)
class Scale:
    """How much of everything."""

    samples: int = 1_500
    """Excited ones that the clean chain is learned from; the noisy one has twice as many."""
    settle: float = 10.0
    """Time before errors count [s]."""
    turns: float = 1.0
    """Periods of the reference that count."""
    seeds: int = 5
    """Of the networks learned without torque."""
    swing: int = 10_000
    """Samples of the paper's swing."""
    epochs: int = 200
    """Of the law of Figure 5."""
    duration: float = 100.0
    """Of Figure 5 [s]."""
    learners: Sequence[passive_data.Learner] = passive_data.LEARNERS


class Row(NamedTuple):
    """One law on one reference."""

    arm: str
    frequency_rad_per_s: float
    law: str
    rms_error_rad: float
    """√ of the mean of ‖z1‖² once settled."""
    ratio: float
    """To that of NBS on the exact model."""
    rms_error_noise_rad: float | None
    """The same while every joint has torque noise of the size of the sensors', for the laws of one kind."""
    ratio_noise: float | None
    peak_torque_Nm: float


def reproduce_learned(folder: Path, seed: int = 0, progress: bool = False, scale: Scale | None = None) -> list[Section]:
    """Runs everything, writes `FILES` into the folder and returns the sections of the page.

    seed: of data, fits and networks, the first of several. scale: None takes `Scale()`, some minutes on two cores.
    Raises OSError when a file cannot be written and KeyboardInterrupt on Ctrl-C.
    """
    scale = scale or Scale()
    studied = list(_on_arms(scale, seed, progress))
    rows, chains = [row for found in studied for row in found.rows], studied[0].learned
    seeds = range(seed, seed + scale.seeds)
    passive = passive_data.learn_passively(load_robot(ARMS[0]), seeds, scale.learners, scale.swing, progress)
    runs = figure5.follow_again(
        {
            "a chain, excited data": chains[CLEAN],
            "cholesky, the paper's swing": passive.models["cholesky", "one swing", seed],
        },
        epochs=scale.epochs,
        duration=scale.duration,
        seed=seed,
        progress=progress,
    )
    write_csv(folder / FILES[0], Row._fields, rows)
    _draw(rows, folder / FILES[1])
    figure5.write(runs, folder)
    passive_data.write(passive, folder)
    return [_section(rows, scale, seed), passive_data.section(passive), figure5.section(runs)]


class Studied(NamedTuple):
    """What was learned of an arm, and how laws do on it."""

    learned: dict[str, DynamicsProvider]
    rows: list[Row]


def _on_arms(scale: Scale, seed: int, progress: bool) -> Iterator[Studied]:
    """Every arm on a core of its own."""
    with joblib.parallel_config(backend="loky", inner_max_num_threads=1):
        pool = joblib.Parallel(n_jobs=min(cores(), len(ARMS)), return_as="generator")
        studied = iter(pool(joblib.delayed(_on_arm)(name, scale, seed) for name in ARMS))
        for _ in tracked(ARMS, "control on learned models", progress):
            yield next(studied)


def _on_arm(name: str, scale: Scale, seed: int) -> Studied:
    robot = load_robot(name)
    learned = learn_chains(robot, scale.samples, seed)
    return Studied(learned, follow_all(robot, learned, scale))


def learn_chains(robot: Robot, samples: int, seed: int) -> dict[str, DynamicsProvider]:
    """The chains of `CLEAN` and `NOISY`, from excited motions of the arm."""
    clean, noisy = (
        collect(robot, samples=samples, seed=seed),
        collect(robot, samples=2 * samples, seed=seed, noise=NOISE),
    )
    return {CLEAN: fit(clean, "chain", seed, robot=robot), NOISY: fit(noisy, "chain", seed, robot=robot)}


def laws(robot: Robot, learned: dict[str, DynamicsProvider]) -> dict[str, Controller]:
    """Every law of the table; all NBS laws have the gains and the networks of the one on the exact model."""
    truth = PinocchioDynamics(robot)
    gains = gains_for_robot(robot, truth, bandwidth=BANDWIDTH, period=PERIOD)
    pd = PD.for_robot(robot, truth, bandwidth=BANDWIDTH, period=PERIOD)
    blind = PD(figure5.Weightless(truth), feedforward="gravity", kp=pd.kp, kd=pd.kd)
    return {
        **{
            name: NeuralBackstepping.for_robot(robot, dynamics=model, gains=gains)
            for name, model in {EXACT: truth, **learned}.items()
        },
        "computed torque, exact model": ComputedTorque.for_robot(robot, truth, bandwidth=BANDWIDTH, period=PERIOD),
        "PD+, exact model": pd,
        "PD with G, exact model": PD.for_robot(robot, truth, feedforward="gravity", bandwidth=BANDWIDTH, period=PERIOD),
        "PD, no model": blind,
    }


def follow_all(robot: Robot, learned: dict[str, DynamicsProvider], scale: Scale) -> list[Row]:
    """A row per reference and law, the exact NBS first of each reference."""
    rows: list[Row] = []
    chosen = laws(robot, learned)
    noise = TorqueNoise(np.full(robot.nv, NOISE.torque), PERIOD)
    first: tuple[float, float | None] = np.nan, None
    for frequency, name in product(FREQUENCIES, chosen):
        error, peak = _followed(robot, chosen[name], frequency, scale)
        shaken = None
        if name in (EXACT, CLEAN, NOISY):
            shaken = _followed(robot, chosen[name], frequency, scale, noise)[0]
        first = (error, shaken) if name == EXACT else first
        ratio = None if shaken is None or first[1] is None else shaken / first[1]
        rows.append(Row(robot.name, frequency, name, error, error / first[0], shaken, ratio, peak))
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


def _section(rows: Sequence[Row], scale: Scale, seed: int) -> Section:
    head = ["", "RMS ‖z1‖ [rad]", "÷ exact NBS", "under torque noise [rad]", "÷ exact NBS", "peak torque [N·m]"]
    tables = []
    for arm in ARMS:
        for frequency in FREQUENCIES:
            group = [row for row in rows if (row.arm, row.frequency_rad_per_s) == (arm, frequency)]
            tables.append(f"**{arm}, ω = {frequency:g} rad/s**\n\n{markdown_table(head, list(map(_cells, group)))}")
    worst = max(row.ratio for row in rows if row.law == CLEAN)
    noisy = [row for row in rows if row.law == NOISY]
    shaken = max(row.ratio_noise or np.nan for row in noisy)
    joined = "\n\n".join(tables)
    text = f"""
MuJoCo with gravity, Ĝ in the law, control at {1e3 * PERIOD:g} ms with half a period of look-ahead, the arm's own effort
limits, from rest {START_ERROR} rad off the reference (`Sinusoid.for_robot`). RMS of ‖z1‖ from {scale.settle:g} s on,
over {scale.turns:g} period of the reference. Every NBS law has the same gains and the same untrained networks; only its
model differs. The chains are learned by `fit(data, "chain")` from {scale.samples} clean samples of excited motions, and
from {2 * scale.samples} with encoders of 2^-16 of a turn, v and v̇ differentiated from them, and {NOISE.torque:g} N·m
of torque noise (seed {seed}). In the columns under torque noise as much of it, white,
acts on every joint, held for 1 ms. Peak torque is that of the run without it, the start included, where limits are met.

{joined}

On the chain from clean data the law's error is at most {worst:.6f} times that on the exact model. On the one from
noisy data it is up to {short(max(row.rms_error_rad for row in noisy))} rad, and up to
{short(max(row.ratio for row in noisy))} times that of the exact model where nothing else disturbs,
since the exact law then errs by rounding and sampling alone; under the torque noise it is at most {shaken:.3f} times
as large.

![Steady error of every law](learned_loop.png)"""
    return Section("Control on learned models", text, {"learned_loop": plain([row._asdict() for row in rows])})


def _cells(row: Row) -> list[str]:
    noise = ["", ""]
    if row.rms_error_noise_rad is not None and row.ratio_noise is not None:
        noise = [short(row.rms_error_noise_rad), f"{row.ratio_noise:.3f}"]
    ratio = f"{row.ratio:.6f}" if row.ratio < 10.0 else short(row.ratio)
    return [row.law, short(row.rms_error_rad), ratio, *noise, short(row.peak_torque_Nm)]


def _draw(rows: Sequence[Row], path: Path) -> None:
    """A panel per arm, a line per law, a dot per reference; hollow ones under torque noise."""
    names = list(dict.fromkeys(row.law for row in rows))
    with picture(path, 11.0, 3.8) as figure:
        panels = figure.subplots(1, len(ARMS), squeeze=False, sharey=True, sharex=True)[0]
        for axes, arm in zip(panels, ARMS, strict=True):
            for row in (row for row in rows if row.arm == arm):
                slow = row.frequency_rad_per_s == min(FREQUENCIES)
                y, colour = names.index(row.law) + (-0.13 if slow else 0.13), ACTUAL if slow else ERROR
                axes.plot(row.rms_error_rad, y, "o", color=colour, markersize=5.5)
                if row.rms_error_noise_rad is not None:
                    axes.plot(row.rms_error_noise_rad, y, "o", mfc="white", color=colour, markersize=5.5)
            axes.set(xscale="log", xlabel="RMS of ‖z1‖ once settled [rad]", ylim=(len(names) - 0.5, -0.5))
            axes.set_yticks(range(len(names)), names)
            axes.set_title(arm, loc="left")
        for frequency, colour in zip(FREQUENCIES, (ACTUAL, ERROR), strict=True):
            panels[0].plot([], [], "o", color=colour, label=f"ω = {frequency:g} rad/s")
        panels[0].plot([], [], "o", mfc="white", color="#5d6b7a", label=f"with torque noise of {NOISE.torque:g} N·m")
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper right", ncols=3, frameon=False)
