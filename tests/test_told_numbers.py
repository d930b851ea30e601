"""Numbers told to a user, in a message or a table, are what they say: on their one side it holds, on the other not."""

import math
import re
import warnings
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

import nbs_pin as nbs
from nbs_pin.base.checks import whole
from nbs_pin.base.exceptions import ArgumentError, CertificateRefused
from nbs_pin.benchmarks.serial_chains import serial_chain
from nbs_pin.certificates import one_joint as one_joint_bounds
from nbs_pin.certificates.admissible import Admissible
from nbs_pin.certificates.margins import check_box, effort_margin, position_margin, sampled_control
from nbs_pin.certificates.sampled_motion import SampledMotion
from nbs_pin.controllers.damping import Damping
from nbs_pin.controllers.gains import check_sampling, pd_gains, warn_if_too_fast
from nbs_pin.controllers.neural_backstepping import NeuralBackstepping
from nbs_pin.controllers.potential import Potential
from nbs_pin.dynamics.pinocchio import PinocchioDynamics

SMALL = 1e-3
ONE = serial_chain(1)


def told(message: str, words: str) -> float:
    """The number that follows these words."""
    return float(re.search(rf"{words}\s*([-+0-9.e]*[0-9])", message)[1])


def warned(call) -> str:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        call()
    return " ".join(str(w.message) for w in caught)


def refused(call) -> str:
    with pytest.raises((ArgumentError, CertificateRefused)) as caught:
        call()
    return str(caught.value)


@pytest.mark.parametrize("name", ["two_link", "panda", "ur5", "kinova"])
def test_the_bandwidth_that_a_warning_names_is_the_largest_without_it(name):
    robot = nbs.load_robot(name)
    dynamics = PinocchioDynamics(robot)
    message = warned(lambda: warn_if_too_fast(robot, dynamics, 100.0))
    largest = told(message, "take at most")
    assert not warned(lambda: warn_if_too_fast(robot, dynamics, largest * (1.0 - 6e-3)))  # told in three digits
    assert warned(lambda: warn_if_too_fast(robot, dynamics, largest * (1.0 + 6e-3)))
    share = told(message, f"of {name} needs")
    assert share == pytest.approx(6.0 * (100.0 / largest) ** 2, rel=0.02)


@given(bandwidth=st.floats(1.0, 1e4), period=st.floats(1e-4, 1.0))
@settings(max_examples=50, deadline=None)
def test_the_bandwidth_that_a_period_allows_is_allowed_and_no_larger_one(bandwidth, period):
    largest = 0.5 / period
    check_sampling(0.999 * largest, period)
    message = refused(lambda: check_sampling(1.001 * largest, period))
    assert told(message, "at most") == pytest.approx(largest, rel=SMALL)
    if bandwidth * period > 0.5:
        message = refused(lambda: check_sampling(bandwidth, period))
        assert told(message, "leaves") == pytest.approx(1.0 / (bandwidth * period), rel=0.05)


@given(total=st.floats(0.01, 100.0), part=st.floats(1e-3, 1.0))
@settings(max_examples=50, deadline=None)
def test_the_duration_that_is_advised_is_a_whole_number_of_periods(total, part):
    ratio = total / part
    if round(ratio) >= 1 and math.isclose(ratio, round(ratio), rel_tol=1e-9):
        assert whole(total, part, "duration", "period") == round(ratio)
        return
    message = refused(lambda: whole(total, part, "duration", "period"))
    assert told(message, "s is") == pytest.approx(ratio, rel=1e-11)
    advised = told(message, "take for instance")
    assert whole(advised, part, "duration", "period") == max(1, round(ratio))


def one_joint(stiffness: float, damping: float, rate: float, omega: float = 0.0) -> NeuralBackstepping:
    """A law of one joint with networks that are zero."""
    phi = Potential(np.array([[0.5 * stiffness]]), widths=(1,))
    d = Damping(1, floor=np.array([[damping]]), widths=(1,))
    for module in (phi.network, d.diagonal):
        for parameter in module.parameters():
            parameter.data.zero_()
    return NeuralBackstepping(PinocchioDynamics(ONE), phi, d, rate=np.array([rate]), inertial_rate=omega)


