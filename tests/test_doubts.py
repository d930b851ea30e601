"""What a fit says of data that contradict the arm: signs and units of torques, friction left out, worthless models."""

import warnings
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

import nbs_pin as nbs
from nbs_pin import cli
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.dynamics.pseudo_inertia import inertial_parameters
from nbs_pin.identification import fit as fitting
from nbs_pin.identification.collect import collect
from nbs_pin.identification.doubts import doubts
from nbs_pin.identification.drive_choice import Wanted
from nbs_pin.identification.explain import explain
from nbs_pin.identification.fit_report import torque_errors, torque_nmse, zero_torque_nmse
from nbs_pin.identification.identify import identify, sign_fault
from nbs_pin.identification.regressor import RobotGeometry
from nbs_pin.identification.remainder import remainder
from nbs_pin.robots.robot import load_robot
from tests.commands import refusal, summary

ARMS = {name: load_robot(name) for name in ("two_link", "three_link", "ur5", "panda")}
PLAIN = Wanted(False, False, False)


@cache
def recorded(name):
    """Motions of an arm with friction and noise of a hundredth of the torque."""
    data = collect(ARMS[name], samples=600, seed=4, duration=1.0)
    rng, size = np.random.default_rng(7), data.tau.std(axis=0)
    drag = 0.2 * size * np.tanh(data.v / 0.01)
    return replace(data, tau=data.tau + drag + 0.01 * size * rng.standard_normal(data.tau.shape))


@pytest.mark.parametrize("name", ARMS)
def test_right_signs_are_not_doubted(name):
    assert sign_fault(recorded(name), ARMS[name]) == ""
    assert sign_fault(collect(ARMS[name], "uniform", samples=200), ARMS[name]) == ""


@pytest.mark.parametrize(("name", "joint"), [(name, joint) for name, arm in ARMS.items() for joint in range(arm.nv)])
def test_a_wrong_sign_of_any_joint_is_named(name, joint):
    data, robot = recorded(name), ARMS[name]
    signs = np.where(np.arange(robot.nv) == joint, -1.0, 1.0)
    fault = sign_fault(replace(data, tau=signs * data.tau), robot)
    assert fault.startswith(f"sign of tau of {robot.joint_names[joint]}? ")
    assert fault.endswith("; reverse it")


@pytest.mark.parametrize("name", ARMS)
def test_a_wrong_sign_of_all_joints_is_named(name):
    data = recorded(name)
    assert sign_fault(replace(data, tau=-data.tau), ARMS[name]).startswith("sign of tau of every joint?")


def test_two_wrong_signs_are_named_together():
    signs = np.array([1.0, -1.0, 1.0, 1.0, -1.0, 1.0, 1.0])
    fault = sign_fault(replace(recorded("panda"), tau=signs * recorded("panda").tau), ARMS["panda"])
    assert fault.startswith("sign of tau of panda_joint2 and panda_joint5? ")


@pytest.mark.parametrize("model", ["identified", "chain", "cholesky"])
def test_no_model_is_fitted_to_a_torque_of_wrong_sign(model):
    data = replace(recorded("two_link"), tau=recorded("two_link").tau * [1.0, -1.0])
    with pytest.raises(ArgumentError, match=r"sign of tau of joint2\?"):
        nbs.fit(data, model, robot=ARMS["two_link"])
    with pytest.raises(ArgumentError, match=r"sign of tau of joint2\?"):
        identify(data, ARMS["two_link"])


@settings(max_examples=15, deadline=None)
@given(st.sampled_from(["two_link", "three_link", "panda"]), st.integers(1, 126))
def test_physical_bodies_are_never_worse_than_none_whatever_the_signs(name, code):
    """In the mean over joints of the squared error over the squared torque, which is 1 without bodies."""
    data, robot = recorded(name), ARMS[name]
    signs = 1.0 - 2.0 * (code >> np.arange(robot.nv) & 1)
    data = replace(data, tau=signs * data.tau)
    found = explain(RobotGeometry(robot), data, PLAIN, 0.3)
    assert found.report.converged
    pseudo = found.factors @ found.factors.swapaxes(1, 2)
    model = nbs.IdentifiedDynamics(robot, inertial_parameters(pseudo))
    share = np.square(torque_errors(model, data)).mean(axis=0) / np.square(data.tau).mean(axis=0)
    assert share.mean() < 1.0


