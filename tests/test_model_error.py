"""Model errors by their definitions: known errors come out, and what is said of δ is what the theorems say."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings, strategies as st
from scipy.optimize import linprog

import nbs_pin as nbs
from nbs_pin.accuracy import mismatch
from nbs_pin.accuracy.compare import DISTANCES, SPEEDS, compare
from nbs_pin.accuracy.energy_drift import free_motion
from nbs_pin.accuracy.error_maps import error_map, telling_joints
from nbs_pin.accuracy.relative_errors import ACCELERATION, Box, Errors, judge
from nbs_pin.base.arrays import matvec
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.dynamics.provider import DynamicsProvider
from nbs_pin.identification.excitation import configuration_box
from nbs_pin.reports import error_charts
from tests.test_plotting import drawn, png_size
from tests.test_run_files import SIGNALS

ARM = nbs.load_robot("three_link")
TRUTH = nbs.PinocchioDynamics(ARM)
TWO = nbs.AnalyticDynamics()


class Altered(DynamicsProvider):
    """A model whose ingredients are those of another, times a factor, plus a gravity."""

    def __init__(self, of, factor=1.0, gravity=lambda q: 0.0 * q):
        self.of, self.factor, self.extra = of, factor, gravity

    @property
    def nv(self):
        return self.of.nv

    def mass_matrix(self, q):
        return self.factor * self.of.mass_matrix(q)

    def coriolis_matrix(self, q, v):
        return self.factor * self.of.coriolis_matrix(q, v)

    def gravity(self, q):
        return self.factor * self.of.gravity(q) + self.extra(q)

    def potential_energy(self, q):
        return self.factor * self.of.potential_energy(q)


def perturbed(name="three_link", size=0.05, seed=0):
    """Pinocchio's arm with other masses, centres and inertias."""
    robot, rng = nbs.load_robot(name), np.random.default_rng(seed)
    model = robot.model.copy()
    for i in range(1, model.njoints):
        old, (mass, lever, turn) = model.inertias[i], 1.0 + size * np.abs(rng.normal(size=3))
        model.inertias[i] = pin.Inertia(old.mass * mass, old.lever * lever, old.inertia * turn)
    return nbs.PinocchioDynamics(dataclasses.replace(robot, model=model))


def closed_loop(model, truth, starts, *, seed=0, duration=0.5, friction=None):
    """Computed torque on the model, the truth as plant, from random starts."""
    law, plant = nbs.ComputedTorque(model, kp=100.0, kd=20.0), nbs.DynamicsPlant(truth, friction=friction)
    away = np.random.default_rng(seed).uniform(-0.3, 0.3, (starts, truth.nv))
    reference = nbs.Sinusoid(np.full(truth.nv, 0.5), 2.0)
    return nbs.simulate(plant, law, reference, duration, 0.01, q0=away, effort_limit=np.inf)


def chosen(run, starts):
    """The run of these starts of a batch alone, or of the only one without a batch."""
    return dataclasses.replace(run, **{name: getattr(run, name)[:, starts] for name in SIGNALS})


# Errors over the box.


@pytest.mark.parametrize("truth", [TRUTH, TWO, nbs.PinocchioDynamics(nbs.load_robot("panda"))])
def test_the_truth_has_no_error(truth):
    found = compare(truth, truth, samples=100)
    assert found.errors[:4] == (0.0, 0.0, 0.0, 0.0)
    assert found.forward < 1e-9  # forward dynamics by ABA, the torque by RNEA
    assert found.scale == (1.0, 0.0)
    np.testing.assert_allclose(found.mass_ratio, 1.0, atol=1e-9)
    np.testing.assert_array_equal(found.motion.drift, found.motion.floor)
    assert found.torque_nmse == 0.0
    assert not found.torque_rms.any()


