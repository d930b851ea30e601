"""The fair comparison: one budget for all, starts that nobody trained on, and no claim beyond the table."""

import csv
import json
import math
from dataclasses import replace

import numpy as np
import pytest

from nbs_pin.benchmarks import fair
from nbs_pin.controllers.computed_torque import ComputedTorque
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.training.train import Training, train

SMALL = fair.Setting(
    "two_link", 0.02, starts=2, checking=1, start_error=1.0, search=2, epochs=3, duration=0.4, judged=2.0
)


@pytest.fixture(scope="module")
def rows():
    return fair.compare_fairly([SMALL], held_out_starts=5)


def test_every_law_meets_every_reference_within_the_limits(rows):
    assert [(r.frequency_rad_per_s, r.law) for r in rows] == [(w, law) for law in fair.LAWS for w in fair.FREQUENCIES]
    for row in rows:
        assert row.convergence_time_median_s <= row.convergence_time_worst_s
        assert row.rms_torque_Nm > 0.0
        assert row.peak_torque_Nm <= 100.0
        assert 0.0 <= row.saturated_fraction <= 1.0


@pytest.fixture
def asked(monkeypatch):
    """Every training that is asked for, and what came of it."""
    asked = []

    def noted(law, plant, references, **settings):
        asked.append((law, repr(plant), references, settings, train(law, plant, references, **settings)))
        return asked[-1][-1]

    monkeypatch.setattr(fair, "train", noted)
    return asked


def score(training):
    return training.held_out[training.best_epoch]


def test_one_budget_for_all(asked):
    """Law by law the same words; only which rate goes on is the law's own."""
    known = None
    for name in fair.LAWS:
        asked.clear()
        fair.tune(SMALL, name)
        if name == "NBS, untrained":
            assert not asked
            continue
        rates = [settings.pop("learning_rate") for *_, settings, _ in asked]
        assert rates[:-1] == list(fair.LEARNING_RATES)
        assert rates[-1] in fair.LEARNING_RATES
        words = [(plant, settings) for _, plant, _, settings, _ in asked]
        assert [w["epochs"] for _, w in words] == [SMALL.search] * len(fair.LEARNING_RATES) + [SMALL.epochs]
        curves = [[reference(np.linspace(0.0, 1.0, 7)).q for reference in entry[2]] for entry in asked]
        known = known or (words, curves)
        assert words == known[0]
        np.testing.assert_array_equal(curves, known[1])


@pytest.mark.parametrize("law", ["PD+", "NBS, trained"])
def test_the_best_learning_rate_goes_on_from_where_it_came(asked, law):
    tuned = fair.tune(SMALL, law)
    *searched, longer = (entry[-1] for entry in asked)
    best = int(np.argmin([score(training) for training in searched]))
    assert tuned.learning_rate == fair.LEARNING_RATES[best] == asked[-1][3]["learning_rate"]
    assert asked[-1][0] is searched[best].controller
    assert longer.held_out[0] == pytest.approx(score(searched[best]), rel=1e-12)
    assert score(tuned.training) == min(score(searched[best]), score(longer)) < searched[0].held_out[0]


def test_a_longer_training_that_betters_nothing_is_not_taken(monkeypatch):
    law = ComputedTorque(PinocchioDynamics(SMALL.robot()), kp=60.0, kd=16.0)

    def given(law, *_, epochs, learning_rate, **__):
        held_out = np.array([1.0, 2.0 if epochs == SMALL.epochs else learning_rate])
        return Training(law, held_out, held_out, int(held_out.argmin()), "epochs", 0.0)

    monkeypatch.setattr(fair, "train", given)
    monkeypatch.setattr(fair, "build_law", lambda *_, **__: law)
    tuned = fair.tune(SMALL, "computed torque")
    assert tuned.learning_rate == score(tuned.training) == min(fair.LEARNING_RATES)


def test_ctrl_c_ends_the_comparison_and_not_one_tuning(monkeypatch):
    def interrupted(*arguments, **settings):
        return replace(train(*arguments, **settings | {"epochs": 1}), stopped="interrupted")

    monkeypatch.setattr(fair, "train", interrupted)
    with pytest.raises(KeyboardInterrupt):
        fair.compare_fairly([SMALL], held_out_starts=2)


