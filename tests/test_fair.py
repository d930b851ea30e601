"""The fair comparison: one budget for all, trials that nobody was tuned on, and no claim beyond the table."""

import csv
import json
import math
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
import torch

import nbs_pin as nbs
from nbs_pin.benchmarks import fair, fair_tuning, real_arms
from nbs_pin.benchmarks.fair_tuning import Budget
from nbs_pin.benchmarks.real_arms import Figures, RealArm
from nbs_pin.robots.places import tool_frame
from nbs_pin.training.train import train

TINY = Budget(trials=2, rates=(0.1, 0.2), epochs=1, trained=0.02, evaluations=3, searched=0.05)
SMALL = fair.Study(("ur5",), fair.FAMILIES[:1], TINY, held_out=2, judged=0.1)


@pytest.fixture(scope="module")
def ur5():
    return RealArm.of("ur5", 0)


@pytest.fixture(scope="module")
def trials(ur5):
    return ur5.trials(2, 0, 1)


@pytest.fixture(scope="module")
def rows():
    return fair.rows_of(SMALL, "ur5", fair.FAMILIES[0], 0)


@pytest.mark.parametrize("name", real_arms.LOADS)
def test_the_true_arm_has_what_its_laws_are_not_told(name):
    arm = RealArm.of(name, 3)
    assert not np.concatenate([arm.told.armature, arm.told.friction, arm.told.damping]).any()
    assert np.concatenate([arm.rotors, arm.friction.coulomb, arm.friction.viscous]).min() > 0.0
    bare, loaded = arm.true(), arm.true(1.5, np.array([0.0, 0.02, 0.0]))
    q = np.linspace(-0.5, 0.5, arm.told.nv)
    told, true = (nbs.PinocchioDynamics(x).mass_matrix(q) for x in (arm.told, bare))
    assert np.linalg.eigvalsh(true - np.diag(arm.rotors) - 0.95 * told).min() > -1e-9
    assert np.linalg.eigvalsh(1.05 * told + np.diag(arm.rotors) - true).min() > -1e-9
    masses = [sum(body.mass for body in list(x.model.inertias)[1:]) for x in (bare, loaded)]
    assert masses[1] - masses[0] == pytest.approx(1.5, abs=1e-9)
    np.testing.assert_array_equal(loaded.effort_limit, arm.told.effort_limit)


def test_fr3_is_that_of_its_description():
    arm, described = RealArm.of("fr3", 0), nbs.load_robot("fr3")
    np.testing.assert_array_equal(arm.rotors, described.armature)
    np.testing.assert_array_equal(arm.friction.coulomb, described.friction)


def test_trials_of_judging_are_none_of_tuning(ur5, trials):
    again, others = ur5.trials(2, 0, 1), ur5.trials(2, 0, 2)
    for one, same in zip(trials, again, strict=True):
        np.testing.assert_array_equal(one.start, same.start)
        assert one.true.model.inertias[6].mass == same.true.model.inertias[6].mass
    every = [*trials, *others]
    loads = {round(trial.true.model.inertias[6].mass, 9) for trial in every}
    assert len(loads) == len({trial.motion.frequency[0] for trial in every}) == len(every)
    for trial in every:
        assert (np.abs(trial.start - trial.motion(0.0).q) <= real_arms.AWAY).all()
        assert 0.7 <= trial.friction.coulomb[0] / ur5.friction.coulomb[0] <= 1.3


def test_a_law_is_given_readings_and_their_differences():
    class Noted(nbs.Controller):
        nv, seen = 2, ()

        def initial_memory(self, q):
            return 0

        def step(self, memory, q, v, reference, period):
            self.seen = (*self.seen, (q, v))
            return 0.0 * q, memory + 1

    law, q = Noted(), np.array([[0.1, -0.2], [0.10011, -0.2], [0.10021, -0.2003]])
    encoded = real_arms.Encoded(law, np.array([False, True]), encoder=2**-12)
    memory = encoded.initial_memory(q[0])
    for x in q:
        _, memory = encoded.step(memory, x, np.full(2, np.nan), None, 0.001)
    step = np.array([2.0 * np.pi, 1.0]) * 2**-12
    read = np.array([x for x, _ in law.seen])
    np.testing.assert_allclose(read / step, np.round(read / step), atol=1e-9)
    assert (np.abs(read - q) <= 0.5 * step + 1e-15).all()
    np.testing.assert_allclose([v for _, v in law.seen], np.diff(read, axis=0, prepend=read[:1]) / 0.001)
    assert memory[1] == 3