def test_relative_errors_are_frobenius_ones_over_the_samples():
    model, found = perturbed(), compare(perturbed(), TRUTH, samples=300, seed=7)
    q, v, a = Box.of_robot(ARM, 3, 2.0).states(np.random.default_rng(7), 300)
    tau = nbs.inverse_dynamics(TRUTH, q, v, a)
    pairs = {
        "mass_matrix": (model.mass_matrix(q), TRUTH.mass_matrix(q)),
        "coriolis": (matvec(model.coriolis_matrix(q, v), v), matvec(TRUTH.coriolis_matrix(q, v), v)),
        "gravity": (model.gravity(q), TRUTH.gravity(q)),
        "inverse": (nbs.inverse_dynamics(model, q, v, a), tau),
        "forward": (nbs.forward_dynamics(model, q, v, tau), a),
    }
    for name, (modelled, true) in pairs.items():
        expected = np.linalg.norm(np.ravel(modelled - true)) / np.linalg.norm(np.ravel(true))
        assert getattr(found, name) == pytest.approx(expected, rel=1e-9)
        assert np.sqrt(np.mean(getattr(found.each, name) ** 2)) == pytest.approx(expected, rel=1e-9)
    delta = pairs["inverse"][0] - tau
    np.testing.assert_allclose(found.torque_rms, np.sqrt(np.mean(delta**2, axis=0)))
    assert found.torque_nmse == pytest.approx(np.mean(np.mean(delta**2, axis=0) / tau.var(axis=0)))
    assert found.eigenvalue_margin == pytest.approx(np.linalg.eigvalsh(model.mass_matrix(q)).min())


def test_samples_fill_the_box_and_no_more():
    box = Box.of(np.array([-1.0, 0.0]), np.array([0.5, 3.0]), np.array([0.1, 4.0]), 2)
    q, v, a = box.states(np.random.default_rng(0), 5000)
    np.testing.assert_allclose(q.min(axis=0), box.lower, atol=0.01)
    np.testing.assert_allclose(q.max(axis=0), box.upper, atol=0.01)
    np.testing.assert_allclose(np.abs(v).max(axis=0), box.speed, rtol=0.01)
    np.testing.assert_allclose(np.abs(a).max(axis=0), ACCELERATION, rtol=0.01)


def test_the_box_of_an_arm_is_its_limits_but_at_most_a_turn():
    box, panda = Box.of_robot(ARM, 3, 2.0), nbs.load_robot("panda")
    np.testing.assert_array_equal(box.upper, np.pi)  # the file says ±2π
    np.testing.assert_array_equal(Box.of_robot(panda, 7, 2.0).lower, panda.lower)
    np.testing.assert_array_equal(Box.of_robot(None, 2, 1.0).lower, -np.pi)


def test_a_long_rail_is_no_turn(tmp_path):
    """A sliding joint of 0 to 8 m keeps its limits, where data are drawn and where models are compared."""
    rail = tmp_path / "rail.urdf"
    text = (Path(__file__).parent / "data" / "gantry.urdf").read_text()
    rail.write_text(text.replace('lower="4" upper="6" effort="400"', 'lower="0" upper="8" effort="400"'))
    robot = nbs.load_robot(rail)
    box = Box.of_robot(robot, robot.nv, 2.0)
    assert (box.lower[0], box.upper[0]) == (0.0, 8.0)
    assert (box.lower[1], box.upper[1]) == (3.5, 6.0)
    np.testing.assert_array_equal((box.lower, box.upper), configuration_box(robot))
    rail.write_text(rail.read_text().replace('lower="3.5" upper="6"', 'lower="0" upper="9"'))
    turning = nbs.load_robot(rail).one_turn_range
    np.testing.assert_allclose((turning[0][1], turning[1][1]), (4.5 - np.pi, 4.5 + np.pi))  # a turn it can make


def test_the_scale_of_the_torque_is_found_and_free_motion_does_not_know_it():
    """The trap of passive data: L and cL move alike (docs/theory.md §6)."""
    found = compare(Altered(TRUTH, 1.7), TRUTH, samples=200)
    np.testing.assert_allclose(found.errors[:4], 0.7, rtol=1e-12)
    assert found.scale.factor == pytest.approx(1.0 / 1.7, rel=1e-12)
    assert found.scale.error < 1e-14
    np.testing.assert_allclose(found.mass_ratio, 1.7, rtol=1e-9)
    np.testing.assert_allclose(found.motion.drift, found.motion.floor, atol=1e-5)
    assert found.energy_drift < 1e-4


@settings(max_examples=5, deadline=None)
@given(seed=st.integers(0, 10_000), size=st.floats(1e-6, 0.3))
def test_a_best_factor_never_leaves_more_and_the_ratio_bounds_the_inertia(seed, size):
    model = perturbed(size=size, seed=seed)
    found = compare(model, TRUTH, samples=50, seed=seed, motions=0)
    assert found.scale.error <= found.inverse
    rng = np.random.default_rng(seed)
    q, x = found.box.states(rng, 50)[0], rng.normal(size=(50, 3))
    inertia, modelled = (np.einsum("bi,bij,bj->b", x, d.mass_matrix(q), x) for d in (TRUTH, model))
    low, high = found.mass_ratio
    assert (modelled >= low * inertia * (1 - 1e-9)).all()
    assert (modelled <= high * inertia * (1 + 1e-9)).all()


