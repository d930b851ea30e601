"""The momentum observer: its identity, its filter against theory, its order, its two paths, runs, payloads and CSV."""

import base64
import csv
import itertools
import math

import numpy as np
import pytest
import torch

import nbs_pin as nbs
from nbs_pin.dynamics.momentum_observer import ObserverMemory
from nbs_pin.reports.signals import signals_of
from tests.random_arms import random_arm
from tests.test_dynamics import learned, relative

TWO = nbs.load_robot("two_link")
PANDA = nbs.load_robot("panda")
GAIN = 50.0


class Plain(nbs.PinocchioDynamics):
    """The same numbers without the kernels: a subclass is no packed tree."""


class Twisted(nbs.JointFriction):
    """Friction of another class, which the kernels do not know."""

    def torque(self, v):
        return 2.0 * super().torque(v)


def states(robot, count, seed=0):
    rng = np.random.default_rng(seed)
    q = rng.uniform(*robot.sampling_range, (count, robot.nv))
    return q, rng.uniform(-1.0, 1.0, (count, robot.nv)) * np.where(np.isfinite(robot.velocity_limit), 1.5, 1.0)


def off(x, y):
    """The largest difference, as a share of the largest number."""
    return relative(x - y, y)


def known(observer, q, v):
    return observer.initial(q, v).rows[1]


def run_of(robot, h=0.001, seconds=0.5, push=None, plant=None, law=None):
    law = nbs.NeuralBackstepping.for_robot(robot) if law is None else law
    plant = nbs.DynamicsPlant.for_robot(robot) if plant is None else plant
    return nbs.simulate(plant, law, nbs.Sinusoid.for_robot(robot), seconds, h, disturbance=push, check=False)


@pytest.mark.parametrize("seed", range(12))
def test_momentum_and_its_known_rate_are_derivatives_of_the_lagrangian(seed, tmp_path):
    # turning and sliding joints, branches, rotors, any mount; p = ∂T/∂v, β = ∂(T − V)/∂q
    robot = random_arm(seed, tmp_path)
    dynamics, observer = nbs.PinocchioDynamics(robot), nbs.MomentumObserver.for_robot(robot)
    q, v = states(robot, 20, seed)
    h, unit = 1e-5, np.eye(robot.nv)

    def lagrangian(q, v):
        return nbs.kinetic_energy(dynamics, q, v) - dynamics.potential_energy(q)

    slopes_q = np.stack([lagrangian(q + h * e, v) - lagrangian(q - h * e, v) for e in unit], axis=-1) / (2.0 * h)
    slopes_v = np.stack([lagrangian(q, v + h * e) - lagrangian(q, v - h * e) for e in unit], axis=-1) / (2.0 * h)
    rows = observer.initial(q, v).rows
    scale = 1.0 + np.abs(slopes_q).max()
    assert np.abs(rows[0] - slopes_v).max() < 1e-7 * scale
    assert np.abs(rows[1] - slopes_q).max() < 1e-7 * scale
    assert not rows[2].any()


@pytest.mark.parametrize("seed", range(12))
def test_the_kernel_equals_the_matrices(seed, tmp_path):
    robot = random_arm(seed, tmp_path)
    friction = nbs.JointFriction.of(robot)
    fast = nbs.MomentumObserver.for_robot(robot, GAIN, friction)
    plain = nbs.MomentumObserver(Plain(robot), GAIN, friction)
    q, v = states(robot, 40, seed)
    tau = np.random.default_rng(seed).normal(size=q.shape) * robot.effort_limit
    assert off(fast.initial(q, v).rows, plain.initial(q, v).rows) < 1e-12
    one, other = fast.initial(q[0], v[0]), plain.initial(q[0], v[0])
    for k in range(1, 40):
        h = 1e-3 * k
        seen, one = fast.step(one, q[k], v[k], tau[k], h)
        expected, other = plain.step(other, q[k], v[k], tau[k], h)
        assert off(seen.torque, expected.torque) < 1e-12
        assert off(seen.momentum, expected.momentum) < 1e-12


