"""The search against the bound of adaptive laws: its runs are those of the simulated loop and of the box."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

import nbs_pin as nbs
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.certificates import transient_attack as attacking
from nbs_pin.certificates.adaptive_storage import loaded_start
from nbs_pin.certificates.certificate import Start
from nbs_pin.certificates.fixed_beside import loaded_model
from nbs_pin.certificates.transient_search import Load, Reached, TransientSearch, loaded_storage
from nbs_pin.dynamics.pinocchio_tree import pack_model

GANTRY = Path(__file__).parent / "data" / "gantry.urdf"
LOADS = {"two_link": 0.5, "panda": 2.0}


def bound_for(name="two_link", radius=0.05, adapts=("load",), **given):
    robot = nbs.load_robot(name)
    law = nbs.AdaptiveLaw(nbs.NeuralBackstepping.for_robot(robot), adapts, load_mass=LOADS[name])
    return nbs.transient_bound(law, LOADS[name], radius, **given)


def search_for(bound, steps=50):
    inner = bound.law.law
    motions = [nbs.Sinusoid.for_robot(bound.law.robot, 2.0), nbs.Hold(np.full(inner.nv, 0.2))]
    return TransientSearch(bound, motions, steps, 0.001)


@pytest.mark.parametrize("name", LOADS)
@pytest.mark.parametrize("adapts", [("load",), ("load", "friction", "rotors")])
def test_a_run_of_the_search_is_the_simulated_loop(name, adapts):
    n = nbs.load_robot(name).nv
    bound = bound_for(name, adapts=adapts, start=0.02, disturbance=np.full(n, 0.3), duration=1.0)
    search = search_for(bound)
    vectors = np.random.default_rng(2).uniform(size=(12, search.size))
    trials = [search.trial(x) for x in vectors]
    found = search.reached(trials, search.period, search.courses)
    assert sum(reached is None for reached in found) < 9
    for x, trial, reached in zip(vectors, trials, found, strict=True):
        run = search.run(trial)
        assert (reached is None) == bool((run.tau != run.tau_command).any())
        if reached is None:
            continue
        errors = np.abs(nbs.metrics.error(run)).max(axis=0)
        np.testing.assert_allclose(reached.joint_errors, errors, rtol=1e-7, atol=1e-12)
        truth = loaded_model(bound.law, bound.frame, *trial.load)
        e = bound.law.law.errors(run.q, run.v, run.q_ref, run.v_ref, run.a_ref)
        values = e.value + 0.5 * np.einsum("ki,kij,kj->k", e.z2, truth.mass_matrix(run.q), e.z2)
        assert reached.storage == pytest.approx(values.max(), rel=1e-7)
        assert values[0] == pytest.approx(bound.start * min(1.0, 1.5 * x[5]), rel=1e-4)
        assert reached.storage > values[0] * 0.999
        np.testing.assert_array_equal(run.disturbance[:-1], trial.tau_d)


def test_a_load_comes_on_top_of_one_that_the_arm_is_known_to_carry():
    robot = nbs.load_robot("panda").with_payload("panda_hand", 1.0, (0.0, 0.0, 0.1))
    law = nbs.AdaptiveLaw(nbs.NeuralBackstepping.for_robot(robot), ("load",), frame="panda_hand", load_mass=1.0)
    search = search_for(nbs.transient_bound(law, 0.5, 0.05))
    load, q = Load(0.5, np.array([0.01, 0.0, 0.03])), np.full(7, 0.3)
    truth = loaded_model(law, "panda_hand", *load)
    errors, still = search.bound.law.law, np.zeros((1, 7))
    value = loaded_storage(errors, search.loaded(load), q[None], q[None], q[None], still)
    z2 = errors.errors(q, q, q, still[0], still[0]).z2
    assert value[0] == pytest.approx(0.5 * z2 @ truth.mass_matrix(q) @ z2, rel=1e-12)
    weights = [sum(body.mass for body in arm.model.inertias) for arm in (robot, truth.robot)]
    assert weights[1] - weights[0] == pytest.approx(0.5)


def test_the_tree_with_a_load_is_that_of_the_loaded_arm():
    bound = bound_for("panda")
    search, q = search_for(bound), np.linspace(-1.0, 1.0, 7)
    load = Load(1.3, np.array([0.01, -0.03, 0.02]))
    robot = bound.law.robot.with_payload(bound.frame, load.mass, com=load.centre.tolist())
    tree = search.loaded(load)
    z2 = np.linspace(0.5, -0.7, 7)
    expected = nbs.PinocchioDynamics(robot).mass_matrix(q)
    still = np.zeros((1, 7))
    aim = nbs.Hold(q)(0.0)
    values = loaded_storage(bound.law.law, tree, q[None], z2[None], aim.q[None], still)
    assert values[0] == pytest.approx(0.5 * z2 @ expected @ z2, rel=1e-9)  # at z1 = 0, z2 is the velocity
    assert pack_model(robot.model).weights == pytest.approx(tree.weights, abs=1e-9)


@given(seed=st.integers(0, 2**32 - 1), ball=st.booleans())
@settings(max_examples=25, deadline=None)
def test_every_vector_is_a_run_that_the_bound_is_for(seed, ball):
    x = np.random.default_rng(seed).uniform(size=100)
    bound = BOUNDS[ball]
    search = SEARCHES[ball]
    trial = search.trial(x[: search.size])
    assert 0.0 <= trial.load.mass <= bound.load_mass
    assert np.linalg.norm(trial.load.centre) <= bound.load_radius * (1.0 + 1e-12)
    assert bound.admissible.contains(trial.tau_d)
    q, v = search.courses[trial.motion].desired[0, :2]
    start = loaded_storage(bound.law.law, search.loaded(trial.load), trial.q0[None], trial.v0[None], q[None], v[None])
    assert start[0] <= bound.start * (1.0 + 1e-9)


BOUNDS = {
    False: bound_for(start=0.02, disturbance=np.array([0.3, 0.1]), duration=1.0),
    True: bound_for(start=0.02, disturbance=0.3, duration=1.0),
}
SEARCHES = {ball: search_for(bound) for ball, bound in BOUNDS.items()}


def test_the_first_run_of_every_motion_has_the_worst_load():
    search = SEARCHES[False]
    worst = search.bound.worst
    for k in range(2):
        trial = search.trial(search.expected(k, np.full(search.size, 0.3)))
        assert trial.motion == k
        assert trial.load.mass == pytest.approx(worst.mass)
        np.testing.assert_allclose(trial.load.centre, worst.centre, atol=1e-12)


def test_a_search_finds_more_than_random_runs_and_keeps_the_bound():
    bound = bound_for(start=0.05)
    found = nbs.transient_attack(bound, duration=0.3, runs=300, seed=1)
    assert found.is_kept
    assert found.runs <= 300
    assert (np.diff(found.history) >= 0.0).all()
    assert found.history[-1] > 1.1 * found.history[0]
    assert found.ratio == pytest.approx(float((bound.joint_errors / found.joint_errors).min()))
    assert found.history[-1] == pytest.approx(1.0 / found.ratio)
    assert "the nearest to its bound" in found.verdict
    seen = bound.check(found.run)
    assert seen.is_kept
    assert seen.ratio == pytest.approx(1.0 / found.ratio, rel=1e-6)
    again = nbs.transient_attack(bound, duration=0.3, runs=300, seed=1)
    np.testing.assert_array_equal(again.joint_errors, found.joint_errors)


def test_an_exceeded_bound_is_told_and_the_hold_is_told_from_the_proof():
    bound = bound_for()
    found = nbs.transient_attack(bound, duration=0.2, runs=20)
    wrong = dataclasses.replace(bound, joint_errors=0.9 * found.joint_errors)
    beyond = nbs.transient_attack(wrong, duration=0.2, runs=20)
    assert not beyond.is_kept
    assert beyond.finer is not None
    assert beyond.finer.exceeds(wrong)
    assert beyond.verdict.startswith("BOUND EXCEEDED: joint")
    assert "exceeds it too" in beyond.verdict
    held = dataclasses.replace(beyond, finer=Reached(0.0, np.zeros(2)))
    assert "the hold of the torque did it, not the proof" in held.verdict
    heavier = dataclasses.replace(found, storage=2.0 * bound.storage_within)
    assert not heavier.is_kept
    assert "V was" in heavier.verdict
    assert Reached(math.nan, np.zeros(2)).exceeds(bound)


def test_runs_with_a_torque_cut_off_are_left_out():
    robot = nbs.load_robot("two_link")
    heavy = robot.with_effort_limit([0.5, 0.5])
    with pytest.warns(UserWarning, match="times its effort limit"):
        law = nbs.AdaptiveLaw(nbs.NeuralBackstepping.for_robot(heavy), load_mass=0.5)
    bound = nbs.transient_bound(law, 0.5)
    with pytest.raises(ArgumentError, match="a torque was cut off, where the bound does not hold"):
        nbs.transient_attack(bound, duration=0.05, runs=10)
    down = nbs.Hold([-np.pi / 2, 0.0])
    some = nbs.transient_attack(bound, reference=[down, nbs.Hold([0.0, 0.0])], duration=0.05, runs=40)
    assert 0 < some.cut < some.runs
    assert some.is_kept


def test_ctrl_c_keeps_what_was_found(monkeypatch):
    bound, rounds = bound_for(), []
    honest = attacking.TransientSearch.shares

    def shares(self, vectors):
        if len(rounds) == stop:
            raise KeyboardInterrupt
        rounds.append(1)
        return honest(self, vectors)

    monkeypatch.setattr(attacking.TransientSearch, "shares", shares)
    stop = 2
    found = nbs.transient_attack(bound, duration=0.1, runs=100)
    assert found.interrupted
    assert found.runs < 100
    assert len(found.history) == 2
    rounds.clear()
    stop = 0
    with pytest.raises(KeyboardInterrupt):
        nbs.transient_attack(bound, duration=0.1, runs=100)


class Other(nbs.AdaptiveLaw):
    """A law of someone else."""


def test_what_cannot_be_searched_is_refused():
    bound = bound_for(disturbance=np.ones(2), duration=0.5)
    with pytest.raises(ArgumentError, match=r"the bound is for 0\.5 s"):
        nbs.transient_attack(bound, duration=1.0)
    with pytest.raises(ArgumentError, match="transient_attack"):
        nbs.attack(bound.law, [1.0, 1.0])
    with pytest.raises(ArgumentError, match="bound is an AdaptiveLaw; give a TransientBound"):
        nbs.transient_attack(bound.law)
    other = nbs.transient_bound(Other(bound.law.law, load_mass=0.5), 0.5)
    with pytest.raises(ArgumentError, match="the search needs machine code"):
        nbs.transient_attack(other, runs=10)


def test_sliding_joints_are_searched_in_metres():
    robot = nbs.load_robot(GANTRY)
    bound = nbs.transient_bound(nbs.AdaptiveLaw(nbs.NeuralBackstepping.for_robot(robot), load_mass=0.2), 0.2)
    found = nbs.transient_attack(bound, duration=0.1, runs=12)
    assert found.is_kept
    assert found.summary()["exceeds"] is False
    assert "error at most" in found._repr_html_()


@pytest.mark.parametrize("name", LOADS)
def test_a_start_is_bounded_with_every_load_of_the_box(name):
    """Above V(0) with point loads at the edge of the box; equal to it for a box without radius."""
    law = bound_for(name).law
    inner, robot, n, mass = law.law, law.robot, law.nv, LOADS[name]
    motion = nbs.Sinusoid.for_robot(robot)
    q0, rng = motion(0.0).q + 0.05 * (-1.0) ** np.arange(n), np.random.default_rng(3)
    start, frame = Start.of(inner, motion, q0, None), bound_for(name).frame

    def storage(centre):
        loaded = nbs.PinocchioDynamics(robot.with_payload(frame, mass, com=centre.tolist())).mass_matrix(q0)
        e = inner.errors(q0, np.zeros(n), start.begin.q, start.begin.v, start.begin.a)
        return float(e.value + 0.5 * e.z2 @ loaded @ e.z2)

    edge = rng.normal(size=(30, 3))
    values = [storage(0.08 * x / np.linalg.norm(x)) for x in edge]
    bound = loaded_start(law, frame, nbs.Payload(mass, 0.08), start)
    assert max(values) <= bound <= 1.1 * max(values)
    assert loaded_start(law, frame, nbs.Payload(mass), start) == pytest.approx(storage(np.zeros(3)), rel=1e-6)


def test_a_start_is_given_in_one_way():
    law = bound_for().law
    motion, q0 = nbs.Sinusoid.for_robot(law.robot), [0.1, 0.2]
    found = nbs.transient_bound(law, 0.5, reference=motion, duration=0.1, q0=q0)
    start = Start.of(law.law, motion, q0, None)
    assert found.start == loaded_start(law, found.frame, nbs.Payload(0.5), start)
    with pytest.raises(ArgumentError, match="start and q0 both state the beginning"):
        nbs.transient_bound(law, 0.5, start=0.1, reference=motion, q0=q0)
    with pytest.raises(ArgumentError, match="q0 and v0 refer to a motion"):
        nbs.transient_bound(law, 0.5, q0=q0)
