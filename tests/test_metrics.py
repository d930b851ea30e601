"""Figures of merit on runs whose figures are known in closed form."""

import json

import numpy as np
import pytest

from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.records import Run
from nbs_pin.simulation import metrics

PERIOD = 0.01


def make_run(z1, tau=None, q_ref=None, continuous=(False, False), limit=(np.inf, np.inf), command=None):
    """A run with the error z1 (rows, ..., 2) and the torque tau."""
    tau = np.zeros(z1.shape) if tau is None else tau
    q_ref = np.zeros(z1.shape) if q_ref is None else q_ref
    zero = np.zeros(z1.shape)
    return Run(
        t=PERIOD * np.arange(float(len(z1))),
        q=q_ref + z1,
        v=zero,
        tau=tau,
        tau_command=tau if command is None else command,
        disturbance=zero,
        q_ref=q_ref,
        v_ref=zero,
        a_ref=zero,
        effort_limit=np.array(limit),
        continuous=np.array(continuous),
        joint_names=("a", "b"),
        period=PERIOD,
    )


def decay(rate=1.0, start=1.0, rows=1001):
    t = PERIOD * np.arange(float(rows))
    return np.stack((start * np.exp(-rate * t), np.zeros(rows)), axis=-1)


def test_an_exponential_decay_converges_when_its_square_passes_the_threshold():
    run = make_run(decay())
    assert metrics.convergence_time(run) == pytest.approx(0.5 * np.log(100.0), abs=PERIOD)
    assert metrics.convergence_time(run) >= 0.5 * np.log(100.0)
    assert metrics.convergence_time(run, threshold=1e-4) == pytest.approx(0.5 * np.log(1e4), abs=PERIOD)
    assert metrics.steady_error(run) == pytest.approx(np.exp(-14.0), rel=1e-9)
    assert metrics.steady_error(run, last=1.0) == pytest.approx(1.0)


def test_convergence_is_final():
    z1 = decay()
    z1[900] = 0.2
    assert metrics.convergence_time(make_run(z1)) == pytest.approx(9.01)
    z1[-1] = 0.2
    assert metrics.convergence_time(make_run(z1)) == np.inf
    assert metrics.convergence_time(make_run(0.0 * z1)) == 0.0


def test_the_papers_index_counts_the_references_own_motion():
    """An exact follower of sin 0.1t at 10 ms scores (0.1·0.01)² = 1e-6 with the shifted index and 0 aligned."""
    t = PERIOD * np.arange(10001.0)
    q_ref = np.stack((np.sin(0.1 * t), np.cos(0.1 * t)), axis=-1)
    run = make_run(np.zeros(q_ref.shape), q_ref=q_ref)
    assert metrics.steady_error(run) == 0.0
    assert metrics.steady_error(run, shift=1) == pytest.approx(1e-6, rel=1e-3)


def test_the_error_wraps_on_continuous_joints_alone():
    run = make_run(np.full((5, 2), 2.0 * np.pi + 0.1), continuous=(True, False))
    np.testing.assert_allclose(metrics.error(run)[0], [0.1, 2.0 * np.pi + 0.1])
    np.testing.assert_allclose(metrics.rms_error(run), [0.1, 2.0 * np.pi + 0.1])


def test_rms_error_is_per_joint_and_from_a_time_on():
    t = PERIOD * np.arange(1000.0)
    run = make_run(np.stack((np.sin(2.0 * np.pi * t), 0.3 + 0.0 * t), axis=-1))
    np.testing.assert_allclose(metrics.rms_error(run), [np.sqrt(0.5), 0.3], rtol=1e-12)
    np.testing.assert_allclose(
        metrics.rms_error(make_run(decay()), after=5.0)[0], np.exp(-5.0) / np.sqrt(10.0), rtol=0.01
    )


