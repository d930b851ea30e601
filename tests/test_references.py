"""Desired motions: v and a are the derivatives of q, files are read whole or refused with the place of the fault."""

import re

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from nbs_pin.base.exceptions import ArgumentError, FileFormatError
from nbs_pin.base.npz import write_npz
from nbs_pin.motions.disturbances import ConstantTorque, SinusoidalTorque, SquareWave, TorqueNoise
from nbs_pin.motions.reference_files import Sampled, load_reference
from nbs_pin.motions.references import Hold, MinimumJerk, Sinusoid, check_reference, paper_reference, resting_posture
from nbs_pin.robots.catalogue import ROBOT_NAMES, find
from nbs_pin.robots.robot import load_robot

T = np.linspace(0.0, 2.0, 21)
JOINTS = ("shoulder", "elbow")
numbers = st.floats(-3.0, 3.0)


def wave(t):
    return np.stack((np.sin(t), np.cos(2.0 * t)), axis=-1)


def with_rest(q, t=T):
    """The motion scaled in time so that it starts and ends at rest."""
    s = t / t[-1]
    return q(t[-1] * s**3 * (10.0 - 15.0 * s + 6.0 * s**2))


REFERENCES = {
    "sinusoid": Sinusoid([0.5, -1.0], [2.0, 3.0], [0.1, 0.2], 0.3),
    "paper": paper_reference(2),
    "hold": Hold([0.4, -0.2]),
    "minimum_jerk": MinimumJerk([[0.0, 1.0], [1.0, -1.0], [0.5, 0.0]], [0.0, 1.2, 2.0]),
    "sampled": Sampled(T, wave(T)),
}


def assert_derivatives(reference, times, h=1e-4, atol=1e-6):
    """Five-point central differences of q and v against v and a."""
    for t in times:
        for low, high in (("q", "v"), ("v", "a")):
            near = [getattr(reference(t + k * h), low) for k in (-2, -1, 1, 2)]
            slope = (near[0] - 8.0 * near[1] + 8.0 * near[2] - near[3]) / (12.0 * h)
            np.testing.assert_allclose(slope, getattr(reference(t), high), rtol=0, atol=atol)


@pytest.mark.parametrize("name", REFERENCES)
def test_v_and_a_are_the_derivatives_of_q(name):
    assert_derivatives(REFERENCES[name], np.random.default_rng(0).uniform(0.01, 1.99, 12))


@settings(max_examples=30, deadline=None)
@given(numbers, numbers, numbers, numbers, st.floats(0.0, 10.0))
def test_every_sinusoid_has_its_derivatives(amplitude, frequency, phase, offset, t):
    reference = Sinusoid(amplitude, [frequency, 1.0], phase, offset)
    assert_derivatives(reference, [t])
    assert reference(0.0).q[0] == pytest.approx(offset + amplitude * np.sin(phase))


@settings(max_examples=30, deadline=None)
@given(
    st.lists(st.tuples(numbers, numbers), min_size=2, max_size=5),
    st.lists(st.floats(0.3, 2.0), min_size=5, max_size=5),
    st.floats(0.0, 1.0),
)
def test_minimum_jerk_rests_at_every_waypoint(waypoints, gaps, fraction):
    times = np.cumsum(gaps[: len(waypoints)])
    reference = MinimumJerk(waypoints, times)
    at = reference(times)
    np.testing.assert_allclose(at.q, waypoints, atol=1e-12)
    np.testing.assert_allclose((at.v, at.a), 0.0, atol=1e-9)
    t = times[0] + fraction * (times[1] - times[0])
    assert_derivatives(reference, [np.clip(t, times[0] + 1e-3, times[1] - 1e-3)], atol=1e-5)
    speed = np.abs(np.subtract(waypoints[1], waypoints[0])) / gaps[1]
    assert (np.abs(reference(t).v) <= 1.875 * speed + 1e-12).all()


@pytest.mark.parametrize("name", REFERENCES)
def test_an_array_of_times_gives_the_stack_of_single_times(name):
    reference = REFERENCES[name]
    grid = np.linspace(-0.5, 2.5, 6).reshape(2, 3)
    stacked = reference(grid)
    for part, alone in zip(stacked, reference(float(grid[1, 2])), strict=True):
        assert part.shape == (2, 3, 2)
        assert alone.shape == (2,)
        np.testing.assert_allclose(part[1, 2], alone, rtol=0, atol=1e-15)