def test_the_rate_of_momentum_uses_the_christoffel_matrix():
    dynamics, (q, v) = nbs.PinocchioDynamics(PANDA), states(PANDA, 50)
    h = 1e-5
    rate = np.einsum("kij,kj->ki", dynamics.mass_matrix(q + h * v) - dynamics.mass_matrix(q - h * v), v) / (2.0 * h)
    force = np.einsum("kij,kj->ki", dynamics.coriolis_matrix(q, v), v)
    beta = known(nbs.MomentumObserver.for_robot(PANDA), q, v)
    assert np.allclose(beta, rate - force - dynamics.gravity(q), atol=1e-7)  # Cᵀv = Ṁv − Cv


@pytest.mark.parametrize("h", [0.0005, 0.001, 0.004])
@pytest.mark.parametrize("robot", [TWO, PANDA], ids=["two_link", "panda"])
def test_a_constant_torque_is_seen_as_the_filter_says(robot, h):
    push = np.linspace(-3.0, 4.0, robot.nv)
    run = run_of(robot, h, push=nbs.ConstantTorque(push))
    seen = nbs.MomentumObserver.for_robot(robot, GAIN).observe(run).torque
    expected = -np.expm1(-GAIN * run.t)[:, None] * push
    assert np.abs(seen - expected).max() < 4.0 * (h / 0.001) ** 2 * 1e-5  # h²/12·|β̈|, below 4e-5 N·m at 1 ms


def test_the_error_is_of_second_order_and_below_its_bound():
    observer, plant, errors = nbs.MomentumObserver.for_robot(PANDA, GAIN), nbs.DynamicsPlant.for_robot(PANDA), []
    for h in (0.004, 0.002, 0.001):
        run = run_of(PANDA, h, seconds=0.4)
        errors.append(np.abs(observer.observe(run).torque).max(axis=0))
        # β̈ within the periods, over which the torque is held
        middle = plant.step(run.q[:-1], run.v[:-1], run.tau[:-1], 0.5 * h)
        beta, between = known(observer, run.q, run.v), known(observer, *middle)
        bend = np.abs(beta[1:] - 2.0 * between + beta[:-1]).max(axis=0) / (0.5 * h) ** 2
        assert (errors[-1] <= 1.01 * h * h / 12.0 * bend + 1e-9).all()
    moved = errors[-1] > 1e-7
    assert moved.sum() >= 4
    for coarse, fine in itertools.pairwise(errors):
        assert ((coarse / fine > 3.5) & (coarse / fine < 4.5))[moved].all()


@pytest.mark.parametrize(("name", "most"), [("two_link", 3e-5), ("panda", 1e-5), ("ur5", 3e-5)])
def test_without_a_torque_from_outside_it_stays_at_the_error_of_the_discretisation(name, most):
    robot = nbs.load_robot(name)
    run = run_of(robot, plant=nbs.MujocoPlant(robot))
    assert np.abs(nbs.MomentumObserver.for_robot(robot).observe(run).torque).max() < most  # N·m, at 1 kHz


def test_at_rest_nothing_is_left_but_rounding():
    observer, q = nbs.MomentumObserver.for_robot(PANDA), states(PANDA, 1)[0][0]
    still, gravity = np.zeros(7), nbs.PinocchioDynamics(PANDA).gravity(q)
    memory = observer.initial(q, still)
    for _ in range(1000):
        seen, memory = observer.step(memory, q, still, gravity, 0.001)
    assert np.abs(seen.torque).max() < 1e-12


@pytest.mark.parametrize("gain", [1.0, 500.0, 1e4, 1e7])
def test_every_gain_is_stable_and_exact_for_its_filter(gain):
    # far above 2/h, where an explicit step of the filter diverges
    push = np.array([2.0, -1.0])
    run = run_of(TWO, 0.01, push=nbs.ConstantTorque(push))
    seen = nbs.MomentumObserver.for_robot(TWO, gain).observe(run).torque
    assert np.abs(seen + np.expm1(-gain * run.t)[:, None] * push).max() < 2e-3


def test_gains_may_differ_from_joint_to_joint():
    run = run_of(TWO, push=nbs.ConstantTorque([2.0, 2.0]))
    both = nbs.MomentumObserver.for_robot(TWO, [20.0, 200.0]).observe(run).torque
    for joint, gain in enumerate((20.0, 200.0)):
        alone = nbs.MomentumObserver.for_robot(TWO, gain).observe(run).torque
        assert np.array_equal(both[:, joint], alone[:, joint])


