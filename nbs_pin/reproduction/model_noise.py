"""Models from noisy data of arms with friction, over sample sizes: the chain, identified inertias, a plain network."""

from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from nbs_pin.base.progress import tracked
from nbs_pin.base.units import percent
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.identification.collect import collect
from nbs_pin.identification.excitation import torque_limits
from nbs_pin.reports.error_charts import plot_sample_sizes
from nbs_pin.reports.markdown import Section, markdown_table, short
from nbs_pin.reproduction.model_trials import MLP, Judge, Trial, attempt, chosen, column
from nbs_pin.reproduction.study import NOISE, write_records
from nbs_pin.robots.robot import Robot, load_robot

MODELS = ("identified", "chain", MLP)
"""From the one that is given most about the arm to the one that is given least."""
VISCOUS, COULOMB = 0.01, 0.02
"""Friction of the arms, as shares of each joint's largest torque (viscous: at 1 rad/s)."""
TORQUES = {"torque_excited": "torque on fresh trajectories", "torque_uniform": "torque on uniform states"}
PARTS = {"mass_matrix": "M", "coriolis": "C v", "gravity": "G"}
"""Entries of a `Trial` and their names on the page; the plain network has only the torques."""
_TIE = 0.05
_Medians: TypeAlias = dict[tuple[str, int], dict[str, dict[str, float]]]


class Noisy(NamedTuple):
    """What was found."""

    trials: list[Trial]
    floors: dict[str, float]
    """By arm: `Judge.floor`."""


def noise_trials(
    arms: Sequence[str], sizes: Sequence[int], seeds: Sequence[int], fresh: int, progress: bool, mlp: Mapping[str, Any]
) -> Noisy:
    """Every model of every arm from that many noisy samples, judged on `fresh` states; mlp: settings of `fit_mlp`."""
    trials, floors = [], {}
    for arm in arms:
        robot = load_robot(arm)
        friction = friction_of(robot)
        judge = Judge.of(robot, friction, fresh)
        floors[arm] = judge.floor
        for size, seed in tracked(list(product(sizes, seeds)), f"models of {arm} from noisy data", progress):
            data = collect(robot, "excited", size, seed, noise=NOISE, friction=friction)
            for model in MODELS:
                settings = mlp if model == MLP else {"held_out": 0.0}
                trials.append(attempt(model, data, seed, robot, judge, friction=True, **settings))
    return Noisy(trials, floors)


def friction_of(robot: Robot) -> JointFriction:
    """The friction of an arm in the study."""
    limit = torque_limits(robot)
    return JointFriction(VISCOUS * limit, COULOMB * limit)


def noise_section(found: Noisy, folder: Path) -> Section:
    """The tables and pictures, with their files in the folder."""
    trials, medians = found.trials, _medians(found.trials)
    figures = write_records(folder / "models_noise.csv", trials)
    for name in TORQUES:
        _draw(trials, name, folder / f"models_noise_{name.removeprefix('torque_')}.png")
    seeds = sorted({t.seed for t in trials})
    floors = ", ".join(f"{short(floor)} ({arm})" for arm, floor in found.floors.items())
    torques = {f"{'trajectories' if name == 'torque_excited' else 'uniform'}: {model}": (name, model)
               for name, model in product(TORQUES, MODELS)}  # fmt: skip
    parts = {f"{PARTS[name]}: {model}": (name, model) for name, model in product(PARTS, ("identified", "chain"))}
    seconds = {"seconds: chain": ("seconds", "chain"), MLP: ("seconds", MLP)}
    text = f"""
Excited trajectories of arms with friction (Coulomb {percent(COULOMB)} of each joint's largest torque, viscous
{percent(VISCOUS)} of it at 1 rad/s), encoders of 2^-16 of a turn, from which v and q̈ come by differentiation, and
{NOISE.torque:g} N·m of torque noise. Friction is learned with every model. Judged without noise, on fresh excited
trajectories and on uniform states, by the torque that the motors need, friction included: RMS error ÷ deviation, its
root mean square over the joints. `identified` knows the geometry; `chain` the order of the joints; `mlp` only that q
is an angle ({MLP}: tanh layers on sin q, cos q, v, q̈ and the shape of friction). Medians of the seeds
{seeds[0]} to {seeds[-1]}. On trajectories even the exact model with the exact friction is left with {floors}: in
MuJoCo a joint sticks before it reverses, with a torque that is not a function of its motion.

{_table(medians, torques)}

![Torque error on fresh trajectories](models_noise_excited.png)

![Torque error on uniform states](models_noise_uniform.png)

{_order(medians)}

{_table(medians, parts | seconds)}

{_cost_of_geometry(medians)}"""
    ratios = {name: _ratios(medians, name) for name in TORQUES | PARTS}
    numbers = {"models_noise": figures, "chain_over_identified": ratios, "models_noise_floor": found.floors}
    return Section("Models from noisy data", text, numbers)