def test_a_model_with_negative_inertia_says_so():
    found = compare(Altered(TRUTH, -1.0), TRUTH, samples=50, motions=0)
    assert found.eigenvalue_margin < 0.0
    assert found.mass_ratio[0] == pytest.approx(-1.0)


def test_a_wrong_gravity_is_an_error_of_gravity_alone_that_speed_hides():
    found = compare(nbs.AnalyticDynamics(gravity=9.8 * 1.1), TWO, samples=400)
    assert found.mass_matrix == found.coriolis == 0.0
    assert found.gravity == pytest.approx(0.1)
    assert found.by_speed.at == SPEEDS
    inverse = [e.inverse for e in found.by_speed.errors]
    assert inverse[-1] < 0.7 * inverse[0]
    for e in (*found.by_speed.errors, *found.by_distance.errors):
        assert e.gravity == pytest.approx(0.1)


def test_an_error_outside_the_box_is_found_outside():
    def far(q):
        return np.where(np.abs(q).max(axis=-1, keepdims=True) > 1.0 + 1e-9, 5.0, 0.0) * np.ones_like(q)

    found = compare(Altered(TRUTH, gravity=far), TRUTH, samples=100, box=(-1.0, 1.0), motions=0)
    assert found.gravity == 0.0
    assert found.by_distance.at == DISTANCES
    for at, e in zip(*found.by_distance, strict=True):
        assert (e.gravity > 0.1) == (at > 1.0)


def test_an_arm_without_gravity():
    weightless = nbs.PinocchioDynamics(nbs.load_robot("three_link", gravity=0.0))
    assert compare(weightless, weightless, samples=50, motions=0).gravity == 0.0
    assert compare(TRUTH, weightless, samples=50, motions=0).gravity == np.inf


# Free motion.


def test_energy_strays_by_the_work_of_the_torque_the_model_forgets():
    """A model without gravity: along its motion the true energy changes as the true potential does."""
    model = Altered(TRUTH, gravity=lambda q: -TRUTH.gravity(q))
    q, v, _ = Box.of_robot(ARM, 3, 2.0).states(np.random.default_rng(0), 4)
    motion = free_motion(model, TRUTH, q, v, duration=0.4)
    potential = np.array([TRUTH.potential_energy(q) for q, _ in free_states(model, q, v)])
    scale = np.max([nbs.kinetic_energy(TRUTH, q, v) for q, v in free_states(TRUTH, q, v)], axis=0)
    np.testing.assert_allclose(motion.drift, np.abs(potential - potential[0]) / scale, atol=1e-6)
    assert motion.drift.max() > 0.1


def free_states(model, q, v):
    states, plant = [(q, v)], nbs.DynamicsPlant(model)
    for _ in range(100):
        states.append(plant.step(*states[-1], np.zeros_like(q), 0.004))
    return states


def test_the_floor_is_the_integrator():
    q, v, _ = Box.of_robot(ARM, 3, 2.0).states(np.random.default_rng(1), 3)
    coarse, fine = (free_motion(TRUTH, TRUTH, q, v, duration=0.2, step=h) for h in (0.01, 0.005))
    assert 10.0 < coarse.floor[-1].max() / fine.floor[-1].max() < 80.0  # fourth order or a little better
    own = free_motion(perturbed(), TRUTH, q, v, duration=0.2, step=0.002)
    assert own.own.max() < 1e-6 < own.drift.max()


def test_a_motion_that_leaves_the_finite_numbers_has_no_finite_drift():
    model = Altered(TRUTH, gravity=lambda q: -np.exp(np.abs(50.0 * q)))
    q, v, _ = Box.of_robot(ARM, 3, 2.0).states(np.random.default_rng(1), 3)
    motion = free_motion(model, TRUTH, q, v)
    assert motion.worst == np.inf
    assert np.isfinite(motion.floor).all()


# The mismatch along a closed loop.


@pytest.fixture(scope="module")
def run():
    return closed_loop(perturbed(), TRUTH, 12)