def test_a_fit_is_called_converged_only_if_it_is_better_than_zero_torque(monkeypatch):
    data = recorded("two_link")
    assert zero_torque_nmse(data) == pytest.approx(np.mean(np.square(data.tau).mean(axis=0) / data.tau.var(axis=0)))
    with pytest.warns(UserWarning, match="friction"):
        nbs.fit(data, "identified", robot=ARMS["two_link"], friction=False)
    good = nbs.fit(data, "identified", robot=ARMS["two_link"])
    assert good.report.stopped == "converged"
    assert good.report.test_nmse < 0.1 < zero_torque_nmse(data)
    still = replace(data, tau=np.random.default_rng(0).standard_normal(data.tau.shape))
    for seed in range(8):
        report = nbs.fit(still, "identified", seed, robot=ARMS["two_link"]).report
        train, test = fitting.split_data(still, None, seed)
        assert len(train) == report.samples
        assert (report.stopped == "no better than zero torque") == (report.test_nmse >= zero_torque_nmse(test))
    monkeypatch.setattr(fitting, "torque_nmse", lambda *_: 1e3)
    assert nbs.fit(still, "identified", robot=ARMS["two_link"]).report.stopped == "no better than zero torque"


@pytest.mark.parametrize(("factor", "said"), [(1.0, False), (3.0, False), (588.0, True), (1e-3, True)])
@pytest.mark.parametrize("name", ["two_link", "panda"])
def test_torques_in_another_unit_are_doubted(name, factor, said):
    data, robot = recorded(name), ARMS[name]
    data = replace(data, tau=factor * data.tau)
    model = identify(data, robot, friction=True)
    left = remainder(model, data, model.friction)
    found = doubts(data, robot, left, {}, robot.joint_names)
    assert len(found) == said
    assert not said or ("mA, N·mm" in found[0] and "N·m?" in found[0])
    assert doubts(data, None, left, {}, robot.joint_names) == ()


@pytest.mark.parametrize("name", ["two_link", "panda"])
def test_friction_that_was_not_learned_is_missed(name):
    data, robot = collect(ARMS[name], samples=600, seed=4, duration=1.0), ARMS[name]
    rubbed = replace(data, tau=data.tau + 0.3 * data.tau.std(axis=0) * np.tanh(data.v / 0.01))
    for friction, tau, said in ((False, rubbed, True), (True, rubbed, False), (False, data, False)):
        model = identify(tau, robot, friction=friction)
        found = doubts(tau, robot, remainder(model, tau, model.friction), {"friction": friction}, robot.joint_names)
        assert len(found) == said
        assert not said or "leave out friction=False to learn it" in found[0]
        if said:
            better = identify(tau, robot, friction=True)
            assert torque_nmse(better, tau, better.friction) < 0.01 * torque_nmse(model, tau)


@pytest.mark.filterwarnings("default")
def test_the_shell_refuses_a_wrong_sign_and_writes_no_model(tmp_path, capsys):
    replace(recorded("two_link"), tau=recorded("two_link").tau * [1.0, -1.0]).save(tmp_path / "data.npz")
    arguments = ["learn", str(tmp_path / "data.npz"), "--model", "identified", "--out", str(tmp_path / "out")]
    assert "sign of tau of joint2?" in refusal(cli.main(arguments), capsys)
    assert not (tmp_path / "out").exists()
    recorded("two_link").save(tmp_path / "data.npz")
    assert cli.main(arguments) == 0
    capsys.readouterr()
    assert cli.main([*arguments, "--force", "--friction", "off"]) == 0
    assert "leave out --friction off to learn it" in capsys.readouterr().err
    assert summary(tmp_path / "out")["figures"]["stopped"] == "converged"


def test_a_network_that_knows_less_than_the_urdf_is_told():
    """After two iterations on a few samples of an arm with friction, its URDF with friction leaves far less."""
    robot = nbs.load_robot("three_link")
    friction = nbs.JointFriction(np.full(3, 0.5), np.full(3, 0.5))
    noise = nbs.Noise(torque=0.05)
    train, test = (nbs.collect(robot, "excited", 300, seed, friction=friction, noise=noise) for seed in (0, 1))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model = nbs.fit(train, "cholesky", robot=robot, held_out=test, iterations=2)
    said = " ".join(str(warning.message) for warning in caught)
    assert "the arm's own URDF with friction and rotors leaves" in said
    assert "; model='residual' or model='identified' begins with it or its geometry." in said
    assert 1e-6 < model.report.details["urdf_nmse"] < 1e-2 < model.report.test_nmse
    exact = nbs.collect(robot, "excited", 300, 0)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        nbs.fit(exact, "cholesky", robot=robot, held_out=0.0, iterations=1)  # a comparison, of whose result all know
    assert not any("own URDF" in str(warning.message) for warning in caught)


def test_where_a_network_is_too_large_for_its_data_a_smaller_one_is_tried():
    robot = nbs.load_robot("three_link")
    train, test = (nbs.collect(robot, "excited", 200, seed) for seed in (0, 1))
    given = {"held_out": test, "iterations": 4}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        large, small, chosen = (
            nbs.fit(train, "cholesky", **given, **own) for own in ({"widths": (32, 32)}, {"widths": (8,)}, {})
        )
    assert large.report.test_nmse > 5.0 * large.report.train_nmse
    best = min(large, small, key=lambda model: min(model.report.held_out))
    assert chosen.report.held_out == best.report.held_out
    assert chosen.network.widths == best.network.widths == (8,)
