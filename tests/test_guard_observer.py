"""Pushes that the guard sees by the momentum observer: when it stops, when it must not, and what leaves no trace."""

import math

import numpy as np
import pytest

import nbs_pin as nbs
from nbs_pin import cli
from tests.commands import printed_by, summary
from tests.test_guard import LAW, MOTION, ROBOT, H

PANDA = nbs.load_robot("panda")
PANDA_LAW = nbs.NeuralBackstepping.for_robot(PANDA)
PANDA_MOTION = nbs.Sinusoid.for_robot(PANDA)
GAIN = 50.0


def driven(push=None, limit=10.0, seconds=2.0, **more):
    start = PANDA_MOTION(0.0).q
    arm = nbs.PlantArm(nbs.MujocoPlant(PANDA), start, real_time=False, disturbance=push)
    guard = nbs.Guard.for_robot(PANDA, external_limit=limit)
    return nbs.drive(arm, PANDA_LAW, PANDA, PANDA_MOTION, seconds, guard=guard, **more)


def tracked(guarded, count, spoil=lambda k, sample: sample, plant=None, tau_of=lambda q, tau: tau):
    """The loop of two_link along its motion; the estimates that the samples had."""
    plant = nbs.DynamicsPlant.for_robot(ROBOT) if plant is None else plant
    q, v, seen = MOTION(0.0).q, MOTION(0.0).v, []
    guarded.begin(q, MOTION(guarded.lead))
    for k in range(count):
        tau = guarded.step(spoil(k, nbs.Sample(k * H, q, v)), MOTION(k * H + guarded.lead))
        seen.append(guarded.seen.sample.external)
        q, v = plant.step(q, v, tau_of(q, tau), H)
    return seen


@pytest.mark.parametrize("size", [30.0, -30.0, 12.0])
def test_a_push_stops_the_arm_when_the_filter_says_and_not_before(size):
    at = 0.5
    result = driven(lambda t, q, v: np.eye(7)[1] * (size if at <= t < at + 0.06 else 0.0))
    assert result.report.code is nbs.Fault.EXTERNAL
    # |r| = 30(1 − e^(−K_o t)) passes 10 N·m after 8.1 ms; it must be beyond it at three samples
    after = math.ceil(-math.log1p(-10.0 / abs(size)) / (GAIN * H)) + 2
    assert result.report.time == pytest.approx(at + after * H, abs=1.5 * H)
    assert "panda_joint2" in str(result.report)
    assert "limit 10 N·m" in str(result.report)
    told = np.array([sample.external for sample, *_ in result.report.samples])
    assert np.abs(told[:, [0, 2, 3, 4, 5, 6]]).max() < 1e-3  # and nothing on the other joints
    # braked: no joint is let go for having been pushed, and the arm is held against gravity
    speed = np.abs(result.run.v)
    assert speed[-1, 1] < 0.4 * speed[round(at / H) :, 1].max()
    assert speed.max() < 2.5
    assert np.abs(result.run.tau[-1, 1]) > 30.0


