"""The monitor with encoders: what readings can tell of torques, no false alarm, and every fault by its name."""

import importlib.util
import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import nbs_pin as nbs
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.records import Reference
from nbs_pin.certificates.claims import Assumption
from nbs_pin.certificates.encoders import Encoders, Limits
from nbs_pin.certificates.loop_model import CompiledModel, LoopModel, PlainModel
from nbs_pin.certificates.window_watch import UNEXPLAINED, WindowWatch
from nbs_pin.identification.measurement import quantised
from nbs_pin.kernels import verdicts, watching as at
from nbs_pin.motions.disturbances import SinusoidalTorque

PATH = Path(__file__).parent.parent / "tools" / "monitor_campaign.py"
BITS = 16


@cache
def campaign():
    spec = importlib.util.spec_from_file_location("monitor_campaign", PATH)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@cache
def loop_of(name, seed=1):
    """An honest loop and its run."""
    certificate, loop = campaign().honest(name, seed, BITS, is_moving=True)
    return certificate, loop.run()


def samples_of(run, rows):
    fields = (run.q, run.v, run.q_ref, run.v_ref, run.a_ref, run.tau, run.tau_command)
    return np.ascontiguousarray(np.stack([x[rows] for x in fields], axis=1))


def window_of(way, run, half):
    """Signals of the first window, and their means."""
    signals = [way.model.observe(samples_of(run, slice(k, k + 3)), run.period) for k in range(2 * half - 1 + at.LAGS)]
    history, n = np.array(signals), run.nv
    mean, more = np.empty((at.SIGNALS, n)), np.empty((at.MORE, n))
    at.average(history, half, mean, more)
    return history, mean, more


@pytest.mark.parametrize("half", [1, 2, 17])
def test_the_mean_is_that_of_a_hat_and_delays_shift_it(half):
    rng = np.random.default_rng(half)
    history, n = rng.normal(size=(2 * half - 1 + at.LAGS, at.SIGNALS, 3)), 3
    hat = (half - np.abs(np.arange(1 - half, half))) / half**2
    assert hat.sum() == pytest.approx(1.0)
    mean, more, late = np.empty((at.SIGNALS, n)), np.empty((at.MORE, n)), np.empty(n)
    at.average(history, half, mean, more)
    assert mean == pytest.approx(np.tensordot(hat, history[at.LAGS :], 1))
    for lag in range(at.LAGS + 1):
        at.earlier(history, half, lag, late)
        window = history[at.LAGS - lag : len(history) - lag, at.TORQUE]
        assert late == pytest.approx(hat @ window)
    steps = np.abs(np.diff(history[at.LAGS - 1 :, at.TORQUE], axis=0))
    assert more[at.SPREAD] == pytest.approx(steps.max(axis=0))
    assert more[at.FROZEN].all() == (half == 1)  # a single reading is equal to itself
    speed = history[at.LAGS :, at.SPEED]
    assert more[at.VARIED] == pytest.approx((speed[half:].sum(axis=0) - speed[: half - 1].sum(axis=0)) / half)


def test_errors_are_over_their_bounds_where_the_readings_cannot_account_for_it():
    rng, errors, bounds = np.random.default_rng(0), np.empty(4), np.empty(4)
    counts = set()
    for _ in range(100):
        z1, start, reach = rng.normal(size=3), 2.0 * rng.uniform(size=4), 0.1 * rng.uniform(size=4)
        found = verdicts.judge_errors(z1, reach, start, 0.7, errors, bounds)
        assert errors == pytest.approx([np.linalg.norm(z1), *np.abs(z1)])
        assert bounds == pytest.approx(0.7 * start)
        assert found == np.count_nonzero(errors - reach > bounds)
        counts.add(found)
    assert counts == {0, 1, 2, 3, 4}


