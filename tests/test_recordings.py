"""Files of recorded motions: units of time and angles, where time begins, wraps, outliers, clocks, columns."""

import ast
import gzip
import re
import warnings
from contextlib import contextmanager

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from numpy.testing import assert_allclose, assert_array_equal

import nbs_pin as nbs
from nbs_pin import cli
from nbs_pin.base.csv_files import read_cells, write_csv
from nbs_pin.base.doors import at_the_shell, option
from nbs_pin.base.exceptions import ArgumentError, FileFormatError
from nbs_pin.base.npz import write_npz
from nbs_pin.identification.datasets import trajectory_slices
from nbs_pin.identification.logs import load_log
from nbs_pin.motions.recordings import TIME_UNITS, Joints, in_radians, unwrapped
from nbs_pin.motions.reference_files import load_reference
from nbs_pin.robots.catalogue import find
from nbs_pin.robots.robot import load_robot
from tests.commands import refusal

T = np.linspace(0.0, 4.0, 401)
TWO = load_robot("two_link")


def smooth(t, size=1.0):
    """From rest to rest, angles up to `size` and twice that [rad]."""
    s = np.clip(t / t[-1], 0.0, 1.0)
    s = s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
    return size * np.column_stack((s, -2.0 * np.sin(2.0 * np.pi * s)))


@pytest.fixture(scope="module")
def turning(tmp_path_factory):
    """two_link with joints that turn without limit."""
    text = find("two_link").path.read_text().replace('type="revolute"', 'type="continuous"')
    path = tmp_path_factory.mktemp("arm") / "turning.urdf"
    path.write_text(text)
    robot = load_robot(path)
    assert robot.continuous.all()
    return robot


def torque(q, t=T):
    """What moves two_link so."""
    v = np.gradient(q, t, axis=0)
    return nbs.inverse_dynamics(nbs.PinocchioDynamics(TWO), q, v, np.gradient(v, t, axis=0))


@contextmanager
def noted():
    """The warnings of the block, as a list of texts that is filled at its end."""
    texts = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        yield texts
    texts += [str(warning.message) for warning in caught]


def reference_file(folder, t, q, v=None):
    write_npz(folder / "motion.npz", {"t": t, "q": q} | ({} if v is None else {"v": v}))
    return folder / "motion.npz"


