"""Motors that turn several joints, beside every model: given or found, solved in coordinates of the motors."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose

import nbs_pin as nbs
from nbs_pin import cli
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.dynamics.chain import Chain
from nbs_pin.dynamics.coupled_network import CoupledNetwork
from nbs_pin.dynamics.registry import NETWORKS, make_network
from nbs_pin.identification import network_fit
from nbs_pin.identification.fit_report import torque_nmse
from nbs_pin.identification.network_equations import Equation, Equations
from tests.commands import summary
from tests.test_drives import ROTORS, TWO, UR5, WRIST, driven, gears, moved, wrists

BOTH = np.array([[1.0, 0.0], [1.0, 1.0]])


def at_motors(data, matrix):
    """The same data with the torques of the motors."""
    return replace(data, tau=data.tau @ np.linalg.inv(matrix))


@cache
def small():
    """Noisy motions of two_link, of which motor 2 turns q1 + q2, and fresh ones."""
    drives = nbs.DriveFriction([2.0, 1.0], [1.5, 1.0], offset=[0.0, 0.3], coupling=BOTH)
    noisy, fresh = moved(TWO, 400, noise=nbs.Noise(torque=0.1)), moved(TWO, 200, seed=9)
    rotors = BOTH.T * [0.3, 0.1] @ BOTH
    return [driven(replace(data, tau=data.tau + data.a @ rotors), drives) for data in (noisy, fresh)]


def judged(model, fresh):
    return torque_nmse(model, fresh, model.friction)


@pytest.mark.parametrize("motors", [False, True], ids=["torques of joints", "torques of motors"])
def test_a_corrected_arm_finds_the_coupling_and_is_as_good_as_an_uncoupled_one(motors, tmp_path):
    (joined, alone), (fresh, fresh_alone) = wrists()
    few = {"robot": UR5, "held_out": 0.0, "widths": (4,), "iterations": 3}
    with pytest.warns(UserWarning, match="motor of wrist_3_joint also turns .* with wrist_2_joint"):
        model = nbs.fit(at_motors(joined, WRIST) if motors else joined, "residual", **few)
    details = model.report.details
    assert details["torques_of_motors"] is motors
    assert_allclose(details["coupling"], WRIST, atol=0.01)
    assert_allclose(model.friction.coupling, details["coupling"])
    assert_allclose(model.nominal.motor_inertia, ROTORS, atol=0.1)
    usual = nbs.fit(alone, "residual", **few)
    assert judged(model, fresh) < 1.2 * judged(usual, fresh_alone)
    assert judged(model, fresh) < 1e-3
    nbs.save(model, tmp_path / "model.nbs")
    again = nbs.load(tmp_path / "model.nbs")
    assert_allclose(judged(again, fresh), judged(model, fresh))


def test_a_tree_beside_a_coupled_wrist_is_as_good_as_beside_an_uncoupled_one(tmp_path):
    (joined, alone), (fresh, fresh_alone) = wrists()
    with pytest.warns(UserWarning, match="motor of wrist_3_joint also turns .* with wrist_2_joint"):
        model = nbs.fit(joined, "chain", robot=UR5, held_out=0.0)
    usual = nbs.fit(alone, "chain", robot=UR5, held_out=0.0)
    assert judged(model, fresh) < 1.2 * judged(usual, fresh_alone)
    assert_allclose(model.network.coupling, WRIST, atol=0.01)
    assert_allclose(model.friction.viscous, gears().viscous, atol=0.2)
    assert_allclose(model.network.rotors.numpy()[1:] ** 2, ROTORS[1:], atol=0.1)  # that of joint 1 is of its link, too
    nbs.save(model, tmp_path / "model.nbs")
    again = nbs.load(tmp_path / "model.nbs")
    assert_allclose(judged(again, fresh), judged(model, fresh))


@pytest.mark.parametrize("motors", [False, True], ids=["torques of joints", "torques of motors"])
@pytest.mark.parametrize(("name", "options"), [("chain", {}), ("cholesky", {"widths": (8,), "iterations": 10})])
def test_without_an_arm_the_better_fit_tells_whose_torques_a_log_holds(name, options, motors):
    data, fresh = small()
    model = nbs.fit(at_motors(data, BOTH) if motors else data, name, coupling=BOTH, held_out=0.0, **options)
    assert model.report.details["torques_of_motors"] is motors
    assert judged(model, fresh) < {"chain": 1e-4, "cholesky": 0.1}[name]
    assert_allclose(model.friction.viscous, [2.0, 1.0], atol=0.2)
    law = nbs.NeuralBackstepping.for_robot(TWO, dynamics=model, friction=model.friction)
    plant = nbs.DynamicsPlant(model, friction=model.friction)
    run = nbs.simulate(plant, law, nbs.Sinusoid.for_robot(TWO), duration=0.3, period=0.002)
    assert np.abs(run.q - run.q_ref).max() < 1e-3


def test_rotors_that_the_arm_states_are_those_of_its_motors():
    arm = TWO.with_armature([0.3, 0.1])
    model = nbs.fit(small()[0], "residual", robot=arm, coupling=BOTH, widths=(4,), iterations=1)
    assert_allclose(model.nominal.motor_inertia, [0.3, 0.1])
    added = model.nominal.mass_matrix([0.2, 0.4]) - nbs.PinocchioDynamics(TWO).mass_matrix([0.2, 0.4])
    assert_allclose(added, BOTH.T * [0.3, 0.1] @ BOTH, atol=1e-12)


def test_no_coupling_is_looked_for_without_an_arm_or_where_there_is_to_be_none():
    data, _ = small()
    few = {"widths": (4,), "iterations": 1}
    assert "coupling" not in nbs.fit(data, "cholesky", **few).report.details
    with pytest.warns(UserWarning, match="own URDF with friction and rotors leaves"):
        assert "coupling" not in nbs.fit(data, "cholesky", robot=TWO, coupling=False, **few).report.details
    with pytest.raises(ArgumentError, match="invertible 2×2"):
        nbs.fit(data, "cholesky", coupling=[[1.0, 1.0], [1.0, 1.0]], **few)


@pytest.mark.parametrize("loss", ["torque", "acceleration"])
@pytest.mark.parametrize("name", [*NETWORKS, "chain"])
def test_friction_of_coupled_motors_is_what_a_network_leaves(name, loss):
    data, drives = moved(TWO, 60), nbs.DriveFriction([2.0, 1.0], [1.5, 0.5], 0.1, offset=[0.2, 0.3], coupling=BOTH)
    slides = [False, False]
    network = Chain([0, 1], slides, 0.1) if name == "chain" else make_network(name, slides, 3, epsilon=0.1)
    q, v, a = (torch.from_numpy(x) for x in (data.q, data.v, data.a))
    needed = network.torque(q, v, v, a).numpy(force=True)
    data = replace(data, tau=needed + drives.feedforward(data.v, needed))
    equations = Equations.of(Equation.fitted(network, drives, loss), data)
    assert equations.cost(equations.theta) < 1e-20
    equations.equation.write_numbers(0.0 * equations.equation.numbers.numpy(force=True))
    equations.write(equations.solved(equations.theta))
    found = equations.equation.friction()
    for term in ("viscous", "coulomb", "offset"):
        assert_allclose(getattr(found, term), getattr(drives, term), rtol=1e-5)  # `lsq_linear`
    assert_allclose(found.coupling, BOTH)
    assert equations.torque_cost(drives) < 1e-20


def test_rotors_that_several_joints_turn_are_part_of_the_model(tmp_path):
    network = CoupledNetwork(Chain([0, 1, 2], [False] * 3, 0.01, seed=3), [[1, 0, 0], [0.5, 1, 0], [0, -1, 1]])
    network.requires_grad_(False).rotors.data += torch.tensor([0.3, 0.5, 0.7], dtype=torch.float64)
    model, bare = nbs.LagrangianDynamics(network), nbs.LagrangianDynamics(network.inner)
    rng = np.random.default_rng(0)
    q, v, w, a = rng.normal(size=(4, 5, 3))
    n = network.coupling
    assert_allclose(model.mass_matrix(q) - bare.mass_matrix(q), [n.T @ np.diag([0.09, 0.25, 0.49]) @ n] * 5)
    assert_allclose(model.coriolis_matrix(q, v), bare.coriolis_matrix(q, v))
    needed = (model.mass_matrix(q) @ a[..., None] + model.coriolis_matrix(q, v) @ w[..., None])[..., 0]
    assert_allclose(model.reference_torque(q, v, w, a), needed + model.gravity(q))
    tensors = [torch.from_numpy(x) for x in (q, v, w, a)]
    assert_allclose(model.reference_torque(*tensors), model.reference_torque(q, v, w, a))
    tau = model.reference_torque(q, v, v, a)
    assert_allclose(model.forward_dynamics(q, v, tau), a, atol=1e-9)
    assert_allclose(model.forward_dynamics(*(torch.from_numpy(x) for x in (q, v, tau))), a, atol=1e-9)
    assert_allclose(network.kinetic(*tensors[:2]), 0.5 * np.einsum("si,sij,sj->s", v, model.mass_matrix(q), v))
    assert model.packed_tree() is None
    assert model.structure_claims().positive.value == bare.structure_claims().positive.value
    nbs.save(model, tmp_path / "model.nbs")
    assert_allclose(nbs.load(tmp_path / "model.nbs").mass_matrix(q), model.mass_matrix(q))


def test_the_shell_takes_a_coupling_for_any_model(tmp_path, capsys):
    path = tmp_path / "data.npz"
    at_motors(small()[0], BOTH).save(path)
    assert cli.main(["learn", str(path), "--coupling", "2.1=1", "--out", str(tmp_path / "out"), "-v"]) == 0
    said = summary(tmp_path / "out")["figures"]
    assert said["coupling"] == BOTH.tolist()
    assert said["details"]["torques_of_motors"] is True
    assert max(said["rms_test_torque_error_Nm"]) < 0.3
    assert "motor of joint2 also turns 1 times with joint1" in " ".join(capsys.readouterr().out.split())


def test_ctrl_c_ends_the_fits_to_both_kinds_of_torque(monkeypatch):
    seen, record = [], network_fit._Search.record

    def interrupted(*given):
        seen.append(given)
        if len(seen) == 4:
            raise KeyboardInterrupt
        return record(*given)

    monkeypatch.setattr(network_fit._Search, "record", interrupted)
    model = nbs.fit(small()[0], "cholesky", coupling=BOTH, held_out=0.0, widths=(4,), iterations=10)
    assert model.report.stopped == "interrupted"
    assert len(seen) == 4


@pytest.mark.parametrize("model", ["identified", "cholesky", "chain"])
@pytest.mark.parametrize("transition", ["abc", None, 0.0, -1.0])
def test_a_transition_that_is_no_speed_is_refused(model, transition):
    with pytest.raises(ArgumentError, match="transition"):
        nbs.fit(small()[0], model, robot=TWO, transition=transition)
