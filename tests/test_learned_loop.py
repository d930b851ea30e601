"""Control on learned models: the law is the exact one's, the scale is what torque tells, the page is what was found."""

import csv
import json
import re

import numpy as np
import pytest

from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.cli import main
from nbs_pin.commands import reproduce
from nbs_pin.controllers.neural_backstepping import paper_controller
from nbs_pin.dynamics.cholesky import CholeskyNetwork
from nbs_pin.dynamics.lagrangian import LagrangianDynamics
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.identification.collect import collect
from nbs_pin.identification.fit import fit
from nbs_pin.motions.references import paper_reference
from nbs_pin.reports.markdown import Section, page
from nbs_pin.reproduction import figure5, learned_loop, passive_data
from nbs_pin.reproduction.figure5 import Weightless
from nbs_pin.robots.robot import load_robot
from nbs_pin.simulation import metrics, processes
from tests.test_plotting import png_size

SMALL = learned_loop.Scale(
    samples=400, settle=0.8, turns=0.005, seeds=2, swing=1_000, epochs=2, duration=0.5,
    learners=(passive_data.Learner("cholesky", "one swing", (6, 6), 2),),
)  # fmt: skip


@pytest.fixture(scope="module")
def arm():
    return load_robot("three_link")


@pytest.fixture(scope="module")
def chain(arm):
    return fit(collect(arm, "uniform", 200), "chain", robot=arm)


def states(count, seed=0):
    return np.random.default_rng(seed).uniform(-2.0, 2.0, (4, count, 3))


# A model without its gravity.


@pytest.mark.parametrize("kind", ["exact", "chain", "cholesky"])
def test_a_weightless_model_keeps_its_inertia_and_nothing_else(arm, chain, kind):
    models = {
        "exact": PinocchioDynamics(arm),
        "chain": chain,
        "cholesky": LagrangianDynamics(CholeskyNetwork([False] * 3, widths=(4, 4))),
    }
    model, light = models[kind], Weightless(models[kind])
    q, v, w, a = states(20)
    plain = np.einsum("...ij,...j", model.mass_matrix(q), a) + np.einsum("...ij,...j", model.coriolis_matrix(q, v), w)
    np.testing.assert_allclose(light.reference_torque(q, v, w, a), plain, rtol=1e-9, atol=1e-9)
    assert np.abs(model.gravity(q)).max() > 1e-3
    assert not light.gravity(q).any()
    assert not light.potential_energy(q).any()
    law, at = paper_controller(light), (q[0], v[0], q[0] + 0.1, w[0], a[0])
    np.testing.assert_allclose(law.compile().torque(*at), law.torque(*at), rtol=1e-9, atol=1e-9)


def test_a_weightless_model_is_that_of_the_arm_in_free_fall(arm):
    q, v, _, tau = states(50)
    expected = PinocchioDynamics(load_robot("three_link", gravity=0.0)).forward_dynamics(q, v, tau)
    np.testing.assert_allclose(Weightless(PinocchioDynamics(arm)).forward_dynamics(q, v, tau), expected, rtol=1e-9)


# Laws on learned models.


def test_laws_of_one_kind_differ_in_their_model_alone(arm, chain):
    wrong = PinocchioDynamics(load_robot("three_link", gravity=3.0))
    found = learned_loop.laws(arm, {learned_loop.CLEAN: chain, learned_loop.NOISY: wrong})
    exact, learned, other = (found[name] for name in (learned_loop.EXACT, learned_loop.CLEAN, learned_loop.NOISY))
    q, v, q_ref, v_ref = states(20)
    np.testing.assert_allclose(
        learned.torque(q, v, q_ref, v_ref, v), exact.torque(q, v, q_ref, v_ref, v), rtol=1e-7, atol=1e-7
    )
    difference = other.torque(q, v, q_ref, v_ref, v) - exact.torque(q, v, q_ref, v_ref, v)
    np.testing.assert_allclose(difference, (3.0 / 9.81 - 1.0) * PinocchioDynamics(arm).gravity(q), rtol=1e-8, atol=1e-8)


def test_the_law_on_a_chain_tracks_as_on_the_exact_model(small):
    rows = [learned_loop.Row(**entry) for entry in small[1][0].figures["learned_loop"]]
    assert len(rows) == 7 * len(learned_loop.FREQUENCIES)
    for row in rows:
        assert row.rms_error_rad > 0.0
        if row.law.startswith("NBS"):
            assert row.ratio == pytest.approx(1.0, abs=1e-4)
            assert row.ratio_noise == pytest.approx(1.0, abs=1e-4)
            assert row.rms_error_noise_rad != row.rms_error_rad
        else:
            assert row.rms_error_noise_rad is None
        if row.law == "PD, no model":
            assert row.ratio > 10.0


def test_one_chain_is_learned_from_clean_data_and_one_from_what_instruments_tell(arm, monkeypatch):
    models = [PinocchioDynamics(arm), PinocchioDynamics(arm)]
    asked = []

    def fitted(data, model, seed, robot):
        asked.append((model, seed, data))
        return models[len(asked) - 1]

    monkeypatch.setattr(learned_loop, "collect", lambda robot, **settings: settings)
    monkeypatch.setattr(learned_loop, "fit", fitted)
    found = learned_loop.learn_chains(arm, 70, 9)
    assert found == {learned_loop.CLEAN: models[0], learned_loop.NOISY: models[1]}
    clean = {"samples": 70, "seed": 9}
    noisy = {"samples": 140, "seed": 9, "noise": learned_loop.NOISE}
    assert asked == [("chain", 9, clean), ("chain", 9, noisy)]


# The scale of the torque.