def test_mismatch_is_the_papers(run):
    """δ = −M̂M⁻¹(u + τ_d − Cv − G) + (u + τ_d − Ĉv − Ĝ), the paper before its Theorem 4."""
    model = perturbed()
    disturbed = dataclasses.replace(run, disturbance=run.disturbance + 0.3)
    found = mismatch.mismatch(model, TRUTH, disturbed)
    q, v, net = run.q[:-1], run.v[:-1], run.tau[:-1] + 0.3
    true, modelled = (net - matvec(d.coriolis_matrix(q, v), v) - d.gravity(q) for d in (TRUTH, model))
    delta = modelled - matvec(model.mass_matrix(q), np.linalg.solve(TRUTH.mass_matrix(q), true[..., None])[..., 0])
    np.testing.assert_allclose(found.size, np.linalg.norm(delta, axis=-1), rtol=1e-8)
    np.testing.assert_allclose(found.rms, np.sqrt(np.mean(delta**2, axis=(0, 1))), rtol=1e-8)


def test_friction_of_the_plant_slows_the_arm_down(run):
    friction = nbs.JointFriction(np.ones(3), np.zeros(3))
    expected = nbs.forward_dynamics(TRUTH, run.q[:-1], run.v[:-1], run.tau[:-1] - run.v[:-1])
    np.testing.assert_array_equal(mismatch.accelerations(TRUTH, run, friction), expected)


def test_the_bound_holds_on_the_run_and_none_is_lower_on_average(run):
    found = compare(perturbed(), TRUTH, samples=50, run=run, motions=0).mismatch
    a, b, c = found.a, found.b, found.c
    assert min(a, b, c) >= 0.0
    assert (found.size <= found.bound(found.q_norm, found.v_norm)).all()
    assert found.trajectories == 12
    weights = [max(np.linalg.norm(x, axis=-1).mean(), 0.1) for x in (run.q_ref, run.v_ref)]
    points = np.column_stack([found.q_norm.ravel(), found.v_norm.ravel(), np.ones(found.size.size)])
    best = linprog([*weights, 1.0], A_ub=-points, b_ub=-found.size.ravel())
    assert weights[0] * a + weights[1] * b + c == pytest.approx(best.fun, rel=1e-5)


@pytest.mark.parametrize("size", [1e-9, 1e6])
def test_the_bound_scales_with_the_mismatch(size):
    rng = np.random.default_rng(0)
    q, v, noise = rng.uniform(0.0, 2.0, (3, 4000))
    delta = 1.5 * q + 0.5 * v + 0.3 - 0.01 * noise
    a, b, c = mismatch._least_bound(q, v, size * delta, [1.0, 1.0])
    assert (size * delta <= a * q + b * v + c).all()
    np.testing.assert_allclose(np.array([a, b, c]) / size, [1.5, 0.5, 0.3], atol=0.02)


def test_no_mismatch_needs_no_bound(run):
    found = mismatch.mismatch(TRUTH, TRUTH, run)
    assert (found.a, found.b, found.c) == (0.0, 0.0, 0.0)


@pytest.mark.parametrize(("trajectories", "chance"), [(374, 0.05), (1905, 0.01), (60, None), (5, None)])
def test_the_chance_is_the_binomial_tail(trajectories, chance):
    epsilon = mismatch.violation_chance(trajectories)
    tail = sum(math.comb(trajectories, i) * epsilon**i * (1 - epsilon) ** (trajectories - i) for i in range(3))
    assert tail == pytest.approx(1e-6, rel=1e-6)
    if chance:  # docs/theory.md §6: the fewest for this chance
        assert epsilon <= chance < mismatch.violation_chance(trajectories - 1)


def test_too_few_trajectories_say_nothing():
    assert [mismatch.violation_chance(n) for n in (1, 2, 3)] == [1.0, 1.0, 1.0]


def test_copies_of_a_start_count_once(run):
    found, twice, one, alone = (
        mismatch.mismatch(perturbed(), TRUTH, chosen(run, starts))
        for starts in (np.arange(12), np.tile(np.arange(12), 2), np.zeros(374, dtype=int), 0)
    )
    assert (found.trajectories, twice.trajectories, one.trajectories, alone.trajectories) == (12, 12, 1, 1)
    assert twice.violation == found.violation < 1.0
    assert one.violation == alone.violation == 1.0
    assert (twice.a, twice.b, twice.c) == pytest.approx((found.a, found.b, found.c))


