"""What structure is worth: models with more and less mechanical structure, from the same data."""

from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from nbs_pin.base.progress import tracked
from nbs_pin.base.units import percent
from nbs_pin.identification.collect import collect
from nbs_pin.reports.markdown import Section, markdown_table, short
from nbs_pin.reports.plotting import ACTUAL, ERROR, LIMIT, REFERENCE, TORQUE, picture
from nbs_pin.reproduction.model_trials import FAST, SPEED, Judge, Trial, attempt, chosen, column
from nbs_pin.reproduction.study import spread, write_records
from nbs_pin.robots.robot import load_robot

ARM = "three_link"
STRUCTURES: Mapping[str, Mapping[str, Any]] = {
    "chain": {},
    "cholesky": {"iterations": 30},
    "homogenised": {"widths": (12, 12), "iterations": 30},
    "picnn": {"iterations": 200},
    "unconstrained": {"iterations": 30},
}
"""Models from most structure to least, and the settings of `fit` that bound each to about two minutes."""
WHAT = {
    "chain": "a rigid tree",
    "cholesky": "M̂ = LLᵀ + εI, any V̂",
    "homogenised": "T̂ quadratic in v, convex network",
    "picnn": "T̂ convex in v (the paper's)",
    "unconstrained": "any L̂(q, v)",
}
ERRORS = {
    "mass_matrix": "M",
    "coriolis": "C v",
    "gravity": "G",
    "torque_uniform": f"torque, |v| ≤ {SPEED:g}",
    "torque_fast": f"torque, |v| ≤ {FAST:g}",
}
EDGE = 1e-4
"""Left end of the picture's axis."""


def structure_trials(
    structures: Mapping[str, Mapping[str, Any]], sizes: Sequence[int], seeds: Sequence[int], fresh: int, progress: bool
) -> list[Trial]:
    """Every model with its settings, from uniform states of the three-link arm, that many, by every seed."""
    robot, trials = load_robot(ARM), []
    judge = Judge.of(robot, samples=fresh)
    # Model by model, so that the fast fits come first.
    for model, size, seed in tracked(list(product(structures, sizes, seeds)), "models of every structure", progress):
        data = collect(robot, "uniform", size, seed)
        trials.append(attempt(model, data, seed, robot, judge, **structures[model]))
    return trials


def structure_section(trials: Sequence[Trial], folder: Path) -> Section:
    """The table and the picture, with their files in the folder."""
    figures = write_records(folder / "models_structure.csv", trials)
    _draw(trials, folder / "models_structure.png")
    seeds = sorted({t.seed for t in trials})
    head = ["", *ERRORS.values(), "M̂ not ≻ 0", "seconds"]
    text = f"""
Uniform states of {ARM} at up to {SPEED:g} rad/s without noise, a fifth of them held out; every model by least squares
on the torque. Relative errors over fresh states, torque: RMS error ÷ deviation; least – **median** – greatest over the
seeds {seeds[0]} to {seeds[-1]}. No data are at {FAST:g} rad/s; a T̂ that is quadratic in v extrapolates to
it. `picnn` and `unconstrained`, whose T̂ is not, have an M̂ that depends on v: M̂ is judged at rest; torque and C v, what
velocity adds to the torque, are those of their L̂. M̂ not ≻ 0: share of the states at which M̂ is not positive definite,
worst seed.

{markdown_table(head, _lines(trials))}

![Errors of models with more and less structure](models_structure.png)"""
    return Section("What structure is worth", text, {"models_structure": figures})


def _draw(trials: Sequence[Trial], path: Path) -> None:
    """A panel per quantity, a row per model, a dot per seed and a bar at the median; filled for the most samples.

    Errors below `EDGE` are drawn there as an arrow, their median beside it.
    """
    models, sizes = list(dict.fromkeys(t.model for t in trials)), sorted({t.samples for t in trials})
    seconds = [np.median(column(chosen(trials, model=model, samples=sizes[-1]), "seconds")) for model in models]
    labels = [f"{model}: {WHAT[model]}\n{took:.2g} s a fit" for model, took in zip(models, seconds, strict=True)]
    right = max(100.0 * EDGE, *(1.6 * column(trials, name).max() for name in ERRORS))
    with picture(path, 14.0, 1.3 + 0.8 * len(models)) as figure:
        grid = figure.subplots(1, len(ERRORS), sharex=True, sharey=True)
        colours = (ACTUAL, REFERENCE, TORQUE, ERROR, ERROR)
        for axes, (name, label), colour in zip(grid, ERRORS.items(), colours, strict=True):
            for (row, model), (k, size) in product(enumerate(models), enumerate(sizes)):
                y = row + 0.6 * ((k + 0.5) / len(sizes) - 0.5)
                _draw_seeds(axes, column(chosen(trials, model=model, samples=size), name), y, colour, size == sizes[-1])
            for edge in range(1, len(models)):
                axes.axhline(edge - 0.5, color=LIMIT, linewidth=0.4, alpha=0.5)
            axes.set(xscale="log", xlabel="relative error", xlim=(0.7 * EDGE, right), ylim=(len(models) - 0.5, -0.5))
            axes.set_title(label, loc="left")
            axes.grid(False, axis="y")
        grid[0].set_yticks(range(len(models)), labels)
        for size in sizes:
            face = LIMIT if size == sizes[-1] else "white"
            grid[0].plot([], [], "o", color=LIMIT, markerfacecolor=face, markersize=4.5, label=f"{size:,} samples")
        figure.legend(loc="outside upper right", ncols=len(sizes), frameon=False)


def _draw_seeds(axes: Any, values: np.ndarray, y: float, colour: str, filled: bool) -> None:
    """A dot per seed about the height y, and their median; an arrow for those too small for the axis."""
    offsets = np.linspace(-0.07, 0.07, len(values)) if len(values) > 1 else np.zeros(len(values))
    look = {"color": colour, "markerfacecolor": colour if filled else "white", "markersize": 4.2, "alpha": 0.8}
    small, middle = values < EDGE, float(np.median(values))
    axes.plot(values[~small], y + offsets[~small], "o", **look)
    if small.any():
        axes.plot(EDGE, y, "<", **look)
    if middle < EDGE:
        axes.annotate(short(middle), (EDGE, y), xytext=(6, 0), textcoords="offset points", va="center", color=colour)
    else:
        axes.plot([middle] * 2, [y - 0.12, y + 0.12], color=colour, linewidth=1.4)


def _lines(trials: Sequence[Trial]) -> list[list[str]]:
    lines = []
    for model, size in dict.fromkeys((t.model, t.samples) for t in trials):
        own = chosen(trials, model=model, samples=size)
        share, seconds = column(own, "indefinite").max(), np.median(column(own, "seconds"))
        errors = [spread(column(own, name)) for name in ERRORS]
        lines.append([f"{model} ({WHAT[model]}), {size:,} samples", *errors, percent(share, 1), f"{seconds:.3g}"])
    return lines
