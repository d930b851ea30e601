"""A certificate's label is the weakest of all that it rests on, and every assumption is checked or said not to be."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies as st

import nbs_pin as nbs
from nbs_pin.accuracy.mismatch import mismatch
from nbs_pin.base.claims import Claim, Label
from nbs_pin.base.exceptions import CertificateRefused
from nbs_pin.base.records import Reference
from nbs_pin.certificates.claims import Assumption, Condition, Role, assumed
from nbs_pin.certificates.constants import constants_of
from nbs_pin.certificates.friction_error import FrictionGap, friction_error
from nbs_pin.certificates.loads import payload
from nbs_pin.dynamics.analytic import AnalyticDynamics
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.inertia import multipliers

certify = nbs.certify


@pytest.fixture(scope="module")
def robot():
    return nbs.load_robot("ur5")


@pytest.fixture(scope="module")
def law(robot):
    return nbs.NeuralBackstepping.for_robot(robot)


@pytest.fixture(scope="module")
def certificate(robot, law):
    motion = nbs.Sinusoid.for_robot(robot)
    return certify(law, np.full(6, 0.5), reference=motion, q0=motion(0.0).q, period=0.001)


# The rule


def test_the_label_is_the_weakest_of_everything_that_it_rests_on(certificate):
    assert certificate.label is Label.PROVED
    doubt = Claim("doubt", 1.0, "", Label.PROBABILISTIC, "")
    weaker = [
        replace(certificate, constants=replace(certificate.constants, label=Label.PROBABILISTIC)),
        replace(certificate, admissible=replace(certificate.admissible, claims=(doubt,))),
        replace(certificate, model_error=certificate.model_error._replace(lines=(doubt,))),
        replace(certificate, friction=certificate.friction._replace(lines=(doubt,))),
    ]
    sufficient = [k for k, c in enumerate(certificate.conditions) if c.role is Role.SUFFICIENT]
    assert len(sufficient) > 2
    for k in sufficient:
        conditions = list(certificate.conditions)
        conditions[k] = replace(conditions[k], label=Label.PROBABILISTIC)
        weaker.append(replace(certificate, conditions=tuple(conditions)))
    for one in weaker:
        assert one.label is Label.PROBABILISTIC
        bounds = [line for line in one.lines if line.name == "‖z1‖" or line.name.startswith("|z1| of")]
        assert {line.label for line in bounds} == {Label.PROBABILISTIC}


def test_a_condition_that_fails_makes_it_empirical_unless_it_is_only_for_comparison(certificate):
    for role in Role:
        failing = Condition("x", 0.0, 1.0, "", Label.PROVED, "", role)
        one = replace(certificate, conditions=(*certificate.conditions, failing))
        assert one.label is (Label.PROVED if role is Role.COMPARISON else Label.EMPIRICAL)
        assert one.void == (() if role is Role.COMPARISON else ("x",))


@pytest.mark.parametrize("numbers", [(np.nan, 1.0), (1.0, np.nan), (np.inf, np.inf), (1.0, 1.0)])
def test_a_condition_with_numbers_that_do_not_compare_fails(numbers):
    assert Condition("x", *numbers, "", Label.PROVED, "").voids


def test_every_assumption_is_listed_with_how_far_it_is_checked():
    """Of a member that nobody lists, `assumptions` would not know the words."""
    robot = nbs.load_robot("kinova")
    listed = certify(nbs.NeuralBackstepping.for_robot(robot), np.full(6, 0.01)).assumptions
    assert len(listed) == len(Assumption)
    assert {checked for _, checked in listed} <= {"checked", "checked in part", "not checked", "FAILS"}
    assert all(text for text, _ in listed)


def test_what_is_said_of_an_assumption_follows_from_its_conditions():
    def condition(role, holds, checks=Assumption.TIME):
        return Condition("x", float(holds), 0.5, "", Label.PROVED, "", role, checks)

    for role, holds, said in [
        (Role.SUFFICIENT, True, "checked"),
        (Role.NECESSARY, True, "checked in part"),
        (Role.SUFFICIENT, False, "FAILS"),
        (Role.NECESSARY, False, "FAILS"),
    ]:
        assert assumed(Assumption.TIME, [condition(role, holds)]).checked == said
        assert assumed(Assumption.EFFORT, [condition(role, holds)]).checked == "not checked"


# What is known of the reference, the start and the limits


def test_torque_that_the_start_takes_is_held_against_the_limits(robot, law):
    motion = nbs.Sinusoid.for_robot(robot)
    near, far = (
        certify(law, np.full(6, 0.5), reference=motion, q0=motion(0.0).q + away * (-1.0) ** np.arange(6))
        for away in (0.02, 0.5)
    )
    assert near.label is Label.PROVED
    assert far.label is Label.EMPIRICAL
    (name,) = far.void
    assert name.endswith("> torque at the start")
    at = motion(0.0)
    torque = np.abs(law.torque(at.q + 0.5 * (-1.0) ** np.arange(6), np.zeros(6), *at))
    condition = next(c for c in far.conditions if c.name == name)
    assert condition.right / condition.left == pytest.approx((torque / robot.effort_limit).max())


def leaps(base):
    def motion(t):
        at = base(t)
        return Reference(at.q + 0.4 * (np.asarray(t)[..., None] >= 1.0), at.v, at.a)

    return motion


def zigzags(base):
    def motion(t):
        phase = np.mod(np.asarray(t, dtype=float)[..., None], 1.0)
        q, v = np.where(phase < 0.5, phase, 1.0 - phase), np.where(phase < 0.5, 1.0, -1.0)
        return Reference(base(0.0).q + 0.8 * q * np.ones(6), 0.8 * v * np.ones(6), 0.0 * q * np.ones(6))

    return motion


@pytest.mark.parametrize(
    "spoil",
    [
        leaps,
        zigzags,
        lambda base: lambda t: base(t)._replace(v=0.0 * base(t).v),
        lambda base: lambda t: base(t)._replace(a=0.0 * base(t).a),
        lambda base: lambda t: base(t)._replace(v=np.rad2deg(base(t).v)),
    ],
    ids=["jump", "zigzag", "no velocity", "no acceleration", "degrees"],
)
def test_a_reference_that_contradicts_its_derivatives_gives_no_promise(robot, law, spoil):
    spoiled = spoil(nbs.Sinusoid.for_robot(robot))
    found = certify(law, np.full(6, 0.5), reference=spoiled)
    assert found.label is Label.EMPIRICAL
    assert any("derivatives do not explain" in name for name in found.void)


@pytest.mark.parametrize("share", [0.9, 1.1])
def test_velocities_a_tenth_off_are_a_contradiction(robot, law, share):
    base = nbs.Sinusoid.for_robot(robot)
    found = certify(
        law, np.full(6, 0.5), reference=lambda t: base(t)._replace(v=share * base(t).v, a=share * base(t).a)
    )
    assert any("derivatives do not explain" in name for name in found.void)


def test_a_long_reference_is_looked_at_closely(robot, law):
    """Once in half an hour it goes out and back by 1.5 rad within 0.4 s."""
    times = np.array([0.0, 1000.0, 1000.2, 1000.4, 1800.0])
    q = np.zeros((5, 6))
    q[2] = 1.5
    found = certify(law, np.full(6, 0.5), reference=nbs.MinimumJerk(q, times), duration=1800.0)
    assert any(name.startswith("velocity limit of") for name in found.void)


def test_a_reference_with_a_length_of_its_own_is_looked_at_whole(robot, law):
    t = np.linspace(0.0, 12.0, 121)
    for late in (
        nbs.Sampled(t, 2.0 * np.clip(t - 11.0, 0.0, None)[:, None] ** 3 * np.ones(6)),
        nbs.MinimumJerk(np.array([[0.0], [0.0], [2.0]]) * np.ones(6), [0.0, 11.5, 12.0]),
    ):
        assert certify(law, np.full(6, 0.5), reference=late).void
        assert not certify(law, np.full(6, 0.5), reference=late, duration=10.0).void


def test_stiffness_far_beyond_the_period_gives_no_promise(robot, law):
    stiff = nbs.NeuralBackstepping.for_robot(robot)
    with torch.no_grad():
        stiff.potential.stiffness.nominal.mul_(1e3)
        stiff.rate.nominal.mul_(1e-3)
    found = certify(stiff, np.full(6, 0.5), reference=nbs.Sinusoid.for_robot(robot), period=0.001)
    assert any("stiffness" in name for name in found.void)


def test_a_solver_that_panics_leaves_the_other_bounds(monkeypatch, robot, law):
    class Panic(BaseException):
        pass

    def panics(*_):
        raise Panic

    monkeypatch.setattr(multipliers.clarabel, "DefaultSolver", panics)
    found = certify(law, np.full(6, 0.5))
    assert found.label is Label.PROVED
    assert "multipliers" not in " ".join(line.because for line in found.lines if line.group == "inertia")


@pytest.mark.parametrize("frequency", [0.1, 1.0, 3.0])
def test_smooth_references_are_no_contradiction(robot, law, frequency):
    for motion in (
        nbs.Sinusoid.for_robot(robot, frequency),
        nbs.MinimumJerk([np.zeros(6), np.full(6, 0.5)], [0.0, 3.0 / frequency]),
        nbs.Hold(np.zeros(6)),
    ):
        conditions = certify(law, np.full(6, 0.5), reference=motion).conditions
        assert all(c.holds for c in conditions if c.checks is Assumption.REFERENCE)


def test_a_reference_faster_than_the_joints_may_turn_gives_no_promise(robot, law):
    found = certify(law, np.full(6, 0.5), reference=nbs.Sinusoid(np.full(6, 0.1), 40.0))
    assert any(name.startswith("velocity limit of") for name in found.void)


def test_between_instants_a_reference_may_come_nearer_to_a_stop(robot, law):
    """A peak between two of the instants that are looked at, of which half a step is allowed for."""
    motion = nbs.Sinusoid(np.full(6, 0.3), 17.0)
    (condition,) = [
        c for c in certify(law, np.full(6, 0.5), reference=motion).conditions if c.checks is Assumption.STOPS
    ]
    fine = np.abs(motion(np.linspace(0.0, 10.0, 200_001)).q)
    joint = int(np.argmin((robot.upper - fine).min(axis=0)))
    assert condition.left <= (robot.upper - fine)[:, joint].min()


# What is known of the arm


def test_a_model_edited_in_place_is_no_longer_the_urdfs():
    robot = nbs.load_robot("panda")
    law = nbs.NeuralBackstepping.for_robot(robot)
    assert certify(law, np.full(7, 1.0)).label is Label.PROVED
    robot.model.appendBodyToJoint(7, robot.model.inertias[7], robot.model.jointPlacements[7])
    found = certify(nbs.NeuralBackstepping.for_robot(robot), np.full(7, 1.0))
    assert found.label is Label.EMPIRICAL
    assert any("difference of the model's torques" in name for name in found.void)


@pytest.mark.parametrize("ceiling", [None, 1.0])
def test_weights_far_from_zero_are_in_the_rule_of_sampled_control(ceiling):
    """D(0) = D₀ for every weight of a network without biases; where the loop goes, D is another, unless bounded."""
    robot = nbs.load_robot("three_link")
    law = nbs.NeuralBackstepping.for_robot(robot, damping_ceiling=ceiling)
    motion = nbs.Sinusoid.for_robot(robot)
    assert certify(law, np.full(3, 0.5), reference=motion, period=0.001).label is Label.PROVED
    with torch.no_grad():
        for network in (law.damping.diagonal, law.damping.lower):
            for parameter in network.parameters():
                parameter.mul_(10.0)
    found = certify(law, np.full(3, 0.5), reference=motion, period=0.001)
    assert found.label is (Label.EMPIRICAL if ceiling is None else Label.PROVED)
    chatters = [
        "control period",
        "bound of |z1_i| of joint1 > largest in simulation",
        "effort limit of joint1 > largest torque in simulation",
    ]
    assert [name.split(":")[0] for name in found.void] == (chatters if ceiling is None else [])


def test_a_bound_on_an_estimated_load_is_no_better_than_the_estimate(robot, law):
    load = payload(robot, 2.0, nbs.Sinusoid.for_robot(robot))
    found = certify(law, load)
    assert found.label is load.label is Label.EMPIRICAL
    assert not found.void
    assert load.claims[0] in found.lines


# Friction


@given(seed=st.integers(0, 2**31))
@settings(max_examples=60, deadline=None)
def test_the_power_of_friction_is_within_its_terms(seed):
    """z2ᵀ(f̂(φ) − f(v)) + z2ᵀb z2 ≤ t y + αxy + P for a dry f, stiction and a smooth one."""
    rng = np.random.default_rng(seed)
    robot = nbs.load_robot("two_link")
    law = nbs.NeuralBackstepping.for_robot(robot)
    b, c, b_fed, c_fed = rng.uniform(0.0, 3.0, (4, 2)) * rng.integers(0, 2, (4, 1))
    arm, fed = nbs.JointFriction(b, c), nbs.JointFriction(b_fed, c_fed)
    gap = FrictionGap.of(2, arm, fed)
    constants = constants_of(law, b)
    speed = rng.uniform(0.1, 2.0, 2)
    terms = friction_error(gap, constants, speed, "")
    for size in (1.0, 0.01):
        v_d, force = rng.uniform(-speed, speed), rng.normal(size=2) * 20.0 * size
        phi = v_d * rng.integers(0, 2) - constants.rate * force
        z2 = np.where(rng.random(2) < 0.3, -phi, rng.normal(size=2) * size)
        v = phi + z2
        x, y = np.sqrt(force @ (constants.rate * force)), np.sqrt(z2 @ constants.floor @ z2)
        most = terms.t * y + terms.alpha * x * y + gap.power
        sign = np.where(np.abs(v) < 1e-12, rng.uniform(-1.0, 1.0, 2), np.sign(v))
        for torque in (b * v + c * sign, arm.torque(v)):
            power = z2 @ (fed.torque(phi) - torque) + z2 @ (b * z2)
            assert power <= most * (1.0 + 1e-9) + 1e-12


@pytest.mark.parametrize("fed", [None, nbs.JointFriction(np.full(2, 2.0), np.full(2, 1.5))])
def test_an_arm_with_friction_stays_within_a_bound_that_counts_it(fed):
    robot = nbs.load_robot("two_link")
    arm = nbs.JointFriction(np.array([3.0, 1.0]), np.array([2.0, 1.0]))
    law, motion = nbs.NeuralBackstepping.for_robot(robot, friction=fed), nbs.Sinusoid.for_robot(robot)
    found = certify(law, np.full(2, 3.0), reference=motion, period=0.001, friction=arm)
    assert found.label is Label.PROVED
    assert found.error > certify(law, np.full(2, 3.0), reference=motion, friction=fed).error
    plant = nbs.DynamicsPlant(PinocchioDynamics(robot), friction=arm)
    for rate in (0.5, 3.0, 10.0, 30.0):
        wave = nbs.SquareWave(np.array([3.0, -3.0]), rate)
        run = nbs.simulate(plant, law, motion, 2.0, 0.001, disturbance=wave)
        seen = nbs.monitor(run, found)
        assert (seen.joint_errors <= found.joint_errors).all()
        assert seen.is_kept
        assert Assumption.MODEL not in seen.failures


def test_friction_that_the_urdf_states_is_counted_or_refused():
    """The law of xarm7 feeds none forward: its wrist has 2 N·m·s/rad and 1 N·m."""
    robot = nbs.load_robot("xarm7")
    with pytest.raises(CertificateRefused, match=r"friction that is not fed forward, .* feed the friction forward"):
        certify(nbs.NeuralBackstepping.for_robot(robot), np.full(7, 0.05))
    own = nbs.JointFriction.of(robot)
    found = certify(nbs.NeuralBackstepping.for_robot(robot, friction=own), np.full(7, 0.05))
    assert (found.friction.t, found.friction.alpha) == (0.0, 0.0)
    assert found.friction.gap.power > 0.0
    none, dry = (nbs.JointFriction(np.zeros(7), c) for c in (np.zeros(7), own.coulomb))
    without = certify(nbs.NeuralBackstepping.for_robot(robot), np.full(7, 0.05), friction=none)
    rough = certify(nbs.NeuralBackstepping.for_robot(robot, friction=dry), np.full(7, 0.05), friction=dry)
    assert rough.error > without.error  # by P, of a sign that is smoothed
    assert found.error < rough.error  # by b, which damps


def test_viscous_friction_without_a_bound_of_speed_gives_no_promise():
    robot = nbs.load_robot("two_link")
    model = AnalyticDynamics()
    law = nbs.NeuralBackstepping.for_robot(robot, dynamics=model)
    friction = nbs.JointFriction(np.ones(2), np.zeros(2))
    assert certify(law, np.ones(2), friction=friction).label is Label.EMPIRICAL
    bounded = certify(law, np.ones(2), friction=friction, reference=nbs.Sinusoid.for_robot(robot))
    assert not any("for viscous friction" in name for name in bounded.void)


# Learned models


def drawn(robot, law, model, duration, away):
    truth, motion = PinocchioDynamics(robot), nbs.Sinusoid.for_robot(robot)
    starts = motion(0.0).q + np.random.default_rng(0).uniform(-away, away, (40, robot.nv))
    wave = nbs.SquareWave(np.full(robot.nv, 0.1), 5.0)
    plant = nbs.DynamicsPlant(truth)
    run = nbs.simulate(plant, law, motion, duration, 0.005, q0=starts, plant_step=0.005, disturbance=wave)
    return mismatch(model, truth, run)


def test_a_scenario_statement_covers_what_was_drawn_and_no_more():
    robot = nbs.load_robot("two_link")
    model = AnalyticDynamics(masses=(1.0, 1.03))
    law, motion = nbs.NeuralBackstepping.for_robot(robot, dynamics=model), nbs.Sinusoid.for_robot(robot)
    seen = drawn(robot, law, model, 2.0, 0.1)
    asked = {"reference": motion, "robot": robot, "mismatch": seen}
    inside = certify(law, np.full(2, 0.1), **asked, duration=2.0, q0=motion(0.0).q + 0.09, v0=np.zeros(2))
    assert inside.label is Label.PROBABILISTIC
    assert all("up to t = 2 s" in line.because for line in inside.lines if line.name == "‖z1‖")
    longer = certify(law, np.full(2, 0.1), **asked, duration=3.0)
    farther = certify(law, np.full(2, 0.1), **asked, duration=2.0, q0=motion(0.0).q + 0.2, v0=np.zeros(2))
    faster = certify(law, np.full(2, 0.1), **asked, duration=2.0, q0=motion(0.0).q, v0=np.full(2, 3.0))
    harder = certify(law, np.full(2, 0.2), **asked, duration=2.0)
    other = certify(law, np.full(2, 0.1), **(asked | {"reference": nbs.Hold(motion(0.0).q)}), duration=2.0)
    for one, words in (
        (longer, "length"),
        (farther, "start error"),
        (faster, "start speed"),
        (harder, "disturbance"),
        (other, "reference"),
    ):
        assert one.label is Label.EMPIRICAL
        assert any(words in name for name in one.void)


# Bounds of no use


def test_a_bound_of_turns_and_a_disturbance_beyond_the_motor_are_called_useless():
    robot = nbs.load_robot("kinova")
    law = nbs.NeuralBackstepping.for_robot(robot)
    (said,) = certify(law, np.full(6, 5.0)).useless
    assert "turns says nothing" in said
    share = float(said.split("a disturbance of ")[1].split()[0])
    smaller = certify(law, np.full(6, 5.0 * share))
    assert smaller.joint_errors.max() == pytest.approx(0.5, rel=0.05)
    assert smaller.useless == ()
    strong = certify(law, np.append(np.full(5, 0.01), 25.0)).useless
    assert "25 N·m, is no less than the 20 N·m of its motor" in strong[0]


# Numbers that are not finite


@pytest.fixture(scope="module")
def kept():
    robot = nbs.load_robot("two_link")
    law, motion = nbs.NeuralBackstepping.for_robot(robot), nbs.Sinusoid.for_robot(robot)
    run = nbs.simulate(nbs.DynamicsPlant(PinocchioDynamics(robot)), law, motion, 0.2, 0.001)
    return run, certify(law, np.full(2, 5.0))


@pytest.mark.parametrize("field", ["q", "v", "q_ref", "v_ref", "a_ref", "tau", "tau_command"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_number_that_is_not_finite_breaks_the_promise_and_is_named(kept, field, value):
    run, certificate = kept
    spoiled = getattr(run, field).copy()
    spoiled[50:53, 1] = value
    seen = nbs.monitor(replace(run, **{field: spoiled}), certificate)
    assert not seen.is_kept
    assert not seen.is_wrong
    (name,) = seen.excesses
    assert "joint2, which is not finite" in name
    np.testing.assert_array_equal(np.flatnonzero(seen.exceeded), [50, 51, 52])
    assert not seen.failures
    assert "t = 0.05 s" in seen.verdict


def test_a_disturbance_or_a_time_that_is_not_finite_is_no_promise_kept(kept):
    run, certificate = kept
    spoiled = run.disturbance + 0.0
    spoiled[50, 1] = np.nan
    assert "recorded disturbance of joint2" in nbs.monitor(replace(run, disturbance=spoiled), certificate).verdict
    with pytest.raises(nbs.ArgumentError, match="a time of the run is not finite"):
        nbs.monitor(replace(run, t=np.append(run.t[:-1], np.inf)), certificate)


@pytest.mark.parametrize("bad", [0, 60])
def test_a_watch_names_such_a_number_and_recovers(kept, bad):
    run, certificate = kept
    watch, memory, verdicts = nbs.Watch(certificate), None, []
    for k in range(len(run.t) - 1):
        q = run.q[k] * (np.nan if k == bad else 1.0)
        aim = Reference(run.q_ref[k], run.v_ref[k], run.a_ref[k])
        seen, memory = watch.step(memory, float(run.t[k]), q, run.v[k], aim, run.tau[k], run.tau_command[k])
        verdicts.append(seen.verdict)
    assert "q of joint1, which is not finite" in verdicts[bad]
    assert set(verdicts[:bad] + verdicts[bad + 1 :]) == {"promise kept"}


@pytest.mark.parametrize("name", ["two_link", "ur5", "panda", "kinova"])
def test_an_honest_loop_at_a_sound_period_fails_no_assumption(name):
    """Disturbances on record and within their bound, in MuJoCo at 1 kHz, for slow laws and fast ones."""
    robot, rng = nbs.load_robot(name), np.random.default_rng(0)
    for bandwidth in (6.0, 18.0):
        law = nbs.NeuralBackstepping.for_robot(robot, bandwidth=bandwidth)
        motion = nbs.Sinusoid.for_robot(robot, frequency=rng.uniform(0.3, 2.0))
        size = np.full(robot.nv, 0.1 if name == "kinova" else 1.0)
        found = certify(law, size, reference=motion, period=0.001)
        wave = nbs.SquareWave(size * rng.choice([-1.0, 1.0], robot.nv), rng.uniform(2.0, 40.0))
        run = nbs.simulate(nbs.MujocoPlant(robot), law, motion, 1.0, 0.001, disturbance=wave)
        assert nbs.monitor(run, found).verdict == "promise kept"