def log_file(folder, t, q, v=None, **more):
    """A log of two trajectories of the same motion."""
    arrays = {"q": q, "tau": torque(q, T if len(q) == len(T) else t)} | ({} if v is None else {"v": v}) | more
    twice = {name: np.concatenate([x, x]) for name, x in arrays.items()}
    stamps = np.concatenate([t, t])
    np.savez(folder / "log.npz", t=stamps, trajectory=np.arange(len(stamps)) // len(t), **twice)
    return folder / "log.npz"


# Time.


@pytest.mark.parametrize("start", [1.695e9, -1.0, 12.5])
def test_time_is_counted_from_the_first_row_which_is_said_once(tmp_path, start):
    q = smooth(T)
    with noted() as none:
        expected = load_reference(reference_file(tmp_path, T, q), TWO)
    with noted() as notes:
        motion = load_reference(reference_file(tmp_path, start + T, q, np.gradient(q, T, axis=0)), TWO)
    assert none == []
    assert len(notes) == 1
    assert f"time is counted from the first row, which is at t = {start:.12g} s" in notes[0]
    assert motion.duration == pytest.approx(4.0, abs=1e-6)
    for seen, wanted in zip(motion(T[1:-1]), expected(T[1:-1]), strict=True):
        assert_allclose(seen, wanted, rtol=1e-5, atol=1e-5)  # seconds since 1970 are rounded to 2e-7
    assert np.abs(motion(2.0).v).max() > 0.5


@pytest.mark.parametrize("unit", ["ms", "us", "ns"])
@pytest.mark.parametrize("stated", [True, False])
@pytest.mark.parametrize("kind", ["reference", "log"])
def test_other_units_of_time_are_named_and_converted_when_given(tmp_path, unit, stated, kind):
    q = smooth(T)
    v = np.gradient(q, T, axis=0) if stated else None
    write, load = (reference_file, load_reference) if kind == "reference" else (log_file, load_log)
    arm = {"robot": TWO}
    plain = load(write(tmp_path, T, q, v), **arm)
    path = write(tmp_path, T / TIME_UNITS[unit], q, v)
    called = {"ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds"}[unit]
    with pytest.raises(FileFormatError, match=f"t looks like {called}.* give time_unit='{unit}'"):
        load(path, **arm)
    converted = load(path, **arm, time_unit=unit)
    assert_allclose(converted.t, plain.t, rtol=1e-12)
    assert_allclose(converted.q, plain.q, rtol=1e-12)


def test_stamps_of_whole_nanoseconds_are_converted(tmp_path):
    stamps = 1_695_000_000_000_000_000 + np.round(1e9 * T).astype(np.int64)
    with noted() as notes:
        motion = load_reference(reference_file(tmp_path, stamps, smooth(T)), TWO, time_unit="ns")
    assert_allclose(motion.t, T, atol=1e-6)
    assert len(notes) == 1
    assert notes[0].endswith(" ns.")


@pytest.mark.parametrize("step", [0.1, 1.0, 10.0])
def test_sparse_rows_are_seconds_if_the_arm_gets_somewhere_and_slow_ones_if_said(tmp_path, step):
    t = step * np.arange(21.0)
    quick, slow = smooth(t, 0.1 * step), smooth(t, 1e-3)
    assert load_reference(reference_file(tmp_path, t, quick), TWO).duration == t[-1]
    path = reference_file(tmp_path, t, slow)
    if step > 0.5:
        with pytest.raises(FileFormatError, match="time_unit='s' if it is that slow"):
            load_reference(path, TWO)
    assert load_reference(path, TWO, time_unit="s").duration == t[-1]


def test_a_unit_that_is_none_is_refused(tmp_path):
    for load, write in ((load_reference, reference_file), (load_log, log_file)):
        with pytest.raises(ArgumentError, match="time_unit is 'min'; give one of s, ms, us, ns"):
            load(write(tmp_path, T, smooth(T)), robot=TWO, time_unit="min")


# Angles.


@settings(max_examples=30, deadline=None)
@given(st.floats(-7.0, 7.0), st.floats(2.0, 12.0), st.integers(0, 99))
def test_unwrapping_undoes_wrapping_but_for_whole_turns(offset, size, seed):
    q = offset + smooth(T, size) + 1e-3 * np.random.default_rng(seed).standard_normal((len(T), 2))
    joints = Joints(("a", "b"), np.ones(2, dtype=bool), np.zeros(2, dtype=bool))
    for low in (-np.pi, 0.0):
        found = unwrapped(low + np.mod(q - low, 2.0 * np.pi), joints, [slice(0, len(T))], None)
        turns = (found.q - q) / (2.0 * np.pi)
        assert not found.fault
        assert_allclose(turns, np.round(turns[:1]) + np.zeros((len(T), 1)), atol=1e-9)


def test_joints_without_limits_are_unwrapped_in_references_and_logs(tmp_path, turning):
    q = smooth(T, 5.0)
    wrapped = np.mod(q + np.pi, 2.0 * np.pi) - np.pi
    with noted() as notes:
        motion = load_reference(reference_file(tmp_path, T, wrapped), turning)
    assert len(notes) == 2
    assert all("it can turn further, so it was unwrapped" in note for note in notes)
    assert_allclose(motion(T).q, q, atol=1e-9)
    for v in (None, np.gradient(q, T, axis=0)):
        with noted() as notes:
            data = load_log(log_file(tmp_path, T, wrapped, v, tau=torque(q)), robot=turning)
        whole = load_log(log_file(tmp_path, T, q, v), robot=turning)
        assert len(notes) == 2
        assert_allclose(data.v, whole.v, atol=1e-9)
        assert_allclose(data.a, whole.a, atol=1e-7)


@pytest.mark.parametrize("stated", [True, False])
def test_wraps_of_joints_with_limits_are_named_and_nothing_is_said_of_v(tmp_path, stated):
    q = smooth(T, 1.6) + np.array([0.0, 0.3])
    v = np.gradient(q, T, axis=0)
    row = int(np.flatnonzero(np.abs(np.diff(np.mod(q[:, 1] + np.pi, 2.0 * np.pi))) > 6.0)[0]) + 1
    wrapped = np.mod(q + np.pi, 2.0 * np.pi) - np.pi
    words = rf"joint2 jumps by -?6\.\d+ rad between rows {row} and {row + 1}: a wrap\? unwrap"
    narrow = load_robot("two_link", limits={"joint2": {"lower": -2.0, "upper": 4.0}})
    for write, load, arm in ((reference_file, load_reference, TWO), (log_file, load_log, narrow)):
        with pytest.raises(FileFormatError, match=words) as caught:
            load(write(tmp_path, T, wrapped, v if stated else None), robot=arm, degrees=False)
        assert "v of" not in str(caught.value)
    with pytest.warns(UserWarning, match=rf"joint2 jumps by a turn .* first between rows {row} and .* was unwrapped"):
        data = load_log(log_file(tmp_path, T, wrapped, v if stated else None, tau=torque(q)), robot=TWO)
    assert_allclose(data.q, load_log(log_file(tmp_path, T, q, v if stated else None), robot=TWO).q, atol=1e-9)


@pytest.mark.parametrize("row", [2, 57, 200, 398])
@pytest.mark.parametrize("size", [0.5, 6.0, 50.0])
@pytest.mark.parametrize("stated", [True, False])
def test_a_single_outlier_is_named_as_such(tmp_path, row, size, stated):
    q = smooth(T, 0.5)
    v = np.gradient(q, T, axis=0) if stated else None
    spoilt = q.copy()
    spoilt[row, 0] += size
    with pytest.raises(FileFormatError, match=rf"row {row + 1}.*an outlier\?"):
        load_reference(reference_file(tmp_path, T, spoilt, v), robot=TWO, degrees=False)
    whole = load_log(log_file(tmp_path, T, q, v), robot=TWO)
    with pytest.warns(UserWarning, match=rf"q of joint1 .* row {row + 1}, where .*: an outlier\? interpolated"):
        data = load_log(log_file(tmp_path, T, spoilt, v, tau=torque(q)), robot=TWO, degrees=False)
    assert_allclose(data.q, whole.q, atol=2e-4)


@pytest.mark.parametrize("stated", [True, False])
def test_two_recordings_in_one_are_told_apart(tmp_path, stated):
    q = np.concatenate([smooth(T, 0.5), smooth(T, 0.5) + 0.4])
    t = np.arange(len(q)) * T[1]
    v = np.tile(np.gradient(smooth(T, 0.5), T, axis=0), (2, 1)) if stated else None
    words = r"to 0\.4 between rows 401 and 402: another recording begins there, and 1 more elsewhere"
    with pytest.warns(UserWarning, match=words):
        data = load_log(log_file(tmp_path, t, q, v, tau=np.tile(torque(smooth(T, 0.5)), (2, 1))))
    assert data.trajectories == 4


def test_degrees_are_converted_when_said_and_named_when_they_wrap(tmp_path, turning):
    q = smooth(T, 5.0)
    wrapped = np.degrees(np.mod(q + np.pi, 2.0 * np.pi) - np.pi)
    path = reference_file(tmp_path, T, wrapped)
    with pytest.raises(
        FileFormatError, match=r"jumps by -?3\d\d\S* between rows .* a wrap in degrees\? give degrees=True"
    ):
        load_reference(path, turning)
    with pytest.warns(UserWarning, match="unwrapped"):
        assert_allclose(load_reference(path, turning, degrees=True)(T).q, q, atol=1e-9)
    panda = load_robot("panda")
    far = np.degrees(np.tile(0.5 * (panda.lower + panda.upper) + 0.2, (9, 1)))
    with pytest.raises(FileFormatError, match="looks like degrees; give degrees=True, or degrees=False"):
        load_reference(reference_file(tmp_path, T[:9], far), panda)
    assert_array_equal(in_radians(np.array([[180.0, 1.0]]), np.array([False, True])), [[np.pi, 1.0]])


# Clocks.


@pytest.mark.parametrize("fault", ["jitter", "dropped"])
def test_uneven_rows_are_resampled(tmp_path, fault):
    """A smooth motion is found again to the accuracy of cubic splines, whose error falls with the fourth power."""
    rng, step = np.random.default_rng(0), T[1]
    t = T + 0.01 * step * rng.uniform(-1.0, 1.0, len(T)) if fault == "jitter" else T[rng.random(len(T)) > 0.03]
    t[0] = 0.0
    q = smooth(np.append(t, 4.0))[:-1]
    path = log_file(tmp_path, t, q, tau=np.cos(3.0 * q) + 2.0)
    with pytest.warns(UserWarning, match=r"s apart, so they were interpolated to one every 0\.01 s"):
        data = load_log(path)
    asked = load_log(path, resample=step)
    for name in ("t", "q", "v", "a", "tau"):
        assert_array_equal(getattr(asked, name), getattr(data, name))
    rows = trajectory_slices(data.trajectory)[0]
    exact = nbs.Sampled(T, smooth(T))(data.t[rows])
    assert_allclose(data.q[rows], exact.q, atol=1e-5)
    assert_allclose(data.v[rows], exact.v, atol=1e-3)
    assert_allclose(data.a[rows], exact.a, atol=0.1)
    assert_allclose(data.tau[rows], np.cos(3.0 * exact.q) + 2.0, atol=1e-2)
    assert_allclose(np.diff(data.t[rows]), step, rtol=1e-9)


def test_long_gaps_are_not_bridged(tmp_path):
    t = np.concatenate([T[:200], T[240:]])
    path = log_file(tmp_path, t, smooth(t))
    with pytest.warns(UserWarning, match=r"0\.41 s are missing between rows 200 and 201.*: another trajectory begins"):
        data = load_log(path, robot=TWO, resample=0.01)
    assert data.trajectories == 4
    assert all(np.diff(data.t[rows]).max() < 0.011 for rows in trajectory_slices(data.trajectory))
    for step, words in ((0.0, "resample is 0"), (1e-9, "more than 10,000,000 rows")):
        with pytest.raises(ArgumentError, match=words):
            load_log(log_file(tmp_path, T, smooth(T)), robot=TWO, resample=step)


# Columns.


def table(names="t,q_joint1,q_joint2,v_joint1,v_joint2,tau_joint1,tau_joint2"):
    q = smooth(T)
    return names.split(","), np.column_stack((T, q, np.gradient(q, T, axis=0), torque(q)))


@pytest.fixture
def load(tmp_path):
    """Loads a table as a log of one trajectory."""

    def loaded(head, rows):
        write_csv(tmp_path / "log.csv", head, rows)
        with noted() as notes:
            data = load_log(tmp_path / "log.csv", robot=TWO)
        return data, [note for note in notes if "one trajectory" not in note]

    return loaded


def test_the_names_of_ros_are_understood(load, tmp_path):
    head, rows = table()
    plain, _ = load(head, rows)
    words = {"q_": "position_", "v_": "velocity_", "tau_": "effort_"}
    ros = [next((name.replace(a, b, 1) for a, b in words.items() if name.startswith(a)), name) for name in head]
    renamed, notes = load(ros, rows)
    assert notes == []
    for name in ("q", "v", "a", "tau"):
        assert_array_equal(getattr(renamed, name), getattr(plain, name))
    assert_array_equal(load_reference(tmp_path / "log.csv", TWO).q, rows[:, 1:3])


def test_columns_of_a_gripper_are_left_out_and_said(load, tmp_path):
    head, rows = table()
    plain, _ = load(head, rows)
    more, notes = load([*head, "q_finger"], np.column_stack((rows, T)))
    assert_array_equal(more.q, plain.q)
    assert len(notes) == 1
    assert "no joint of the arm is named finger; left out" in notes[0]
    with pytest.warns(UserWarning, match="finger; left out"):
        load_reference(tmp_path / "log.csv", TWO)
    with pytest.raises(FileFormatError, match="leave out the columns of other joints and number these 1 to 2"):
        load(["t", "q1", "q2", "q3", "tau1", "tau2", "tau3"], rows)
    with pytest.raises(FileFormatError, match=r"1 joints .* expected 2 .* add those of joint2"):
        load(["t", "q_joint1", "tau_joint1"], rows[:, :3])


def test_a_comma_at_the_end_of_lines_is_no_column(load):
    head, rows = table()
    plain, _ = load(head, rows)
    for start in ([*head, ""], head):
        again, _ = load(start, [[*map(repr, row.tolist()), ""] for row in rows])
        assert_array_equal(again.q, plain.q)


@pytest.mark.parametrize(("mark", "point"), [(";", "."), (";", ","), ("\t", "."), (" ", "."), ("|", ".")])
def test_other_separators_are_understood(load, tmp_path, mark, point):
    head, rows = table()
    plain, _ = load(head, rows)
    text = "\n".join([mark.join(head), *(mark.join(map(str, row)).replace(".", point) for row in rows.tolist())])
    (tmp_path / "log.txt").write_text(text)
    with pytest.warns(UserWarning, match="one trajectory"):
        assert_array_equal(load_log(tmp_path / "log.txt", robot=TWO).q, plain.q)
    (tmp_path / "log.csv.gz").write_bytes(gzip.compress(text.encode()))
    with pytest.warns(UserWarning, match="one trajectory"):
        assert_array_equal(load_log(tmp_path / "log.csv.gz", robot=TWO).tau, plain.tau)


@pytest.mark.parametrize("mark", [";", "\t"])
def test_references_are_read_with_other_separators(tmp_path, mark):
    rows = np.column_stack((T, smooth(T)))
    (tmp_path / "motion.csv").write_text("\n".join(mark.join(map(str, row)) for row in (["t", "q_1", "q_2"], *rows)))
    motion = load_reference(tmp_path / "motion.csv", TWO)
    assert_allclose(motion(T).q, smooth(T), atol=1e-9)


def test_a_velocity_that_is_zero_is_found_again(load):
    head, rows = table()
    plain, _ = load(head, rows)
    rows[:, 4] = 0.0
    data, notes = load(head, rows)
    assert len(notes) == 1
    assert "v of joint2 is 0 in every row while q changes, so v was differentiated from q instead" in notes[0]
    assert_allclose(data.v, plain.v, atol=1e-3)


@pytest.mark.parametrize("setting", [{"degrees": True}, {"window": 0.2}, {"time_unit": "ms"}, {"resample": 0.01}])
def test_a_saved_dataset_takes_no_settings_of_a_log(tmp_path, setting):
    nbs.collect(TWO, "uniform", samples=10).save(tmp_path / "data.npz")
    (name,) = setting
    with pytest.raises(ArgumentError, match=f"is a saved dataset, .* takes no {name}=.*; leave that out"):
        load_log(tmp_path / "data.npz", robot=TWO, **setting)
    assert len(load_log(tmp_path / "data.npz", robot=TWO, degrees=False)) == 10


# Remedies, in Python and in the shell.


def test_an_option_is_named_as_its_reader_types_it():
    assert option("time_unit", "ms") == "time_unit='ms'"
    assert option("degrees", False) == "degrees=False"
    assert option("limits", {"a": {"effort": 80.0}}) == "limits={'a': {'effort': 80.0}}"
    with at_the_shell():
        assert option("time_unit", "ms") == "--time-unit ms"
        assert (option("degrees", True), option("degrees", False)) == ("--degrees", "--radians")
        assert option("limits", {"a": {"effort": 80.0}}) == "--limits a.effort=80.0"
    assert option("degrees", True) == "degrees=True"


def bare(folder):
    """A table without a header."""
    np.savetxt(folder / "bare.csv", np.zeros((5, 13)), delimiter=",")
    return folder / "bare.csv"


def test_the_shell_names_its_own_options_and_they_help(tmp_path, capsys):
    path, out = reference_file(tmp_path, 1e3 * T, smooth(T, 0.4)), ["--out", str(tmp_path / "out")]
    track = ["track", "two_link", "--reference", str(path), *out, "--plant", "pinocchio"]
    assert "give --time-unit ms, or --time-unit s" in refusal(cli.main(track), capsys)
    assert cli.main([*track, "--time-unit", "ms"]) == 0
    assert "simulated 4 s" in capsys.readouterr().out
    assert "--degrees and --radians" in refusal(cli.main([*track, "--degrees", "--radians"]), capsys)
    log = log_file(tmp_path, T + 1e-4 * np.sin(1e3 * T), smooth(T))
    learn = ["learn", str(log), "--robot", "two_link", "--model", "identified", "--force", *out]
    with warnings.catch_warnings():
        warnings.simplefilter("default")
        assert cli.main(learn) == 0
    assert "so they were interpolated to one every 0.01 s" in capsys.readouterr().err
    assert "give --columns t=1,q=2-7,tau=8-13" in refusal(cli.main(["learn", str(bare(tmp_path)), *out]), capsys)


# Friction and weight in the torques of a reference.


@pytest.fixture
def rubbing(tmp_path):
    """Makes a two_link with friction and effort limits."""

    def arm(damping, friction, effort):
        text = find("two_link").path.read_text()
        text = re.sub(r"<dynamics[^>]*/>", "", text)
        text = re.sub(r"(<limit[^>]*/>)", rf'\1<dynamics damping="{damping}" friction="{friction}"/>', text)
        (tmp_path / "arm.urdf").write_text(text)
        robot = load_robot(tmp_path / "arm.urdf")
        assert robot.friction.tolist() == [friction] * 2
        return robot.with_effort_limit(effort)

    return arm


def test_friction_beyond_the_effort_limit_is_named_if_it_is_kept(rubbing):
    robot = rubbing(0.0, 200.0, 150.0)
    motion = nbs.Sinusoid.for_robot(robot)
    nbs.check_reference(motion, robot, 5.0)
    words = r"Coulomb friction 200 N·m of joint 'joint1' is not below its effort limit 150 .*\(joint_friction='drop'\)"
    with pytest.raises(ArgumentError, match=words):
        nbs.check_reference(motion, robot, 5.0, joint_friction="keep")
    nbs.check_reference(nbs.Hold(motion(0.0).q), robot, 5.0, joint_friction="keep")
    with pytest.raises(ArgumentError, match="give one of drop, keep"):
        nbs.check_reference(motion, robot, 5.0, joint_friction="some")


@settings(max_examples=10, deadline=None)
@given(st.floats(0.0, 3.0), st.floats(0.0, 5.0))
def test_the_torque_of_a_reference_includes_the_friction_of_the_urdf(tmp_path_factory, damping, friction):
    text = find("two_link").path.read_text()
    text = re.sub(r"<dynamics[^>]*/>", "", text)
    path = tmp_path_factory.mktemp("arm") / "arm.urdf"
    path.write_text(re.sub(r"(<limit[^>]*/>)", rf'\1<dynamics damping="{damping}" friction="{friction}"/>', text))
    robot = load_robot(path)
    motion, t = nbs.Sinusoid.for_robot(robot), np.linspace(0.0, 5.0, 2001)
    q, v, a = motion(t)
    drag = nbs.JointFriction.of(robot).torque(v)
    needed = np.abs(nbs.PinocchioDynamics(robot).reference_torque(q, v, v, a) + drag).max(axis=0)
    nbs.check_reference(motion, robot.with_effort_limit(1.0001 * needed), 5.0, joint_friction="keep")
    with pytest.raises(ArgumentError, match="torque"):
        nbs.check_reference(motion, robot.with_effort_limit(0.9999 * needed), 5.0, joint_friction="keep")


def test_the_remedy_for_too_large_a_torque_is_one_that_helps():
    q = np.array([0.5 * np.pi, 0.0])
    for posture in (q, np.zeros(2)):
        weight = np.abs(nbs.PinocchioDynamics(TWO).gravity(posture)).max()
        if weight > 1.0:
            break
    weak = TWO.with_effort_limit(0.5 * weight)
    with pytest.raises(ArgumentError, match=r"its weight alone takes .*, so choose another posture or raise") as caught:
        nbs.check_reference(nbs.Hold(posture), weak, 1.0)
    limits = ast.literal_eval(re.search(r"limits=(\{.*\})", str(caught.value))[1])
    stronger = {name: {"effort": weak.effort_limit[i]} for i, name in enumerate(weak.joint_names)} | limits
    nbs.check_reference(nbs.Hold(posture), nbs.load_robot("two_link", limits=stronger), 1.0)
    assert min(limit["effort"] for limit in limits.values()) >= 0.5 * weight


def test_only_the_joints_that_are_too_weak_are_to_be_stronger_and_hold_their_weight():
    motion = nbs.Sinusoid.for_robot(TWO)
    with pytest.raises(ArgumentError, match="raise the limit") as caught:
        nbs.check_reference(motion, nbs.load_robot("two_link", limits={"joint2": {"effort": 0.1}}), 5.0)
    limits = ast.literal_eval(re.search(r"limits=(\{.*\})", str(caught.value))[1])
    assert set(limits) == {"joint2"}
    nbs.check_reference(motion, nbs.load_robot("two_link", limits=limits), 5.0)
    weights = np.abs(nbs.PinocchioDynamics(TWO).gravity(motion(np.linspace(0.0, 5.0, 2001)).q)).max(axis=0)
    assert limits["joint2"]["effort"] >= weights[1]


def test_limits_of_a_joint_stand_beside_that_of_all_joints(tmp_path):
    options = ["--effort-limit", "95", "--limits", "joint2.effort=80", "--duration", "0.1", "--out", str(tmp_path)]
    assert cli.main(["track", "two_link", *options]) == 0
    assert nbs.Run.load(tmp_path / "run.npz").effort_limit.tolist() == [95.0, 80.0]


SLIDER = """<robot name="slider"><link name="base"/><link name="car"><inertial><mass value="2"/>
<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
<joint name="rail" type="prismatic"><parent link="base"/><child link="car"/><axis xyz="1 0 0"/>
<limit lower="-1" upper="1" effort="100" velocity="3"/></joint></robot>"""


def test_joints_that_slide_are_in_metres_in_every_sentence_about_a_motion(tmp_path):
    (tmp_path / "slider.urdf").write_text(SLIDER)
    arm, t = load_robot(tmp_path / "slider.urdf"), np.linspace(0.0, 4.0, 1001)
    q = 0.3 * np.sin(t)[:, None]
    jump = np.where(t > 2.0, q[:, 0] + 0.05, q[:, 0])[:, None]
    for motion, v in ((jump, None), (q, 3.0 * np.cos(t)[:, None])):
        np.savez(tmp_path / "m.npz", t=t, q=motion, **({} if v is None else {"v": v}))
        with pytest.raises(FileFormatError, match=r" m/s ?") as caught:
            nbs.load_reference(tmp_path / "m.npz", arm)
        assert "rad" not in str(caught.value)
    np.savez(tmp_path / "m.npz", t=t, q=q, v=300.0 * np.cos(t)[:, None])  # mm/s
    with pytest.raises(FileFormatError, match=r"v of rail: 300 m/s, but q changes by 0\.3 m/s"):
        nbs.load_reference(tmp_path / "m.npz", arm)
    np.savez(tmp_path / "m.npz", t=1e3 * t, q=q, v=0.3 * np.cos(t)[:, None])
    with pytest.raises(FileFormatError, match="t looks like milliseconds"):
        nbs.load_reference(tmp_path / "m.npz", arm)


@pytest.mark.parametrize(
    ("first", "cells"),
    [
        ("t,q1 [rad; wrapped],q2", ["t", "q1 [rad; wrapped]", "q2"]),
        ("0,5;1,25;-2,0", ["0.5", "1.25", "-2.0"]),
        ("t;q1 [rad, wrapped];q2", ["t", "q1 [rad. wrapped]", "q2"]),
        ("t\tq1\tq2", ["t", "q1", "q2"]),
        ("t q1 q2", ["t", "q1", "q2"]),
    ],
)
def test_the_separator_is_the_most_frequent_mark(tmp_path, first, cells):
    (tmp_path / "a.csv").write_text(first + "\n")
    assert read_cells(tmp_path / "a.csv") == [cells]
