"""The adversary: it finds the known worst cases, never leaves what is admissible, and never loses what it found."""

import re

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

import nbs_pin as nbs
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.certificates.admissible import Admissible
from nbs_pin.certificates.attack import attack, random_disturbances, worst_of
from nbs_pin.certificates.ensemble import LoopEnsemble, motions_of, slowest_rate
from nbs_pin.certificates.torque_waves import KINDS
from nbs_pin.motions.references import Hold
from nbs_pin.reproduction.certificate_study import constant_damping, one_joint


def linear_loop(stiffness, damping):
    """M = 1, G = 0, Φ = S z², D constant: a linear loop."""
    return constant_damping(one_joint(), 2.0 * stiffness, damping, quiet=True)


def exact_worst(stiffness, damping):
    """∫|h| dt of z1's impulse response: ż1 = −2S z1 + z2, ż2 = −2S z1 − D z2, by steps of the matrix exponential."""
    loop = np.array([[-2.0 * stiffness, 1.0], [-2.0 * stiffness, -damping]])
    values, vectors = np.linalg.eig(loop)
    start = np.linalg.solve(vectors, [0.0, 1.0])
    t = np.arange(0.0, 60.0 / np.abs(values.real).min(), 1e-3)
    impulse = (np.exp(np.outer(t, values)) * (vectors[0] * start)).sum(axis=1).real
    return np.abs(impulse).sum() * 1e-3


def test_the_papers_theorem_3_is_broken_by_one_joint():
    """‖∇Φ‖² reaches 0.687 d where the paper's Theorem 3 prints d/2 (docs/theory.md §5)."""
    d = 0.01
    law = linear_loop(0.25, 0.5)
    found = attack(law, [np.sqrt(d)], reference=Hold([0.0]), duration=12.0, period=0.01, rounds=1, starts=1)
    gradient = 0.5 * found.error
    assert gradient**2 / d == pytest.approx(0.687, abs=0.006)
    assert found.found_by == "bang-bang ascent"


@pytest.mark.parametrize("stiffness", [0.25, 1.0])
@pytest.mark.parametrize("damping", [0.5, 2.0])
def test_a_linear_loop_is_solved_exactly_in_one_round(stiffness, damping):
    law, exact = linear_loop(stiffness, damping), exact_worst(stiffness, damping)
    found = attack(law, [0.1], reference=Hold([0.0]), period=0.005, rounds=1, starts=1)
    assert found.error == pytest.approx(0.1 * exact, rel=0.01)
    assert found.error <= 0.1 * exact * 1.003  # the held law differs a little from the one in continuous time


@pytest.fixture(scope="module")
def two_link():
    return nbs.NeuralBackstepping.for_robot(nbs.load_robot("two_link"))


@pytest.mark.parametrize("disturbance", [np.array([5.0, 2.0]), np.array([3.0, 0.0]), 4.0])
def test_an_attack_is_admissible_its_run_is_its_own_and_it_never_gets_worse(two_link, disturbance):
    found = attack(two_link, disturbance, duration=0.2, rounds=4, starts=4)
    assert Admissible.of(disturbance, 2).contains(found.disturbance)
    z1 = found.run.q - found.run.q_ref
    assert np.linalg.norm(z1, axis=-1).max() == pytest.approx(found.error, rel=1e-12)
    assert not z1[0].any()
    assert (np.diff(found.history) >= 0.0).all()
    assert found.history[-1] == found.error > 0.0
    assert (found.joint_errors >= np.abs(z1).max(axis=0)).all()
    assert (found.joint_errors <= found.error).all()
    assert np.array_equal(found.run.disturbance[:-1], found.disturbance)


def test_an_attack_beats_random_disturbances(two_link):
    admissible = Admissible.of([5.0, 5.0], 2)
    found = attack(two_link, admissible, duration=0.3, rounds=3)
    given = random_disturbances(admissible, 300, 0.001, 160, np.random.default_rng(1))
    peaks = worst_of(two_link, given)
    assert peaks.error.max() < found.error < 2.0 * peaks.error.max()
    assert (peaks.joint_errors.max(axis=0) < found.joint_errors).all()


