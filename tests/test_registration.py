"""One line in a registry carries a law, a network family or a plant through everything that asks for names."""

import json

import numpy as np
import pytest

import nbs_pin as nbs
from nbs_pin.base.claims import Label
from nbs_pin.base.known_code import known_code
from nbs_pin.base.registry import Entry, entry
from nbs_pin.certificates.model_structure import check_model
from nbs_pin.cli import main
from nbs_pin.controllers.registry import LAWS
from nbs_pin.dynamics.registry import NETWORKS
from nbs_pin.identification.registry import MODELS
from nbs_pin.simulation.registry import PLANTS
from tests.outside import DiagonalNetwork, Impedance

TRACK = ["track", "two_link", "--duration", "0.1", "--period", "0.005"]


@pytest.fixture
def law(monkeypatch):
    monkeypatch.setitem(LAWS, "impedance", Entry("tests.outside:Impedance.for_robot"))


def test_a_law_is_tracked_trained_saved_loaded_and_runs_as_it_is_written(law, tmp_path):
    assert main([*TRACK, "--controller", "impedance", "--out", str(tmp_path / "a")]) == 0
    trained = ["train", "two_link", "--controller", "impedance", "--epochs", "2", "--starts", "3", "--duration", "0.05"]
    assert main([*trained, "--out", str(tmp_path / "b")]) == 0
    file = tmp_path / "b" / "controller.nbs"
    found = nbs.load(file)
    assert type(found) is Impedance
    assert not found.packable
    assert found.compile() is found
    assert main([*TRACK, "--controller", str(file), "--out", str(tmp_path / "c")]) == 0
    used = [json.loads((tmp_path / x / "summary.json").read_text())["settings"]["controller"] for x in "ac"]
    assert used == ["impedance", str(file)]


@known_code
class Offset(nbs.SlotineLi):
    """A law whose author vouches for its code, and which inherits another's kernel."""

    def torque(self, q, v, q_ref, v_ref, a_ref):
        return super().torque(q, v, q_ref, v_ref, a_ref) + 100.0


@known_code
class Heavier(nbs.PinocchioDynamics):
    """The same of a model."""

    def gravity(self, q):
        return super().gravity(q) + 100.0

    def reference_torque(self, q, v, v_r, a_r):
        return super().reference_torque(q, v, v_r, a_r) + 100.0


@pytest.mark.parametrize("make", [Offset.for_robot, lambda arm: nbs.ComputedTorque.for_robot(arm, Heavier(arm))])
def test_a_kernel_is_of_the_class_that_packs_for_it_and_of_no_subclass(make):
    law, rows = make(nbs.load_robot("two_link")), np.random.default_rng(0).normal(size=(5, 2))
    np.testing.assert_allclose(law.compile().torque(*rows), law.torque(*rows), rtol=1e-12)


def test_certify_says_what_such_a_law_lacks(law, capsys):
    assert main(["certify", "two_link", "--law", "impedance", "--disturbance", "1"]) == 3
    assert "--law impedance, of which no Lyapunov function is known" in " ".join(capsys.readouterr().err.split())


def test_a_misspelt_name_is_told_the_nearest_of_all(law, capsys):
    assert main([*TRACK, "--controller", "impedence"]) == 2
    assert "did you mean impedance?" in capsys.readouterr().err


def test_a_network_family_is_fitted_saved_loaded_and_judged_on_samples(monkeypatch, tmp_path):
    monkeypatch.setitem(NETWORKS, "diagonal", Entry("tests.outside:DiagonalNetwork"))
    monkeypatch.setitem(MODELS, "diagonal", Entry("nbs_pin.identification.fitters:fit_family"))
    robot = nbs.load_robot("two_link")
    data = nbs.collect(robot, "uniform", samples=60, seed=0)
    model = nbs.fit(data, "diagonal", robot=robot, iterations=3)
    assert type(model.network) is DiagonalNetwork
    assert model.network.widths == (8,)
    nbs.save(model, tmp_path / "m.nbs")
    again, q = nbs.load(tmp_path / "m.nbs"), data.q[:5]
    np.testing.assert_array_equal(again.mass_matrix(q), model.mass_matrix(q))
    assert {claim.label for claim in check_model(model)} == {Label.EMPIRICAL}
    data.save(tmp_path / "data.npz")
    learn = ["learn", str(tmp_path / "data.npz"), "--model", "diagonal", "--iterations", "1"]
    assert main([*learn, "--out", str(tmp_path / "out")]) == 0
    certificate = nbs.certify(nbs.NeuralBackstepping.for_robot(robot, model), 1.0)
    assert certificate.label is Label.EMPIRICAL


def test_a_plant_is_a_choice_of_track(monkeypatch, tmp_path):
    monkeypatch.setitem(PLANTS, "sticky", Entry("tests.outside:Sticky.for_robot"))
    assert main([*TRACK, "--plant", "sticky", "--out", str(tmp_path)]) == 0
    assert "semi_implicit_euler" in nbs.Run.load(tmp_path / "run.npz").info["plant"]


@pytest.mark.parametrize("table", [LAWS, NETWORKS, MODELS, PLANTS])
def test_every_entry_leads_somewhere_and_an_unknown_name_lists_them(table):
    assert all(callable(found.load()) for found in table.values())
    with pytest.raises(nbs.ArgumentError, match=f"thing 'nope' is unknown; choose one of {', '.join(table)}"):
        entry("thing", "nope", table)