def test_a_law_that_diverges_is_not_converged():
    law = fair.tune(SMALL, "NBS, untrained").law
    wild = ComputedTorque(law.dynamics, kp=1e6, kd=1e3)
    calm = fair.judge(SMALL, "calm", law, count=3, seed=0)
    assert all(math.isfinite(row.convergence_time_worst_s) for row in calm)
    assert not math.isfinite(
        fair.judge(replace(SMALL, judged=0.2), "wild", wild, count=3, seed=0)[0].convergence_time_worst_s
    )


def test_the_page_the_csv_and_the_figures_carry_one_table(rows, monkeypatch, tmp_path):
    monkeypatch.setattr(fair, "compare_fairly", lambda *_, **__: rows)
    sections = fair.fair_part(tmp_path, 0, False, (SMALL,))
    page = "\n".join(section.markdown for section in sections)
    with (tmp_path / "fair.csv").open() as file:
        written = list(csv.DictReader(file))
    tables = "".join(section.markdown for section in sections[1:])
    assert len(written) == len(rows) == tables.count("\n| ") - 2 - len(fair.LAWS)
    assert tables.count(f"| {rows[3].learning_rate:g} | {rows[3].checking_cost:.4f} |") >= 1
    assert all(row.checking_cost_tuned <= row.checking_cost for row in rows if row.law != "NBS, untrained")
    for row, entry in zip(rows, written, strict=True):
        assert float(entry["convergence_time_median_s"]) == row.convergence_time_median_s
        assert f"{row.steady_error_rad2:.1e} | {row.rms_torque_Nm:.1f} | {row.peak_torque_Nm:.1f} |" in page
    best = min(r.convergence_time_median_s for r in rows if r.frequency_rad_per_s == 1.0)
    assert f"20 ms, 1 rad/s: lowest median {best:.3f} s" in page
    assert len(json.loads(json.dumps(sections[0].figures, allow_nan=False))["fair"]) == len(rows)
    assert (tmp_path / "fair.png").stat().st_size > 10_000


def test_the_protocol_is_made_from_the_settings(rows, monkeypatch):
    odd = replace(SMALL, starts=17, checking=7, start_error=0.37, search=19, epochs=23, duration=0.43, judged=2.9)
    monkeypatch.setattr(fair, "SETTINGS", (odd,))
    said = fair._protocol(rows, seed=41)
    assert "| two_link, 20 ms | 19 | 23 | 17 | 7 | 0.37 | 0.43 | 20 | 5 | 2.9 |" in said
    assert "one seed (41)" in said
    assert "at least 10 % of its S, Λ and D₀" in said


@pytest.mark.parametrize(
    ("second", "words"),
    [
        (0.5, "lowest median 0.500 s, shared by NBS, trained and PD+, less than one control period apart"),
        (0.51, "(NBS, trained), then 0.510 s (PD+), less than one control period apart"),
        (0.52, "(NBS, trained), then 0.520 s (PD+)."),
        (math.inf, "(NBS, trained), then ∞ s (PD+)."),
    ],
)
def test_a_lead_of_less_than_a_period_is_told(second, words):
    ours = fair.Row("two_link", 0.02, 1.0, "NBS, trained", 0.5, 0.7, 1e-9, 90.0, 20.0, 0.1)
    other = ours._replace(law="PD+", convergence_time_median_s=second)
    told = fair._findings([other, ours] if second > 0.5 else [ours, other])
    assert words in told
    assert ", as it was built" in fair._findings([ours._replace(checking_cost=0.2, checking_cost_tuned=0.2)] * 2)
    assert told.endswith("Trained NBS: median 0.500 s, worst start 0.700 s, steady error 1.0e-09 rad².")


def test_no_law_is_first_where_none_converges():
    row = fair.Row("two_link", 0.02, 1.0, "NBS, trained", math.inf, math.inf, math.nan, math.nan, math.nan, math.nan)
    assert "no law converges from most starts. " in fair._findings([row, row._replace(law="PID")])
    assert fair._tables([row]).count("not finite") == 4
