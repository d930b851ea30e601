"""Training through the closed loop: exact gradients, one loop by two engines, and what training promises."""

import os
import signal

import numba
import numpy as np
import pytest
import torch

import nbs_pin as nbs
from nbs_pin.base.exceptions import ArgumentError, SimulationDiverged
from nbs_pin.controllers.registry import build_law
from nbs_pin.simulation.costs import TimeOutside, TorqueAware, squared_error
from nbs_pin.simulation.loop import Loop
from nbs_pin.simulation.rollout import Batch, engine_for, motions, recorded, running_cost
from nbs_pin.storage.checkpoints import about
from tests.laws import COMPILED

PERIOD = 0.01
ROBOT = nbs.load_robot("two_link")
PLANT = nbs.DynamicsPlant(nbs.PinocchioDynamics(ROBOT))
REFERENCE = nbs.Sinusoid.for_robot(ROBOT)


def arm(name, effort=None):
    robot = nbs.load_robot(name)
    return robot if effort is None else robot.with_effort_limit(effort)


def problem(robot, steps=8, starts=2, *, integrator="rk4", substeps=1, friction=None, error=0.5, **given):
    """A batch of motions of the arm from random starts."""
    plant = nbs.DynamicsPlant(nbs.PinocchioDynamics(robot), integrator, friction)
    settings = {"plant_step": PERIOD / substeps, "effort_limit": None, "lookahead": None} | given
    loop = Loop.of(plant, robot.nv, steps * PERIOD, PERIOD, **settings)
    reference = nbs.Sinusoid.for_robot(robot, 2.0)
    draw = np.random.default_rng(3)
    q0 = reference(0.0).q + draw.uniform(-error, error, (starts, robot.nv))
    return Batch.of(loop, reference, q0, draw.normal(size=q0.shape), draw.normal(size=robot.nv))


def law_for(robot, name="nbs", **settings):
    controller = build_law(name, robot, period=PERIOD, bandwidth=4.0, **settings)
    draw = torch.Generator().manual_seed(5)
    with torch.no_grad():  # gains off their nominal values, so that every term of their derivative counts
        for parameter in controller.parameters():
            parameter += 0.05 * torch.randn(parameter.shape, generator=draw, dtype=torch.float64)
    return controller


def value_and_gradient(controller, batch, cost, engine):
    controller.zero_grad()
    value = running_cost(motions(controller, batch, engine), batch, cost).mean()
    value.backward()
    return float(value.detach()), torch.cat([p.grad.ravel() for p in controller.parameters()])


def assert_engines_agree(controller, batch, cost):
    assert engine_for(controller, batch.loop) == "kernels"
    fast, slow = (value_and_gradient(controller, batch, cost, engine) for engine in ("kernels", "torch"))
    assert fast[0] == pytest.approx(slow[0], rel=1e-9)
    assert float(torch.linalg.norm(fast[1] - slow[1])) <= 1e-9 * float(torch.linalg.norm(slow[1]))


@pytest.mark.parametrize("name", COMPILED)
def test_both_engines_are_one_loop_for_every_law(name):
    robot = arm("two_link", 30.0)
    assert_engines_agree(law_for(robot, name), problem(robot), TorqueAware.for_robot(robot))


@pytest.mark.parametrize("name", ["panda", "kinova", "double_pendulum"])
def test_both_engines_are_one_loop_on_larger_and_continuous_arms(name):
    robot = nbs.load_robot(name, zero_limits="unlimited")
    assert_engines_agree(law_for(robot), problem(robot, steps=3), TorqueAware.for_robot(robot))