@pytest.mark.parametrize("name", ["hold", "minimum_jerk", "sampled"])
@pytest.mark.parametrize(("outside", "end"), [(-1.0, 0.0), (400.0, 2.0)])
def test_beyond_its_ends_a_motion_is_held(name, outside, end):
    reference = REFERENCES[name]
    q, v, a = reference(outside)
    np.testing.assert_array_equal(q, reference(end).q)
    np.testing.assert_array_equal((v, a), 0.0)


def test_the_papers_reference_alternates_sine_and_cosine():
    q, v, _ = paper_reference(3)(5.0)
    np.testing.assert_allclose(q, [np.sin(0.5), np.cos(0.5), np.sin(0.5)], rtol=1e-12)
    np.testing.assert_allclose(v, [0.1 * np.cos(0.5), -0.1 * np.sin(0.5), 0.1 * np.cos(0.5)], rtol=1e-12)


def test_the_spline_passes_through_its_samples_and_follows_between_to_fourth_order():
    def worst(step):
        t = np.arange(0.0, 2.0 + 0.5 * step, step)
        reference, between = Sampled(t, wave(t)), np.linspace(0.5, 1.5, 97)
        np.testing.assert_allclose(reference(t).q, wave(t), rtol=0, atol=1e-14)
        return np.abs(reference(between).q - wave(between)).max()

    assert np.log2(worst(0.1) / worst(0.05)) > 3.5


@pytest.mark.parametrize(
    "make",
    [
        lambda: Sinusoid([1.0, 2.0], [1.0, 2.0, 3.0]),
        lambda: Sinusoid(np.nan, 1.0),
        lambda: Sinusoid([[1.0]], 1.0),
        lambda: Hold([np.inf]),
        lambda: Hold([]),
        lambda: paper_reference(0),
        lambda: MinimumJerk([[0.0], [1.0]], [0.0, 0.0]),
        lambda: MinimumJerk([[0.0], [1.0]], [0.0, 1.0, 2.0]),
        lambda: MinimumJerk([[0.0], [np.nan]], [0.0, 1.0]),
        lambda: MinimumJerk([[0.0]], [0.0]),
        lambda: Sampled(T[:3], wave(T[:3])),
        lambda: Sampled(T[::-1].copy(), wave(T)),
        lambda: Sampled([0.0, 1.0], [[0.0], [1.0, 2.0]]),
        lambda: Sampled(T, 1.0),
        lambda: Sampled("abcd", wave(T[:4])),
        lambda: Hold("up"),
        lambda: Hold([1.0, [2.0, 3.0]]),
        lambda: MinimumJerk([[0.0], [1.0, 2.0]], [0.0, 1.0]),
        lambda: ConstantTorque(None),
        lambda: SinusoidalTorque([1.0, 2.0], [1.0, 2.0, 3.0]),
    ],
)
def test_motions_that_make_no_sense_are_refused(make):
    with pytest.raises(ArgumentError):
        make()


def test_lists_are_samples_too():
    np.testing.assert_array_equal(Sampled(T.tolist(), wave(T).tolist())(0.77), REFERENCES["sampled"](0.77))


def test_numbers_alone_move_one_joint():
    assert Sinusoid(0.5, 1.0)(0.0).q.shape == Hold(0.0)(0.0).q.shape == (1,)
    assert Sinusoid([0.5, 0.1], 1.0)(0.0).q.shape == (2,)


@pytest.mark.parametrize("batch", [(), (4,), (3, 1)])
@pytest.mark.parametrize("size", [2, 3])
@pytest.mark.parametrize("kind", [ConstantTorque, lambda x: SinusoidalTorque(x, 1.0), lambda x: SquareWave(1.0, x),
                                  lambda x: TorqueNoise(x, 0.01)])  # fmt: skip
def test_a_disturbance_for_another_arm_is_refused(kind, size, batch):
    q = np.zeros((*batch, 6))
    with pytest.raises(ArgumentError, match=f"{size} torques for 6 joints"):
        kind([1.0] * size)(0.1, q, q)
    for torque in (1.0, [1.0], [1.0] * 6):
        assert kind(torque)(0.1, q, q).shape == q.shape


