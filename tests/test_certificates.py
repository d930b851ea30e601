"""Certificates: the inequalities behind them, against brute force, exact solutions, simulation and an adversary."""

import dataclasses
import json
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies as st

import nbs_pin as nbs
from nbs_pin.accuracy.mismatch import mismatch
from nbs_pin.base.claims import Claim, Label, weakest
from nbs_pin.base.exceptions import ArgumentError, CertificateRefused
from nbs_pin.certificates import one_joint
from nbs_pin.certificates.admissible import Admissible
from nbs_pin.certificates.attack import worst_of
from nbs_pin.certificates.claims import Condition
from nbs_pin.certificates.comparison_system import _STEEPNESS, ComparisonSystem, _growth, decay, level, reach
from nbs_pin.certificates.torque_waves import random_disturbances
from nbs_pin.controllers.gains import gains_for_robot
from nbs_pin.dynamics.registry import make_network
from tests.test_run_files import SIGNALS

POSITIVE = st.floats(0.05, 20.0)
CONSTANTS = st.builds(
    ComparisonSystem,
    rho=POSITIVE,
    delta=POSITIVE,
    kappa=POSITIVE,
    nu=st.one_of(st.just(math.inf), st.floats(20.0, 200.0)),
    omega=st.one_of(st.just(0.0), POSITIVE),
    t=st.floats(0.1, 10.0),
    alpha=st.one_of(st.just(0.0), st.floats(0.0, 0.5)),
    beta=st.one_of(st.just(0.0), st.floats(0.0, 0.4)),
)


def quadratic(robot, stiffness, floor, *, omega=0.0, rate=None, seed=0):
    """A law whose Φ is zᵀSz and whose D is D₀: every free weight is zero."""
    n = robot.nv
    law = nbs.NeuralBackstepping(
        nbs.PinocchioDynamics(robot),
        nbs.Potential(np.diag(np.full(n, stiffness)), seed=seed),
        nbs.Damping(n, floor=np.diag(np.full(n, floor)), seed=seed),
        rate=rate,
        inertial_rate=omega,
    )
    with torch.no_grad():
        for part in (law.potential.network, law.damping.diagonal, law.damping.lower):
            for p in part.parameters():
                p.zero_()
    return law


@pytest.fixture
def one_joint_arm(tmp_path):
    """M = 1 kg·m², no gravity, no limits that matter."""
    path = tmp_path / "one.urdf"
    path.write_text(
        '<robot name="one"><link name="base"/><link name="link"><inertial><mass value="1"/>'
        '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>'
        '<joint name="hinge" type="revolute"><parent link="base"/><child link="link"/><axis xyz="0 0 1"/>'
        '<limit lower="-3" upper="3" effort="1000" velocity="100"/></joint></robot>'
    )
    return nbs.load_robot(path, gravity=0.0)


# The plane (Φ, W)


@settings(max_examples=60, deadline=None)
@given(k=CONSTANTS, seed=st.integers(0, 1000))
def test_growth_is_the_largest_of_all_choices(k, seed):
    """Ẇ + mΦ̇ of random choices on an edge never exceeds it, and the best of many come close."""
    rng = np.random.default_rng(seed)
    end, low = rng.uniform(0.0, 5.0), rng.uniform(0.0, 5.0)
    bound = _growth(k, np.full(len(_STEEPNESS), end), low, low)
    j = rng.integers(len(_STEEPNESS))
    m = _STEEPNESS[j]
    if not np.isfinite(bound[j]):
        return
    y0 = math.sqrt(2.0 * k.kappa * low)
    y = rng.uniform(y0, min(math.sqrt(2.0 * k.nu * low), y0 + 30.0 * k.t), 20_000)
    x = math.sqrt(2.0 * k.rho * end) + rng.exponential(rng.uniform(0.1, 10.0), 20_000)
    s = rng.uniform(-1.0, 1.0, 20_000) * x * y / math.sqrt(k.delta)
    sigma = rng.uniform(-1.0, 1.0, 20_000) * k.t * y
    phi_dot = -x * x + s
    w_dot = -s - (1.0 - k.beta) * y**2 + k.alpha * x * y - 2.0 * k.omega * low + sigma
    assert (w_dot + m * phi_dot).max() <= bound[j] + 1e-9 * (1.0 + abs(bound[j]))