@pytest.mark.parametrize("name", ["two_link", "panda"])
@pytest.mark.parametrize("half", [4, 40])
def test_the_mean_unexplained_torque_is_the_mean_disturbance(name, half):
    """Second differences of exact positions are exact means of the acceleration: no error of first order remains."""
    robot = nbs.load_robot(name)
    law, reference = nbs.NeuralBackstepping.for_robot(robot), nbs.Sinusoid.for_robot(robot, 2.0)
    wave, start = SinusoidalTorque(np.full(robot.nv, 2.0), 9.0), reference(np.zeros(1))
    plant = nbs.DynamicsPlant(nbs.PinocchioDynamics(robot), integrator="rk4")
    run = nbs.simulate(plant, law, reference, 0.12, 0.001, q0=start.q[0] + 0.1, disturbance=wave)
    way = WindowWatch(nbs.certify(law, np.full(robot.nv, 2.0)), Encoders(0.0))
    history, mean, _ = window_of(way, run, half)
    rows = np.arange(at.LAGS + 1, len(history) + 1)
    torque = np.array([wave(run.t[k], run.q[k], run.v[k]) for k in range(len(run.t))])
    around = 0.5 * (torque[rows] + torque[rows - 1])
    hat = (half - np.abs(np.arange(1 - half, half))) / half**2
    assert np.abs(mean[at.U] - hat @ around).max() < 0.02


@pytest.mark.parametrize("name", ["two_link", "ur5", "panda", "kinova"])
@pytest.mark.parametrize("bits", [12, 16, 20])
def test_rounding_moves_the_mean_torque_by_no_more_than_its_bound(name, bits):
    """|ΔU| ≤ |M| r (2/(mh)² + r/h²), for rounding to any grid."""
    certificate, run = loop_of(name)
    prismatic, half, h = certificate.robot.prismatic, 40, run.period
    rng, encoders = np.random.default_rng(bits), Encoders.of_bits(bits)
    smooth = replace(run, q=run.q_ref + 0.02 * np.sin(9.0 * run.t)[:, None])
    way = WindowWatch(certificate, encoders)
    _, exact, _ = window_of(way, smooth, half)
    worst = 0.0
    for _ in range(5):
        shift = rng.uniform(0.0, 1.0, run.nv) * way.resolution
        rounded = replace(smooth, q=quantised(smooth.q - shift, encoders.step, prismatic) + shift)
        history, mean, _ = window_of(way, rounded, half)
        q = history[at.LAGS + half - 1, at.READING]
        _, share = way.model.centre(mean, q, way.resolution, half * h)
        assert share == pytest.approx(np.abs(certificate.controller.dynamics.mass_matrix(q)) @ way.resolution)
        allowed = share * (2.0 / (half * h) ** 2 + way.resolution / h**2)
        worst = max(worst, float((np.abs(mean[at.U] - exact[at.U]) / allowed).max()))
    assert 0.02 < worst < 1.0


@pytest.mark.parametrize("bits", [16, 20])
def test_v_of_the_means_is_no_more_than_v_was(bits):
    """Jensen: V is convex, so V at the means of z1 and z2 is no more than the largest V in the window."""
    certificate, run = loop_of("ur5")
    law, encoders, half = certificate.controller, Encoders.of_bits(bits), 20
    true = replace(run, q=run.q_ref + 0.02 * np.sin(9.0 * run.t)[:, None])
    v = run.v_ref + 0.18 * np.cos(9.0 * run.t)[:, None]
    way = WindowWatch(certificate, encoders)
    read = replace(true, q=quantised(true.q, encoders.step, certificate.robot.prismatic))
    history, mean, _ = window_of(way, read, half)
    q = history[at.LAGS + half - 1, at.READING]
    (phi, phi_slack, kinetic, slack), _ = way.model.centre(mean, q, way.resolution, half * run.period)
    largest = law.storage(true.q, v, true.q_ref, true.v_ref)[: len(history) + 2].max()
    least = max(phi - phi_slack, 0.0) + max(math.sqrt(kinetic) - math.sqrt(slack), 0.0) ** 2
    assert 0.1 * largest < least <= largest