@pytest.mark.parametrize("name", ROBOT_NAMES)
def test_the_resting_posture_is_in_the_middle_half_of_the_range(name):
    robot = load_robot(name)
    lower, upper = robot.sampling_range
    assert (np.abs(resting_posture(robot) - 0.5 * (lower + upper)) <= 0.25 * (upper - lower) + 1e-12).all()


def test_the_resting_posture_of_a_range_beyond_a_turn_is_its_middle(tmp_path):
    text = re.sub(r'lower="[^"]*" upper="[^"]*"', 'lower="3.5" upper="6"', find("two_link").path.read_text())
    (tmp_path / "far.urdf").write_text(text)
    robot = load_robot(tmp_path / "far.urdf", gravity=0.0)
    np.testing.assert_array_equal(resting_posture(robot), [4.75, 4.75])
    check_reference(Sinusoid.for_robot(robot), robot, 7.0)


def write_csv(path, header, rows):
    path.write_text("\n".join([header, *(",".join(map(str, row)) for row in rows)]) + "\n")
    return path


def table(t=T):
    return [list(row) for row in np.column_stack((t, wave(t)))]


def test_csv_and_npz_give_the_motion_in_the_arms_order(tmp_path):
    q = with_rest(wave)
    expected, rows = Sampled(T, q)(0.77), np.column_stack((T, q)).tolist()
    csv = write_csv(tmp_path / "a.csv", "t,elbow,shoulder", [[t, b, a] for t, a, b in rows])
    plain = write_csv(tmp_path / "b.csv", "t, q1, q2", rows)
    write_npz(tmp_path / "c.npz", {"t": T, "q": q[:, ::-1], "joint_names": np.array(["elbow", "shoulder"])})
    write_npz(tmp_path / "d.npz", {"t": T, "q": q})
    for path in (csv, plain, tmp_path / "c.npz", tmp_path / "d.npz"):
        np.testing.assert_allclose(load_reference(path, JOINTS)(0.77), expected, rtol=0, atol=1e-15)


def changed(row, column, value):
    rows = table()
    rows[row][column] = value
    return rows


@pytest.mark.parametrize(
    ("header", "rows", "reason"),
    [
        ("t,q1,q2", changed(16, 2, "nan"), "row 17, column elbow: nan"),
        ("t,q1,q2", changed(16, 2, "inf"), "row 17, column elbow: inf"),
        ("t,q1,q2", changed(4, 1, "abc"), "row 5, column q1: 'abc'"),
        ("t,q1,q2", changed(4, 1, "1_0"), "row 5, column q1: '1_0'"),
        ("t,q1,q2", changed(4, 1, "٣"), "row 5, column q1"),
        ("t,q1,q2", changed(4, 1, ""), "row 5, column q1"),
        ("t,q1,q2", changed(4, 1, "1,5"), "row 5 has 4 values, expected 3"),
        ("t,q1,q2", [*table(), [3.0]], "row 22 has 1 values, expected 3"),
        ("t,q1,q2", changed(8, 0, 0.1), "row 9"),
        ("t,q1,q2", changed(8, 0, T[7]), "time must increase"),
        ("t,q1,q2", table()[:3], "at least 4"),
        ("t,q1,q2", [], "at least 4"),
        ("t,q1", [row[:2] for row in table()], "1 joints .* expected 2"),
        ("t,shoulder,wrist", table(), "no joint is named wrist"),
        ("t,q1,q1", table(), "header"),
        ("time,q1,q2", table(), "header"),
        ("0.0,0.1,0.2", table(), "header"),
    ],
)
def test_faults_in_a_csv_are_refused_with_their_place(tmp_path, header, rows, reason):
    path = write_csv(tmp_path / "motion.csv", header, rows)
    with pytest.raises(FileFormatError, match=f"motion.csv: .*{reason}"):
        load_reference(path, JOINTS)


@pytest.mark.parametrize("content", [b"", b"\x00\xff\xfe", b'{"t": 1}', b't,"q1\n'])
@pytest.mark.parametrize("suffix", [".csv", ".npz", ".txt"])
def test_other_files_are_refused(tmp_path, content, suffix):
    path = tmp_path / f"motion{suffix}"
    path.write_bytes(content)
    with pytest.raises(FileFormatError, match="motion"):
        load_reference(path, JOINTS)


