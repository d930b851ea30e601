"""The fair comparison: every law tuned alike on an arm as it is, and judged on loads, motions and starts held out."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from nbs_pin.base.csv_files import write_csv
from nbs_pin.base.plain import plain
from nbs_pin.base.units import percent
from nbs_pin.benchmarks.fair_tuning import CHARGE, ROUGH, Budget, gain_groups, scaled, searched, trained
from nbs_pin.benchmarks.real_arms import (
    AWAY,
    BODIES,
    ENCODER,
    LOADS,
    OFF_CENTRE,
    PERIOD,
    WARMTH,
    RealArm,
    Trial,
    attempt,
)
from nbs_pin.controllers.adaptive_law import AdaptiveLaw
from nbs_pin.controllers.controller import Controller
from nbs_pin.controllers.registry import build_law
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.identification.collect import collect
from nbs_pin.identification.fit import fit
from nbs_pin.identification.measurement import Noise
from nbs_pin.reports.markdown import Section, markdown_table
from nbs_pin.simulation.processes import on_all_cores

ALL = ("load", "friction", "rotors")
"""What an adaptive law adapts that is told the description alone."""
INTEGRAL = ("offsets",)
"""What integral action adapts: constant torques."""
LEAST_SHARE = 0.01
"""Least share of NBS's S, Λ and D₀ that training keeps."""
TRANSITION = 0.05
"""Speed over which laws that compensate Coulomb friction change its sign [rad/s]: two steps of the encoders."""
SAMPLES, TORQUE_NOISE = 4_000, 0.1
"""Samples of excited motion that models are learned from, and the noise of their torques [N·m]."""
AS_IT_COMES = "NBS, as it comes"
"""The row of the law that nothing is tuned of."""


@dataclass(frozen=True)
class Family:
    """Rows of the table that share a law and its training."""

    law: str
    """Name for `build_law`."""
    rows: dict[str, tuple[str, ...]]
    """Rows, and what an adaptive law around the trained one adapts in them; () is the trained one itself."""
    model: str | None = None
    """Name for `fit` of the model that is learned from the unloaded arm; None is that of the description."""


FAMILIES = (
    Family("nbs", {"NBS": (), "NBS, adaptive": ALL, "NBS, integral": INTEGRAL}),
    Family("slotine-li", {"Slotine–Li": (), "Slotine–Li, adaptive": ALL}),
    Family("computed-torque", {"computed torque": (), "computed torque, integral": INTEGRAL}),
    Family("pd-plus", {"PD+": ()}),
    Family("pid", {"PID": ()}),
    Family("nbs", {"NBS, identified": (), "NBS, identified, adaptive": ("load",)}, "identified"),
    Family("computed-torque", {"computed torque, identified": ()}, "identified"),
    Family("pd-plus", {"PD+, identified": ()}, "identified"),
)
"""All entrants."""


@dataclass(frozen=True)
class Study:
    """Arms, and the budget of every law on each."""

    arms: tuple[str, ...] = tuple(LOADS)
    families: tuple[Family, ...] = FAMILIES
    budget: Budget = field(default_factory=Budget)
    held_out: int = 12
    """Trials that no law was tuned on."""
    judged: float = 6.0
    """Duration of their motions [s], of which the second half counts."""


QUICK = Study(
    ("ur5",), FAMILIES[:2], Budget(trials=1, rates=(0.1,), epochs=2, trained=0.2, evaluations=4, searched=0.4), 2, 0.6
)
"""To see the page in a minute; nothing is tuned to its end."""


class Row(NamedTuple):
    """A law on an arm, over the held-out trials; medians and worst of `real_arms.Figures`."""

    arm: str
    law: str
    error_median_rad: float
    """inf where most trials diverge; a worst or mean value is inf where one does."""
    error_worst_rad: float
    peak_median_rad: float
    tool_median_m: float
    roughness_median: float
    saturated_mean: float
    cost: float | None = None
    """Mean cost of the trials of tuning; None for a law that is not tuned."""
    factors: tuple[float, ...] = ()
    """What the search multiplied the gains of every group with, then γ, of which `adaptive` takes at most 1.5."""