def test_friction_of_the_plant_is_no_error_of_the_model():
    friction = nbs.JointFriction(np.array([0.8, 0.5, 0.3]), np.array([0.4, 0.3, 0.2]), 0.1)
    model = perturbed()
    run = closed_loop(model, TRUTH, 5, duration=0.3, friction=friction)
    told, untold = (compare(model, TRUTH, 20, run=run, motions=0, friction=x) for x in (friction, None))
    np.testing.assert_array_equal(told.mismatch.rms, mismatch.mismatch(model, TRUTH, run, friction=friction).rms)
    assert (np.abs(told.mismatch.rms / untold.mismatch.rms - 1.0) > 0.01).any()
    states = [x[:-1].reshape(-1, 3) for x in (run.q, run.v)]
    a = mismatch.accelerations(TRUTH, run, friction).reshape(-1, 3)
    assert told.along_run == pytest.approx(judge(model, TRUTH, *states, a).errors)
    assert untold.along_run.inverse != pytest.approx(told.along_run.inverse)


def test_the_scenario_promise_is_kept():
    """Bounds from 40 random trajectories of 5 states: at confidence 0.9, at most one in ten breaks its promise."""
    epsilon, rng = mismatch.violation_chance(40, 0.1), np.random.default_rng(0)

    def trajectories(count):
        q, v, x = rng.uniform(0.0, 1.0, (3, count, 5))
        return q, v, q * x + v**2 + 0.3 * rng.exponential(size=(count, 1))

    broken = 0
    for _ in range(60):
        a, b, c = mismatch._least_bound(*(x.ravel() for x in trajectories(40)), [0.5, 0.5])
        q, v, size = trajectories(3000)
        broken += bool(np.mean((size > a * q + b * v + c).any(axis=1)) > epsilon)
    assert broken <= 6


def test_fresh_closed_loops_keep_the_bound_as_often_as_promised():
    model = nbs.AnalyticDynamics(masses=(1.1, 0.9))
    fitted = mismatch.mismatch(model, TWO, closed_loop(model, TWO, 100), doubt=0.01)
    fresh = mismatch.mismatch(model, TWO, closed_loop(model, TWO, 400, seed=1))
    outside = (fresh.size > fitted.bound(fresh.q_norm, fresh.v_norm)).any(axis=0)
    assert 0.0 < outside.mean() <= fitted.violation < 0.1


# Maps.


def test_a_cell_of_the_map_is_the_error_there():
    box, model = Box.of_robot(ARM, 3, 2.0), perturbed()
    heat = error_map(model, TRUTH, box, (2, 1), points=6, draws=3, seed=4)
    q, v, _ = box.states(np.random.default_rng(4), 3)
    q[:, 2], q[:, 1] = heat.x[4], heat.y[1]
    here = matvec(model.coriolis_matrix(q, v), v) - matvec(TRUTH.coriolis_matrix(q, v), v)
    q, v, a = everywhere(box, heat)
    size = np.linalg.norm(matvec(TRUTH.coriolis_matrix(q, v), v), axis=1)
    expected = np.sqrt(np.mean(np.sum(here**2, axis=1))) / np.sqrt(np.mean(size**2))
    assert heat.errors.coriolis[1, 4] == pytest.approx(expected)
    whole = judge(model, TRUTH, q, v, a).each
    assert np.sqrt(np.mean(heat.errors.gravity**2)) == pytest.approx(np.sqrt(np.mean(whole.gravity**2)))


def everywhere(box, heat):
    """All states of a map with six points and three draws."""
    q, v, a = (np.tile(x, (36, 1)) for x in box.states(np.random.default_rng(4), 3))
    q[:, 2] = np.tile(np.repeat(heat.x, 3), 6)
    q[:, 1] = np.repeat(heat.y, 18)
    return q, v, a


def test_the_telling_joints_are_those_the_error_depends_on():
    panda = nbs.PinocchioDynamics(nbs.load_robot("panda"))

    def gravity(q):
        return (10.0 * np.maximum(q[..., 2:3], 0.0) + 15.0 * np.maximum(q[..., 5:6] - 2.0, 0.0)) * np.ones(7)

    box = Box.of_robot(panda.robot, 7, 2.0)
    assert telling_joints(Altered(panda, gravity=gravity), panda, box) == (2, 5)


# Pictures.