def test_the_run_of_an_attack_is_that_of_simulate(two_link):
    """The search goes through its own kernels: the plain time loop finds the same motion."""
    reference = nbs.Sinusoid.for_robot(two_link.dynamics.robot)
    found = attack(two_link, [5.0, 5.0], reference=reference, duration=0.2, rounds=2, starts=2)

    def torque(t, q, v):
        return found.disturbance[min(int(t / found.period + 1e-6), len(found.disturbance) - 1)] + 0.0 * q

    plant = nbs.DynamicsPlant(two_link.dynamics)
    run = nbs.simulate(plant, two_link, reference, 0.2, found.period, effort_limit=np.inf, disturbance=torque)
    assert np.abs(run.q - found.run.q).max() < 1e-9


def test_a_law_without_kernels_is_attacked_too(two_link):
    """A subclass runs as it is written, through torch."""

    class Weaker(nbs.NeuralBackstepping):
        def torque(self, q, v, q_ref, v_ref, a_ref):
            return super().torque(q, v, q_ref, v_ref, a_ref) + 1e-6 * (q - q_ref)

    weaker = Weaker(two_link.dynamics, two_link.potential, two_link.damping, inertial_rate=two_link.inertial_rate)
    hold = Hold([0.3, -0.4])
    ensemble = LoopEnsemble.of(weaker, hold, None, 0.012, 0.001, np.inf, 0)
    assert ensemble.engine == "torch"
    plain = nbs.NeuralBackstepping(
        two_link.dynamics, two_link.potential, two_link.damping, inertial_rate=two_link.inertial_rate
    )
    settings_ = {"reference": hold, "duration": 0.012, "rounds": 1, "starts": 1}
    found = [attack(law, [5.0, 5.0], **settings_) for law in (weaker, plain)]
    assert found[0].error == pytest.approx(found[1].error, rel=1e-6)
    assert found[0].error > 0.0


def test_effort_limits_are_taken(two_link):
    free = {"reference": Hold([0.3, -0.4]), "duration": 0.1, "rounds": 1, "starts": 2}
    found = attack(two_link, [5.0, 5.0], effort_limit=3.0, **free)
    assert np.abs(found.run.tau[:-1]).max() == 3.0


def test_another_truth_is_taken(tmp_path):
    """At rest (1 + D)·2S·z1 = τ_d, whatever M is; an arm four times as heavy as believed overshoots."""
    law, heavy = linear_loop(1.0, 2.0), tmp_path / "heavy.urdf"
    light = law.dynamics.robot.urdf.xml.decode()
    heavy.write_text(re.sub(r'i(xx|yy|zz)="1(\.0)?"', r'i\1="4"', light))
    truth = nbs.PinocchioDynamics(nbs.load_robot(heavy))
    torque = np.full((1, 1000, 1), 0.1)
    believed, other = (worst_of(law, torque, Hold([0.0]), period=0.01, plant_dynamics=p) for p in (None, truth))
    assert believed.error[0] == pytest.approx(0.1 / 6.0, rel=0.02)
    assert other.error[0] > 1.1 * believed.error[0]


def test_slowest_rate_is_that_of_the_linear_loop():
    assert slowest_rate(linear_loop(0.25, 0.5), Hold([0.0])) == pytest.approx(0.5)


@given(seed=st.integers(0, 10_000), radius=st.booleans(), steps=st.integers(1, 60), n=st.integers(1, 4))
@settings(max_examples=40, deadline=None)
def test_random_disturbances_are_admissible_and_reach_the_boundary(seed, radius, steps, n):
    rng = np.random.default_rng(seed)
    admissible = Admissible(radius=2.5) if radius else Admissible(box=rng.uniform(0.1, 5.0, n))
    signals = random_disturbances(admissible, steps, 0.01, len(KINDS), rng, nv=n)
    assert signals.shape == (len(KINDS), steps, n)
    assert admissible.contains(signals)
    scale = 2.5 if radius else admissible.box
    size = np.linalg.norm(signals, axis=-1) / scale if radius else np.abs(signals / scale).min(axis=-1)
    assert size[:5] == pytest.approx(np.ones((5, steps)))  # constants, squares, steps, switching: always there
    assert signals.any(axis=(1, 2)).sum() >= len(KINDS) - 1  # noise of one step is nothing