def _medians(trials: Sequence[Trial]) -> _Medians:
    """(arm, samples) -> model -> entry of a `Trial` -> its median over the seeds."""
    found: _Medians = {}
    for arm, size, model in dict.fromkeys((t.arm, t.samples, t.model) for t in trials):
        own = chosen(trials, arm=arm, samples=size, model=model)
        medians = {name: float(np.median(column(own, name))) for name in (*TORQUES, *PARTS, "seconds")}
        found.setdefault((arm, size), {})[model] = medians
    return found


def _ratios(medians: _Medians, name: str) -> dict[str, float]:
    """Error of the chain ÷ that of identified inertias, by arm and number of samples."""
    return {f"{arm}, {size}": m["chain"][name] / m["identified"][name] for (arm, size), m in medians.items()}


def _ranking(models: dict[str, dict[str, float]], name: str) -> list[str]:
    """The models, best first; those within `_TIE` of one that is given more about the arm stay behind it."""
    order: list[str] = []
    for model in MODELS:
        better = (k for k, other in enumerate(order) if models[model][name] < (1.0 - _TIE) * models[other][name])
        order.insert(next(better, len(order)), model)
    return order


def _draw(trials: Sequence[Trial], name: str, path: Path) -> None:
    panels: dict[str, dict[str, dict[int, list[float]]]] = {}
    for arm, model, size in dict.fromkeys((t.arm, t.model, t.samples) for t in trials):
        errors = column(chosen(trials, arm=arm, samples=size, model=model), name).tolist()
        panels.setdefault(arm, {}).setdefault(model, {})[size] = errors
    plot_sample_sizes(panels, path, ylabel=f"error of {TORQUES[name]}")


def _table(medians: _Medians, columns: Mapping[str, tuple[str, str]]) -> str:
    """A row per arm and number of samples; columns: head -> entry of a `Trial` and model."""
    lines = []
    for (arm, size), models in medians.items():
        cells = [(name, models[model][name]) for name, model in columns.values()]
        numbers = [f"{x:.2g}" if name == "seconds" else short(x) for name, x in cells]
        lines.append([f"{arm}, {size:,} samples", *numbers])
    return markdown_table(["", *columns], lines)


def _order(medians: _Medians) -> str:
    """Where the model that is given more about the arm is not the better one."""
    told, usual = [], list(MODELS)
    for name, label in TORQUES.items():
        rankings = {f"{arm}, {size:,}": _ranking(models, name) for (arm, size), models in medians.items()}
        others = "; ".join(f"{case}: {' < '.join(order)}" for case, order in rankings.items() if order != usual)
        said = f"except {others}" if others else "everywhere"
        told.append(f"Errors of {label} are in the order {' < '.join(usual)} {said}.")
    return "\n".join([*told, f"Differences below {percent(_TIE)} do not count."])


def _cost_of_geometry(medians: _Medians) -> str:
    told = []
    for name, label in (TORQUES | PARTS).items():
        ratios = _ratios(medians, name)
        worst = max(ratios, key=lambda case: ratios[case])
        told.append(f"{label} {np.median(list(ratios.values())):.2g} ({ratios[worst]:.2g} at {worst} samples)")
    return (
        "The cost of not knowing the geometry: error of `chain` ÷ error of `identified`, medians over the seeds, the "
        f"median over arms and sample sizes and the largest: {'; '.join(told)}."
    )