@settings(max_examples=25, deadline=None)
@given(k=CONSTANTS, seed=st.integers(0, 1000))
def test_no_choice_leaves_the_level_or_passes_the_reach(k, seed):
    """An adversary of the plane itself, which the arm need not even be able to be."""
    found = level(k)
    if not math.isfinite(found.storage):
        return
    limit = reach(k, found.storage)
    assert 0.0 <= limit <= found.storage
    rng = np.random.default_rng(seed)
    phi, w = np.zeros(64), np.zeros(64)
    h = 0.02 / max(k.rho, k.kappa, k.omega, 1.0)
    highest = 0.0
    for _ in range(400):
        y0 = np.sqrt(2.0 * k.kappa * w)
        y1 = np.minimum(np.sqrt(2.0 * k.nu * w), y0 + 3.0 * k.t) if math.isfinite(k.nu) else y0 + 3.0 * k.t
        y = np.where(rng.random(64) < 0.5, y0, rng.uniform(y0, np.maximum(y0, y1)))
        y = np.where(w == 0.0, rng.uniform(0.0, k.t, 64) if not math.isfinite(k.nu) else 1e-3 * k.t, y)
        x = np.sqrt(2.0 * k.rho * phi)
        s = rng.choice([-1.0, 1.0], 64) * x * y / math.sqrt(k.delta)
        phi_dot = -x * x + s
        w_dot = -s - (1.0 - k.beta) * y**2 + k.alpha * x * y - 2.0 * k.omega * w + k.t * y
        phi, w = np.maximum(phi + h * phi_dot, 0.0), np.maximum(w + h * w_dot, 0.0)
        highest = max(highest, float((phi + w).max()))
    # Euler steps overshoot by a little
    assert highest <= 1.05 * found.storage
    assert phi.max() <= 1.05 * limit


def test_the_level_is_the_one_in_closed_form():
    """ω = 0: V∞ = Δ/(2εc) with ε = 1 if κ ≤ 2ρ, else 2 − 2ρ/κ; inertial: Δ/(8 min(ρ, ω)) without any κ."""
    for rho, kappa in ((1.0, 0.3), (1.0, 1.9), (0.5, 4.0)):
        epsilon = 1.0 if kappa <= 2.0 * rho else 2.0 - 2.0 * rho / kappa
        exact = 4.0 / (2.0 * epsilon * min(2.0 * rho, (2.0 - epsilon) * kappa))
        found = level(ComparisonSystem(rho, 1.0, kappa, math.inf, 0.0, 2.0))
        assert exact * (1.0 - 1e-12) <= found.storage <= 1.01 * exact
    found = level(ComparisonSystem(8.0, 0.1, 0.0, math.inf, 5.0, 2.0))
    assert found.storage == pytest.approx(4.0 / (8.0 * 5.0))
    assert decay(ComparisonSystem(8.0, 0.1, 0.0, math.inf, 5.0, 2.0)) == 10.0
    assert level(ComparisonSystem(8.0, 0.1, 0.0, math.inf, 0.0, 2.0)).storage == math.inf


def test_a_models_error_slows_the_decay_until_theorem_4_fails():
    k = ComparisonSystem(2.0, 1.0, 3.0, math.inf, 0.0, 1.0)
    rates = [decay(dataclasses.replace(k, alpha=a)) for a in (0.0, 0.5, 1.0, 1.9)]
    assert rates == sorted(rates, reverse=True)
    assert rates[-1] > 0.0
    worse = dataclasses.replace(k, alpha=2.01)
    assert not worse.is_dissipative
    assert decay(worse) == 0.0
    assert level(worse).storage == math.inf


def test_the_reach_is_tighter_than_the_level_on_a_panda_with_constant_damping():
    """S = D = 4I, 5 N·m on every joint: 4.43 rad by the level, with the trace bound a₂ = 14.35 kg·m²."""
    k = ComparisonSystem(8.0, 4.0, 4.0 / 14.35, math.inf, 0.0, math.sqrt(175.0 / 4.0))
    storage = level(k).storage
    assert math.sqrt(storage / 4.0) == pytest.approx(4.43, abs=0.01)
    assert math.sqrt(reach(k, storage) / 4.0) < 1.27