def test_random_disturbances_differ_and_are_reproducible():
    box = Admissible(box=np.array([1.0, 2.0]))
    first, again, other = (random_disturbances(box, 50, 0.01, 16, np.random.default_rng(seed)) for seed in (3, 3, 4))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)
    assert len(np.unique(first.reshape(16, -1), axis=0)) >= 14  # two corners may be the same


def test_references_are_taken_in_turn_and_made_without_any(two_link):
    assert len(motions_of(two_link.dynamics, None, 0)) > 4
    motions = [Hold([0.0, 0.0]), Hold([1.0, 1.0])]
    torque = np.tile([5.0, -5.0], (4, 100, 1))
    peaks = worst_of(two_link, torque, motions)
    alone = [worst_of(two_link, torque[:1], motion).error[0] for motion in motions]
    assert peaks.error == pytest.approx([alone[0], alone[1], alone[0], alone[1]], rel=1e-12)
    assert alone[0] != alone[1]


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"rounds": -1}, "rounds"),
        ({"rounds": 1.5}, "rounds is 1.5; give a whole number"),
        ({"rounds": "many"}, "rounds is .many.; give"),
        ({"starts": 0}, "starts"),
        ({"seed": -1}, "seed"),
        ({"reference": 3.0}, "reference is 3.0; give a motion"),
        ({"reference": [Hold([0.0, 0.0]), "fast"]}, "reference is .fast.; give a motion"),
        ({"reference": lambda t: t}, "expected a Reference of q, v and a"),
        ({"reference": []}, "empty list"),
        ({"period": 0.0}, "period"),
        ({"duration": 0.0015}, "whole number"),
    ],
)
def test_arguments_that_do_not_fit_are_refused(two_link, change, told, without_type_checks):
    with pytest.raises(ArgumentError, match=told):
        attack(two_link, [1.0, 1.0], **change)


def test_what_is_no_law_with_a_model_is_refused(two_link, without_type_checks):
    """A PID, a compiled law, a certificate, an arm: each in one sentence."""
    robot = two_link.dynamics.robot
    for other in (nbs.PID.for_robot(robot), two_link.compile(), nbs.certify(two_link, [1.0, 1.0]), robot, None):
        with pytest.raises(ArgumentError, match=f"a {type(other).__name__} is not a law with a model"):
            attack(other, [1.0, 1.0])
        with pytest.raises(ArgumentError, match="is not a law with a model"):
            worst_of(other, np.zeros((2, 10, 2)))
    with pytest.raises(ArgumentError, match="entries that are no numbers"):
        attack(two_link, nbs.certify(two_link, [1.0, 1.0]))
    for wrong in (np.zeros((10, 2)), np.full((1, 10, 2), np.nan), "waves"):
        with pytest.raises(ArgumentError, match="disturbances"):
            worst_of(two_link, wrong)


def test_disturbances_of_another_arm_are_refused(two_link):
    with pytest.raises(ArgumentError, match="expected"):
        worst_of(two_link, np.zeros((2, 10, 3)))
    with pytest.raises(ArgumentError, match="nv"):
        random_disturbances(Admissible(radius=1.0), 10, 0.01, 1, np.random.default_rng(0))


def test_an_unstable_loop_is_named(two_link):
    """A period far too long for the gains."""
    with pytest.raises(nbs.SimulationDiverged, match="shorter control period"):
        attack(two_link, [5.0, 5.0], reference=Hold([0.3, -0.4]), period=0.5, duration=10.0, rounds=0)
