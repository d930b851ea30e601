"""The fair comparison: every law tuned alike on the same motions, and judged on held-out starts."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from nbs_pin.base.csv_files import write_csv
from nbs_pin.base.plain import plain
from nbs_pin.base.progress import tracked
from nbs_pin.base.units import percent
from nbs_pin.controllers.registry import build_law
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.motions.references import DesiredMotion, Sinusoid
from nbs_pin.reports.markdown import Section, markdown_table
from nbs_pin.robots.robot import Robot, load_robot
from nbs_pin.simulation.costs import TimeOutside
from nbs_pin.simulation.dynamics_plant import DynamicsPlant
from nbs_pin.simulation.loop import Loop
from nbs_pin.simulation.metrics import PAPER_THRESHOLD
from nbs_pin.training.evaluation import FRESH_STARTS, compared, fresh_batch, fresh_figures
from nbs_pin.training.train import Training, train

FREQUENCIES = (0.1, 1.0, 3.0)
"""ω of the references [rad/s]."""
LEARNING_RATES = (0.001, 0.003, 0.01, 0.03, 0.1, 0.3)
"""Every law is tuned briefly with each, then longer with the one of the lowest held-out cost."""
LEAST_SHARE = 0.1
"""Least share of NBS's S, Λ and D₀ that tuning keeps; the gains of the other laws have no floor."""
LAWS = {
    "NBS, untrained": "nbs",
    "NBS, trained": "nbs",
    "Slotine–Li": "slotine-li",
    "computed torque": "computed-torque",
    "PD+": "pd-plus",
    "PID": "pid",
}
"""Rows of the table, and the name of each law for `build_law`."""


@dataclass(frozen=True)
class Setting:
    """One arm at one control period, and the budget of every law on it."""

    arm: str
    period: float
    """Control period, and plant step of the tuning [s]."""
    starts: int
    """Training starts per reference."""
    checking: int
    """Further starts per reference, which choose the epoch and the learning rate."""
    start_error: float
    """Starts are at rest, each joint within this of the reference's start [rad]."""
    search: int = 15
    """Epochs with every learning rate."""
    epochs: int = 60
    """Further epochs with the best of them."""
    duration: float = 1.0
    """Duration of a training motion [s]."""
    judged: float = 4.0
    """Duration of the motions of the table [s]."""

    @property
    def judged_step(self) -> float:
        """Longest plant step of those motions [s]."""
        return min(self.period, 0.005)

    def robot(self) -> Robot:
        """The arm with its limits."""
        robot = load_robot(self.arm)
        return robot.with_effort_limit(100.0) if self.arm == "two_link" else robot

    def reference(self, robot: Robot, frequency: float) -> DesiredMotion:
        """The paper's motion at that frequency on two_link, one that the arm can follow on every other."""
        if self.arm != "two_link":
            return Sinusoid.for_robot(robot, frequency)
        return Sinusoid(amplitude=np.ones(2), frequency=frequency, phase=np.array([0.0, 0.5 * np.pi]))


SETTINGS = (
    Setting("two_link", 0.01, starts=12, checking=6, start_error=1.0, search=40, epochs=120),
    Setting("two_link", 0.001, starts=4, checking=6, start_error=1.0, duration=0.6),
    Setting("panda", 0.01, starts=12, checking=6, start_error=0.5, search=40, epochs=120),
    Setting("panda", 0.001, starts=4, checking=6, start_error=0.5, duration=0.6),
)
QUICK = (Setting("two_link", 0.01, starts=4, checking=2, start_error=1.0, search=3, epochs=10),)
"""To see the page in a minute; nothing is tuned to its end."""


class Row(NamedTuple):
    """A law on one reference, over held-out starts; figures as in `training.evaluation.fresh_figures`."""

    arm: str
    period_s: float
    frequency_rad_per_s: float
    law: str
    convergence_time_median_s: float
    """inf if most starts do not converge."""
    convergence_time_worst_s: float
    steady_error_rad2: float
    """Aligned in time; NaN, as all below, if a motion is not finite."""
    peak_torque_Nm: float
    rms_torque_Nm: float
    saturated_fraction: float
    learning_rate: float | None = None
    """The best one; None for a law that is not tuned."""
    checking_cost: float | None = None
    """Mean cost of the checking motions of all references before tuning."""
    checking_cost_tuned: float | None = None
    """The same after tuning."""


class Tuned(NamedTuple):
    """A law after tuning."""

    law: Any
    training: Training | None = None
    """None for a law that is not tuned, as all below."""
    learning_rate: float | None = None
    checking_cost: float | None = None
    """Before tuning."""