@pytest.mark.parametrize("name", ["two_link", "three_link", "panda"])
@pytest.mark.parametrize("law", ["nbs", "slotine-li"])
def test_gradients_are_those_of_finite_differences(name, law):
    """Along random directions of all parameters, by sixth-order differences, with joints at their limits.

    Not for the paper's ψ: its torque jumps, so its motions do, and no difference across a jump is a derivative.
    """
    robot = arm(name, 40.0 if name != "panda" else None)
    controller, batch, cost = law_for(robot, law), problem(robot, steps=40, starts=3), TorqueAware.for_robot(robot)
    _, gradient = value_and_gradient(controller, batch, cost, "kernels")
    parameters = list(controller.parameters())
    theta = torch.nn.utils.parameters_to_vector(parameters).detach()
    draw = torch.Generator().manual_seed(1)

    def along(direction, size):
        torch.nn.utils.vector_to_parameters(theta + size * direction, parameters)
        with torch.no_grad():
            return float(running_cost(motions(controller, batch, "kernels"), batch, cost).mean())

    for _ in range(3):
        direction = torch.randn(theta.shape, generator=draw, dtype=torch.float64)
        h = 1e-5
        steps = [(along(direction, k * h) - along(direction, -k * h)) / (2 * k * h) for k in (1, 2, 3)]
        expected = 1.5 * steps[0] - 0.6 * steps[1] + 0.1 * steps[2]
        assert float(direction @ gradient) == pytest.approx(expected, rel=1e-6)


def test_disturbances_are_differentiable_too():
    controller, batch = law_for(ROBOT), problem(ROBOT)
    gradients = []
    for engine in ("kernels", "torch"):
        tau_d = torch.tensor(batch.tau_d, requires_grad=True)
        running_cost(motions(controller, batch, engine, tau_d), batch, squared_error).sum().backward()
        gradients.append(tau_d.grad)
    torch.testing.assert_close(*gradients, rtol=1e-9, atol=1e-15)
    assert float(gradients[0].abs().min()) > 0.0


def test_disturbances_of_another_size_are_refused_before_any_kernel_runs():
    controller, batch = law_for(ROBOT), problem(ROBOT)
    for shape in ((2, 5, 2), (2, 9, 2), (1, 8, 2), (2, 8, 3)):
        with pytest.raises(ArgumentError, match="tau_d is"):
            motions(controller, batch, None, torch.zeros(shape, dtype=torch.float64))
    for torque in (np.zeros(3), [1.0, np.nan], "much"):
        with pytest.raises(ArgumentError, match="disturbance"):
            Batch.of(batch.loop, REFERENCE, tau_d=torque)