@pytest.mark.parametrize("scale", [0.05, 7.0])
def test_motion_without_torque_does_not_know_the_scale(arm, chain, scale):
    """c·L explains it all, and one factor, from ten samples with torque, makes it right."""
    heavier = LagrangianDynamics(chain.network, arm)
    heavier.network.factors.data *= np.sqrt(scale)
    data = passive_data.coasting(collect(arm, "uniform", 100, seed=4), arm)
    actuated = collect(arm, "uniform", passive_data.ACTUATED, seed=5)
    free, torque, c, left, some, settled = passive_data._judged(heavier, PinocchioDynamics(arm), data, actuated)
    assert free < 1e-7
    assert torque == pytest.approx(abs(scale - 1.0), rel=1e-6)
    assert (c, some) == pytest.approx((1.0 / scale, 1.0 / scale), rel=1e-6)
    assert max(left, settled) < 1e-7


def test_coasting_states_have_the_acceleration_of_an_arm_without_torque(arm):
    data = collect(arm, "uniform", 30)
    coasting = passive_data.coasting(data, arm)
    expected = PinocchioDynamics(arm).forward_dynamics(data.q, data.v, 0.0 * data.tau)
    np.testing.assert_allclose(coasting.a, expected, rtol=1e-7, atol=1e-7)
    assert not coasting.tau.any()


def test_the_chain_refuses_data_without_torque(arm):
    data = collect(arm, "passive", 50)
    with pytest.raises(ArgumentError, match="no torque") as refused:
        fit(data, "chain")
    assert passive_data._refusal(data) == str(refused.value)
    with pytest.raises(RuntimeError, match="scale means nothing"):
        passive_data._refusal(collect(load_robot("two_link"), "uniform", 60))


# Figure 5.


def test_a_pd_without_a_model_beats_the_papers_number_without_gravity():
    """docs/theory.md §8: 2.9e-5, a fiftieth of the paper's; with gravity it has none of it."""
    arm = load_robot("three_link", gravity=0.0)
    law = figure5.PD(PinocchioDynamics(arm), feedforward="gravity", kp=20.0, kd=10.0)
    light, heavy = figure5._followed(arm, law, 16.0), figure5._followed(load_robot("three_link"), law, 3.0)
    assert metrics.steady_error(light) == pytest.approx(2.9e-5, rel=0.5)
    assert metrics.steady_error(light) < 0.03 * figure5.PRINTED
    assert metrics.steady_error(heavy) > 1.0
    np.testing.assert_allclose(light.q_ref, paper_reference(3)(light.t).q)


def test_one_law_is_trained_for_all_models(chain):
    runs = figure5.follow_again({"a chain": chain}, epochs=3, duration=0.2)
    assert list(runs) == [figure5.WITHOUT, figure5.WITH]
    for several in runs.values():
        exact, learned, pd = several.values()
        np.testing.assert_allclose(learned.q, exact.q, atol=1e-9)
        assert np.abs(pd.q - exact.q).max() > 1e-3


# The page and its files.


@pytest.fixture(scope="module")
def small(tmp_path_factory, chain):
    """Folder and sections of a small study, in this process, its chains from data that cost little."""
    folder, chains = tmp_path_factory.mktemp("learned"), {learned_loop.CLEAN: chain, learned_loop.NOISY: chain}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(learned_loop, "ARMS", ("three_link",))
        patch.setattr(learned_loop, "learn_chains", lambda *_: chains)
        patch.setattr(processes, "cores", lambda: 1)
        return folder, list(learned_loop.reproduce_learned(folder, seed=3, scale=SMALL))


def test_the_page_and_the_files_carry_what_was_found(small):
    folder, sections = small
    assert sorted(path.name for path in folder.iterdir()) == sorted(learned_loop.FILES)
    text = page("Title", "Lead.", sections)
    for name in re.findall(r"!\[[^\]]+\]\(([^)]+)\)", text):
        assert min(png_size(folder / name)) > 300
    assert set(re.findall(r"\(([a-z0-9_]+\.png)\)", text)) == {n for n in learned_loop.FILES if n.endswith(".png")}
    numbers = json.loads(json.dumps({k: v for s in sections for k, v in s.figures.items()}, allow_nan=False))
    files = {"learned_loop": "learned_loop.csv", "passive": "passive.csv", "figure5": "figure5.csv"}
    for key, name in files.items():
        with (folder / name).open(newline="") as file:
            rows = list(csv.DictReader(file))
        assert [list(row) for row in rows] == [list(entry) for entry in numbers[key]]
        for row, entry in zip(rows, numbers[key], strict=True):
            told = {k: x for k, x in entry.items() if isinstance(x, float)}
            assert {k: float(row[k]) for k in told} == told
    assert [entry["seed"] for entry in numbers["passive"]] == [3, 4]
    assert 'refuses: "' in text


def test_the_sentences_follow_the_numbers(small, tmp_path):
    _, sections = small
    rows = [learned_loop.Row(**entry) for entry in sections[0].figures["learned_loop"]]
    told = [row._replace(ratio=1.2345) if row.law == learned_loop.CLEAN else row for row in rows]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(learned_loop, "ARMS", ("three_link",))
        text = learned_loop._section(told, SMALL._replace(samples=77), 3, tmp_path).markdown
    assert "at most 1.234500 times" in text
    assert "from 77 clean samples" in text


def test_the_command_has_the_part(tmp_path, monkeypatch):
    monkeypatch.setitem(reproduce.PARTS, "lnn", lambda *_: [Section("Learned", "Text.", {"x": 1})])
    assert main(["reproduce", "--part", "lnn", "--out", str(tmp_path / "out")]) == 0
    assert "## Learned\n\nText." in (tmp_path / "out" / "report.md").read_text()