@pytest.mark.parametrize(
    ("arrays", "reason"),
    [
        ({"t": T}, "no 'q'"),
        ({"t": T, "q": T}, r"shape \(21,\)"),
        ({"t": T[1:], "q": wave(T)}, "one time per row"),
        ({"t": T, "q": wave(T).astype(int)}, "expected real numbers"),
        ({"t": T, "q": wave(T), "joint_names": np.array(["a"])}, "1 joint_names for 2"),
        ({"t": T, "q": wave(T), "joint_names": np.array(["a", "b"])}, "no joint is named a, b"),
        ({"t": T, "q": np.where(wave(T) > 0.9, np.nan, wave(T))}, "not a finite number"),
    ],
)
def test_faults_in_an_npz_are_refused(tmp_path, arrays, reason):
    write_npz(tmp_path / "motion.npz", arrays)
    with pytest.raises(FileFormatError, match=reason):
        load_reference(tmp_path / "motion.npz", JOINTS)


def ramp(t):
    return np.stack((2.0 * np.abs(t - 1.0), 0.0 * t), axis=-1)


@pytest.mark.parametrize(
    ("q", "reason"),
    [
        (lambda t: 0.5 * np.c_[t, (2.0 - t) ** 2], "velocity jump 2 .* of elbow at t = 0 s, where the motion starts"),
        (lambda t: 1.5 * np.c_[t**2, t], "velocity jump 6 rad/s of shoulder at t = 2 s, where the motion ends"),
        (lambda t: ramp(with_rest(lambda s: s, t)), r"velocity jump .* of shoulder at t = 1 s \(row 11\); smooth"),
        (ramp, r"velocity jump 4 rad/s of shoulder at t = 1 s \(row 11\); smooth"),
        (lambda t: with_rest(wave, t) + 0.5 * (np.arange(21) == 7)[:, None], "velocity jump .* at t = 0.7"),
        (lambda t: with_rest(wave, t) + 0.5 * (np.arange(21) > 11)[:, None], r"velocity jump .* at t = 1\.[12]"),
    ],
)
def test_velocity_jumps_in_a_file_are_refused_with_their_place(tmp_path, q, reason):
    write_npz(tmp_path / "motion.npz", {"t": T, "q": q(T)})
    with pytest.raises(FileFormatError, match=reason):
        load_reference(tmp_path / "motion.npz", JOINTS)


@pytest.mark.parametrize("rows", [6, 8, 12, 21, 200, 2000])
@pytest.mark.parametrize("duration", [0.1, 0.5, 2.0])
def test_a_smooth_motion_is_none_however_fast_and_coarse(tmp_path, rows, duration):
    """From rest to rest, with a rest of the same length at either side, 2 rad apart."""
    t = np.linspace(0.0, 3.0 * duration, 3 * rows)
    q = MinimumJerk([[0.0, 0.0], [2.0, -1.0]], [duration, 2.0 * duration])(t)
    write_npz(tmp_path / "motion.npz", {"t": t, "q": q.q})
    assert load_reference(tmp_path / "motion.npz", JOINTS).duration == t[-1]


def test_a_stated_velocity_must_be_that_of_the_motion(tmp_path):
    q = with_rest(wave)
    exact = Sampled(T, q)(T).v
    for stated in (exact, exact + 0.05):
        write_npz(tmp_path / "motion.npz", {"t": T, "q": q, "v": stated})
        load_reference(tmp_path / "motion.npz", JOINTS)
    for stated, reason in (
        (np.degrees(exact), "v of shoulder: .* rad/s, but q changes by"),
        (np.where(T[:, None] == T[9], np.nan, exact), "row 10, v of shoulder: nan"),
        (exact[1:], "'v' has shape"),
    ):
        write_npz(tmp_path / "motion.npz", {"t": T, "q": q, "v": stated})
        with pytest.raises(FileFormatError, match=reason):
            load_reference(tmp_path / "motion.npz", JOINTS)


@pytest.mark.parametrize("suffix", ["csv", "npz"])
def test_a_missing_file_is_not_found(tmp_path, suffix):
    with pytest.raises(FileNotFoundError):
        load_reference(tmp_path / f"none.{suffix}", JOINTS)