def test_a_push_below_the_limit_and_a_motion_without_one_do_not_stop_it():
    assert driven(limit=0.01, seconds=6.0).report is None
    push = np.array([0.0, 9.9, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert driven(lambda t, q, v: push if t > 0.3 else 0.0 * push).report is None


def test_a_motor_of_the_wrong_sign_looks_like_a_push_and_ends_limp():
    guarded = nbs.Guarded(LAW, ROBOT, nbs.Guard.for_robot(ROBOT, external_limit=5.0))
    plant = nbs.DynamicsPlant.for_robot(ROBOT)
    q, v = MOTION(0.0).q, MOTION(0.0).v
    guarded.begin(q, MOTION(guarded.lead))
    for k in range(1500):
        tau = guarded.step(nbs.Sample(k * H, q, v), MOTION(k * H + guarded.lead))
        q, v = plant.step(q, v, tau if k < 200 else -tau, H)
    assert guarded.report.code is nbs.Fault.EXTERNAL
    assert guarded.report.time < 0.25
    assert not guarded.tau.any()  # the brake drives its joints: at twice their velocity limits they are let go


def test_limits_may_differ_from_joint_to_joint():
    push = np.array([0.0, 0.0, 0.0, 5.0, 0.0, 0.0, 0.0])
    loose, tight = np.full(7, np.inf), np.full(7, np.inf)
    loose[1], tight[3] = 1.0, 4.0
    assert driven(lambda t, q, v: push, limit=loose, seconds=0.5).report is None
    result = driven(lambda t, q, v: push, limit=tight, seconds=0.5)
    assert result.report.code is nbs.Fault.EXTERNAL
    assert "panda_joint4" in str(result.report)


def test_without_a_limit_nobody_observes_and_with_an_observer_samples_have_its_estimate():
    assert tracked(nbs.Guarded(LAW, ROBOT), 5)[-1] is None
    watched = nbs.Guarded(LAW, ROBOT, observer=nbs.MomentumObserver.for_robot(ROBOT, 500.0))
    plant, push = nbs.DynamicsPlant.for_robot(ROBOT), np.array([1.0, -2.0])
    seen = tracked(watched, 100, plant=plant, tau_of=lambda q, tau: tau + push)
    assert np.allclose(seen[-1], push, atol=1e-3)
    assert watched.report is None
    with pytest.raises(nbs.ArgumentError, match="observer has 7 joints"):
        nbs.Guarded(LAW, ROBOT, observer=nbs.MomentumObserver.for_robot(PANDA))


def test_an_arm_that_tells_the_torque_itself_is_believed():
    guarded = nbs.Guarded(LAW, ROBOT, nbs.Guard.for_robot(ROBOT, external_limit=4.0))
    seen = tracked(guarded, 30, spoil=lambda k, s: s._replace(external=[0.0, 4.1 if k >= 10 else 0.0]))
    assert seen[9].tolist() == [0.0, 0.0]
    assert guarded.report.code is nbs.Fault.EXTERNAL
    assert guarded.report.time == pytest.approx(0.012)


@pytest.mark.parametrize(
    ("name", "spoil"),
    [
        ("one jump", lambda k, s: s._replace(q=s.q + 0.5) if k == 50 else s),
        ("one wild velocity", lambda k, s: s._replace(v=s.v + 1e6) if k == 50 else s),
        ("one NaN", lambda k, s: s._replace(q=s.q * np.nan) if k == 50 else s),
        ("one NaN in the clock", lambda k, s: s._replace(t=np.nan) if k == 50 else s),
        ("ten NaN", lambda k, s: s._replace(v=s.v * np.nan) if 50 <= k < 60 else s),
        ("ten lost", lambda k, s: s._replace(fresh=False) if 50 <= k < 60 else s),
        ("every second lost", lambda k, s: s._replace(fresh=k % 2 == 0)),
    ],
)
def test_samples_that_the_guard_refuses_leave_no_trace_in_the_estimate(name, spoil):
    guard = nbs.Guard.for_robot(ROBOT, external_limit=0.1)
    guarded = nbs.Guarded(LAW, ROBOT, guard)
    seen = [x for x in tracked(guarded, 300, spoil) if x is not None]
    assert guarded.report is None
    assert np.abs(seen[60:]).max() < 2e-3  # periods of ten have an error of h²/12·|β̈|
    assert guarded.counters.held > 0


def test_numbers_of_any_size_end_in_a_verdict_and_never_in_an_exception():
    rng = np.random.default_rng(0)
    for size in (1e3, 1e31, 1e99, 1e200, np.inf):
        guarded = nbs.Guarded(LAW, ROBOT, nbs.Guard.for_robot(ROBOT, external_limit=5.0))
        tracked(guarded, 60, lambda k, s, size=size: s._replace(v=size * rng.normal(size=2)) if k > 20 else s)
        assert guarded.report is not None


def test_gravity_that_the_arm_adds_is_counted():
    robot_gravity = nbs.PinocchioDynamics(ROBOT).gravity
    plant = nbs.DynamicsPlant.for_robot(ROBOT)

    class Compensated:
        """Adds G at every tenth of a period, as the computer of an arm does."""

        def step(self, q, v, tau, h):
            for _ in range(10):
                q, v = plant.step(q, v, tau + robot_gravity(q), h / 10)
            return q, v

    guard = nbs.Guard.for_robot(ROBOT, external_limit=0.05, compensated=True)
    guarded = nbs.Guarded(LAW, ROBOT, guard)
    seen = tracked(guarded, 500, plant=Compensated())
    assert guarded.report is None
    assert np.abs(seen).max() < 5e-3  # a tenth of a period of the change of G


def test_known_friction_is_no_push():
    friction = nbs.JointFriction(viscous=[1.0, 1.0], coulomb=[2.0, 1.0], transition=0.05)
    plant = nbs.DynamicsPlant(nbs.PinocchioDynamics(ROBOT), friction=friction)
    law = nbs.NeuralBackstepping.for_robot(ROBOT, friction=friction)
    guard = nbs.Guard.for_robot(ROBOT, external_limit=0.5)
    knows = nbs.Guarded(law, ROBOT, guard, observer=nbs.MomentumObserver.for_robot(ROBOT, friction=friction))
    tracked(knows, 1000, plant=plant)
    assert knows.report is None
    naive = nbs.Guarded(law, ROBOT, guard)
    tracked(naive, 1000, plant=plant)
    assert naive.report.code is nbs.Fault.EXTERNAL


def test_a_begin_forgets():
    guarded = nbs.Guarded(LAW, ROBOT, nbs.Guard.for_robot(ROBOT, external_limit=2.0))
    first = tracked(guarded, 100, tau_of=lambda q, tau: tau + np.array([3.0, 0.0]))
    assert guarded.report.code is nbs.Fault.EXTERNAL
    again = tracked(guarded, 100)
    assert guarded.report is None
    assert not np.any(again[0])
    assert np.any(first[5])


def test_the_command_takes_a_limit(tmp_path, capsys):
    asked = ["run", "two_link", "--duration", "0.3", "--force", "--out", tmp_path]
    printed_by(*asked, "--external-limit", "50")
    assert summary(tmp_path)["figures"]["stopped"] is None
    assert cli.main([*map(str, asked), "--external-limit", "1e-9"]) == 4
    assert "a torque from outside is beyond its bound (joint" in capsys.readouterr().out
    assert summary(tmp_path)["figures"]["stopped"]["code"] == "EXTERNAL"
