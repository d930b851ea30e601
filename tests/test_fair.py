"""The fair comparison: one budget for all, starts that nobody trained on, and no claim beyond the table."""

import csv
import json
import math
from dataclasses import replace

import numpy as np
import pytest

from nbs_pin.controllers.computed_torque import ComputedTorque
from nbs_pin.learning.training import train
from nbs_pin.studies import fair

SMALL = fair.Setting("two_link", 0.02, starts=2, start_error=1.0, epochs=4, duration=0.4, judged=2.0)


@pytest.fixture(scope="module")
def rows():
    return fair.compare_fairly([SMALL], held_out_starts=5)


def test_every_law_meets_every_reference_within_the_limits(rows):
    assert [(r.frequency_rad_per_s, r.law) for r in rows] == [(w, law) for law in fair.LAWS for w in fair.FREQUENCIES]
    for row in rows:
        assert row.convergence_median_s <= row.convergence_worst_s
        assert row.rms_torque_Nm > 0.0
        assert row.peak_torque_Nm <= 100.0
        assert 0.0 <= row.saturated_fraction <= 1.0


def test_one_budget_for_all(monkeypatch):
    """Every training is asked for with the same words but law, learning rate and nothing else."""
    asked = {}

    def noted(law, plant, references, **settings):
        asked.setdefault(name, []).append((repr(plant), settings.pop("learning_rate"), settings, references))
        return train(law, plant, references, **settings | {"epochs": 1, "learning_rate": 0.01})

    monkeypatch.setattr(fair, "train", noted)
    for name in fair.LAWS:
        fair.tune(SMALL, name)
    assert set(asked) == set(fair.LAWS) - {"NBS, untrained"}
    first, *others = asked.values()
    assert [rate for _, rate, _, _ in first] == list(fair.LEARNING_RATES)
    for other in others:
        for (plant, rate, settings, references), known in zip(other, first, strict=True):
            assert (plant, rate, settings) == known[:3]
            times = np.linspace(0.0, 1.0, 7)
            for one, two in zip(references, known[3], strict=True):
                np.testing.assert_array_equal(one(times).q, two(times).q)


def test_tuning_takes_the_learning_rate_with_the_lowest_held_out_cost(monkeypatch):
    given = []

    def noted(*arguments, **settings):
        given.append(train(*arguments, **settings))
        return given[-1]

    monkeypatch.setattr(fair, "train", noted)
    tuned = fair.tune(SMALL, "PD+")
    costs = [t.held_out[t.best_epoch] for t in given]
    assert tuned.training is given[int(np.argmin(costs))]
    assert tuned.training.held_out.min() < tuned.training.held_out[0]
    assert fair.tune(SMALL, "NBS, untrained").training is None


def test_a_law_that_diverges_is_not_converged():
    law = fair.tune(SMALL, "NBS, untrained").law
    wild = ComputedTorque(law.dynamics, kp=1e6, kd=1e3)
    calm = fair.judge(SMALL, "calm", law, count=3, seed=0)
    assert all(math.isfinite(row.convergence_worst_s) for row in calm)
    assert not math.isfinite(
        fair.judge(replace(SMALL, judged=0.2), "wild", wild, count=3, seed=0)[0].convergence_worst_s
    )


def test_the_page_the_csv_and_the_figures_carry_one_table(rows, monkeypatch, tmp_path):
    monkeypatch.setattr(fair, "SETTINGS", (SMALL,))
    monkeypatch.setattr(fair, "compare_fairly", lambda **_: rows)
    sections = fair.fair_part(tmp_path, 0, False)
    page = "\n".join(section.markdown for section in sections)
    with (tmp_path / "fair.csv").open() as file:
        written = list(csv.DictReader(file))
    assert len(written) == len(rows) == page.count("\n| ") - 2
    for row, entry in zip(rows, written, strict=True):
        assert float(entry["convergence_median_s"]) == row.convergence_median_s
        assert f"{row.steady_error_rad2:.1e} | {row.rms_torque_Nm:.1f} | {row.peak_torque_Nm:.1f} |" in page
    best = min(r.convergence_median_s for r in rows if r.frequency_rad_per_s == 1.0)
    assert f"20 ms, 1 rad/s: lowest median {best:.3f}" in page
    assert len(json.loads(json.dumps(sections[0].figures, allow_nan=False))["fair"]) == len(rows)
    assert (tmp_path / "fair.png").stat().st_size > 10_000
