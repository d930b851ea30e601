"""The fair comparison: every law tuned alike on the same motions, and judged on starts that none of them has seen."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from nbs_pin.base.csv_files import write_csv
from nbs_pin.base.plain import plain
from nbs_pin.base.progress import tracked
from nbs_pin.controllers.neural_backstepping import NeuralBackstepping
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
"""Of the references [rad/s]."""
LEARNING_RATES = (0.001, 0.003, 0.01, 0.03, 0.1, 0.3)
"""Every law is tuned shortly with each, and goes on with the one of the lowest held-out cost."""
LEAST_SHARE = 0.1
"""What tuning leaves at least of NBS's S, Λ and D₀; the gains of the other laws have no floor at all."""
LAWS = {
    "NBS, untrained": "nbs",
    "NBS, trained": "nbs",
    "Slotine–Li": "slotine-li",
    "computed torque": "computed-torque",
    "PD+": "pd-plus",
    "PID": "pid",
}
"""Rows of the table, and the law of each as `build_controller` names it."""


@dataclass(frozen=True)
class Setting:
    """One arm at one control period, and the budget of every law on it."""

    arm: str
    period: float
    """[s]; one plant step while tuning."""
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
    """Of a training motion [s]."""
    judged: float = 4.0
    """Duration of the motions the table is made of [s]."""

    @property
    def judged_step(self) -> float:
        """Longest plant step of those motions [s]."""
        return min(self.period, 0.005)

    @property
    def title(self) -> str:
        """As the page says it."""
        limit = "|τ| ≤ 100 N·m" if self.arm == "two_link" else "its own effort limits"
        return f"{self.arm}, control at {1000 * self.period:g} ms, {limit}"

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


@dataclass(frozen=True)
class Row:
    """A law on one reference, over held-out starts; figures as `training.evaluation.fresh_figures` has them."""

    arm: str
    period_s: float
    frequency_rad_per_s: float
    law: str
    convergence_time_median_s: float
    """inf where most starts do not converge."""
    convergence_time_worst_s: float
    steady_error_rad2: float
    """Aligned; NaN, as all below, where a motion is not finite."""
    peak_torque_Nm: float
    rms_torque_Nm: float
    saturated_fraction: float
    learning_rate: float | None = None
    """That went on; None for a law that is taken as it was built."""
    checking_cost: float | None = None
    """Mean cost of the checking motions under the law as it was built, of all references."""
    checking_cost_tuned: float | None = None
    """The same after tuning."""


class Tuned(NamedTuple):
    """A law as it was built and as tuning left it."""

    law: Any
    training: Training | None
    """None for a law that is taken as it was built."""
    learning_rate: float | None
    checking_cost: float | None
    """Of the law as it was built; None likewise."""


def compare_fairly(
    settings: Sequence[Setting] = SETTINGS,
    *,
    seed: int = 0,
    held_out_starts: int = FRESH_STARTS,
    progress: bool = False,
) -> list[Row]:
    """A row per setting, reference and law.

    Every law but the untrained one is tuned by `train` with the same optimiser, cost, learning rates, epochs, motions
    and checking motions, from its own `for_robot`; only then it meets the starts of the table.
    """
    rows = []
    tasks = [(setting, name) for setting in settings for name in LAWS]
    doing = [""]
    for setting, name in tracked(tasks, lambda: f"fair comparison, {doing[0]}", progress):
        doing[0] = f"{setting.arm} at {1000 * setting.period:g} ms, {name}"
        tuned = tune(setting, name, seed=seed)
        cost = None if tuned.training is None else _checked(tuned.training)
        for row in judge(setting, name, tuned.law, count=held_out_starts, seed=seed):
            before, rate = tuned.checking_cost, tuned.learning_rate
            rows.append(replace(row, learning_rate=rate, checking_cost=before, checking_cost_tuned=cost))
    return rows


def tune(setting: Setting, name: str, *, seed: int = 0) -> Tuned:
    """The law of that row, tuned with the setting's budget: a short search over learning rates, then on with the best.

    What going on does not better is left as the search had it.
    """
    law = _built(setting, name, setting.robot(), seed)
    if name == "NBS, untrained":
        return Tuned(law, None, None, None)
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


def fair_part(folder: Path, seed: int, progress: bool) -> list[Section]:
    """Runs the comparison, writes `fair.csv` and `fair.png` into the folder, and returns sections for the page."""
    from nbs_pin.reports.charts import plot_comparison

    rows = compare_fairly(seed=seed, progress=progress)
    write_csv(folder / "fair.csv", list(asdict(rows[0])), [list(asdict(row).values()) for row in rows])
    plot_comparison([asdict(row) for row in rows], folder / "fair.png")
    figures = plain([asdict(row) for row in rows])
    return [Section("The fair comparison", _protocol(rows, seed), {"fair": figures})] + [
        Section(setting.title, _of_setting([r for r in rows if (r.arm, r.period_s) == (setting.arm, setting.period)]))
        for setting in SETTINGS
    ]