def test_machine_code_is_the_law_as_it_is_written():
    certificate, run = loop_of("panda")
    law = certificate.controller
    quick, plain = CompiledModel(law), PlainModel(law)
    assert isinstance(LoopModel.of(law), CompiledModel)
    assert isinstance(LoopModel.of(nbs.SlotineLi.for_robot(certificate.robot)), PlainModel)
    resolution = Encoders.of_bits(16).resolution(certificate)
    for k in (0, 300, 800):
        three = samples_of(run, slice(k, k + 3))
        assert quick.observe(three, run.period) == pytest.approx(plain.observe(three, run.period), rel=1e-9, abs=1e-7)
        mean = plain.observe(three, run.period)
        ours, theirs = (x.centre(mean, run.q[k], resolution, 0.05) for x in (quick, plain))
        assert ours[0] == pytest.approx(theirs[0], rel=1e-9)
        assert ours[1] == pytest.approx(theirs[1], rel=1e-9)
        value = plain.storage(three[0])
        assert quick.storage(three[0]) == pytest.approx(value, rel=1e-9)
        ours, theirs = (x.period(three[0], three[1], run.period, value) for x in (quick, plain))
        assert ours[0] == pytest.approx(theirs[0], rel=1e-8, abs=1e-7)
        assert ours[1] == pytest.approx(theirs[1], rel=1e-8, abs=1e-7)


@pytest.mark.parametrize("friction", [None, "fed"])
def test_a_law_without_kernels_is_watched_in_the_same_way(friction):
    robot = nbs.load_robot("two_link")
    given = None if friction is None else nbs.JointFriction([0.4, 0.2], [0.3, 0.2], 0.05)
    law = nbs.SlotineLi.for_robot(robot, friction=given)
    reference = nbs.Sinusoid.for_robot(robot)
    plant = nbs.DynamicsPlant(nbs.PinocchioDynamics(robot), friction=given)
    run = nbs.simulate(plant, law, reference, 0.4, 0.001)
    certificate = nbs.certify(law, [0.5, 0.5], friction=given)
    read = replace(run, q=quantised(run.q, 2.0**-16, robot.prismatic))
    assert nbs.monitor(read, certificate, encoders=Encoders.of_bits(16)).verdict == "promise kept"
    seen = nbs.monitor(
        replace(read, tau=0.5 * run.tau, tau_command=0.5 * run.tau), certificate, encoders=Encoders(2.0**-16)
    )
    assert {Assumption.MODEL, Assumption.TIME} <= set(seen.broken)


@pytest.mark.parametrize("seed", range(8))
def test_honest_arms_raise_no_alarm(seed):
    tool = campaign()
    certificate, loop = tool.honest(tool.ARMS[seed % 4], seed, BITS)
    said = tool.watched(certificate, loop.run(), BITS)
    assert tool.alarm(said) is None
    assert np.isfinite([one.storage for one in said[400:]]).all()


@pytest.mark.parametrize("fault", sorted(campaign().FAULTS))
def test_every_fault_is_named_in_time_and_the_certificate_never_blamed(fault):
    tool = campaign()
    k = sorted(tool.FAULTS).index(fault)
    certificate, loop = tool.faulty(fault, tool.ARMS[k % 4], 5, BITS)
    run = loop.run()
    said = tool.watched(certificate, run, BITS)
    assert tool.alarm(said) * tool.PERIOD >= loop.begins - 1.5 * tool.PERIOD
    assert tool.naming(fault, said) * tool.PERIOD - loop.begins <= tool.SOON
    assert not tool.blames_certificate(said)
    seen = nbs.monitor(run, certificate, encoders=Encoders.of_bits(BITS))
    assert not seen.is_wrong
    assert [bool(one.excesses) for one in said] == seen.exceeded.tolist()
    if any(one.broken for one in said):
        assert set(seen.broken) == set(said[-1].broken)