def test_a_law_that_diverges_has_no_error(trials):
    wild = nbs.ComputedTorque(nbs.PinocchioDynamics(trials[0].arm.told), kp=1e9, kd=1e6)
    figures = real_arms.attempt(wild, replace(trials[0], true=trials[0].true.with_effort_limit(1e9)), 0.3)
    assert figures.error == math.inf
    assert fair_tuning.cost(figures) == fair_tuning.cost(figures._replace(error=math.nan)) == 20.0


def test_roughness_is_charged_above_its_leave_alone():
    calm = Figures(2e-3, 0.0, 0.0, 0.9 * fair_tuning.ROUGH, 0.0)
    assert fair_tuning.cost(calm) == pytest.approx(math.log(2.0))
    rough = calm._replace(roughness=math.e * fair_tuning.ROUGH)
    assert fair_tuning.cost(rough) == pytest.approx(math.log(2.0) + 3.0)


@pytest.mark.parametrize("change", [0.1, 5.0])
def test_training_minimises_the_cost_of_the_search(change):
    """One joint that moves is the worst one, so both are the same number."""
    limit, rows = np.array([80.0, 10.0]), 20
    z1, tau = torch.zeros(3, rows, 2), torch.zeros(3, rows, 2)
    z1[:, rows // 2 :, 0], z1[:, : rows // 2] = 0.004, 1.0
    tau[:, ::2, 1] = change
    price = fair_tuning.LateCost(limit)(z1, z1, tau).sum(dim=-1) * real_arms.PERIOD
    same = fair_tuning.cost(Figures(0.004, 0.0, 0.0, change / 10.0, 0.0))
    np.testing.assert_allclose(price.numpy(), same, rtol=1e-6)


def test_factors_scale_all_joints_of_a_group(ur5):
    for law, name in ((nbs.SlotineLi.for_robot(ur5.told), "gain"), (nbs.PD.for_robot(ur5.told), "kd")):
        twice = fair_tuning.scaled(law, [1.0, 2.0])
        np.testing.assert_allclose(getattr(twice, name), 2.0 * getattr(law, name))
    law = nbs.NeuralBackstepping.for_robot(ur5.told, least_share=0.0)
    other = fair_tuning.scaled(law, [2.0, 3.0, 5.0])
    np.testing.assert_allclose(other.potential.stiffness.numpy(), 2.0 * law.potential.stiffness.numpy())
    np.testing.assert_allclose(other.rate.numpy(), 3.0 * law.rate.numpy())
    np.testing.assert_allclose(other.damping.floor.numpy(), 5.0 * law.damping.floor.numpy())
    assert other.inertial_rate == pytest.approx(6.0 * law.inertial_rate)


def test_the_search_keeps_the_best_within_its_evaluations(monkeypatch, trials):
    made = []

    def figures(law, trial, duration):
        return Figures(1e-3 * math.exp((law - 0.4) ** 2), 0.0, 0.0, 0.0, 0.0)

    monkeypatch.setattr(fair_tuning, "attempt", figures)
    found = fair_tuning.searched(lambda x: made.append(x) or float(np.log(x[0])), 1, trials, Budget(evaluations=25))
    assert len(made) <= 26
    assert found.law == pytest.approx(0.4, abs=0.02)
    assert found.factors == (pytest.approx(math.exp(0.4), rel=0.02),)


def test_one_budget_for_all(monkeypatch, ur5):
    """Every law is trained by the same words on the same plants and motions, and is searched as often."""
    asked, tried = [], Counter()

    def noted(law, plants, references, **settings):
        described = ([repr(plant) for plant in plants], [m(0.3).q.tolist() for m in references])
        asked.append((described, {k: v for k, v in settings.items() if k not in ("learning_rate", "cost")}))
        return train(law, plants, references, **settings)

    def figures(law, trial, duration):
        tried[duration] += 1
        return Figures(1e-3, 1e-3, 1e-3, 1e-3, 0.0)

    def known(data, model, seed, *, robot, **_):
        own = np.stack([body.toDynamicParameters() for body in list(robot.model.inertias)[1:]])
        return nbs.IdentifiedDynamics(robot, own, friction=nbs.JointFriction(np.zeros(6), np.ones(6)))

    monkeypatch.setattr(fair_tuning, "train", noted)
    for module in (fair, fair_tuning):
        monkeypatch.setattr(module, "attempt", figures)
    monkeypatch.setattr(fair, "fit", known)
    monkeypatch.setattr(fair, "collect", lambda *_, **__: None)
    for family in fair.FAMILIES:
        asked.clear()
        tried.clear()
        found = fair.rows_of(SMALL, "ur5", family, 0)
        assert [row.law for row in found if row.cost is not None] == list(family.rows)
        assert len(asked) == len(TINY.rates)
        first = first if family is not fair.FAMILIES[0] else asked[0]
        assert all(entry == first for entry in asked)
        assert tried[TINY.searched] <= (TINY.evaluations + 2) * TINY.trials * len(family.rows)
        assert tried[SMALL.judged] == SMALL.held_out * len(found)


def test_every_row_is_judged_and_as_it_comes_is_not_tuned(rows):
    assert [row.law for row in rows] == [fair.AS_IT_COMES, *fair.FAMILIES[0].rows]
    assert [row.cost is None for row in rows] == [True, False, False, False]
    for row in rows:
        assert 0.0 < row.error_median_rad <= row.error_worst_rad
        assert row.error_median_rad <= row.peak_median_rad
        assert row.roughness_median > 0.0
        assert 0.0 <= row.saturated_mean <= 1.0
        assert len(row.factors) == {fair.AS_IT_COMES: 0, "NBS": 3}.get(row.law, 4)


def test_the_page_the_csv_and_the_figures_carry_one_table(rows, monkeypatch, tmp_path):
    monkeypatch.setattr(fair, "compare_fairly", lambda *_, **__: iter([rows]))
    (section,) = fair.fair_part(tmp_path, 0, False, SMALL)
    with (tmp_path / "fair.csv").open() as file:
        written = list(csv.DictReader(file))
    assert len(written) == len(rows) == section.markdown.count("\n| ") - 2
    for row, entry in zip(rows, written, strict=True):
        assert float(entry["error_median_rad"]) == row.error_median_rad
        assert f"| {row.law} | {1e3 * row.error_median_rad:.3g} | {1e3 * row.error_worst_rad:.3g} |" in section.markdown
    best = min(rows, key=lambda row: row.error_median_rad)
    assert f"* ur5: lowest median error {1e3 * best.error_median_rad:.3g} mrad ({best.law})" in section.markdown
    assert len(json.loads(json.dumps(section.figures, allow_nan=False))["fair"]) == len(rows)
    assert (tmp_path / "fair.png").stat().st_size > 10_000


def test_ctrl_c_keeps_the_rows_that_are_done(rows, monkeypatch, tmp_path):
    def stopped(*_, **__):
        yield rows
        raise KeyboardInterrupt

    monkeypatch.setattr(fair, "compare_fairly", stopped)
    sections = fair.fair_part(tmp_path, 0, False, SMALL)
    assert "interrupted" in next(sections).title
    with pytest.raises(KeyboardInterrupt):
        next(sections)
    assert (tmp_path / "fair.csv").read_text().count("\n") == len(rows) + 1


def test_ctrl_c_ends_the_comparison_and_not_one_tuning(monkeypatch, trials):
    monkeypatch.setattr(fair_tuning, "train", lambda *a, **s: replace(train(*a, **s), stopped="interrupted"))
    with pytest.raises(KeyboardInterrupt):
        fair_tuning.trained(nbs.PD.for_robot(trials[0].arm.told), trials, TINY, 0)


def test_the_protocol_is_made_from_the_settings():
    odd = replace(SMALL, budget=TINY._replace(trials=17, epochs=23, evaluations=29), held_out=31, judged=2.9)
    said = fair._protocol(odd, seed=41)
    for words in ("on 17 trials", "0.1 and 0.2, 23 epochs", "29\nevaluations", "31 further trials of 2.9 s", "Seed 41"):
        assert words in said


def test_no_law_is_first_where_all_diverge(rows):
    lost = [
        row._replace(error_median_rad=math.inf, error_worst_rad=math.inf, roughness_median=math.inf) for row in rows
    ]
    assert "every law diverges in most trials. " in fair._findings(lost)
    assert "| ∞ | ∞ |" in fair._tables(lost)


def test_tools_are_where_the_loads_are(ur5, trials):
    figures = real_arms.attempt(nbs.NeuralBackstepping.for_robot(ur5.told), trials[0], 0.1)
    assert tool_frame(ur5.told) in ur5.told.frames
    assert 0.0 < figures.tool < 0.5