@pytest.mark.parametrize("friction", [None, "known"])
def test_friction_that_is_not_known_is_seen_as_a_torque_from_outside(friction):
    given = nbs.JointFriction(viscous=[0.5, 0.4], coulomb=[1.0, 0.8], transition=0.1)
    plant = nbs.DynamicsPlant(nbs.PinocchioDynamics(TWO), friction=given)
    run = run_of(TWO, plant=plant)
    observer = nbs.MomentumObserver.for_robot(TWO, 2000.0, given if friction else None)
    seen = observer.observe(run).torque[50:]
    if friction:
        assert np.abs(seen).max() < 2e-4
    else:
        assert np.abs(seen + given.torque(run.v[50:])).max() < 0.02
    assert np.abs(given.torque(run.v[50:])).max() > 0.5


def test_friction_of_another_class_is_asked_for_its_torque():
    given = nbs.JointFriction(viscous=[0.5, 0.4], coulomb=[1.0, 0.8])
    twice = nbs.MomentumObserver.for_robot(TWO, GAIN, Twisted(given.viscous, given.coulomb))
    double = nbs.MomentumObserver.for_robot(TWO, GAIN, nbs.JointFriction(2.0 * given.viscous, 2.0 * given.coulomb))
    (q, v), tau = states(TWO, 2), np.ones(2)
    seen = [o.step(o.initial(q[0], v[0]), q[1], v[1], tau, 0.001)[0].torque for o in (twice, double)]
    assert np.allclose(*seen, rtol=1e-12)


def test_an_unknown_payload_is_the_difference_of_two_inverse_dynamics():
    loaded = PANDA.with_payload("panda_hand_tcp", 2.0)
    law, plant = nbs.NeuralBackstepping.for_robot(loaded), nbs.DynamicsPlant.for_robot(loaded)
    run = run_of(loaded, seconds=1.0, law=law, plant=plant)
    acceleration = np.gradient(run.v, run.t, axis=0)
    own, true = (
        nbs.inverse_dynamics(nbs.PinocchioDynamics(arm), run.q, run.v, acceleration) for arm in (PANDA, loaded)
    )
    seen = nbs.MomentumObserver.for_robot(PANDA, 500.0).observe(run).torque
    missing = own - true  # the part of the motors' torque that the payload takes
    assert np.abs(missing).max() > 10.0
    # the filter is 1/K_o late: 2 ms times the rate of that torque
    late = 2.0 * np.abs(np.gradient(missing, run.t, axis=0)).max() / 500.0
    assert np.abs(seen - missing)[50:].max() < late
    assert late < 0.1


def test_runs_may_have_batches_and_gaps():
    push, observer = nbs.SinusoidalTorque([2.0, 1.0], 5.0), nbs.MomentumObserver.for_robot(TWO)
    starts = np.array([[0.1, 0.2], [-0.3, 0.4], [0.5, -0.1]])
    law, plant = nbs.NeuralBackstepping.for_robot(TWO), nbs.DynamicsPlant.for_robot(TWO)
    run = nbs.simulate(
        plant, law, nbs.Hold([0.3, 0.2]), 0.2, 0.001, q0=starts.reshape(3, 1, 2), disturbance=push, check=False
    )
    all_ = observer.observe(run)
    assert all_.torque.shape == run.q.shape == (201, 3, 1, 2)
    memory = observer.initial(run.q[0, 1, 0], run.v[0, 1, 0])
    for k in range(1, 201):
        seen, memory = observer.step(memory, run.q[k, 1, 0], run.v[k, 1, 0], run.tau[k - 1, 1, 0], 0.001)
        assert np.allclose(seen.torque, all_.torque[k, 1, 0], rtol=0, atol=1e-9)
    memory = observer.initial(run.q[0], run.v[0])
    batch, _ = observer.step(memory, run.q[1], run.v[1], run.tau[0], 0.001)
    assert np.allclose(batch.torque, all_.torque[1], rtol=0, atol=1e-9)
    # where the motors' torque does not change, rows that are left out only lengthen a period
    kept, push = np.r_[0:50, 60:201], nbs.ConstantTorque([1.0, -1.0])
    free = nbs.simulate(plant, Constant(), nbs.Hold(starts[0]), 0.2, 0.001, disturbance=push, check=False)
    gaps = observer.estimate(free.t[kept], free.q[kept], free.v[kept], free.tau[kept])
    assert np.abs(gaps - observer.observe(free).torque[kept]).max() < 3e-3  # h²/12·|β̈| with the longer period