def test_a_wrong_sign_is_recognised():
    tool = campaign()
    certificate, loop = tool.faulty("wrong sign", "ur5", 1, BITS)
    seen = nbs.monitor(loop.run(), certificate, encoders=Encoders.of_bits(BITS))
    assert "shoulder_lift_joint with the wrong sign" in seen.verdict
    assert f"{Assumption.MODEL}, or {Assumption.MEASUREMENT}" in seen.verdict


def test_the_watch_recovers_from_a_reading_that_is_no_number_and_sees_the_next_fault():
    certificate, run = loop_of("two_link")
    spoiled, late = run.q.copy(), run.q.copy()
    spoiled[300, 0] = np.nan
    late[300, 0], late[800:, 1] = np.nan, late[800:, 1] + 0.1
    said = campaign().watched(certificate, replace(run, q=spoiled), BITS)
    assert [k for k, one in enumerate(said) if not one.is_kept] == [300]
    assert said[-1].verdict.startswith("promise kept")
    said = campaign().watched(certificate, replace(run, q=late), BITS)
    assert Assumption.MEASUREMENT in said[-1].broken
    seen = nbs.monitor(replace(run, q=spoiled), certificate, encoders=Encoders.of_bits(BITS))
    assert seen.exceeded.nonzero()[0].tolist() == [300]
    assert "q of joint1, which is not finite" in seen.verdict
    assert seen.broken == ()


def test_a_missing_instant_begins_a_new_window():
    certificate, run = loop_of("two_link")
    kept = np.delete(np.arange(len(run.t)), [400, 401])
    fields = ("t", "q", "v", "tau", "tau_command", "disturbance", "q_ref", "v_ref", "a_ref")
    seen = nbs.monitor(
        replace(run, **{name: getattr(run, name)[kept] for name in fields}), certificate, encoders=Encoders(2.0**-16)
    )
    assert seen.is_kept
    assert "V and torques were not compared for 0.165 s" in seen.verdict
    assert seen.broken == ()
    assert np.isnan(seen.storage[401:500]).all()
    assert np.isfinite(seen.storage[-200:]).all()


def test_a_joint_at_its_stop_is_named():
    certificate, run = loop_of("ur5")
    robot = certificate.robot
    way, watch = WindowWatch(certificate, Encoders.of_bits(BITS)), nbs.Watch(certificate)
    at_stop = run.q.copy()
    at_stop[50, 2] = robot.upper[2] - 0.5 * way.resolution[2]
    assert Assumption.STOPS in nbs.monitor(replace(run, q=at_stop), certificate, encoders=way.encoders).broken
    assert Assumption.STOPS not in nbs.monitor(run, certificate, encoders=way.encoders).broken
    at_stop[50, 2] = robot.upper[2]
    assert Assumption.STOPS in nbs.monitor(replace(run, q=at_stop), certificate).broken
    memory = None
    for k in range(52):
        aim = nbs.Reference(run.q_ref[k], run.v_ref[k], run.a_ref[k])
        one, memory = watch.step(memory, float(run.t[k]), at_stop[k], run.v[k], aim, run.tau[k], run.tau_command[k])
    assert Assumption.STOPS in one.broken