def _built(setting: Setting, name: str, robot: Robot, seed: int) -> Any:
    if LAWS[name] == "nbs":
        return NeuralBackstepping.for_robot(robot, period=setting.period, least_share=LEAST_SHARE, seed=seed)
    return build_law(LAWS[name], robot, period=setting.period, seed=seed)


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
    if training.stopped == "interrupted":  # no law may be judged by less tuning than the others had
        raise KeyboardInterrupt
    return training


def _checked(training: Training) -> float:
    return float(training.held_out[training.best_epoch])


def _protocol(rows: Sequence[Row], seed: int) -> str:
    """How the table came about, from the settings themselves."""
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
    return f"""Each law starts from its own `for_robot` at 8 rad/s and is tuned by the same optimiser (Adam that goes
back when the cost has risen): a search over {len(LEARNING_RATES)} learning rates ({rates}), then on with
the best, on the same motions along references of {", ".join(f"{w:g}" for w in FREQUENCIES)} rad/s. Checking starts
choose the epoch and the learning rate. The cost is ∫ ‖z1‖²/(‖z1‖² + {cost.threshold:g}) + {cost.pull:g}‖z1‖² dt, nearly
the time spent outside the paper's mark of convergence, with torques cut off at the limits.

The table is made of {FRESH_STARTS} further starts per reference. All starts are at rest, every joint within the start
error of the reference. Convergence is the paper's: the time from which ‖z1‖² stays below {PAPER_THRESHOLD:g} rad²,
counted in control periods. Steady error is the largest ‖z1‖² of the last 30 % of the time over all starts, aligned in
time. Peak torque is that of one joint, RMS torque that of ‖τ‖ over starts and time; saturated is the share of control
periods with any joint beyond its limit. One draw of starts, one seed: small leads are not separated from chance.

{markdown_table(head, cells)}

Every law but the PID has the exact, frictionless model, and all look half a period ahead. {_edges(rows)}

What is not equal: NBS alone has floors, tuning leaves at least {LEAST_SHARE:.0%} of its S, Λ and D₀, and a rate ω that
tuning cannot move; the gains of every other law are free. Its networks are those of one seed ({seed}). Laws begin at
different costs, given below each table. Tuning takes one plant step per control period, judging the steps above. It
sees motions shorter than those it is judged by, and its cost hardly asks what a law does inside the mark: what chatters
there, or later, was chosen all the same.

A lead of less than one control period is within the resolution of the measure, and is marked so:

{_findings(rows)}

![Convergence of every law](fair.png)
"""


def _edges(rows: Sequence[Row]) -> str:
    """Which laws the search left at an end of the learning rates."""
    ends = (min(LEARNING_RATES), max(LEARNING_RATES))
    found = dict.fromkeys(f"{r.law} on {r.arm} at {1000 * r.period_s:g} ms" for r in rows if r.learning_rate in ends)
    return f"Left at an end of the learning rates: {', '.join(found) or 'none'}."


def _findings(rows: Sequence[Row]) -> str:
    """What the table carries, in sentences made from it."""
    return "\n".join(
        f"* {arm}, {1000 * period:g} ms, {frequency:g} rad/s: {_finding(group)}"
        for (arm, period, frequency), group in _grouped(rows).items()
    )


def _grouped(rows: Sequence[Row]) -> dict[tuple[str, float, float], list[Row]]:
    groups: dict[tuple[str, float, float], list[Row]] = {}
    for row in rows:
        groups.setdefault((row.arm, row.period_s, row.frequency_rad_per_s), []).append(row)
    return groups


def _finding(group: Sequence[Row]) -> str:
    """Who converges first in one setting along one reference, by how much, and where trained NBS stands."""
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
    told = ", as it was built since no tuning bettered it," if as_built else ":"
    return (
        f"{lead}. Trained NBS{told} median {_time(ours.convergence_time_median_s)} s, worst start"
        f" {_time(ours.convergence_time_worst_s)} s, steady error {_number(ours.steady_error_rad2, '.1e')} rad²."
    )


def _of_setting(rows: Sequence[Row]) -> str:
    return f"{_tables(rows)}\n\nWhat tuning did to the mean cost of the checking motions [s]:\n\n{_tuning(rows)}"


def _tuning(rows: Sequence[Row]) -> str:
    """Per law, the learning rate and the cost before and after."""
    tuned = {row.law: row for row in rows if row.checking_cost is not None}
    cells = [
        (law, f"{r.learning_rate:g}", f"{r.checking_cost:.4f}", f"{r.checking_cost_tuned:.4f}")
        for law, r in tuned.items()
    ]
    return markdown_table(("law", "learning rate", "before", "after"), cells)


def _tables(rows: Sequence[Row]) -> str:
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
            _number(r.saturated_fraction, ".1%"),
        )
        for r in sorted(rows, key=lambda r: r.frequency_rad_per_s)
    ]
    return markdown_table(head, cells)


def _time(value: float) -> str:
    return f"{value:.3f}" if math.isfinite(value) else "∞"


def _number(value: float, form: str) -> str:
    return format(value, form) if math.isfinite(value) else "not finite"