def compare_fairly(study: Study = Study(), *, seed: int = 0, progress: bool = False) -> Iterator[list[Row]]:
    """The rows of every arm and family, in order; families are computed on all cores."""
    tasks = [(study, arm, family, seed) for arm in study.arms for family in study.families]
    yield from on_all_cores(rows_of, tasks, "fair comparison", progress)


def rows_of(study: Study, name: str, family: Family, seed: int) -> list[Row]:
    """The rows of one family on one arm."""
    arm, budget = RealArm.of(name, seed), study.budget
    own, others = arm.trials(budget.trials, seed, 1), arm.trials(study.held_out, seed, 2)
    law = build(family, arm, seed)
    rows = []
    if AS_IT_COMES.startswith(next(iter(family.rows))):
        rows.append(judged(arm, AS_IT_COMES, law, others, study.judged))
    law = trained(law, own, budget, seed)
    groups = len(gain_groups(law))
    for row, adapts in family.rows.items():

        def make(factors: np.ndarray, adapts: tuple[str, ...] = adapts) -> Controller:
            inner = scaled(law, factors[:groups].tolist())
            return adaptive(inner, adapts, float(factors[-1])) if adapts else inner

        found = searched(make, groups + bool(adapts), own, budget)
        row_of = judged(arm, row, found.law, others, study.judged)
        rows.append(row_of._replace(cost=found.cost, factors=found.factors))
    return rows


def build(family: Family, arm: RealArm, seed: int) -> Any:
    """The law of the family with its own `for_robot`, on the description or on a learned model."""
    settings: dict[str, Any] = {"period": PERIOD, "seed": seed, "least_share": LEAST_SHARE}
    n = arm.told.nv
    friction: JointFriction | None = JointFriction(np.zeros(n), np.zeros(n), TRANSITION)  # where an adaptive law begins
    if family.model is not None:
        noise = Noise(encoder=ENCODER, torque=TORQUE_NOISE)
        data = collect(arm.true(), "excited", samples=SAMPLES, seed=seed, noise=noise, friction=arm.friction)
        asked: dict[str, Any] = {"friction": True, "rotor_inertia": True, "transition": TRANSITION}
        model = fit(data, family.model, seed, robot=arm.told, **asked)
        settings["dynamics"], friction = model, model.friction
    return build_law(family.law, arm.told, friction=friction, **settings)


def adaptive(law: Any, adapts: Sequence[str], factor: float) -> AdaptiveLaw:
    """The law with an adaptive model; γ is the factor times its default, at most 1.5 times."""
    gain = min(0.6 * factor, 0.9)
    return AdaptiveLaw(law, adapts, gain=gain, period=PERIOD)


def judged(arm: RealArm, row: str, law: Controller, trials: Sequence[Trial], duration: float) -> Row:
    """The law on the held-out trials."""
    figures = np.array([attempt(law, trial, duration) for trial in trials])
    error, peak, tool, rough, _ = np.median(figures, axis=0).tolist()
    worst, saturated = float(figures[:, 0].max()), float(figures[:, 4].mean())
    return Row(arm.name, row, error, worst, peak, tool, rough, saturated)


def fair_part(folder: Path, seed: int, progress: bool, study: Study = Study()) -> Iterator[Section]:
    """Run the comparison and give the sections of the page; `fair.csv` grows with every family, then `fair.png`."""
    from nbs_pin.reports.charts import plot_comparison

    rows: list[Row] = []
    try:
        for found in compare_fairly(study, seed=seed, progress=progress):
            rows += found
            write_csv(folder / "fair.csv", Row._fields, [_cells(row) for row in rows])
    except KeyboardInterrupt:
        if rows:
            yield Section("The fair comparison, interrupted", _tables(rows), {"fair": plain(_records(rows))})
        raise
    plot_comparison(_records(rows), folder / "fair.png")
    text = f"{_protocol(study, seed)}\n\n{_findings(rows)}\n\n{_tables(rows)}\n\n![Errors of every law](fair.png)"
    yield Section("The fair comparison", text, {"fair": plain(_records(rows))})


def _records(rows: Sequence[Row]) -> list[dict[str, Any]]:
    return [row._asdict() for row in rows]


def _cells(row: Row) -> tuple[Any, ...]:
    return *row[:-1], " ".join(f"{factor:.3g}" for factor in row.factors)