# One joint


@pytest.mark.parametrize(("p1", "p0"), [(1.0, 1.0), (0.1, 2.0), (3.0, 1.0), (2.0, 1.0), (2.0 + 1e-9, 1.0), (8.0, 0.5)])
def test_norms_of_second_order_systems(p1, p0):
    """Against the impulse response, sampled."""
    a = np.array([[0.0, 1.0], [-p0, -p1]])
    h, count = 1e-3, 400_000
    values, vectors = np.linalg.eig(a + 1e-10 * np.eye(2) * np.array([1.0, 0.0]))
    t = h * np.arange(count)
    response = np.real((vectors * np.linalg.solve(vectors, [0.0, 1.0]))[0] @ np.exp(np.outer(values, t)))
    found = one_joint._norms(p1, p0)
    assert found[0] == pytest.approx(h * np.abs(response).sum(), rel=1e-3)
    assert found[1] == pytest.approx(np.abs(np.diff(response)).sum(), rel=1e-3)


def test_the_counterexample_of_theorems_2_and_3_is_certified_exactly(one_joint_arm):
    """S = ¼, D = ½: limsup |z1| = (4/3) coth(π/2√2) √d, where Theorem 3 prints √2."""
    certificate = nbs.certify(quadratic(one_joint_arm, 0.25, 0.5), np.array([1.0]))
    exact = 4.0 / 3.0 / math.tanh(math.pi / (2.0 * math.sqrt(2.0)))
    assert certificate.error == pytest.approx(exact, rel=1e-7)
    assert certificate.error >= exact
    assert certificate.label is Label.PROVED
    assert certificate.printed_error == pytest.approx(math.sqrt(2.0), rel=1e-6)
    assert (0.5 * certificate.error) ** 2 == pytest.approx(0.687, abs=5e-4)  # ‖∇Φ‖²/d against the printed 0.5


@pytest.mark.parametrize("seed", range(2))
def test_one_joint_with_networks_stays_inside_its_bound(one_joint_arm, seed):
    """ψ and T of small random weights: sectors cost a little, and square waves at every rate stay inside."""
    law = quadratic(one_joint_arm, 0.5, 1.0)
    torch.manual_seed(seed)
    with torch.no_grad():
        for part in (law.potential.network, law.damping.diagonal):
            for p in part.parameters():
                p.copy_(0.05 * torch.rand_like(p))
    z = np.linspace(-2.0, 2.0, 2001)[:, None]
    second = law.potential.terms(z, np.ones_like(z))[2][:, 0] - 1.0
    bounds = law.potential.curvature(2.0)
    assert bounds.low <= second.min() <= second.max() <= bounds.high
    assert bounds.high - bounds.low < 1.2 * (second.max() - second.min()) + 1e-3
    extra, more = law.damping.excess(2.0), law.damping.matrix(z)[:, 0, 0] - 1.0
    assert extra.low <= more.min() <= more.max() <= extra.high
    certificate = nbs.certify(law, np.array([1.0]))
    found = nbs.attack(law, np.array([1.0]), reference=nbs.Hold(np.zeros(1)), period=0.01, rounds=3, starts=4)
    assert 0.8 * certificate.error < found.error <= certificate.error


# Whole certificates


