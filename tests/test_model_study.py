"""The studies of learned models: what they judge by is right, and the page says what the files hold."""

import csv
from itertools import product

import numpy as np
import pytest

from nbs_pin.accuracy.compare import compare
from nbs_pin.base.torch_threads import one_thread
from nbs_pin.dynamics.equations import inverse_dynamics
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.identification.collect import collect
from nbs_pin.reproduction import model_study
from nbs_pin.reproduction.inverse_mlp import fit_mlp
from nbs_pin.reproduction.model_noise import Noisy, _medians, _ranking, _ratios, friction_of, noise_section
from nbs_pin.reproduction.model_structure import structure_section
from nbs_pin.reproduction.model_trials import MLP, SPEED, Judge, Trial, attempt, chosen, column
from nbs_pin.robots.robot import load_robot
from tests.test_plotting import png_size

SMALL = model_study.Scale(
    fresh=200,
    seeds=2,
    clean_arms=("three_link",),
    clean_samples=200,
    noise_arms=("three_link",),
    noise_seeds=1,
    noise_samples=(150, 300),
    mlp={"steps": 60, "widths": (16,)},
    structure_samples=(100, 200),
    structures={"chain": {}, "cholesky": {"widths": (4,), "iterations": 2}},
)
MODELS, RECIPES = ("chain", "identified"), ("uniform", "excited")


@pytest.fixture(scope="module")
def arm():
    return load_robot("three_link")


@pytest.fixture(scope="module")
def judge(arm):
    return Judge.of(arm, None, 400)


@pytest.fixture(scope="module")
def rough(arm):
    """The same arm with friction."""
    return Judge.of(arm, friction_of(arm), 200)


@pytest.fixture(scope="module", autouse=True)
def thread():
    with one_thread():
        yield


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """Folder and sections of a small study."""
    folder = tmp_path_factory.mktemp("models")
    return folder, list(model_study.reproduce_models(folder, seed=3, scale=SMALL))


def rows(path):
    with path.open() as file:
        return list(csv.DictReader(file))


# The judge.


def test_the_truth_has_no_error(arm, rough):
    """With the friction that acts, nothing is left on uniform states; a joint at rest in MuJoCo is another matter."""
    friction = friction_of(arm)
    truth = PinocchioDynamics(arm)

    def torque(q, v, a):
        return inverse_dynamics(truth, q, v, a) + friction.torque(v)

    found = rough.torque_errors(torque)
    assert max(found["torque_uniform"], found["torque_fast"]) < 1e-12
    assert 0.0 < found["torque_excited"] == rough.floor < 0.06
    errors = rough.model_errors(truth)
    assert errors == {"mass_matrix": 0.0, "coriolis": 0.0, "gravity": 0.0, "indefinite": 0.0}


def test_without_friction_mujoco_agrees_with_the_truth(arm, judge):
    truth = PinocchioDynamics(arm)
    assert max(judge.torque_errors(lambda q, v, a: inverse_dynamics(truth, q, v, a)).values()) < 1e-10


def test_errors_are_shares_of_the_deviation(judge):
    """The mean torque as a model has error 1; a torque off by one deviation has error 1."""
    for motion, name in ((judge.uniform, "torque_uniform"), (judge.excited, "torque_excited")):
        mean = np.broadcast_to(motion.tau.mean(axis=0), motion.tau.shape)
        assert judge.torque_errors(lambda q, v, a, mean=mean: mean)[name] == pytest.approx(1.0, abs=1e-12)
        shifted = motion.tau + motion.tau.std(axis=0)
        assert judge.torque_errors(lambda q, v, a, shifted=shifted: shifted)[name] == pytest.approx(1.0, abs=1e-12)


def test_the_judge_agrees_with_compare(arm, judge):
    """Two arms of other masses, on other draws of the same box: equal up to sampling."""
    other = load_robot("three_link")
    other.model.inertias[3].mass *= 1.3
    found = judge.model_errors(PinocchioDynamics(other))
    expected = compare(PinocchioDynamics(other), PinocchioDynamics(arm), 400, SPEED, motions=0)
    for name in ("mass_matrix", "coriolis", "gravity"):
        assert found[name] == pytest.approx(getattr(expected, name), rel=0.2)
        assert found[name] > 0.01


def test_an_indefinite_inertia_is_counted(arm, judge):
    class Upside(PinocchioDynamics):
        def mass_matrix(self, q):
            return np.where(np.sin(q[..., :1, None]) > 0.0, 1.0, -1.0) * super().mass_matrix(q)

    share = float(np.mean(np.sin(judge.uniform.q[:, 0]) < 0.0))
    assert judge.model_errors(Upside(arm))["indefinite"] == share
    assert 0.3 < share < 0.7


# A plain network.


def test_the_plain_network_learns_what_it_can(arm, judge):
    data = collect(arm, "uniform", 2_000, seed=0)
    first, last = (
        judge.torque_errors(fit_mlp(data, 0, steps=steps, widths=(32,)).torque)["torque_uniform"]
        for steps in (20, 1_200)
    )
    assert last < 0.5 < 0.8 < first


def test_the_plain_network_is_periodic_and_seeded(arm):
    data = collect(arm, "uniform", 200, seed=0)
    first, again, other = (fit_mlp(data, seed, steps=20, widths=(8,)) for seed in (1, 1, 2))
    here = first.torque(data.q, data.v, data.a)
    np.testing.assert_allclose(first.torque(data.q + 2.0 * np.pi, data.v, data.a), here, atol=1e-9)
    assert np.array_equal(again.torque(data.q, data.v, data.a), here)
    assert not np.allclose(other.torque(data.q, data.v, data.a), here)