def test_the_page_draws_what_was_found(tmp_path, monkeypatch, run):
    found = compare(perturbed(), TRUTH, samples=80, run=run)
    heat = error_map(perturbed(), TRUTH, found.box, (1, 2), points=5)
    draw = {"title": "a $page$", "joints": ["one [rad]", "two [rad]", "three [m]"]}
    figure = drawn(lambda: error_charts.plot_model_errors(found, heat, tmp_path / "a.png", **draw), monkeypatch)
    assert png_size(tmp_path / "a.png")[0] == 1620
    panels = {axes.get_title(loc="left"): axes for axes in figure.axes}
    np.testing.assert_array_equal(panels["relative error of G"].collections[0].get_array().ravel(),
                                  heat.errors.gravity.ravel())  # fmt: skip
    assert panels["relative error of G"].get_xlabel() == "two [rad]"
    coriolis = panels["relative error by speed"].lines[0]
    np.testing.assert_array_equal(coriolis.get_ydata(), [e.coriolis for e in found.by_speed.errors])
    shares = panels["torque error by joint"].lines[0].get_xdata()
    np.testing.assert_allclose(shares, found.torque_rms / found.torque_deviation)
    bound = panels["closed loop: mismatch ‖δ‖ [N·m]"].lines[0].get_ydata()
    m = found.mismatch
    np.testing.assert_allclose(bound, m.bound(m.q_norm, m.v_norm).max(axis=1))
    tiles = {text.get_text() for axes in figure.axes for text in axes.texts}
    assert {error_charts.number(e) for e in found.errors} <= tiles


@pytest.mark.parametrize("model", [TRUTH, Altered(TRUTH, gravity=lambda q: -np.exp(np.abs(50.0 * np.sin(q)))),
                                   Altered(TRUTH, -1.0)])  # fmt: skip
def test_any_model_can_be_drawn(tmp_path, model):
    """Without any error, with motions that leave the finite numbers, and without motions."""
    found = compare(model, TRUTH, samples=20, motions=3 if model is not TRUTH else 0)
    heat = error_map(model, TRUTH, found.box, (0, 1), points=4, draws=2)
    error_charts.plot_model_errors(found, heat, tmp_path / "a.png", title="any", joints=list(ARM.joint_names))
    assert png_size(tmp_path / "a.png")[1] > 1000


def test_sample_sizes_are_drawn_by_medians(tmp_path, monkeypatch):
    curves = {"chain": {300: [1e-3, 2e-3, 9e-3], 100: [0.1]}, "identified": {100: [0.0], 300: [1e-9]}}
    figure = drawn(
        lambda: error_charts.plot_sample_sizes({"M": curves, "G": curves}, tmp_path / "a.png", ylabel="error"),
        monkeypatch,
    )
    first, second = figure.axes[0].lines[:2]
    assert first.get_xdata().tolist() == [100, 300]
    assert first.get_ydata().tolist() == [0.1, 2e-3]
    assert second.get_ydata().tolist() == [error_charts.LEAST, 1e-9]


# Refusals.


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"model": TWO}, "the model has 2 joints and the truth 3"),
        ({"samples": 1}, "samples is 1; give a whole number from 2"),
        ({"speed": -1.0}, "is empty; give lower < upper and speeds > 0"),
        ({"speed": [1.0, 2.0]}, "give one finite number, or 3 of them"),
        ({"box": (1.0, -1.0)}, "is empty"),
        ({"box": (-1.0, np.inf)}, "one finite number"),
        ({"box": (-1.0, 0.0, 1.0)}, "the box has 3 parts"),
        ({"model": Altered(TRUTH, gravity=lambda q: q / 0.0)}, "gravity is not finite"),
    ],
)
@pytest.mark.filterwarnings("ignore:divide by zero")
def test_what_cannot_be_compared_is_refused(arguments, words):
    with pytest.raises(ArgumentError, match=words.replace("(", r"\(")):
        compare(**{"model": perturbed(), "truth": TRUTH, "samples": 20, "motions": 0, **arguments})


def test_a_run_of_another_arm_is_refused():
    with pytest.raises(ArgumentError, match="the run has 2 joints and the truth 3"):
        mismatch.mismatch(TRUTH, TRUTH, closed_loop(TWO, TWO, 2, duration=0.1))


@pytest.mark.parametrize("joints", [(0, 0), (0, 3), (-1, 1)])
def test_a_map_needs_two_joints_of_the_arm(joints):
    with pytest.raises(ArgumentError, match="expected two different ones of 0 to 2"):
        error_map(TRUTH, TRUTH, Box.of_robot(ARM, 3, 2.0), joints)


def test_doubt_is_a_chance(run):
    with pytest.raises(ArgumentError, match="expected a probability"):
        mismatch.mismatch(TRUTH, TRUTH, run, doubt=0.0)


def test_errors_have_one_order_everywhere():
    assert tuple(error_charts.LOOKS) == Errors._fields