def compare_fairly(
    settings: Sequence[Setting] = SETTINGS,
    *,
    seed: int = 0,
    held_out_starts: int = FRESH_STARTS,
    progress: bool = False,
) -> list[Row]:
    """A row per setting, reference and law.

    Every law but the untrained one is tuned by `train` with the same optimiser, cost, learning rates, epochs, motions
    and checking motions, from its own `for_robot`; only then it is judged on `held_out_starts` of every reference.
    """
    rows = []
    tasks = [(setting, name) for setting in settings for name in LAWS]
    doing = [""]
    for setting, name in tracked(tasks, lambda: f"fair comparison, {doing[0]}", progress):
        doing[0] = f"{setting.arm} at {1000 * setting.period:g} ms, {name}"
        tuned = tune(setting, name, seed=seed)
        after = None if tuned.training is None else _checked(tuned.training)
        for row in judge(setting, name, tuned.law, count=held_out_starts, seed=seed):
            row = row._replace(learning_rate=tuned.learning_rate, checking_cost=tuned.checking_cost)
            rows.append(row._replace(checking_cost_tuned=after))
    return rows


def tune(setting: Setting, name: str, *, seed: int = 0) -> Tuned:
    """The law of that row, tuned with the setting's budget: a search over learning rates, then longer with the best.

    If the longer training does not improve the law, that of the search is kept.
    """
    law = build_law(LAWS[name], setting.robot(), period=setting.period, seed=seed, least_share=LEAST_SHARE)
    if name == "NBS, untrained":
        return Tuned(law)
    searched = {rate: _train(setting, law, rate, setting.search, seed) for rate in LEARNING_RATES}
    rate = min(searched, key=lambda rate: _checked(searched[rate]))
    longer = _train(setting, searched[rate].controller, rate, setting.epochs, seed)
    best = min(searched[rate], longer, key=_checked)
    return Tuned(best.controller, best, rate, float(searched[rate].held_out[0]))


def judge(setting: Setting, name: str, law: Any, *, count: int, seed: int) -> list[Row]:
    """The law on every reference, from `count` starts that `train` never draws."""
    robot, period = setting.robot(), setting.period
    plant, step = DynamicsPlant(PinocchioDynamics(robot)), setting.judged_step
    loop = Loop.of(plant, robot.nv, setting.judged, period, plant_step=step, effort_limit=None, lookahead=None)
    rows = []
    for frequency in FREQUENCIES:
        batch = fresh_batch(loop, [setting.reference(robot, frequency)], setting.start_error, seed, count)
        rows.append(Row(setting.arm, period, frequency, name, **fresh_figures(compared(law, batch))))
    return rows


def fair_part(folder: Path, seed: int, progress: bool, settings: Sequence[Setting] = SETTINGS) -> list[Section]:
    """Run the comparison, write `fair.csv` and `fair.png` into the folder and return the sections of the page."""
    from nbs_pin.reports.charts import plot_comparison

    rows = compare_fairly(settings, seed=seed, progress=progress)
    records = [row._asdict() for row in rows]
    write_csv(folder / "fair.csv", Row._fields, rows)
    plot_comparison(records, folder / "fair.png")
    sections = [Section("The fair comparison", _protocol(rows, seed), {"fair": plain(records)})]
    for s in settings:
        limit = "|τ| ≤ 100 N·m" if s.arm == "two_link" else "its own effort limits"
        own = [row for row in rows if (row.arm, row.period_s) == (s.arm, s.period)]
        sections.append(Section(f"{s.arm}, control at {1000 * s.period:g} ms, {limit}", _tables(own)))
    return sections


def _train(setting: Setting, law: Any, rate: float, epochs: int, seed: int) -> Training:
    robot = setting.robot()
    training = train(
        law,
        DynamicsPlant(PinocchioDynamics(robot)),
        [setting.reference(robot, frequency) for frequency in FREQUENCIES],
        starts=setting.starts,
        held_out=setting.checking,
        start_error=setting.start_error,
        duration=setting.duration,
        period=setting.period,
        cost=TimeOutside(PAPER_THRESHOLD),
        epochs=epochs,
        optimiser="adam-backtracking",
        learning_rate=rate,
        seed=seed,
    )
    if training.stopped == "interrupted":  # every law gets the whole budget
        raise KeyboardInterrupt
    return training


def _checked(training: Training) -> float:
    return float(training.held_out[training.best_epoch])