@pytest.mark.parametrize("seed", range(5))
def test_the_longest_period_and_delay_are_the_rules_of_the_theory(seed):
    """h < 2/(s + e) and delay < π/2s with s = ω + D/M and e = ΛK, the two rates of one joint (docs/theory.md §5)."""
    rng = np.random.default_rng(seed)
    stiffness, damping, rate, omega = rng.uniform(0.5, 20.0, 4)
    law = one_joint(stiffness, damping, rate, omega)
    mass = float(law.dynamics.mass_matrix(np.zeros(1))[0, 0])
    hold, delay = (line.value for line in sampled_control(law, None)[0])
    speed = omega + damping / mass
    assert hold == pytest.approx(2.0 / (speed + rate * stiffness), rel=1e-9)
    assert delay == pytest.approx(0.5 * np.pi / speed, rel=1e-9)
    for period, holds in ((0.4999 * hold, True), (0.5001 * hold, False)):
        condition, _ = sampled_control(law, period)[1]
        assert (condition.holds, condition.left, condition.right) == (holds, 0.5 * hold, period)


@pytest.mark.parametrize(("share", "grows"), [(0.9, False), (1.1, True)])
def test_a_damper_held_for_the_longest_period_is_at_the_edge_of_chatter(share, grows):
    """Without stiffness the held loop is z2⁺ = (1 − hs)z2, which decays for h < 2/s and grows beyond."""
    law = one_joint(1e-9, 2.0, 1e-9)
    hold = sampled_control(law, None)[0][0].value
    plant = nbs.DynamicsPlant(PinocchioDynamics(ONE), "semi_implicit_euler")
    period = share * hold
    run = nbs.simulate(plant, law, nbs.Hold(np.zeros(1)), 60 * period, period, q0=[0.0], v0=[1e-3], lookahead=0.0,
                       effort_limit=np.inf)  # fmt: skip
    assert (np.abs(run.v[-1]) > np.abs(run.v[0])).all() == grows


@pytest.mark.parametrize(("share", "grows"), [(0.95, False), (1.05, True)])
def test_a_damper_delayed_for_the_longest_delay_is_at_the_edge_of_oscillation(share, grows):
    """ẋ(t) = −s x(t − δ), by Euler: it decays for sδ < π/2 and grows beyond."""
    law = one_joint(1e-9, 2.0, 1e-9)
    delay = share * sampled_control(law, None)[0][1].value
    mass = float(law.dynamics.mass_matrix(np.zeros(1))[0, 0])
    steps = 2000
    h, x = delay / steps, np.ones(60 * steps)
    for k in range(steps, len(x) - 1):
        x[k + 1] = x[k] - h * 2.0 / mass * x[k - steps]
    peaks = np.abs(x.reshape(6, -1)).max(axis=1)
    assert (peaks[-1] > peaks[1]) == grows


@pytest.mark.parametrize("side", ["lower", "upper"])
@pytest.mark.parametrize("joint", [0, 1, 2])
def test_room_to_a_stop_is_measured_at_both_ends(side, joint):
    robot = nbs.load_robot("panda")
    middle, gap = 0.5 * (robot.lower + robot.upper), 0.02
    q = middle.copy()
    q[joint] = robot.lower[joint] + gap if side == "lower" else robot.upper[joint] - gap
    for error, holds in ((0.99 * gap, True), (1.01 * gap, False)):
        (condition,) = position_margin(robot, np.full(7, error), SampledMotion.of(nbs.Hold(q), 7, 1.0))
        assert condition.name.startswith(f"room of {robot.joint_names[joint]} ")
        assert condition.left == pytest.approx(gap)
        assert (condition.right, condition.holds) == (error, holds)


@given(low=st.floats(-2.0, 0.9), size=st.floats(0.0, 0.5), joint=st.integers(0, 2))
@settings(max_examples=30, deadline=None)
def test_the_excess_over_a_box_that_is_told_is_what_the_box_lacks(low, size, joint):
    positions = np.zeros((5, 3))
    positions[3, joint] = 1.0
    high = np.full(3, 10.0)
    high[joint] = low
    message = refused(lambda: check_box(positions, -high - 9.0, high, error=size))
    assert f"at joint {joint + 1} " in message
    lacking = told(message, f"at joint {joint + 1} by")
    for share, holds in ((1.01, True), (0.99, False)):
        high[joint] = low + share * lacking
        if holds:
            assert check_box(positions, -high - 9.0, high, error=size).value >= 0.0
        else:
            refused(lambda: check_box(positions, -high - 9.0, high, error=size))