def test_the_plain_network_sees_friction_turn(arm):
    data = collect(arm, "uniform", 200, seed=0)
    blind, seeing = (fit_mlp(data, 0, steps=1, widths=(8,), transition=x) for x in (None, 0.01))
    assert seeing.inputs.shape[1] == blind.inputs.shape[1] + data.nv


# Trials.


def test_a_model_with_friction_is_judged_with_it(arm, rough):
    """Below one per cent: what MuJoCo's joints do near rest is no function of their speed."""
    data = collect(arm, "uniform", 400, 0, friction=friction_of(arm))
    with_it = attempt("identified", data, 0, arm, rough, friction=True, held_out=0.0)
    without = attempt("identified", data, 0, arm, rough, held_out=0.0)
    assert with_it.torque_uniform < 0.01 < 0.02 < without.torque_uniform
    assert with_it.mass_matrix < 1e-3


# The page.


def test_the_study_writes_its_files_and_says_what_they_hold(small):
    folder, sections = small
    assert sorted(path.name for path in folder.iterdir()) == sorted(model_study.FILES)
    for name in model_study.FILES:
        if name.endswith(".png"):
            assert min(png_size(folder / name)) > 200
    for section, name in zip(sections, ("models_clean", "models_noise", "models_structure"), strict=True):
        read = rows(folder / f"{name}.csv")
        assert len(read) == len(section.figures[name])
        for line, figures in zip(read, section.figures[name], strict=True):
            for key, value in figures.items():
                assert line[key] == ("nan" if value is None else str(value))


def test_the_study_has_every_model_seed_and_size(small):
    folder, _ = small
    clean, noise, structure = (rows(folder / f"models_{name}.csv") for name in ("clean", "noise", "structure"))
    assert {(r["model"], r["data"], r["seed"]) for r in clean} == set(product(MODELS, RECIPES, "34"))
    assert {(r["model"], r["samples"], r["seed"]) for r in noise} == set(product([*MODELS, MLP], ("150", "300"), "3"))
    assert {(r["model"], r["samples"], r["seed"]) for r in structure} == set(
        product(("chain", "cholesky"), ("100", "200"), "34")
    )
    for row in noise:
        assert (row["mass_matrix"] == "nan") == (row["model"] == MLP)  # a plain network has no inertia
        assert float(row["torque_excited"]) > 0.0
        assert float(row["seconds"]) > 0.0


def test_clean_data_give_the_arm(small):
    folder, sections = small
    assert "2 of 2" in sections[0].markdown
    for row in rows(folder / "models_clean.csv"):
        assert float(row["torque_uniform"]) ** 2 < 1e-8
        assert float(row["mass_matrix"]) < 1e-4


def test_structure_pays(small):
    """Exact where everything is known; a little network of two steps is far off."""
    folder, _ = small
    errors = {row["model"]: float(row["mass_matrix"]) for row in rows(folder / "models_structure.csv")}
    assert errors["chain"] < 1e-6 < 1e-2 < errors["cholesky"]


def trial(model, samples, error, **others):
    base = Trial("three_link", "excited", samples, 0, model, 1.0, 1, *[error] * 6, 0.0)
    return base._replace(**others)


def test_the_page_says_where_the_order_changes_and_what_geometry_costs(tmp_path):
    errors = {300: (0.02, 0.05, 0.5), 1_000: (0.02, 0.01, 0.4)}
    trials = [
        trial(model, size, error)
        for size, three in errors.items()
        for model, error in zip(("identified", "chain", MLP), three, strict=True)
    ]
    section = noise_section(Noisy(trials, {"three_link": 0.015}), tmp_path)
    assert "except three_link, 1,000: chain < identified < mlp." in section.markdown
    assert "three_link, 300: " not in section.markdown
    ratios = section.figures["chain_over_identified"]["mass_matrix"]
    assert ratios == pytest.approx({"three_link, 300": 2.5, "three_link, 1000": 0.5})
    assert "left with 0.015 (three_link)" in section.markdown
    assert "M 1.5 (2.5 at three_link, 300 samples)" in section.markdown


def test_medians_are_over_the_seeds():
    trials = [trial("chain", 300, error, seed=k) for k, error in enumerate((1.0, 5.0, 2.0))]
    assert sorted(column(chosen(trials, model="chain", samples=300), "gravity")) == [1.0, 2.0, 5.0]
    assert chosen(trials, model="chain", seed=1) == [trials[1]]
    assert trials[1]._asdict()["gravity"] == 5.0
    known = [trial("identified", 300, error, seed=k) for k, error in enumerate((1.0, 1.0, 4.0))]
    assert _ratios(_medians(trials + known), "gravity") == {"three_link, 300": 2.0}  # of means it would be 4/3


def test_what_differs_by_less_than_a_twentieth_keeps_its_place():
    errors = {"identified": 1.0, "chain": 0.99, MLP: 0.5}
    medians = _medians([trial(m, 300, e) for m, e in errors.items()])
    assert _ranking(medians["three_link", 300], "gravity") == [MLP, "identified", "chain"]


def test_the_table_of_structures_shows_the_spread(tmp_path):
    trials = [trial("cholesky", 100, error, seed=k) for k, error in enumerate((0.01, 0.02, 0.04))]
    section = structure_section(trials, tmp_path)
    assert "0.01 – **0.02** – 0.04" in section.markdown