@pytest.mark.parametrize("name", ["two_link", "ur5", "panda"])
def test_inertia_shaped_bounds_rest_on_chosen_constants_alone(name):
    robot = nbs.load_robot(name)
    law = nbs.NeuralBackstepping.for_robot(robot, bandwidth=8.0)
    none = nbs.JointFriction(np.zeros(robot.nv), np.zeros(robot.nv))
    certificate = nbs.certify(law, np.full(robot.nv, 5.0), friction=none)
    gains = gains_for_robot(robot, law.dynamics, bandwidth=8.0, period=0.001)
    storage = (25.0 / gains.damping).sum() / (8.0 * 8.0)
    assert certificate.label is Label.PROVED
    assert certificate.storage == pytest.approx(storage, rel=1e-6)
    assert certificate.storage >= storage
    assert certificate.potential <= certificate.storage
    assert certificate.rate >= 8.0 * (1.0 - 1e-9)
    assert (certificate.joint_errors <= np.sqrt(2.0 * storage / gains.stiffness) * (1.0 + 1e-6)).all()
    assert certificate.error <= np.linalg.norm(certificate.joint_errors) * (1.0 + 1e-12)
    assert all(condition.holds for condition in certificate.conditions)
    json.dumps(certificate.summary(), allow_nan=False)


def test_a_ball_is_inside_the_box_around_it():
    law = nbs.NeuralBackstepping.for_robot(nbs.load_robot("three_link"))
    ball, box = nbs.certify(law, 2.0), nbs.certify(law, np.full(3, 2.0))
    assert ball.error < box.error
    assert nbs.certify(law, 0.0).error == 0.0
    assert "‖τ_d‖ ≤ 2" in str(ball.admissible)


def test_the_bound_grows_in_proportion_to_the_disturbance():
    law = nbs.NeuralBackstepping.for_robot(nbs.load_robot("three_link"), damping="bounded")
    errors = [nbs.certify(law, np.full(3, d)).error for d in (0.5, 1.0, 4.0)]
    np.testing.assert_allclose(errors, errors[1] * np.array([0.5, 1.0, 4.0]), rtol=2e-4)


def test_no_random_disturbance_breaks_a_bound():
    """Two arms, both kinds of damping; the thousand of each arm are `nbs-pin reproduce --part certificates`."""
    for name, damping in (("two_link", "inertial"), ("two_link", "bounded"), ("three_link", "bounded")):
        robot = nbs.load_robot(name)
        law = nbs.NeuralBackstepping.for_robot(robot, damping=damping, seed=3)
        admissible = Admissible.of(np.full(robot.nv, 3.0), robot.nv)
        certificate = nbs.certify(law, admissible)
        waves = random_disturbances(admissible, 400, 0.002, 40, np.random.default_rng(0))
        peaks = worst_of(law, waves, nbs.Sinusoid.for_robot(robot, 2.0), period=0.002)
        assert (peaks.joint_errors <= certificate.joint_errors).all()
        assert (peaks.error <= certificate.error).all()
        assert peaks.error.max() > 0.0


def test_the_storage_function_keeps_its_promise_from_a_start():
    robot = nbs.load_robot("ur5").with_effort_limit(np.inf)
    law = nbs.NeuralBackstepping.for_robot(robot)
    reference = nbs.Sinusoid.for_robot(robot, 1.0)
    begin = reference(np.zeros(1))
    q0 = begin.q[0] + np.linspace(-0.1, 0.1, 6)
    certificate = nbs.certify(law, np.full(6, 3.0), reference=reference, q0=q0)
    wave = nbs.SquareWave(3.0, 9.0)
    run = nbs.simulate(nbs.DynamicsPlant(law.dynamics), law, reference, 0.5, 0.001, q0=q0, disturbance=wave)
    v = law.storage(run.q, run.v, run.q_ref, run.v_ref)
    assert (v <= certificate.storage_bound(run.t, float(v[0])) * (1.0 + 1e-3)).all()
    overshoot, joints = certificate.from_start(float(v[0]))
    z1 = run.q - run.q_ref
    assert np.linalg.norm(z1, axis=1).max() <= overshoot
    assert (np.abs(z1).max(axis=0) <= joints).all()
    assert any(line.name == "‖z1‖ from the start" and line.value == overshoot for line in certificate.lines)


def test_what_follows_is_known_no_better_than_what_it_rests_on():
    assert weakest() is Label.PROVED
    assert weakest(Label.PROVED, Label.EMPIRICAL, Label.PROBABILISTIC) is Label.EMPIRICAL
    robot = nbs.load_robot("two_link")
    paper = nbs.certify(nbs.paper_controller(nbs.PinocchioDynamics(robot), m=1.0), 1.0)
    assert paper.label is Label.EMPIRICAL
    learned = nbs.LagrangianDynamics(make_network("cholesky", [False] * robot.nv, seed=0), robot)
    assert nbs.certify(nbs.NeuralBackstepping.for_robot(robot, learned), 1.0).label is Label.EMPIRICAL