class Constant(nbs.Controller):
    """The same torque at every instant."""

    nv = 2

    def step(self, memory, q, v, reference, period):
        return np.array([20.0, 8.0]), memory

    def initial_memory(self, q):
        return None

    def compile(self):
        return self


@pytest.mark.parametrize("name", ["chain", "cholesky", "homogenised", "residual"])
def test_a_learned_model_serves_as_well(name):
    model = learned(name)
    rng, h, unit = np.random.default_rng(0), 1e-5, np.eye(3)
    q, v = rng.uniform(-1.0, 1.0, (2, 10, 3))

    def lagrangian(q):
        return nbs.kinetic_energy(model, q, v) - model.potential_energy(q)

    rows = nbs.MomentumObserver(model).initial(q, v).rows
    slopes = np.stack([lagrangian(q + h * e) - lagrangian(q - h * e) for e in unit], axis=-1) / (2.0 * h)
    assert off(rows[0], np.einsum("kij,kj->ki", model.mass_matrix(q), v)) < 1e-12
    assert off(rows[1], slopes) < 1e-6


def test_memory_and_record_are_values():
    observer, (q, v) = nbs.MomentumObserver.for_robot(TWO), states(TWO, 2)
    memory = observer.initial(q[0], v[0])
    before = memory.rows.copy()
    seen, after = observer.step(memory, q[1], v[1], np.ones(2), 0.001)
    kept = after.rows.copy()
    seen.torque[:], seen.momentum[:] = np.nan, np.nan
    assert np.array_equal(memory.rows, before)
    assert np.array_equal(after.rows, kept)


def test_it_takes_what_can_be_read_as_numbers_and_refuses_the_rest():
    observer, (q, v) = nbs.MomentumObserver.for_robot(TWO), states(TWO, 2)
    memory = observer.initial(q[0], v[0])
    expected, _ = observer.step(memory, q[1], v[1], np.ones(2), 0.001)
    for given in (q[1].tolist(), np.asfortranarray(np.tile(q[1][:, None], 2))[:, 0], np.float32(0.0) + q[1]):
        assert np.array_equal(observer.step(memory, given, v[1], [1, 1], 0.001)[0].torque, expected.torque)
    with pytest.raises(nbs.ArgumentError, match="expected numpy arrays"):
        observer.initial(torch.zeros(2, dtype=torch.float64), torch.zeros(2, dtype=torch.float64))
    with pytest.raises(nbs.ArgumentError, match="period"):
        observer.step(memory, q[1], v[1], np.ones(2), 0.0)
    with pytest.raises(nbs.ArgumentError, match="memory"):
        observer.step(None, q[1], v[1], np.ones(2), 0.001)
    with pytest.raises(nbs.ArgumentError, match="this loop"):
        observer.step(observer.initial(q, v), q[1], v[1], np.ones(2), 0.001)
    with pytest.raises(nbs.ArgumentError, match="one number per joint"):
        observer.step(memory, np.zeros(3), np.zeros(3), np.zeros(3), 0.001)
    with pytest.raises(nbs.ArgumentError, match="gain"):
        nbs.MomentumObserver.for_robot(TWO, [1.0, 2.0, 3.0])
    with pytest.raises(nbs.ArgumentError, match="gain"):
        nbs.MomentumObserver.for_robot(TWO, 0.0)
    with pytest.raises(nbs.ArgumentError, match="friction is for 7"):
        nbs.MomentumObserver.for_robot(TWO, friction=nbs.JointFriction.of(PANDA))
    with pytest.raises(nbs.ArgumentError, match="7 joints and the observer 2"):
        observer.observe(run_of(PANDA, seconds=0.01))
    with pytest.raises(nbs.ArgumentError, match="increasing times"):
        observer.estimate([0.0, 0.0], q, v, v)
    with pytest.raises(nbs.TooLarge):
        observer.initial(q[0], 1e200 * np.ones(2))
    lost, memory = observer.step(memory, q[1] * np.nan, v[1], np.ones(2), 0.001)
    assert np.isnan(lost.torque).all()


