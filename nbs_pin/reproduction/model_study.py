"""Learned models against the truth: from clean data (in this module), from noisy data, and by their structure."""

from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from nbs_pin.base.progress import tracked
from nbs_pin.identification.collect import collect
from nbs_pin.reports.markdown import Section, markdown_table, short
from nbs_pin.reproduction.model_noise import noise_section, noise_trials
from nbs_pin.reproduction.model_structure import STRUCTURES, structure_section, structure_trials
from nbs_pin.reproduction.model_trials import FRESH_SAMPLES, SPEED, Judge, Trial, attempt, chosen, column
from nbs_pin.reproduction.study import write_records
from nbs_pin.robots.robot import load_robot

FILES = ("models_clean.csv", "models_noise.csv", "models_noise_excited.png", "models_noise_uniform.png",
         "models_structure.csv", "models_structure.png")  # fmt: skip
"""What `reproduce_models` writes."""
MODELS, RECIPES = ("chain", "identified"), ("uniform", "excited")
"""Models from clean data, and the recipes of these data."""
FOUND_NMSE, FOUND_MASS = 1e-8, 1e-4
"""An arm counts as found when the torque nMSE on fresh uniform states and the error of M are below these."""


class Scale(NamedTuple):
    """How much of everything; the defaults take about an hour on two cores."""

    fresh: int = FRESH_SAMPLES
    """States that a model is judged on, uniform ones and as many on trajectories."""
    seeds: int = 5
    """Seeds of data and first parameters, for clean data and structures."""
    clean_arms: tuple[str, ...] = ("three_link", "ur5", "panda", "xarm7")
    clean_samples: int = 1_500
    noise_arms: tuple[str, ...] = ("three_link", "ur5", "panda")
    noise_seeds: int = 5
    noise_samples: tuple[int, ...] = (300, 1_000, 3_000, 10_000)
    mlp: Mapping[str, Any] = {}
    """Settings of `fit_mlp`."""
    structure_samples: tuple[int, ...] = (1_000, 10_000)
    structures: Mapping[str, Mapping[str, Any]] = STRUCTURES
    """Models, and the settings of `fit` that bound their time."""


QUICK = Scale(
    fresh=300,
    seeds=1,
    clean_arms=("three_link",),
    clean_samples=300,
    noise_arms=("three_link",),
    noise_seeds=1,
    noise_samples=(300,),
    structure_samples=(300,),
    structures={"chain": {}, "cholesky": {"iterations": 5}, "unconstrained": {"iterations": 5}},
)
"""To see the page in a minute; its figures are not those of the study."""


def reproduce_models(
    folder: Path, seed: int = 0, progress: bool = False, scale: Scale | None = None
) -> Iterator[Section]:
    """Run the study, write `FILES` into the folder and yield the sections of the page, each once it is done."""
    scale = scale or Scale()
    seeds, noisy_seeds = range(seed, seed + scale.seeds), range(seed, seed + scale.noise_seeds)
    clean = clean_trials(scale.clean_arms, scale.clean_samples, seeds, scale.fresh, progress)
    yield clean_section(clean, folder)
    noisy = noise_trials(scale.noise_arms, scale.noise_samples, noisy_seeds, scale.fresh, progress, scale.mlp)
    yield noise_section(noisy, folder)
    structured = structure_trials(scale.structures, scale.structure_samples, seeds, scale.fresh, progress)
    yield structure_section(structured, folder)


def clean_trials(arms: Sequence[str], samples: int, seeds: Sequence[int], fresh: int, progress: bool) -> list[Trial]:
    """Every model of every arm from data of every recipe and seed, judged on `fresh` states."""
    trials, cases = [], list(product(RECIPES, seeds))
    for arm in arms:
        robot = load_robot(arm)
        judge = Judge.of(robot, samples=fresh)
        for recipe, seed in tracked(cases, f"models of {arm} from clean data", progress):
            data = collect(robot, recipe, samples, seed)
            trials += [attempt(model, data, seed, robot, judge, held_out=0.0) for model in MODELS]
    return trials


def clean_section(trials: Sequence[Trial], folder: Path) -> Section:
    """The table, with its CSV file in the folder."""
    figures = write_records(folder / "models_clean.csv", trials)
    head = ["", "found", "torque nMSE, uniform", "torque nMSE, trajectories", "M", "C v", "G", "seconds", "starts"]
    lines = [
        [f"{arm}, {recipe}: {model}", *_cells(chosen(trials, arm=arm, data=recipe, model=model))]
        for arm, recipe, model in dict.fromkeys((t.arm, t.data, t.model) for t in trials)
    ]
    text = f"""
{trials[0].samples} samples without noise, q̈ from the simulator: independent states ("uniform") or trajectories
("excited"). The worst of the seeds {min(t.seed for t in trials)} to {max(t.seed for t in trials)}; seconds and starts:
median – worst. Every model is judged on the same fresh uniform states (q in the joint ranges, |v| ≤ {SPEED:g} rad/s,
|q̈| ≤ 5 rad/s²) and on fresh excited trajectories. M, C v and G: relative Frobenius errors over the uniform states.
`chain` is given the order and the kinds of the joints and nothing else; `identified` the whole geometry. Found: torque
nMSE ≤ {short(FOUND_NMSE)} on uniform states and M ≤ {short(FOUND_MASS)}.

{markdown_table(head, lines)}"""
    return Section("Models from clean data", text, {"models_clean": figures})


def _cells(trials: Sequence[Trial]) -> list[str]:
    squares = [np.square(column(trials, name)) for name in ("torque_uniform", "torque_excited")]
    parts = [column(trials, name) for name in ("mass_matrix", "coriolis", "gravity")]
    found = (squares[0] <= FOUND_NMSE) & (parts[0] <= FOUND_MASS)
    seconds, starts = column(trials, "seconds"), column(trials, "starts")
    return [
        f"{found.sum()} of {len(trials)}",
        *(short(float(x.max())) for x in (*squares, *parts)),
        f"{np.median(seconds):.2g} – {seconds.max():.2g}",
        f"{np.median(starts):.0f} – {starts.max():.0f}",
    ]