def test_theorem_4_for_a_model_of_other_masses():
    """δ fitted on closed loops of the law it is for: a bound with the chance and confidence it was fitted with."""
    robot = nbs.load_robot("two_link").with_effort_limit(np.inf)
    truth, belief = nbs.PinocchioDynamics(robot), nbs.AnalyticDynamics(masses=(1.001, 0.999), robot=robot)
    law = nbs.NeuralBackstepping.for_robot(robot, belief)
    reference = nbs.Sinusoid.for_robot(robot, 1.0)
    begin, rng = reference(np.zeros(1)), np.random.default_rng(0)
    q0 = begin.q[0] + rng.uniform(-0.01, 0.01, (400, 2))
    run = nbs.simulate(nbs.DynamicsPlant(truth), law, reference, 0.3, 0.002, q0=q0, v0=np.tile(begin.v[0], (400, 1)))
    delta = mismatch(belief, truth, run)
    certificate = nbs.certify(law, np.zeros(2), reference=reference, duration=0.3, mismatch=delta)
    assert certificate.label is Label.PROBABILISTIC
    theorem = next(c for c in certificate.conditions if c.name.startswith("Theorem 4"))
    assert theorem.holds
    assert theorem.left < 1.0
    assert np.linalg.norm(run.q[-1] - run.q_ref[-1], axis=-1).max() <= certificate.error
    few = mismatch(belief, truth, dataclasses.replace(run, **{f: getattr(run, f)[:, :1] for f in SIGNALS}))
    assert nbs.certify(law, np.zeros(2), reference=reference, duration=0.3, mismatch=few).label is Label.EMPIRICAL


def test_a_closed_form_of_other_masses_is_no_proof():
    """Named after the arm or held against it, a model counts as exact only if it is."""
    robot = nbs.load_robot("two_link")
    same, other = nbs.AnalyticDynamics(robot=robot), nbs.AnalyticDynamics(masses=(5.0, 5.0), robot=robot)
    assert nbs.certify(nbs.NeuralBackstepping.for_robot(robot, same), 1.0).label is Label.PROVED
    wrong = nbs.certify(nbs.NeuralBackstepping.for_robot(robot, other), 1.0)
    assert wrong.label is Label.EMPIRICAL
    assert any("nothing bounds it" in line.because for line in wrong.lines)
    nameless = nbs.NeuralBackstepping.for_robot(robot, nbs.AnalyticDynamics(masses=(5.0, 5.0)))
    assert nbs.certify(nameless, 1.0, robot=robot).label is Label.EMPIRICAL


def test_the_overshoot_grows_from_the_bound_at_rest():
    robot = nbs.load_robot("ur5")
    law = nbs.NeuralBackstepping.for_robot(robot, damping="bounded")
    certificate = nbs.certify(law, np.full(6, 5.0))
    assert certificate.potential < 0.9 * certificate.storage
    assert certificate.from_start(1e-12)[0] == pytest.approx(certificate.error, rel=1e-6)
    far = certificate.from_start(4.0 * certificate.potential)
    assert far[0] == pytest.approx(2.0 * certificate.error, rel=1e-6)
    with torch.no_grad():
        law.potential.stiffness.change -= 1.0
    assert certificate.from_start(4.0 * certificate.potential)[0] == far[0]


@pytest.mark.parametrize("name", ["kinova", "panda"])
def test_a_start_beyond_what_the_joints_can_do_proves_nothing(name):
    """Errors that wrap, and joints that meet their stops."""
    robot = nbs.load_robot(name)
    law, motion = nbs.NeuralBackstepping.for_robot(robot), nbs.Hold(nbs.Sinusoid.for_robot(robot)(0.0).q)
    starts = (motion(0.0).q + away for away in (1e-4, 2.5))
    near, far = (nbs.certify(law, np.full(robot.nv, 0.01), reference=motion, q0=q0) for q0 in starts)
    assert near.label is Label.PROVED
    assert near.overshoot[0] < far.overshoot[0]
    assert far.label is Label.EMPIRICAL
    assert far.void