def test_it_says_what_it_is_and_a_run_of_it_is_a_table(tmp_path):
    observer = nbs.MomentumObserver.for_robot(TWO, friction=nbs.JointFriction.of(TWO))
    assert repr(observer) == "MomentumObserver(2 joints, model PinocchioDynamics, gain 50 1/s, with friction)"
    run = run_of(TWO, push=nbs.ConstantTorque([2.0, -1.0]))
    seen = nbs.MomentumObserver.for_robot(TWO).observe(run)
    assert repr(seen) == "ObservedTorques(2 joints, 501 rows, gain 50 1/s)"
    assert "<td>2 N·m</td>" in seen._repr_html_()
    assert np.allclose(seen.largest, [2.0, 1.0], atol=1e-4)
    path = seen.save(tmp_path / "seen.csv")
    with path.open() as file:
        head, *rows = csv.reader(file)
    assert head == ["t", "external_joint1", "external_joint2"]
    assert np.array_equal(np.array(rows, dtype=float), np.column_stack([seen.t, seen.torque]))
    with pytest.raises(nbs.ArgumentError, match="starts 0 to 0"):
        seen.save(path, start=1)


def test_noise_of_the_velocity_is_amplified_as_told():
    # docs/theory.md §9: white noise σ of v, M σ √(2/(1 + a))·(1 − a)/h in r, a = e^(−K_o h)
    rng, h, sigma = np.random.default_rng(0), 0.001, 0.01
    observer, q = nbs.MomentumObserver.for_robot(TWO, GAIN), np.array([0.3, 0.8])
    t = h * np.arange(40_000)
    v = sigma * rng.normal(size=(len(t), 2)) * [1.0, 0.0]
    tau = np.tile(nbs.PinocchioDynamics(TWO).gravity(q), (len(t), 1))
    seen = observer.estimate(t, np.tile(q, (len(t), 1)), v, tau)[1000:]
    a = math.exp(-GAIN * h)
    mass = nbs.PinocchioDynamics(TWO).mass_matrix(q)[:, 0]
    assert np.allclose(seen.std(axis=0), np.abs(mass) * sigma * math.sqrt(2.0 / (1.0 + a)) * (1.0 - a) / h, rtol=0.05)


def test_what_is_remembered_are_plain_numbers():
    memory = nbs.MomentumObserver.for_robot(TWO).initial(np.zeros(2), np.zeros(2))
    assert isinstance(memory, ObserverMemory)
    assert memory.rows.shape == (3, 2)


def test_a_picture_shows_what_was_observed_beside_the_disturbance(tmp_path):
    run = run_of(TWO, push=nbs.ConstantTorque([20.0, -10.0]))
    seen = nbs.MomentumObserver.for_robot(TWO).observe(run)
    plain, more = (
        nbs.plot_tracking(run, tmp_path / name, external=given).read_text()
        for name, given in (("a.svg", None), ("b.svg", seen))
    )
    assert plain.count("stroke-dasharray") < more.count("stroke-dasharray")
    with pytest.raises(nbs.ArgumentError, match="returned for this run"):
        nbs.plot_tracking(run.head(10), tmp_path / "c.svg", external=seen)
    short = nbs.MomentumObserver.for_robot(TWO).observe(run.head(1))
    assert short.torque.shape == (1, 2)
    assert not short.torque.any()


@pytest.mark.parametrize("kept", [False, True])
def test_pages_have_it_as_a_signal_with_the_friction_that_was_simulated(kept):
    robot = TWO.with_friction(viscous=1.0, coulomb=1.0)
    push, plant = nbs.ConstantTorque([3.0, -1.0]), nbs.MujocoPlant(robot, joint_friction="keep" if kept else "drop")
    run = run_of(robot, push=push, plant=plant)
    signals = signals_of(run, robot)
    numbers = np.frombuffer(base64.b64decode(signals["external"]), dtype=np.float32).reshape(run.q.shape)
    friction = nbs.JointFriction.of(robot) if kept else None
    assert np.allclose(numbers, nbs.MomentumObserver.for_robot(robot, friction=friction).observe(run).torque, atol=1e-5)
    # MuJoCo's own Coulomb friction is not the smooth one that is known here
    assert np.abs(numbers[-1] - [3.0, -1.0]).max() < (0.2 if kept else 1e-3)


def test_samples_of_several_states_may_be_read_only():
    observer = nbs.MomentumObserver(nbs.PinocchioDynamics(TWO))
    q, v = states(TWO, 3)
    memory = observer.initial(q, v)
    known, _ = observer.step(memory, q, v, 0.0 * v, 0.001)
    for x in (q, v):
        x.setflags(write=False)
    again, _ = observer.step(memory, q, v, 0.0 * v, 0.001)
    np.testing.assert_array_equal(again.torque, known.torque)
