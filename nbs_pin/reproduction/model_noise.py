"""Models from noisy data of arms with friction, over sample sizes: the chain, identified inertias, a plain network."""

from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from nbs_pin.base.progress import tracked
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.identification.collect import collect
from nbs_pin.identification.excitation import torque_limits
from nbs_pin.identification.measurement import Noise
from nbs_pin.reports.error_charts import plot_sample_sizes
from nbs_pin.reports.markdown import Section, markdown_table, short
from nbs_pin.reproduction.model_trials import MLP, Judge, Trial, attempt, chosen, column, write_trials
from nbs_pin.robots.robot import Robot, load_robot

MODELS = ("identified", "chain", MLP)
"""In the order of what they know of the arm."""
NOISE = Noise(encoder=2.0**-16, torque=0.5)
VISCOUS, COULOMB = 0.01, 0.02
"""Friction of the arms, as shares of each joint's largest torque (viscous: at 1 rad/s)."""
ERRORS = {
    "torque_excited": "torque on fresh trajectories",
    "torque_uniform": "torque on uniform states",
    "mass_matrix": "M",
    "coriolis": "C v",
    "gravity": "G",
}
_TIE = 0.05
_JUDGED = ("torque_excited", "torque_uniform")  # what the plain network has as well


class Noisy(NamedTuple):
    """What was found."""

    trials: list[Trial]
    floors: dict[str, float]
    """By arm: error of the exact model with the exact friction on fresh trajectories, where joints at rest stick."""


def noise_trials(
    arms: Sequence[str],
    sizes: Sequence[int],
    seeds: Sequence[int],
    fresh: int,
    progress: bool = False,
    mlp: Mapping[str, Any] | None = None,
) -> Noisy:
    """Every model of every arm from that many noisy samples, judged on `fresh` states without noise.

    mlp: settings of `fit_mlp`.
    """
    settings: dict[str, Mapping[str, Any]] = {MLP: mlp or {}}
    trials, floors = [], {}
    for arm in arms:
        robot = load_robot(arm)
        friction = friction_of(robot)
        judge = Judge.of(robot, friction, fresh)
        floors[arm] = judge.floor(friction)
        for size, seed in tracked(list(product(sizes, seeds)), f"models of {arm} from noisy data", progress):
            data = collect(robot, "excited", size, seed, noise=NOISE, friction=friction)
            for model in MODELS:
                given = settings.get(model, {"held_out": 0.0})
                trials.append(attempt(model, data, seed, robot, judge, friction=True, **given))
    return Noisy(trials, floors)


def friction_of(robot: Robot) -> JointFriction:
    """The friction that the study gives an arm."""
    limit = torque_limits(robot)
    return JointFriction(VISCOUS * limit, COULOMB * limit)


def noise_section(found: Noisy, folder: Path) -> Section:
    """The tables and pictures, with their files in the folder."""
    trials = found.trials
    figures = write_trials(trials, folder / "models_noise.csv")
    for name in _JUDGED:
        _draw(trials, name, folder / f"models_noise_{name.removeprefix('torque_')}.png")
    seeds = sorted({t.seed for t in trials})
    text = f"""
Excited trajectories of arms with friction (Coulomb {COULOMB:.0%} of each joint's largest torque, viscous {VISCOUS:.0%}
of it at 1 rad/s), encoders of 2^-16 of a turn, from which v and q̈ come by differentiation, and {NOISE.torque:g} N·m of
torque noise. Friction is learned with every model. Judged without noise, on fresh excited trajectories and on uniform
states, by the torque that the motors need, friction included: RMS error ÷ deviation, its root mean square over the
joints. `identified` knows the geometry; `chain` the order of the joints; `mlp` only that q is an angle ({MLP}: tanh
layers on sin q, cos q, v, q̈ and the shape of friction). Medians of the seeds {seeds[0]} to {seeds[-1]}. On
trajectories even the exact arm with its exact friction is left with {_named(found.floors)}: MuJoCo's joints stick
before they turn back, with a torque that is no function of their motion.

{_torque_table(trials)}

![Torque error on fresh trajectories](models_noise_excited.png)

![Torque error on uniform states](models_noise_uniform.png)

{_order(trials)}

{_model_table(trials)}

{_ratio(trials)}"""
    worst = {name: _ratios(trials, name) for name in ERRORS}
    numbers = {"models_noise": figures, "chain_over_identified": worst, "models_noise_floor": found.floors}
    return Section("Models from noisy data", text, numbers)