@pytest.mark.parametrize("share", [0.9, 1.5])
def test_a_ball_of_torques_is_compared_as_one(share):
    """‖U‖ against the radius; of a box each |U_i|."""
    n, half, h = 3, 10, 0.001
    certificate = nbs.certify(loop_of("two_link")[0].controller, 1.0)
    assert Limits.of(certificate, np.zeros(2)).numbers[verdicts.RADIUS] == 1.0
    limits, numbers = np.zeros((verdicts.LIMITS, n)), np.zeros(verdicts.NUMBERS)
    limits[verdicts.BOX], numbers[verdicts.RADIUS], numbers[verdicts.TRANSITION] = np.inf, 1.0, 1.0
    mean, more, found = np.zeros((at.SIGNALS, n)), np.zeros((at.MORE, n)), np.empty(verdicts.WINDOW)
    mean[at.U] = share * np.array([2.0, -1.0, 2.0]) / 3.0
    history = np.zeros((2 * half - 1 + at.LAGS, at.SIGNALS, n))
    verdicts.judge_window(mean, history, more, np.zeros(n), h, half, np.zeros(n), limits, numbers, found)
    assert bool(found[verdicts.EXCEEDS]) == (share > 1.0)
    assert found[verdicts.RATIO] == pytest.approx(max(1.0, share * 2.0 / 3.0))


def test_the_window_is_as_short_as_the_encoder_allows():
    certificate, _ = loop_of("ur5")
    widths = [Encoders.of_bits(bits).half_width(certificate, 0.001) for bits in (24, 20, 18, 16)]
    assert widths == sorted(widths)
    assert widths[0] < 20
    assert widths[-1] == 80
    assert Encoders(0.0).half_width(certificate, 0.001) == 1


def test_a_false_certificate_is_blamed_if_readings_are_fine_enough():
    """Bounds far below what the noise in the command could have caused."""
    certificate, run = loop_of("two_link")
    small = replace(
        certificate,
        error=1e-4 * certificate.error,
        joint_errors=1e-4 * certificate.joint_errors,
        level=certificate.level._replace(storage=1e-8 * certificate.storage),
        potential=1e-8 * certificate.potential,
    )
    seen = nbs.monitor(run, small, encoders=Encoders.of_bits(BITS))
    assert not seen.is_kept
    assert seen.is_wrong
    assert not nbs.monitor(run, certificate, encoders=Encoders.of_bits(BITS)).is_wrong


def test_what_fails_by_nothing_noticeable_is_named_as_what_it_may_be():
    certificate, run = loop_of("two_link")
    level = certificate.level._replace(storage=0.1 * certificate.storage)
    said = campaign().watched(replace(certificate, level=level, potential=0.1 * certificate.potential), run, BITS)
    exceeding = [one for one in said if one.excesses]
    assert exceeding
    assert all(one.broken == UNEXPLAINED for one in exceeding)


def test_wrong_arguments_are_refused(without_type_checks):
    certificate, run = loop_of("two_link")
    for step in (-0.1, 0.5, math.nan):
        with pytest.raises(ArgumentError, match=r"step is .*; give a finite number"):
            Encoders(step)
    watch, exact = nbs.Watch(certificate, Encoders.of_bits(BITS)), nbs.Watch(certificate)
    aim = nbs.Reference(run.q_ref[0], run.v_ref[0], run.a_ref[0])
    row = (run.q[0], run.v[0], aim, run.tau[0], run.tau_command[0])
    _, memory = watch.step(None, 0.0, *row)
    with pytest.raises(ArgumentError, match="in order"):
        watch.step(memory, 0.0, *row)
    with pytest.raises(ArgumentError, match="another kind"):
        exact.step(memory, 0.001, *row)


@pytest.mark.parametrize("encoders", [None, Encoders.of_bits(16)])
def test_a_sample_of_other_joints_is_refused_at_every_step(encoders):
    certificate, _ = loop_of("two_link")
    watch, rows = nbs.Watch(certificate, encoders), [np.zeros(2)] * 7
    _, memory = watch.step(None, 0.0, rows[0], rows[1], Reference(*rows[2:5]), rows[5], rows[6])
    for kept, t in ((None, 0.0), (memory, 0.001)):
        with pytest.raises(ArgumentError, match="one number per joint"):
            watch.step(kept, t, np.zeros(3), rows[1], Reference(*rows[2:5]), rows[5], rows[6])