def _protocol(rows: Sequence[Row], seed: int) -> str:
    """The method of the comparison, from its settings."""
    rates, cost = ", ".join(f"{rate:g}" for rate in LEARNING_RATES), TimeOutside(PAPER_THRESHOLD)
    head = ("setting", "epochs of search, each rate", "further epochs", "training starts per reference",
            "checking starts", "start error [rad]", "training motion [s]", "plant step, tuning [ms]", "judging [ms]",
            "judged motion [s]")  # fmt: skip
    cells = [
        (
            f"{s.arm}, {1000 * s.period:g} ms",
            *(str(n) for n in (s.search, s.epochs, s.starts, s.checking)),
            *(f"{x:g}" for x in (s.start_error, s.duration, 1000 * s.period, 1000 * s.judged_step, s.judged)),
        )
        for s in SETTINGS
    ]
    return f"""Each law starts from its own `for_robot` at 8 rad/s and is tuned by the same optimiser (Adam that
reverts when the cost has risen): a search over {len(LEARNING_RATES)} learning rates ({rates}), then longer with
the best, on the same motions along references of {", ".join(f"{w:g}" for w in FREQUENCIES)} rad/s. Checking starts
choose the epoch and the learning rate. The cost is ∫ ‖z1‖²/(‖z1‖² + {cost.threshold:g}) + {cost.pull:g}‖z1‖² dt, nearly
the time spent outside the paper's mark of convergence, with torques cut off at the limits.

The table has {FRESH_STARTS} further starts per reference. All starts are at rest, every joint within the start
error of the reference. Convergence is the paper's: the time from which ‖z1‖² stays below {PAPER_THRESHOLD:g} rad²,
counted in control periods. Steady error is the largest ‖z1‖² of the last 30 % of the time over all starts, aligned in
time. Peak torque is that of one joint, RMS torque that of ‖τ‖ over starts and time; saturated is the share of control
periods with any joint beyond its limit. One draw of starts, one seed: small leads are not separated from chance.

{markdown_table(head, cells)}

Every law but the PID has the exact, frictionless model, and all have a look-ahead of half a period. {_edges(rows)}

What is not equal: only NBS has floors, at least {percent(LEAST_SHARE)} of its S, Λ and D₀, and a rate ω that tuning
does not change; the gains of every other law are free. Its networks are those of one seed ({seed}). The laws start from
different costs, given below each table. Tuning takes one plant step per control period, judging the steps above. The
motions of the tuning are shorter than those of the table, and its cost hardly depends on the motion inside the mark:
chattering there, or later, is not penalised.

A lead of less than one control period is within the resolution of the measure, and is marked as such:

{_findings(rows)}

![Convergence of every law](fair.png)
"""


def _edges(rows: Sequence[Row]) -> str:
    """The laws whose best learning rate is an end of the range."""
    ends = (min(LEARNING_RATES), max(LEARNING_RATES))
    found = dict.fromkeys(f"{r.law} on {r.arm} at {1000 * r.period_s:g} ms" for r in rows if r.learning_rate in ends)
    return f"Best learning rate at an end of the range: {', '.join(found) or 'none'}."


def _findings(rows: Sequence[Row]) -> str:
    """Sentences on every setting and reference, from the numbers of the table."""
    groups: dict[str, list[Row]] = {}
    for row in rows:
        where = f"{row.arm}, {1000 * row.period_s:g} ms, {row.frequency_rad_per_s:g} rad/s"
        groups.setdefault(where, []).append(row)
    return "\n".join(f"* {where}: {_finding(group)}" for where, group in groups.items())


def _finding(group: Sequence[Row]) -> str:
    """Which law converges first in one setting along one reference, by how much, and the figures of trained NBS."""
    first, *others = sorted(group, key=lambda row: row.convergence_time_median_s)
    best, second = first.convergence_time_median_s, others[0].convergence_time_median_s
    ours = next(row for row in group if row.law == "NBS, trained")
    if not math.isfinite(best):
        lead = "no law converges from most starts"
    elif second == best:
        lead = f"lowest median {_time(best)} s, shared by {first.law} and {others[0].law}"
    else:
        lead = f"lowest median {_time(best)} s ({first.law}), then {_time(second)} s ({others[0].law})"
    if second - best < (1.0 - 1e-9) * first.period_s:
        lead += ", less than one control period apart and so within the resolution of the measure"
    as_built = ours.checking_cost is not None and ours.checking_cost == ours.checking_cost_tuned
    told = ", as it was built since tuning did not improve it," if as_built else ":"
    return (
        f"{lead}. Trained NBS{told} median {_time(ours.convergence_time_median_s)} s, worst start"
        f" {_time(ours.convergence_time_worst_s)} s, steady error {_number(ours.steady_error_rad2, '.1e')} rad²."
    )


def _tables(rows: Sequence[Row]) -> str:
    """The figures of every law and reference of one setting, and the tuning of every law."""
    head = ("law", "ω [rad/s]", "convergence, median [s]", "worst [s]", "steady error [rad²]", "RMS torque [N·m]",
            "peak torque [N·m]", "saturated")  # fmt: skip
    cells = [
        (
            r.law,
            f"{r.frequency_rad_per_s:g}",
            _time(r.convergence_time_median_s),
            _time(r.convergence_time_worst_s),
            _number(r.steady_error_rad2, ".1e"),
            _number(r.rms_torque_Nm, ".1f"),
            _number(r.peak_torque_Nm, ".1f"),
            percent(r.saturated_fraction, 1) if math.isfinite(r.saturated_fraction) else "not finite",
        )
        for r in sorted(rows, key=lambda r: r.frequency_rad_per_s)
    ]
    tuned = {r.law: (r.law, f"{r.learning_rate:g}", f"{r.checking_cost:.4f}", f"{r.checking_cost_tuned:.4f}")
             for r in rows if r.checking_cost is not None}  # fmt: skip
    tuning = markdown_table(("law", "learning rate", "before", "after"), list(tuned.values()))
    return (
        f"{markdown_table(head, cells)}\n\nMean cost of the checking motions [s] before and after tuning:\n\n{tuning}"
    )


def _time(value: float) -> str:
    return f"{value:.3f}" if math.isfinite(value) else "∞"


def _number(value: float, form: str) -> str:
    return format(value, form) if math.isfinite(value) else "not finite"