def test_a_motion_beyond_the_arms_limits_is_refused_with_joint_and_time():
    robot = load_robot("panda")
    q = 0.5 * (robot.lower + robot.upper)
    check_reference(Sinusoid(0.1 * np.ones(7), 1.0, 0.0, q), robot, 3.0)
    with pytest.raises(ArgumentError, match=r"position 2\.89817 rad of joint 'panda_joint3' at t = .* outside \[-2.89"):
        check_reference(Sinusoid([0, 0, 3.0, 0, 0, 0, 0], 1.0, 0.0, q), robot, 3.0)
    with pytest.raises(ArgumentError, match=r"velocity .* 'panda_joint1' at t = 0 s.* slow it down"):
        check_reference(Sinusoid([0.1, 0, 0, 0, 0, 0, 0], 100.0, 0.0, q), robot, 3.0)
    with pytest.raises(ArgumentError, match=r"torque .* N·m of joint 'panda_joint"):
        check_reference(Sinusoid([0.05, 0, 0, 0, 0, 0, 0], 43.0, 0.0, q), robot, 3.0)
    check_reference(Sinusoid([0.05, 0, 0, 0, 0, 0, 0], 43.0, 0.0, q), robot.with_effort_limit(np.inf), 3.0)
    with pytest.raises(ArgumentError, match="are these degrees"):
        check_reference(Hold(np.full(7, 45.0)), robot, 3.0)
    with pytest.raises(ArgumentError, match="2 joints, the arm has 7"):
        check_reference(paper_reference(2), robot, 3.0)
    with pytest.raises(ArgumentError, match="duration"):
        check_reference(Hold(q), robot, -1.0)


def test_any_callable_is_a_reference_and_what_it_lacks_is_said():
    robot = load_robot("two_link")
    still = np.zeros((2001, 2))
    check_reference(lambda t: (still, still, still), robot, 1.0)
    check_reference(lambda t: (still.tolist(), still.tolist(), still.tolist()), robot, 1.0)
    with pytest.raises(ArgumentError, match=r"gave v of shape \(2,\), expected \(2001, 2\); let it take arrays"):
        check_reference(lambda t: (still, np.zeros(2), still), robot, 1.0)
    with pytest.raises(ArgumentError, match="3 joints, the arm has 2"):
        check_reference(lambda t: (still, still, np.zeros((2001, 3))), robot, 1.0)
    with pytest.raises(ArgumentError, match="the reference's q is 'up', with text"):
        check_reference(lambda t: ("up", still, still), robot, 1.0)


@pytest.mark.parametrize("name", ROBOT_NAMES)
def test_the_motion_made_for_an_arm_is_one_it_can_follow(name):
    robot = load_robot(name)
    reference = Sinusoid.for_robot(robot)
    check_reference(reference, robot, 7.0)
    assert (reference.amplitude > 0.0).all()


@pytest.mark.parametrize(
    "motion",
    [
        Sinusoid([0.5, 0.2], [3.0, 20.0], phase=0.3),
        Hold([0.1, 0.2]),
        MinimumJerk([[0.0, 1.0], [0.4, 0.0], [0.1, 0.3]], [0.0, 0.3, 1.0]),
        Sampled(np.linspace(0.0, 1.0, 40), np.sin(np.linspace(0.0, 6.0, 80)).reshape(40, 2)),
    ],
)
def test_accelerations_change_no_faster_than_a_motion_states(motion):
    t = np.linspace(0.0, 1.0, 20001)
    rates = np.abs(np.diff(motion(t).a, axis=0)) / np.diff(t)[:, None]
    assert (rates <= motion.largest_jerk * (1.0 + 1e-6) + 1e-6).all()
    assert (rates.max(axis=0) >= 0.98 * motion.largest_jerk - 1e-6).all()


def test_samples_that_begin_late_state_no_jerk():
    """The motion is held before them, and jumps when they begin."""
    t, q = np.linspace(0.5, 1.0, 20), np.sin(np.linspace(0.0, 3.0, 20))[:, None]
    assert np.isinf(Sampled(t, q).largest_jerk).all()
    assert np.isfinite(Sampled(t - 0.5, q).largest_jerk).all()