def test_torque_figures():
    t = PERIOD * np.arange(1001.0)
    tau = np.stack((3.0 * np.sin(2.0 * np.pi * t), -4.0 + 0.0 * t), axis=-1)
    tau[-1] = 1e6  # computed, never applied
    run = make_run(decay(), tau, limit=(2.0, 5.0))
    assert metrics.peak_torque(run) == pytest.approx(4.0)
    np.testing.assert_allclose(metrics.joint_peak_torque(run), [3.0, 4.0])
    assert metrics.rms_torque(run) == pytest.approx(np.sqrt(4.5 + 16.0))
    assert metrics.peak_torque_rate(run) == pytest.approx(6.0 * np.pi, rel=1e-3)
    assert metrics.saturated_fraction(run) == pytest.approx(1.0 - 2.0 / np.pi * np.arcsin(2.0 / 3.0), abs=0.01)


def test_saturation_is_read_from_the_command_and_from_a_time_on():
    command = np.zeros((1001, 2))
    command[:100, 1] = -6.0
    command[500, 0] = 2.0  # at the limit is not beyond it
    run = make_run(decay(), np.clip(command, -2.0, 5.0), command=command, limit=(2.0, 5.0))
    assert metrics.saturated_fraction(run) == pytest.approx(0.1)
    assert metrics.saturated_fraction(run, after=0.5) == pytest.approx(50 / 950)
    assert metrics.saturated_fraction(run, after=1.0) == 0.0


def test_a_period_that_ends_at_the_given_time_does_not_count_whatever_the_rounding_of_times():
    assert any(k * PERIOD > k / 100 for k in range(1000))
    for k in range(1, 1000):
        command = np.zeros((1001, 2))
        command[:k] = 9.0
        run = make_run(decay(), np.clip(command, -2.0, 5.0), command=command, limit=(2.0, 5.0))
        assert metrics.saturated_fraction(run, after=k / 100) == 0.0


def test_a_batch_gives_what_its_starts_give_alone():
    rng = np.random.default_rng(0)
    z1 = np.stack([decay(rate, start) for rate in (0.2, 1.0) for start in (0.5, 1.0, 2.0)], axis=1).reshape(
        1001, 2, 3, 2
    )
    tau, command = rng.normal(size=(2, *z1.shape))
    batch = make_run(z1, tau, command=command, limit=(1.0, 2.0))
    figures = (
        metrics.steady_error,
        metrics.convergence_time,
        metrics.rms_error,
        metrics.peak_torque,
        metrics.joint_peak_torque,
        metrics.rms_torque,
        metrics.peak_torque_rate,
        metrics.saturated_fraction,
    )
    for i, j in np.ndindex(2, 3):
        alone = make_run(z1[:, i, j], tau[:, i, j], command=command[:, i, j], limit=(1.0, 2.0))
        for figure in figures:
            np.testing.assert_allclose(figure(batch)[i, j], figure(alone), rtol=1e-12, err_msg=figure.__name__)
    assert np.isinf(metrics.convergence_time(batch)[0, 2])


def test_the_summary_is_json_and_says_none_for_what_never_happens():
    run = make_run(np.ones((101, 3, 2)))
    figures = json.loads(json.dumps(metrics.summary(run), allow_nan=False))
    assert figures["convergence_time_s"] == [None, None, None]
    assert figures["effort_limit_Nm"] == [None, None]
    assert np.shape(figures["rms_error_rad"]) == (3, 2)
    assert figures["joints"] == ["a", "b"]
    assert figures["late_after_s"] == 0.5
    single = metrics.summary(make_run(decay()))
    assert isinstance(single["steady_error_rad2"], float)
    assert single["late_after_s"] == 1.0


def test_questions_outside_the_run_are_refused():
    run = make_run(decay(rows=11))
    for ask in (
        lambda: metrics.steady_error(run, last=0.0),
        lambda: metrics.steady_error(run, last=1.1),
        lambda: metrics.steady_error(run, shift=-1),
        lambda: metrics.steady_error(run, shift=11),
        lambda: metrics.rms_error(run, after=0.1),
        lambda: metrics.saturated_fraction(run, after=-0.1),
    ):
        with pytest.raises(ArgumentError):
            ask()
