"""Models from clean data: how exact they are, and how surely the chain finds an arm from its motions alone."""

from collections.abc import Sequence
from itertools import product
from pathlib import Path

import numpy as np

from nbs_pin.base.progress import tracked
from nbs_pin.identification.collect import collect
from nbs_pin.reports.markdown import Section, markdown_table, short
from nbs_pin.reproduction.model_trials import SPEED, Judge, Trial, attempt, chosen, column, write_trials
from nbs_pin.robots.robot import load_robot

MODELS, RECIPES = ("chain", "identified"), ("uniform", "excited")
FOUND_NMSE, FOUND_MASS = 1e-8, 1e-4
"""An arm counts as found when the torque nMSE on fresh uniform states and the error of M are below these."""


def clean_trials(
    arms: Sequence[str], samples: int, seeds: Sequence[int], fresh: int, progress: bool = False
) -> list[Trial]:
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
    figures = write_trials(trials, folder / "models_clean.csv")
    head = ["", "found", "torque nMSE, uniform", "torque nMSE, trajectories", "M", "C v", "G", "seconds", "starts"]
    groups = dict.fromkeys((t.arm, t.data, t.model) for t in trials)
    lines = [
        [f"{arm}, {recipe}: {model}", *_cells(chosen(trials, arm=arm, data=recipe, model=model))]
        for arm, recipe, model in groups
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
    found = np.square(column(trials, "torque_uniform")) <= FOUND_NMSE
    found &= column(trials, "mass_matrix") <= FOUND_MASS
    squares = [np.square(column(trials, name)).max() for name in ("torque_uniform", "torque_excited")]
    worst = [column(trials, name).max() for name in ("mass_matrix", "coriolis", "gravity")]
    seconds, starts = column(trials, "seconds"), column(trials, "starts")
    return [
        f"{found.sum()} of {len(trials)}",
        *(short(float(x)) for x in (*squares, *worst)),
        f"{np.median(seconds):.2g} – {seconds.max():.2g}",
        f"{np.median(starts):.0f} – {starts.max():.0f}",
    ]