def _named(floors: Mapping[str, float]) -> str:
    return ", ".join(f"{short(floor)} ({arm})" for arm, floor in floors.items())


def _median(trials: Sequence[Trial], name: str, **case: Any) -> float:
    return float(np.median(column(chosen(trials, **case), name)))


def _cases(trials: Sequence[Trial]) -> list[tuple[str, int]]:
    return list(dict.fromkeys((t.arm, t.samples) for t in trials))


def _ratios(trials: Sequence[Trial], name: str) -> dict[str, float]:
    """Median error of the chain ÷ that of identified inertias, by arm and number of samples."""
    return {
        f"{arm}, {size}": _median(trials, name, arm=arm, samples=size, model="chain")
        / _median(trials, name, arm=arm, samples=size, model="identified")
        for arm, size in _cases(trials)
    }


def _ranking(trials: Sequence[Trial], name: str, arm: str, size: int) -> list[str]:
    """The models, best first; those that differ by less than `_TIE` from what knows more of the arm stay behind it."""
    error = {model: _median(trials, name, arm=arm, samples=size, model=model) for model in MODELS}
    order: list[str] = []
    for model in MODELS:
        better = (k for k, other in enumerate(order) if error[model] < (1.0 - _TIE) * error[other])
        order.insert(next(better, len(order)), model)
    return order


def _draw(trials: Sequence[Trial], name: str, path: Path) -> None:
    panels = {
        arm: {
            model: {
                size: column(chosen(trials, arm=arm, samples=size, model=model), name).tolist()
                for a, size in _cases(trials)
                if a == arm
            }
            for model in MODELS
        }
        for arm in dict.fromkeys(t.arm for t in trials)
    }
    plot_sample_sizes(panels, path, ylabel=f"error of the {ERRORS[name]}".replace("the torque on", "torque on"))


def _torque_table(trials: Sequence[Trial]) -> str:
    head = [
        "",
        *(
            f"{'trajectories' if name == 'torque_excited' else 'uniform'}: {model}"
            for name, model in product(_JUDGED, MODELS)
        ),
    ]
    lines = [
        [
            f"{arm}, {size:,} samples",
            *(
                short(_median(trials, name, arm=arm, samples=size, model=model))
                for name, model in product(_JUDGED, MODELS)
            ),
        ]
        for arm, size in _cases(trials)
    ]
    return markdown_table(head, lines)


def _model_table(trials: Sequence[Trial]) -> str:
    names, models = ("mass_matrix", "coriolis", "gravity"), ("identified", "chain")
    head = ["", *(f"{ERRORS[name]}: {model}" for name, model in product(names, models)), "seconds: chain", MLP]
    lines = [
        [
            f"{arm}, {size:,} samples",
            *(short(_median(trials, name, arm=arm, samples=size, model=m)) for name, m in product(names, models)),
            *(f"{_median(trials, 'seconds', arm=arm, samples=size, model=m):.2g}" for m in ("chain", MLP)),
        ]
        for arm, size in _cases(trials)
    ]
    return markdown_table(head, lines)


def _order(trials: Sequence[Trial]) -> str:
    """Where what knows more of the arm is not the better model, whichever numbers there are."""
    told = []
    for name in _JUDGED:
        other = {
            f"{arm}, {size:,}": " < ".join(ranking)
            for arm, size in _cases(trials)
            if (ranking := _ranking(trials, name, arm, size)) != list(MODELS)
        }
        usual = " < ".join(MODELS)
        said = "everywhere" if not other else "except " + "; ".join(f"{case}: {order}" for case, order in other.items())
        told.append(
            f"Errors of the {ERRORS[name]} are in the order {usual} {said}.".replace("the torque on", "torque on")
        )
    return "\n".join([*told, f"Less than {_TIE:.0%} is no difference here."])


def _ratio(trials: Sequence[Trial]) -> str:
    """How much the geometry that the chain must find costs."""
    told = []
    for name, label in ERRORS.items():
        ratios = _ratios(trials, name)
        worst = max(ratios, key=lambda case: ratios[case])
        told.append(f"{label} {np.median(list(ratios.values())):.2g} ({ratios[worst]:.2g} at {worst} samples)")
    return (
        "What not knowing the geometry costs: error of `chain` ÷ error of `identified`, medians over the seeds, the "
        f"median over arms and sample sizes and the largest: {'; '.join(told)}."
    )