def test_gradients_of_many_starts_are_the_sum_of_those_of_few(monkeypatch):
    controller, batch = law_for(ROBOT), problem(ROBOT, starts=7)
    whole = value_and_gradient(controller, batch, squared_error, "kernels")
    monkeypatch.setattr("nbs_pin.simulation.rollout._BATCH", 3)
    parts = value_and_gradient(controller, batch, squared_error, "kernels")
    torch.testing.assert_close(parts[1], whole[1], rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("name", COMPILED)
def test_a_motion_is_the_run_that_simulate_gives(name):
    robot = arm("two_link", 20.0)
    controller, batch = law_for(robot, name), problem(robot, steps=30, starts=1, lookahead=0.004)
    with torch.no_grad():
        run = recorded(motions(controller, batch), batch, "law")
    start = {"q0": batch.q0[0], "v0": batch.v0[0], "disturbance": nbs.ConstantTorque(batch.tau_d[0, 0])}
    plant, reference = batch.loop.plant, nbs.Sinusoid.for_robot(robot, 2.0)
    known = nbs.simulate(plant, controller, reference, 0.3, PERIOD, plant_step=PERIOD, lookahead=0.004, **start)
    for field in ("q", "v", "q_ref", "v_ref", "a_ref"):
        np.testing.assert_allclose(getattr(run, field)[:, 0], getattr(known, field), rtol=1e-9, atol=1e-11)
    for field in ("tau", "tau_command", "disturbance"):
        np.testing.assert_allclose(getattr(run, field)[:-1, 0], getattr(known, field)[:-1], rtol=1e-9, atol=1e-9)
    assert np.any(np.abs(known.tau_command) > 20.0) or name == "pid"


def test_threads_do_not_change_a_bit(monkeypatch):
    controller, batch = law_for(ROBOT), problem(ROBOT, starts=5)
    several = value_and_gradient(controller, batch, squared_error, "kernels")
    monkeypatch.setattr(numba.config, "NUMBA_NUM_THREADS", 1)
    one = value_and_gradient(controller, batch, squared_error, "kernels")
    assert several[0] == one[0]
    assert torch.equal(several[1], one[1])


def test_parts_from_outside_go_by_torch():
    class Other(nbs.NeuralBackstepping):
        def torque(self, q, v, q_ref, v_ref, a_ref):
            return 0.5 * super().torque(q, v, q_ref, v_ref, a_ref)

    batch, other = problem(ROBOT, steps=2), Other.for_robot(ROBOT, period=PERIOD)
    assert engine_for(other, batch.loop) == "torch"
    with pytest.raises(ArgumentError, match="no kernels; take engine='torch'"):
        motions(other, batch, "kernels")
    half, whole = motions(other, batch), motions(untrained(), batch)
    torch.testing.assert_close(half.command[:, 0], 0.5 * whole.command[:, 0])


def untrained(name="nbs", robot=ROBOT, **settings):
    return build_law(name, robot, period=PERIOD, **settings)


def quick(controller, robot=ROBOT, **settings):
    plant = nbs.DynamicsPlant(nbs.PinocchioDynamics(robot))
    given = {"starts": 4, "duration": 0.4, "epochs": 12} | settings
    return nbs.train(controller, plant, [nbs.Sinusoid.for_robot(robot)], **given)


@pytest.mark.parametrize("name", COMPILED)
@pytest.mark.parametrize("optimiser", ["adam-backtracking", "adam", "lbfgs"])
def test_training_lowers_the_held_out_cost_and_leaves_the_given_law_alone(name, optimiser):
    controller = untrained(name)
    before = {k: x.clone() for k, x in controller.state_dict().items()}
    result = quick(controller, optimiser=optimiser, cost=squared_error)
    assert result.held_out[result.best_epoch] == np.nanmin(result.held_out) < result.held_out[0]
    assert result.stopped == "epochs"
    assert len(result.history) == len(result.held_out) == 13
    assert all(torch.equal(x, before[k]) for k, x in controller.state_dict().items())
    assert all(p.grad is None for p in result.controller.parameters())


def test_the_given_controller_is_the_one_of_the_best_epoch():
    result = quick(untrained(), held_out=0, epochs=5)
    loop = Loop.of(PLANT, 2, 0.4, PERIOD, plant_step=PERIOD, effort_limit=None, lookahead=None)
    q0 = REFERENCE(0.0).q + np.random.default_rng(0).uniform(-0.5, 0.5, (4, 2))
    batch = Batch.of(loop, REFERENCE, q0)
    cost = running_cost(motions(result.controller, batch), batch, TorqueAware.for_robot(ROBOT)).mean()
    assert float(cost.detach()) == result.history[result.best_epoch]


def test_gains_stay_above_their_share_and_can_be_left_alone():
    controller = untrained()
    moved = quick(controller, learning_rate=0.02).controller
    assert not np.array_equal(moved.rate.numpy(), controller.rate.numpy())
    for gain, nominal in ((moved.rate, controller.rate), (moved.damping.floor, controller.damping.floor)):
        least = gain.numpy() - float(gain.least_share) * nominal.numpy()
        assert np.all(np.linalg.eigvalsh(least if least.ndim == 2 else np.diag(least)) > 0.0)
    fixed = quick(controller, gains=False).controller
    np.testing.assert_array_equal(fixed.rate.numpy(), controller.rate.numpy())
    np.testing.assert_array_equal(fixed.potential.stiffness.numpy(), controller.potential.stiffness.numpy())
    with pytest.raises(ArgumentError, match="nothing to train besides its gains"):
        quick(untrained("pid"), gains=False)


def test_a_regulariser_keeps_weights_small():
    controller = untrained()

    def size(law):
        return sum((p**2).sum() for p in law.potential.network.parameters())

    free, bound = (quick(controller, held_out=0, regulariser=r) for r in (None, lambda law: 10.0 * size(law)))
    assert float(size(bound.controller).detach()) < 0.9 * float(size(free.controller).detach())
    assert bound.history[0] == pytest.approx(free.history[0] + 10.0 * float(size(controller).detach()))


@pytest.mark.parametrize(("optimiser", "epoch"), [("adam-backtracking", 13), ("adam", 6), ("lbfgs", 13)])
def test_a_resumed_training_is_the_same_to_the_last_bit(optimiser, epoch, tmp_path, monkeypatch):
    controller = untrained()
    settings = {"optimiser": optimiser, "epochs": 16, "starts": 2, "duration": 0.2, "learning_rate": 0.05}
    whole = quick(controller, **settings, checkpoint=tmp_path / "whole.ckpt")
    stop_at(monkeypatch, epoch)
    stopped = quick(controller, **settings, checkpoint=tmp_path / "part.ckpt")
    assert stopped.stopped == "interrupted"
    assert len(stopped.history) < len(whole.history)
    assert stopped.held_out[stopped.best_epoch] == stopped.held_out.min()
    monkeypatch.undo()
    resumed = quick(controller, **settings, checkpoint=tmp_path / "part.ckpt", resume=True)
    np.testing.assert_array_equal(resumed.history, whole.history)
    np.testing.assert_array_equal(resumed.held_out, whole.held_out)
    for name, x in whole.controller.state_dict().items():
        assert torch.equal(x, resumed.controller.state_dict()[name]), name


def stop_at(monkeypatch, epoch):
    """Ctrl-C, as a signal, in the middle of that epoch."""
    count = iter(range(10_000))

    def rollouts(*arguments):
        if next(count) == 2 * epoch:
            os.kill(os.getpid(), signal.SIGINT)
        return motions(*arguments)

    monkeypatch.setattr("nbs_pin.training.trainer.motions", rollouts)


def test_patience_ends_a_training_that_gains_nothing():
    result = quick(untrained(), optimiser="adam", learning_rate=1.0, epochs=40, patience=3)
    assert result.stopped == "patience"
    assert len(result.history) < 41


def test_a_checkpoint_of_another_training_or_arm_is_refused(tmp_path):
    controller, path = untrained(), tmp_path / "a.ckpt"
    quick(controller, checkpoint=path, epochs=2)
    changes = (
        ({"epochs": 3}, "it has epochs=2, and here is epochs=3"),
        ({"starts": 5}, "it differs in the number of starts"),
        ({"seed": 1, "learning_rate": 0.5}, "it has learning_rate=.*, seed=0, and here is learning_rate=0.5, seed=1"),
        ({"cost": squared_error}, "it differs in cost"),
        ({"cost": TorqueAware(torch.tensor(ROBOT.effort_limit), effort=1e-3)}, "it differs in cost"),
        ({"regulariser": lambda law: sum((p**2).sum() for p in law.parameters())}, "it differs in cost, regulariser"),
    )
    same = {"checkpoint": path, "epochs": 2, "resume": True}
    for law, change, words in (*((controller, *x) for x in changes), (untrained(bandwidth=7.0), {}, "the controller")):
        with pytest.raises(ArgumentError, match=f"not a checkpoint of this training, as .*{words}"):
            quick(law, **same | change)
    assert about(path)["info"] == {"seed": 0}
    other = arm("three_link")
    with pytest.raises(ArgumentError, match="two_link"):
        quick(untrained(robot=other), other, **same)


def test_a_training_whose_plant_is_another_arm_than_the_law_believes_is_resumed(tmp_path):
    controller, heavier = untrained(), nbs.load_robot("two_link", gravity=12.0)
    settings = {"starts": 2, "duration": 0.2, "epochs": 3, "effort_limit": 50.0, "checkpoint": tmp_path / "c.ckpt"}
    first = quick(controller, heavier, **settings)
    again = quick(controller, heavier, **settings, resume=True)
    np.testing.assert_array_equal(first.history, again.history)


def test_what_no_checkpoint_can_hold_is_known_before_the_first_epoch(tmp_path):
    class Mine(nbs.NeuralBackstepping):
        pass

    with pytest.raises(ArgumentError, match="Mine"):
        quick(Mine.for_robot(ROBOT, period=PERIOD), checkpoint=tmp_path / "c.ckpt", duration=0.02, epochs=1)


def test_gradients_that_are_no_numbers_do_not_reach_the_parameters(tmp_path):
    """A cost that is finite, with a derivative that is not from the third evaluation on."""
    count = iter(range(1000))

    def kinked(z1, dz1, tau):
        return (z1 * z1).sum(-1) + (torch.sqrt(0.0 * z1[..., 0]) if next(count) > 8 else 0.0)

    result = quick(untrained(), cost=kinked, checkpoint=tmp_path / "c.ckpt")
    assert all(bool(p.isfinite().all()) for p in result.controller.parameters())
    assert result.history[1] < result.history[0]


def test_costs_may_be_negative():
    result = quick(untrained(), cost=lambda z, dz, tau: (z * z).sum(-1) - 1.0)
    assert result.history[0] < 0.0
    assert len(set(result.history)) > 6


def test_held_out_motions_that_are_never_finite_are_named():
    robot = arm("two_link", np.inf)
    with pytest.raises(SimulationDiverged, match="the held-out motions diverge"):
        quick(untrained(robot=robot), robot, held_out=(np.zeros((1, 2)), np.full((1, 2), 1e99)))


def test_what_cannot_be_trained_is_refused_in_one_sentence():
    controller, other = untrained(), nbs.DynamicsPlant(nbs.PinocchioDynamics(arm("three_link")))
    for law, plant, references, message in (
        (controller, nbs.MujocoPlant(ROBOT), [REFERENCE], "has no derivatives; train on DynamicsPlant"),
        (controller.compile(), PLANT, [REFERENCE], "has no parameters to train"),
        (controller, PLANT, [], r"references is \[\]; give a list of 1"),
        (controller, other, [REFERENCE], "2 joints and the plant 3"),
    ):
        with pytest.raises(ArgumentError, match=message):
            nbs.train(law, plant, references)
    for given, message in (
        ({"optimiser": "sgd"}, "optimiser 'sgd' is unknown"),
        ({"epochs": 0}, "epochs is 0"),
        ({"starts": 0}, "the number of starts is 0; give a whole number from 1"),
        ({"patience": 0}, "patience is 0"),
        ({"start_error": -1.0}, "start_error"),
        ({"disturbance": np.nan}, "disturbance"),
        ({"starts": np.zeros((3, 5))}, "q0 has shape"),
        ({"starts": np.full((3, 2), np.nan)}, "finite"),
        ({"learning_rate": -1.0}, "learning_rate"),
        ({"duration": 0.123456}, "whole number"),
        ({"resume": True}, "without a checkpoint"),
    ):
        with pytest.raises(ArgumentError, match=message):
            quick(controller, **given)


def test_motions_that_leave_the_finite_numbers_are_reported():
    robot = arm("two_link", np.inf)
    wild = nbs.ComputedTorque(nbs.PinocchioDynamics(robot), kp=1e9, kd=1e9)
    with pytest.raises(SimulationDiverged, match="the training motions diverge"):
        quick(wild, robot, duration=1.0)


def test_stage_costs_are_what_they_say():
    z, dz = torch.tensor([[0.3, 0.4]], dtype=torch.float64), torch.tensor([[1.0, 0.0]], dtype=torch.float64)
    tau = torch.tensor([[15.0, -5.0]], dtype=torch.float64)
    assert float(squared_error(z, dz, tau)) == pytest.approx(0.25)
    priced = TorqueAware(torch.tensor([10.0, np.inf]), rate=0.1, excess=2.0, effort=3.0)
    assert float(priced(z, dz, tau)) == pytest.approx(0.25 + 0.01 + 2.0 * 0.25 + 3.0 * 2.25)
    assert float(TimeOutside(0.25, pull=0.0)(z, dz, tau)) == pytest.approx(0.5)
    for bad in (lambda: TorqueAware(torch.ones(2), rate=-1.0), lambda: TimeOutside(0), lambda: TimeOutside(0.1, -1.0)):
        with pytest.raises(ArgumentError):
            bad()


def heavier(mass):
    return nbs.DynamicsPlant(nbs.PinocchioDynamics(ROBOT.with_payload("tip", mass)))


BRIEF = {"starts": [[0.3, 0.2], [0.1, -0.4]], "duration": 0.1, "period": PERIOD, "epochs": 2}


def test_several_plants_count_alike():
    plants, law = [PLANT, heavier(2.0)], nbs.SlotineLi.for_robot(ROBOT, period=PERIOD)
    both = nbs.train(law, plants, [REFERENCE], **BRIEF)
    single = [nbs.train(law, plant, [REFERENCE], **BRIEF).history for plant in plants]
    assert single[0][0] != pytest.approx(single[1][0], rel=1e-2)
    assert both.history[0] == pytest.approx(0.5 * (single[0][0] + single[1][0]), rel=1e-12)
    assert not np.allclose(both.controller.rate, nbs.train(law, PLANT, [REFERENCE], **BRIEF).controller.rate, rtol=1e-9)


def test_a_training_on_several_plants_goes_on_with_these_alone(tmp_path):
    law, file = nbs.PD.for_robot(ROBOT, period=PERIOD), tmp_path / "law.nbs"
    task = {"starts": 2, "held_out": 1, "duration": 0.1, "period": PERIOD, "encoder": 2**-16}
    plants = [PLANT, heavier(1.0)]
    whole = nbs.train(law, plants, [REFERENCE], epochs=4, **task)
    nbs.train(law, plants, [REFERENCE], epochs=4, checkpoint=file, **task)
    again = nbs.train(law, plants, [REFERENCE], epochs=4, checkpoint=file, resume=True, **task)
    np.testing.assert_array_equal(again.history, whole.history)
    for other in ([PLANT, heavier(1.5)], [PLANT]):
        with pytest.raises(ArgumentError, match="not a checkpoint of this training"):
            nbs.train(law, other, [REFERENCE], epochs=4, checkpoint=file, resume=True, **task)


def test_a_plant_without_derivatives_among_several_is_refused():
    with pytest.raises(ArgumentError, match="has no derivatives"):
        nbs.train(nbs.PD.for_robot(ROBOT), [PLANT, nbs.MujocoPlant(ROBOT)], [REFERENCE], starts=1)


def test_encoders_disturb_a_training_as_they_disturb_the_law():
    """The torque of the first instants is that of a law which reads encoders, up to products with the error."""
    law, encoder = nbs.NeuralBackstepping.for_robot(ROBOT, period=PERIOD), 2**-12
    loop = Loop.of(PLANT, 2, 0.05, PERIOD, plant_step=PERIOD, effort_limit=None, lookahead=0.0)
    batch = Batch.of(loop, REFERENCE, [REFERENCE(0.0).q + np.array([0.1, -0.2])])
    misread = batch.misread(encoder, np.random.default_rng(7))
    error = 2.0 * np.pi * encoder * np.random.default_rng(7).uniform(-0.5, 0.5, (1, loop.steps, 2))[0]
    motion = motions(law, misread)
    q, v, command = (x[0].detach().numpy() for x in motion)
    for k in range(loop.steps):
        aim, rate = REFERENCE(k * PERIOD), (error[k] - (error[k - 1] if k else 0.0)) / PERIOD
        exact = law.torque(q[k], v[k], *aim)
        read = law.torque(q[k] + error[k], v[k] + rate, *aim)
        assert np.linalg.norm(command[k] - read) < 0.05 * np.linalg.norm(read - exact)
    np.testing.assert_array_equal(batch.misread(0.0, np.random.default_rng(7)).aims, batch.aims)
