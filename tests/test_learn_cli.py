"""`nbs-pin learn`: what it writes, what it prints, and what it refuses."""

import re
import warnings
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal

import nbs_pin as nbs
from nbs_pin import cli
from nbs_pin.commands import learn as learning
from nbs_pin.dynamics.cholesky import CholeskyNetwork
from nbs_pin.identification.collect import collect
from nbs_pin.identification.datasets import load_dataset
from nbs_pin.identification.fit import fit, split_data
from nbs_pin.identification.fit_report import torque_errors
from tests.commands import contents, refusal, summary
from tests.test_dynamics import GANTRY
from tests.test_plotting import png_size

ROBOT = nbs.load_robot("two_link")


@pytest.fixture(scope="module", autouse=True)
def narrow():
    """Networks that are small by default."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(CholeskyNetwork, "fit_widths", (6, 6))
        yield


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    """Data of two_link."""
    path = tmp_path_factory.mktemp("data") / "data.npz"
    collect(ROBOT, samples=100, duration=0.5, seed=2).save(path)
    return path


def run(path, folder, *options):
    return cli.main(["learn", str(path), "-v", "--out", str(folder), *options])


BARE = ("--friction", "off", "--offset", "off")


@pytest.fixture(scope="module")
def network(path, tmp_path_factory):
    """Where a network learned from them lies."""
    folder = tmp_path_factory.mktemp("network") / "out"
    with warnings.catch_warnings():
        warnings.simplefilter("default")  # so short a fit is doubted
        assert run(path, folder, "--model", "cholesky", "--iterations", "4", "--seed", "3", *BARE) == 0
    return folder


def test_the_files_are_a_model_and_how_it_came_about(path, network):
    assert {file.name for file in network.iterdir()} == set(learning.FILES) - set(learning.IDENTIFIED)
    said, model = summary(network), nbs.load(network / "model.nbs")
    assert said["settings"]["model"] == "cholesky"
    assert said["robot_sha256"] == ROBOT.sha256 == model.robot.sha256
    figures, (train, test) = said["figures"], split_data(load_dataset(path), 0.2, 3)
    assert figures["samples"] == len(train)
    assert figures["test_samples"] == len(test)
    expected = np.sqrt(np.square(torque_errors(model, test)).mean(axis=0))
    assert figures["rms_test_torque_error_Nm"] == pytest.approx(expected.tolist())
    assert figures["viscous_friction"] is None
    width, height = png_size(network / "learning.png")
    assert width > height > 300


def test_the_arm_is_the_one_of_the_data_and_inertias_are_found(path, tmp_path, capsys):
    assert run(path, tmp_path, "--model", "identified", "--friction", "on") == 0
    model, said = nbs.load(tmp_path / "model.nbs"), capsys.readouterr().out
    q = np.array([0.3, -1.1])
    assert np.abs(model.mass_matrix(q) - nbs.PinocchioDynamics(ROBOT).mass_matrix(q)).max() < 1e-8
    arm = nbs.load_robot(tmp_path / "model.urdf", gravity=9.8)
    assert np.abs(model.mass_matrix(q) - nbs.PinocchioDynamics(arm).mass_matrix(q)).max() < 1e-8
    head, *rows = (tmp_path / "parameters.csv").read_text().splitlines()
    assert head == "joint,parameter,unit,value,standard deviation,urdf"
    assert [row.split(",")[:3] for row in rows[:2]] == [["joint1", "m", "kg"], ["joint1", "mx", "kg·m"]]
    assert summary(tmp_path)["figures"]["viscous_friction"] == pytest.approx([0.0, 0.0], abs=1e-6)
    for word in ("two_link, identified", "joint2", "held out", "model.nbs", "learning.png"):
        assert word in said
    assert "no better" not in said
    assert "do not show what the bodies weigh in all" in said
    assert "masses add up" not in said


def test_the_mass_of_all_bodies_is_told_where_a_joint_lifts_them(tmp_path, capsys):
    gantry = nbs.load_robot(GANTRY)
    collect(gantry, "uniform", 200, noise=nbs.Noise(torque=0.1)).save(tmp_path / "data.npz")
    assert run(tmp_path / "data.npz", tmp_path / "out", "--model", "identified") == 0
    told = re.search(r"masses add up to (\S+) kg, give or take (\S+) kg, 5.3 kg in the URDF", capsys.readouterr().out)
    assert float(told[1]) == pytest.approx(5.3, abs=4.0 * float(told[2]))


def test_what_is_solved_without_iterations_has_no_empty_panel(path, network, tmp_path):
    assert run(path, tmp_path, "--model", "identified") == 0
    (narrow, height), (wide, usual) = (png_size(folder / "learning.png") for folder in (tmp_path, network))
    assert narrow < 0.7 * wide
    assert height == pytest.approx(usual, rel=0.15)  # by the lines of the heading


def test_a_log_needs_a_named_arm(path, tmp_path, capsys):
    data = load_dataset(path)
    log = tmp_path / "log.npz"
    np.savez(log, t=data.t, q=data.q, v=data.v, a=data.a, tau=data.tau, trajectory=data.trajectory)
    assert "give --robot" in refusal(run(log, tmp_path / "a", "--model", "identified"), capsys)
    assert not (tmp_path / "a").exists()
    assert run(log, tmp_path / "b", "--model", "identified", "--robot", "two_link") == 0
    assert nbs.load(tmp_path / "b" / "model.nbs").robot.name == "two_link"


@pytest.mark.parametrize("named", [True, False])
def test_the_command_that_is_named_next_compares_the_model_with_an_arm(path, tmp_path, capsys, named):
    data = load_dataset(path)
    log, folder = tmp_path / "log.npz", tmp_path / "out"
    np.savez(log, t=data.t, q=data.q, v=data.v, a=data.a, tau=data.tau, trajectory=data.trajectory)
    assert run(path if named else log, folder, "--model", "cholesky", "--iterations", "4", "--held-out", "0") == 0
    following = capsys.readouterr().out.splitlines()[-1]
    assert following == f"next: nbs-pin compare {folder / 'model.nbs'}" + ("" if named else " --against ROBOT")
    words = following.removeprefix("next: nbs-pin ").replace("ROBOT", "two_link").split()
    compared = tmp_path / "compared"
    assert cli.main([*words, "--samples", "20", "--trajectories", "0", "--out", str(compared)]) == 0
    assert "relative_error" in summary(compared)["figures"]


def test_an_early_end_keeps_the_best(path, tmp_path, monkeypatch, capsys):
    from nbs_pin.identification.network_equations import Equations

    calls, normal = [], Equations.normal

    def interrupted(self, theta, rows):
        calls.append(theta)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return normal(self, theta, rows)

    monkeypatch.setattr(Equations, "normal", interrupted)
    assert run(path, tmp_path, "--model", "cholesky") == 130
    said = summary(tmp_path)
    assert said["interrupted"] is True
    assert said["figures"]["stopped"] == "interrupted"
    assert nbs.load(tmp_path / "model.nbs").nv == 2
    assert "interrupted" in capsys.readouterr().err


def test_another_model_is_not_replaced(path, network, capsys):
    before = contents(network)
    code = run(path, network, "--model", "cholesky", "--iterations", "2")
    assert "holds model.nbs of another model" in refusal(code, capsys)
    assert contents(network) == before


@pytest.mark.parametrize(
    ("data", "options", "words"),
    [
        ("data.npz", "--model forest", "forest"),
        ("data.npz", "--held-out 1", "--held-out is '1'"),
        ("data.npz", "--iterations 0", "--iterations is '0'"),
        ("data.npz", "--model identified --loss acceleration", "takes no --loss acceleration"),
        ("data.npz", "--robot three_link", "three_link"),
        ("data.npz", "--robot nowhere", "nowhere"),
        ("panda.npz", "--robot xarm7", "the data are of panda, not of xarm7; give the arm they were recorded on"),
        ("none.npz", "", "none.npz"),
    ],
)
def test_what_cannot_be_meant_is_refused(path, tmp_path, capsys, data, options, words):
    collect(nbs.load_robot("panda"), "uniform", 40).save(path.parent / "panda.npz")
    assert words in refusal(run(path.parent / data, tmp_path / "out", *options.split()), capsys)
    assert not (tmp_path / "out").exists()


def test_an_arm_whose_description_changed_is_refused(path):
    data = load_dataset(path)
    changed = replace(data, about=data.about | {"robot": data.about["robot"] | {"sha256": "0" * 64}})
    with pytest.raises(nbs.ArgumentError, match="has changed since"):
        learning.arm_of(changed)
    assert learning.arm_of(data).name == "two_link"
    assert learning.arm_of(replace(data, about={})) is None


def test_the_model_of_the_command_is_that_of_fit(path, network):
    train, test = split_data(load_dataset(path), 0.2, 3)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # so short a fit without friction is doubted
        model = fit(train, "cholesky", 3, robot=ROBOT, held_out=test, iterations=4, friction=False, offset=False)
    assert_array_equal(model.mass_matrix(test.q), nbs.load(network / "model.nbs").mass_matrix(test.q))
    assert summary(network)["figures"]["curves"]["history"] == list(model.report.history)


def test_without_a_terminal_lines_say_how_far_it_is(path, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("nbs_pin.base.progress._BEAT", 0.01)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # so short a fit knows less than the URDF
        assert run(path, tmp_path / "out", "--model", "cholesky", "--iterations", "3", "--held-out", "0") == 0
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("learning cholesky, 0 s")]
    assert any("fitting, nMSE" in line and " of 3" in line for line in lines)