def test_a_bound_of_one_joint_starts_from_a_speed_that_is_rounded_up(monkeypatch):
    """½Mv² ≥ V in exact arithmetic, where v comes from √(2V/M)."""
    asked = []
    monkeypatch.setattr(one_joint_bounds, "worst_error", lambda *arguments: asked.append(arguments) or math.inf)
    law = one_joint(2.0, 3.0, 0.5)
    for disturbance in np.random.default_rng(0).uniform(0.1, 1.0, 20):
        certificate = nbs.certify(law, disturbance)
        loop, *_, within = asked[-1]
        assert Fraction(within.z2) ** 2 * Fraction(loop.inertia) / 2 >= Fraction(certificate.storage)


@pytest.mark.parametrize("norm", [False, True])
def test_the_torque_told_is_what_the_effort_limit_must_exceed(norm):
    robot = nbs.load_robot("two_link")
    motion, dynamics = nbs.Sinusoid.for_robot(robot), PinocchioDynamics(robot)
    admissible = Admissible.of(3.0 if norm else np.array([3.0, 2.0]), 2)
    t = np.linspace(0.0, 10.0, 2001)
    needed = np.abs(nbs.inverse_dynamics(dynamics, *motion(t))).max(axis=0) + (3.0 if norm else np.array([3.0, 2.0]))
    for share, holds in ((1.001, True), (0.999, False)):
        arm = robot.with_effort_limit(share * needed)
        (condition,) = effort_margin(arm, dynamics, admissible, SampledMotion.of(motion, 2, 10.0))
        assert condition.holds is holds
        assert condition.right in needed


@pytest.mark.parametrize(("name", "error"), [("two_link", 1e-5), ("three_link", 1e-3)])
def test_the_period_that_a_design_asks_for_is_short_enough(name, error):
    robot = nbs.load_robot(name).with_effort_limit(1e6)
    bounds = np.full(robot.nv, 5.0)
    message = refused(lambda: nbs.propose(robot, bounds, error, periods=(0.01,)))
    longest = 1e-3 * told(message, "period of at most")
    assert nbs.propose(robot, bounds, error, periods=(0.99 * longest,)).period == 0.99 * longest
    again = refused(lambda: nbs.propose(robot, bounds, error, periods=(1.01 * longest,)))
    assert "control period" in again


def test_a_limit_that_a_reference_breaks_is_named_with_what_would_do():
    robot = nbs.load_robot("two_link")
    fast = nbs.Sinusoid(1.0, [1.0, 30.0])
    message = refused(lambda: nbs.check_reference(fast, robot, 10.0))
    assert told(message, "the velocity") <= 30.0
    low, high = (float(x) for x in re.search(r"outside \[(\S+), (\S+)\]", message).groups())
    assert (-low, high) == (robot.velocity_limit[1], robot.velocity_limit[1])


@pytest.mark.parametrize("name", ["panda", "ur5"])
def test_critical_damping_is_critical_for_the_largest_inertia_of_each_joint(name):
    """K_d = 2√(K_p M_ii) or less, where a sampled damper would chatter: a quarter of 2M_e/h."""
    robot = nbs.load_robot(name)
    dynamics = PinocchioDynamics(robot)
    kp, kd = pd_gains(robot, dynamics, bandwidth=8.0, period=1e-6)
    q = np.random.default_rng(1).uniform(*robot.sampling_range, (3000, robot.nv))
    largest = np.diagonal(dynamics.mass_matrix(q), axis1=-2, axis2=-1).max(axis=0)
    np.testing.assert_allclose(kd, 2.0 * np.sqrt(kp * largest), rtol=0.1)
    slow = pd_gains(robot, dynamics, bandwidth=8.0, period=0.01)[1]
    least = (1.0 / np.diagonal(np.linalg.inv(dynamics.mass_matrix(q)), axis1=-2, axis2=-1)).min(axis=0)
    assert (slow <= 0.5 * 1.2 * least / 0.01).all()