def _protocol(study: Study, seed: int) -> str:
    """The method of the comparison, from its settings."""
    budget, rates = study.budget, " and ".join(f"{rate:g}" for rate in study.budget.rates)
    loads = ", ".join(f"{arm} {LOADS[arm]:g} kg" for arm in study.arms)
    return f"""**The arms as they are.** MuJoCo at {1000 * PERIOD:g} ms with the arm's own torque limits. Rotors and
friction of fr3 are those of its description; panda and ur5 have rotors of 0.1 kg·m² at every joint, Coulomb friction of
2 % of the effort limit and as much viscous friction at full speed. Every body is up to {percent(BODIES)} heavier or
lighter than described. In each trial the tool carries a load from nothing up to ({loads}), its centre up to
{100 * OFF_CENTRE:g} cm off on every axis, friction is up to {percent(WARMTH)} more or less, the motion is a sinusoid of
another amplitude (0.2 to 0.5 rad) and frequency (0.5 to 2.5 rad/s), and the start is at rest up to {AWAY:g} rad off in
every joint. Encoders have {-round(math.log2(ENCODER))} bits a turn, and velocities are differences of readings.

**What the laws are told.** The description without rotors, friction and load. "adaptive" learns load, friction and
rotors while it moves, "integral" constant torques. "identified" has a model from {SAMPLES:,} samples of excited motion
of the unloaded arm, read by the same encoders with torque noise of {TORQUE_NOISE:g} N·m, in the geometry of the
description, with its rotors and friction; "identified, adaptive" learns the load beside it.

**Tuning, alike for all.** Every law starts from its own `for_robot` and is trained by `train` on {budget.trials} trials
at once, with encoder noise (learning rate {rates}, {budget.epochs} epochs). Then every group of its gains, and γ of
adaptive laws, is scaled by one factor for all joints, found by Nelder and Mead's method with {budget.evaluations}
evaluations in MuJoCo on the same trials. The cost of both is the mean of
ln(error) + {CHARGE:g} max(0, ln(roughness / {percent(ROUGH)})). An error is the RMS error of the worst joint over the
second half of a motion, roughness the RMS change of a torque in a millisecond as a share of its limit, on the worst
joint: all have the same leave to be rough. An adaptive law is built around the trained law of the same name.

**Judging.** {study.held_out} further trials of {study.judged:g} s, of which no law has seen load, friction, motion or
start. Seed {seed}: one arm of each kind, one draw of networks."""


def _findings(rows: Sequence[Row]) -> str:
    """Who is ahead on every arm, among all and among those that are told the description alone."""
    found = []
    for arm in dict.fromkeys(row.arm for row in rows):
        own = [row for row in rows if row.arm == arm]
        bare = [row for row in own if "identified" not in row.law]
        found.append(f"* {arm}: {_lead(own)}. Without a learned model: {_lead(bare)}.")
    return "\n".join(found)


def _lead(rows: Sequence[Row]) -> str:
    first, *others = sorted(rows, key=lambda row: row.error_median_rad)
    if not math.isfinite(first.error_median_rad):
        return "every law diverges in most trials"
    lead = f"lowest median error {_mrad(first.error_median_rad)} mrad ({first.law})"
    return lead + (f", then {_mrad(others[0].error_median_rad)} ({others[0].law})" if others else "")


def _tables(rows: Sequence[Row]) -> str:
    """A table for every arm."""
    head = ("law", "error, median [mrad]", "worst [mrad]", "peak, median [mrad]", "tool, median [mm]",
            "roughness, median", "saturated")  # fmt: skip
    tables = []
    for arm in dict.fromkeys(row.arm for row in rows):
        cells = [
            (
                row.law,
                *(
                    _mrad(x)
                    for x in (row.error_median_rad, row.error_worst_rad, row.peak_median_rad, row.tool_median_m)
                ),
                *(percent(x, 2) if math.isfinite(x) else "∞" for x in (row.roughness_median, row.saturated_mean)),
            )
            for row in rows
            if row.arm == arm
        ]
        tables.append(f"**{arm}**\n\n{markdown_table(head, cells)}")
    return "\n\n".join(tables)


def _mrad(value: float) -> str:
    """Thousandths, in three digits."""
    return f"{1e3 * value:.3g}" if math.isfinite(value) else "∞"