@pytest.mark.parametrize(
    ("name", "sizes", "speed", "condition"),
    [("two_link", (1.0, 1e4), 1.0, "effort limit"), ("kinova", (0.1, 1e3), None, "continuous")],
)
def test_a_disturbance_that_breaks_a_condition_takes_the_proof_away(name, sizes, speed, condition):
    """Torques beyond the effort limits, and errors beyond half a turn of a continuous joint."""
    robot = nbs.load_robot(name)
    law, motion = nbs.NeuralBackstepping.for_robot(robot), speed and nbs.Sinusoid.for_robot(robot, speed)
    fine, wild = (nbs.certify(law, np.full(robot.nv, size), reference=motion) for size in sizes)
    assert fine.label is Label.PROVED
    assert wild.label is Label.EMPIRICAL
    assert any(condition in name for name in wild.void)


def test_a_disturbance_is_bounded_in_one_way():
    for wrong in ({}, {"box": np.ones(2), "radius": 1.0}, {"box": np.array([5.0, -5.0])}, {"radius": -3.0}):
        with pytest.raises(ArgumentError, match="expected one of the two"):
            Admissible(**wrong)


def test_a_model_too_wrong_for_theorem_4_is_refused_with_both_sides():
    robot = nbs.load_robot("two_link").with_effort_limit(np.inf)
    law, reference = nbs.NeuralBackstepping.for_robot(robot), nbs.Sinusoid.for_robot(robot, 1.0)
    run = nbs.simulate(nbs.DynamicsPlant(law.dynamics), law, reference, 0.1, 0.002)
    wrong = mismatch(law.dynamics, law.dynamics, run)._replace(a=0.0, b=1e6, c=0.0)
    with pytest.raises(CertificateRefused, match="Theorem 4 requires 1 − β > α²/4"):
        nbs.certify(law, 1.0, reference=reference, mismatch=wrong)


def test_arguments_that_do_not_fit_are_refused():
    robot = nbs.load_robot("two_link")
    law, reference = nbs.NeuralBackstepping.for_robot(robot), nbs.Sinusoid.for_robot(robot, 1.0)
    for wrong in (-1.0, np.nan, np.array([1.0]), np.ones(3), np.array([1.0, np.inf]), "five", 1e200, 1e-200):
        with pytest.raises(ArgumentError, match="disturbance"):
            nbs.certify(law, wrong)
    starts = (np.zeros(3), np.zeros((4, 2)), np.array([0.0, np.nan]))
    for wrong, words in (
        ({"q0": np.zeros(2)}, "give the reference too"),
        ({"reference": reference, "v0": np.zeros(2)}, "v0 was given without q0"),
        ({"period": 0.0}, "period"),
        *(({"reference": reference, "q0": q0}, "q0 is") for q0 in starts),
        ({"robot": nbs.load_robot("ur5")}, "give its own arm"),
    ):
        with pytest.raises(ArgumentError, match=words):
            nbs.certify(law, 1.0, **wrong)
    with pytest.raises(CertificateRefused):
        nbs.certify(nbs.PD.for_robot(robot), 1.0)


def test_the_control_period_is_held_against_the_rule():
    robot = nbs.load_robot("panda")
    law = quadratic(robot, 4.0, 4.0)
    slow, fast = (nbs.certify(law, 1.0, period=h) for h in (0.004, 0.0005))
    verdict = [next(c for c in x.conditions if c.name.startswith("control period")).holds for x in (slow, fast)]
    assert verdict == [False, True]  # 250 Hz chatters, docs/theory.md §5


def test_claims_are_numbers():
    with pytest.raises(ArgumentError, match="not a number"):
        Claim("nothing", math.nan, "", Label.PROVED, "")
    assert Claim("no bound", math.inf, "m", Label.EMPIRICAL, "x").plain()["value"] is None
    assert not Condition("1 > 2", 1.0, 2.0, "", Label.PROVED, "").holds
