"""Approaches: within the limits of the arm from every feasible start, smooth, and refused with what helps."""

import numpy as np
import pytest

import nbs_pin as nbs
from nbs_pin.base.exceptions import ArgumentError

TWO_LINK = nbs.load_robot("two_link")


def starts(robot, rng, count):
    """Random configurations, with some joints, every fifth time all, at or near their limits."""
    lower, upper = robot.sampling_range
    for k in range(count):
        q = rng.uniform(lower, upper)
        edge = np.where(rng.random(robot.nv) < 0.5, lower, upper)
        inward = np.sign(0.5 * (lower + upper) - edge) * rng.uniform(0.0, 1e-3, robot.nv) * (k % 2)
        yield np.where(rng.random(robot.nv) < (1.0 if k % 5 == 0 else 0.4), edge + inward, q)


def check_leads(led, robot, q, v):
    """It begins with the arm, is smooth, keeps the limits for a while beyond, and ends in the motion."""
    begin, end = led(0.0), led.length + (led.ramp or 0.0)
    assert np.allclose([begin.q, begin.v, begin.a], [q, v, np.zeros(robot.nv)], atol=1e-8)
    nbs.check_reference(led, robot, end + 1.0, samples=10_001)
    h = 1e-6
    for t in np.concatenate([np.linspace(h, end + 0.1, 50), [led.length, end]]):
        before, here, after = led(t - h), led(t), led(t + h)
        assert np.allclose((after.q - before.q) / (2.0 * h), here.v, atol=1e-5)
        assert np.allclose((after.v - before.v) / (2.0 * h), here.a, atol=2e-3)
    for t in (end, end + 0.37):
        assert all(np.allclose(x, y, atol=1e-9) for x, y in zip(led(t), led.motion(t - led.lag), strict=True))


@pytest.mark.parametrize("name", ["panda", "ur5"])
def test_every_start_within_the_limits_has_an_approach_that_keeps_them(name):
    robot, rng = nbs.load_robot(name), np.random.default_rng(0)
    motion, waits = nbs.Sinusoid.for_robot(robot), []
    for q in starts(robot, rng, 10):
        led = nbs.Approach.from_state(motion, robot, q)
        check_leads(led, robot, q, np.zeros(robot.nv))
        waits.append(led.ramp is not None)
    assert len(set(waits)) == 2  # both ways are taken


@pytest.mark.parametrize("name", ["panda", "ur5"])
def test_a_motion_that_begins_at_speed_and_uses_its_range_is_led_to(name):
    robot = nbs.load_robot(name)
    mild = nbs.Sinusoid.for_robot(robot)
    reach = np.minimum(mild.offset - robot.lower, robot.upper - mild.offset)
    share = 0.02 + 0.97 * (np.arange(robot.nv) == 3)  # one joint to its stops, at nearly its velocity limit
    fast = nbs.Sinusoid(share * np.minimum(reach, 1.5), 0.95 * robot.velocity_limit[3] / 1.5, 0.0, mild.offset)
    nbs.check_reference(fast, robot, 10.0)
    for away in (-1.0, 1.0):
        q = fast(0.0).q.copy()
        q[3] = (robot.lower if away < 0.0 else robot.upper)[3] - 0.01 * away
        check_leads(nbs.Approach.from_state(fast, robot, q), robot, q, np.zeros(robot.nv))


def test_a_moving_arm_is_led_without_a_step():
    rng, motion = np.random.default_rng(1), nbs.Sinusoid.for_robot(TWO_LINK)
    for _ in range(5):
        q, v = rng.uniform(-1.5, 1.5, 2), rng.uniform(-0.5, 0.5, 2)
        check_leads(nbs.Approach.from_state(motion, TWO_LINK, q, v), TWO_LINK, q, v)


def test_a_given_length_is_kept_or_refused():
    motion = nbs.Sinusoid.for_robot(TWO_LINK)
    assert nbs.Approach.from_state(motion, TWO_LINK, [1.0, 1.0], length=7.0).length == 7.0
    with pytest.raises(ArgumentError, match="give another length, or none"):
        nbs.Approach.from_state(motion, TWO_LINK, [1.0, 1.0], length=0.01)


def test_refusals_name_what_helps():
    motion = nbs.Sinusoid.for_robot(TWO_LINK)
    narrow = nbs.load_robot("two_link", limits={"*": {"lower": -1.0, "upper": 1.0, "velocity": 2.0}})
    heavy = np.abs(nbs.PinocchioDynamics(TWO_LINK).gravity(np.zeros(2)))
    for robot, aim, q, v, words in (
        (narrow, nbs.Hold([0.0, 0.0]), [0.0, 1.1], None, "position 1.1 rad of joint 'joint2'.*move it inside first"),
        (narrow, nbs.Hold([0.0, 0.0]), [0.0, 0.5], [2.5, 0.0], "velocity 2.5 rad/s of joint 'joint1'.*slow down first"),
        (narrow, nbs.Hold([0.0, 0.0]), [0.0, 1.0], [0.0, 1.5], "let it come to rest first"),
        (narrow, nbs.Hold([0.0, 1.5]), [0.0, 0.5], None, "needs the position 1.5 rad.*stay inside"),
        (narrow, nbs.Sinusoid([0.5, 0.5], 5.0), [0.0, 0.9], None, "needs the velocity 2.5 rad/s.*slow it down"),
        (
            TWO_LINK.with_effort_limit(0.6 * heavy),
            nbs.Hold([0.5 * np.pi, 0.0]),
            [-0.5 * np.pi, 0.0],
            None,
            "its weight alone takes.*bring the arm nearer to the beginning",
        ),
    ):
        with pytest.raises(ArgumentError, match=words):
            nbs.Approach.from_state(aim, robot, q, v)
    assert nbs.Approach.from_state(motion, narrow, [1.0, -1.0]).lag == 0.0


@pytest.mark.parametrize("approach", [True, False])
def test_an_arm_is_not_driven_along_a_motion_beyond_its_limits(approach):
    arm = nbs.PlantArm(nbs.MujocoPlant(TWO_LINK), [0.0, 0.0], real_time=False)
    late = nbs.MinimumJerk([[0.0, 0.0], [0.5, 0.0], [8.0, 0.0]], [0.0, 3.0, 6.0])
    with pytest.raises(ArgumentError, match=r"needs the position .*stay inside"):
        nbs.drive(arm, nbs.PD.for_robot(TWO_LINK), TWO_LINK, late, 6.0, approach=approach)


def test_a_motion_that_waits_for_the_arm_is_driven_to_its_end():
    robot = nbs.load_robot("two_link", limits={"joint1": {"lower": -1.0, "upper": 1.0}, "joint2": {"velocity": 1.0}})
    wave, q = nbs.Sinusoid([0.999, 0.1], 2.0), [0.9, 0.8]  # joint2 needs 3 s, in which joint1 has no room for more
    arm = nbs.PlantArm(nbs.MujocoPlant(robot), q, real_time=False)
    driven = nbs.drive(arm, nbs.NeuralBackstepping.for_robot(robot), robot, wave, 1.0)
    lag = nbs.Approach.from_state(wave, robot, q).lag
    assert lag > 0.0
    assert driven.report is None
    assert len(driven.run.t) == 1000 + np.ceil(1000.0 * lag)
    assert np.abs(driven.run.q_ref[-1] - wave(driven.run.t[-1] - lag).q).max() < 1e-9
    assert nbs.metrics.squared_error(driven.run).max() < 1e-8
