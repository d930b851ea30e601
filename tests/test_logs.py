"""Logs of real arms, made here from a simulated one: what is put right, what is doubted, what they may look like."""

import functools
import re
import warnings
from dataclasses import replace

import numpy as np
import pytest
import scipy.io
from numpy.testing import assert_allclose, assert_array_equal

import nbs_pin as nbs
from nbs_pin import cli
from nbs_pin.base.csv_files import joint_columns
from nbs_pin.base.exceptions import ArgumentError, FileFormatError
from nbs_pin.identification.datasets import recordings, trajectory_slices
from nbs_pin.identification.fit import split_data
from nbs_pin.identification.log_doubts import log_doubts
from nbs_pin.identification.log_files import Columns
from nbs_pin.identification.repairs import _cut
from nbs_pin.identification.resampling import lowpassed
from nbs_pin.motions.recordings import Joints
from tests.commands import refusal

ARM = nbs.load_robot("ur5")
STEP, SECONDS = 0.004, 24.0


@functools.cache
def motion():
    """t, q, v, a and tau of ur5 in harmonics of 0.1 Hz, with viscous friction."""
    rng, t = np.random.default_rng(0), np.arange(0.0, SECONDS, STEP)
    w = 0.2 * np.pi * np.arange(1, 5)
    size, phase = rng.uniform(-0.5, 0.5, (4, 6)) / w[:, None] ** 0.5, rng.uniform(0.0, 6.0, (4, 6))
    angle = w * t[:, None, None] + phase.T
    q = (size.T * np.sin(angle)).sum(axis=-1) + np.array([0.0, -1.2, 1.0, -0.5, 0.7, 0.2])
    v = (w * size.T * np.cos(angle)).sum(axis=-1)
    a = -(w**2 * size.T * np.sin(angle)).sum(axis=-1)
    return t, q, v, a, nbs.inverse_dynamics(nbs.PinocchioDynamics(ARM), q, v, a) + 5.0 * v


@functools.cache
def measured():
    """Columns of a log without a: t, q with noise of an encoder, v, and tau with noise."""
    t, q, v, _, tau = motion()
    rng = np.random.default_rng(1)
    return {
        "t": t,
        "q": q + 1e-5 * rng.standard_normal(q.shape),
        "v": v + 2e-3 * rng.standard_normal(v.shape),
        "tau": tau + 0.02 * tau.std(axis=0) * rng.standard_normal(tau.shape),
    }


def read(folder, arrays, **settings):
    """The data in a log with these columns, and what was said, without the usual notes on noise."""
    np.savez(folder / "log.npz", **arrays)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        data = nbs.load_log(folder / "log.npz", **{"robot": ARM} | settings)
    texts = [str(warning.message) for warning in said]
    return data, [text for text in texts if "low-pass" not in text]


def nmse(data, reference):
    """Of the best rigid bodies with friction, trained on these data, on the last fifth of the others."""
    model = nbs.identify(data.split()[0], ARM, friction=True)
    test = reference.split()[1]
    torque = nbs.inverse_dynamics(model, test.q, test.v, test.a) + model.friction.torque(test.v)
    return (np.square(torque - test.tau).mean(axis=0) / test.tau.var(axis=0)).mean()


# What is put right.


def test_a_noisy_log_is_low_passed_alike_and_thinned_and_then_fits_better(tmp_path):
    data, said = read(tmp_path, measured())
    raw, _ = read(tmp_path, measured(), lowpass=0)
    assert said == []
    assert data.about["doubts"] == []
    assert data.about["lowpass_Hz"] == 8.0
    assert len(data) < 0.3 * len(raw)
    t, q, v, a, _ = motion()
    rows = np.searchsorted(t, data.t - 1e-9)
    for name, truth in (("q", q), ("v", v), ("a", a)):
        assert_allclose(getattr(data, name), truth[rows], atol=0.02 * np.abs(truth).max())
    assert nmse(data, data) < 0.5 * nmse(raw, raw)


def test_the_filter_delays_nothing_and_treats_all_signals_alike():
    t = np.arange(0.0, 10.0, 0.01)
    slow, fast = np.sin(2.0 * t)[:, None], np.sin(300.0 * t)[:, None]
    found = lowpassed(Columns(t, slow + fast, 3.0 * (slow + fast), slow, None, np.zeros(len(t), dtype=int)), 0.01, 5.0)
    inside = slice(100, -100)
    assert_allclose(found.q[inside], slow[inside], atol=1e-3)
    assert_allclose(found.tau, 3.0 * found.q, atol=1e-12)
    assert found.a is None


@pytest.mark.parametrize("step", [0.001, 0.004, 0.01])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_recording_that_begins_and_ends_in_motion_is_as_good_there_as_inside(tmp_path, step, seed):
    robot, rng, t = nbs.load_robot("two_link"), np.random.default_rng(seed), np.arange(0.0, 4.0, step)
    dynamics, parts = nbs.PinocchioDynamics(robot), []
    for number in range(4):
        size, rate, phase = rng.uniform(0.3, 0.8, 2), rng.uniform(1.0, 4.0, 2), rng.uniform(0.0, 6.0, 2)
        found = nbs.Sinusoid(size, rate, phase)(t)
        tau = nbs.inverse_dynamics(dynamics, found.q, found.v, found.a)
        noisy = tau + rng.normal(0.0, 0.05, tau.shape)
        parts.append({"t": t, "trajectory": np.full(len(t), number), "q": found.q, "tau": noisy})
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    data, _ = read(tmp_path, columns, robot=robot)
    assert data.about["lowpass_Hz"] > 0.0
    off = nbs.inverse_dynamics(dynamics, data.q, data.v, data.a) - data.tau
    for rows in trajectory_slices(data.trajectory):
        own = np.abs(off[rows])
        inside = np.sqrt(np.square(own[10:-10]).mean())
        assert max(own[:10].max(), own[-10:].max()) < 6.0 * inside
    assert nbs.identify(data, robot).report.outliers == 0


def test_jitter_repeats_spikes_and_gaps_are_put_right(tmp_path):
    """As of a controller that is asked at uneven times, often before it knows more."""
    clean, _ = read(tmp_path, measured())
    rng, columns = np.random.default_rng(2), {name: x.copy() for name, x in measured().items()}
    rows = len(columns["t"])
    columns["t"] += 0.2 * STEP * rng.uniform(-1.0, 1.0, rows)
    for k in rng.choice(np.arange(5, rows - 5), 40, replace=False):
        for name in ("q", "v", "tau"):
            columns[name][k] = columns[name][k - 1]
    hit = np.sort(rng.choice(np.arange(100, rows - 100), 24, replace=False))
    columns["tau"][hit, 1] += 500.0 * rng.choice([-1.0, 1.0], len(hit))
    columns["q"][3000, 2] += 0.3
    data, said = read(tmp_path, columns)
    assert len(said) == 4
    words = "|".join(said)
    assert "rows that repeat the one before were left out" in words
    assert f"N·m in row {hit[0] + 1}, where about" in words
    assert f"the first of {len(hit)} spikes" in words
    assert "rad in row 3001, where about" in words
    assert "s apart, so they were interpolated to one every 0.004 s" in words
    assert nmse(data, clean) < 1.1 * nmse(clean, clean)
    gone = np.r_[0:2000, 2400:rows]
    parted, said = read(tmp_path, {name: x[gone] for name, x in measured().items()})
    assert len(said) == 1
    assert "1.604 s are missing between rows 2000 and 2001: another trajectory begins there" in said[0]
    assert parted.trajectories == 2


def test_an_angle_that_stands_still_and_a_limit_of_torque_are_named(tmp_path):
    t, q, v, a, tau = motion()
    fast = int(np.argmax(np.abs(v[1000:2000, 3]))) + 1000
    frozen = q.copy()
    frozen[fast : fast + 3, 3] = frozen[fast - 1, 3]
    data, said = read(tmp_path, {"t": t, "q": frozen, "v": v, "a": a, "tau": tau})
    assert len(said) == 1
    assert f"q of wrist_1_joint stood still in motion, in 3 rows, first row {fast + 1}" in said[0]
    assert_allclose(data.q, q, atol=1e-3)
    limit = 0.6 * np.abs(tau[:, 1]).max()
    cut, said = read(tmp_path, {"t": t, "q": q, "v": v, "a": a, "tau": np.clip(tau, -limit, limit)})
    words = f"tau of shoulder_lift_joint is cut off at -{limit:.6g} N·m, which it has in "
    assert any(words in text and "rows near it were left out" in text for text in said)
    assert 0.2 * len(t) < len(cut) < 0.95 * len(t)
    assert np.abs(cut.tau[:, 1]).max() < 0.98 * limit
    assert_allclose(
        nbs.inverse_dynamics(nbs.PinocchioDynamics(ARM), cut.q, cut.v, cut.a) + 5.0 * cut.v, cut.tau, atol=1e-9
    )


# What is doubted.

TURNED = np.array([1.0, -1.0, 1.0, 1.0, 1.0, 1.0])
SWAPPED = [0, 2, 1, 3, 4, 5]
DOUBTED = {
    "amperes": (
        lambda c: {"tau": c["tau"] / [14.0, 13.0, 11.0, 11.0, 11.0, 11.0]},
        r"motor currents .*give torque_gain",
    ),
    "motor side": (lambda c: {"tau": c["tau"] / 100.0}, r"0\.0\d+ times .*motors' side .*, about 100 by the masses"),
    "N·mm": (lambda c: {"tau": 1e3 * c["tau"]}, r"in N·mm \(mN·m\)\? give torque_gain=0\.001"),
    "one sign": (
        lambda c: {"tau": TURNED * c["tau"]},
        r"tau of shoulder_lift_joint has the other sign than q; give torque",
    ),
    "all signs": (lambda c: {"tau": -c["tau"]}, r"the torques have the other sign than q; give torque_gain=-1"),
    "swapped": (lambda c: {"tau": c["tau"][:, SWAPPED]}, r"swapped: .*shoulder_lift_joint fits elbow_joint"),
    "zero": (
        lambda c: {"q": c["q"] + np.pi / 2 * (np.arange(6) == 1)},
        r"zero of shoulder_lift_joint .* fit q -90°; give zero=\[0, -1\.570796, 0, 0, 0, 0\]",
    ),
    "offset": (
        lambda c: {"tau": c["tau"] + [5.0, 20.0, 10.0, 2.0, 2.0, 2.0]},
        r"constant parts .*\+20\S* N·m at shoulder_lift",
    ),
    "late by 30 ms": (lambda c: {"tau": shifted(c, 0.03)}, r"about (29|30|31) ms late .*give delay=0\.0(29|3|31)"),
    "late by 100 ms": (lambda c: {"tau": shifted(c, 0.1)}, r"about (99|100|101) ms late"),
}


def shifted(columns, delay):
    """The torques written `delay` later."""
    t = columns["t"]
    return np.column_stack([np.interp(t - delay, t, x) for x in columns["tau"].T])


@pytest.mark.parametrize("fault", DOUBTED)
def test_the_masses_of_the_arm_doubt_units_signs_order_zeros_and_delays(tmp_path, fault):
    change, words = DOUBTED[fault]
    data, said = read(tmp_path, measured() | change(measured()))
    (doubt,) = data.about["doubts"]
    assert re.search(words, doubt)
    assert any(doubt in text for text in said)


@pytest.mark.parametrize(
    ("fault", "settings"),
    [
        ("motor side", {"torque_gain": 100.0}),
        ("one sign", {"torque_gain": TURNED.tolist()}),
        ("zero", {"zero": [0.0, -np.pi / 2, 0.0, 0.0, 0.0, 0.0]}),
        ("late by 30 ms", {"delay": 0.03}),
    ],
)
def test_what_is_doubted_is_put_right_by_what_is_told_to_give(tmp_path, fault, settings):
    clean, _ = read(tmp_path, measured())
    data, said = read(tmp_path, measured() | DOUBTED[fault][0](measured()), **settings)
    assert said == []
    if fault != "late by 30 ms":  # whose rows are others
        assert_allclose(data.tau, clean.tau, atol=0.02 * np.abs(clean.tau).max())
        assert_allclose(data.q, clean.q, atol=1e-9)
    assert nmse(data, clean) < 1.2 * nmse(clean, clean)


def test_motors_with_gears_are_told_by_one_number(tmp_path):
    c = measured()
    plain, _ = read(tmp_path, c)
    motor = {"q": 50.0 * c["q"], "v": 50.0 * c["v"], "tau": c["tau"] / 50.0}
    geared, _ = read(tmp_path, c | motor, gear=50.0)
    for name in ("q", "v", "a", "tau"):
        assert_allclose(getattr(geared, name), getattr(plain, name), rtol=1e-9, atol=1e-9)
    with pytest.raises(ArgumentError, match="torque_gain has 2 numbers and the log 6 joints"):
        read(tmp_path, c, torque_gain=[1.0, 2.0])


# One long log.


def test_of_one_long_log_the_end_is_held_out_after_a_pause(tmp_path):
    data, _ = read(tmp_path, measured())
    train, test = data.split(0.2)
    assert test.t[-1] == data.t[-1]
    assert test.t[0] - train.t[-1] >= 0.5
    assert np.ptp(test.t) == pytest.approx(0.2 * np.ptp(data.t), rel=0.02)
    assert_array_equal(split_data(data)[1].q, test.q)
    with pytest.raises(ArgumentError, match="only one trajectory"):
        data.take(data.t < 4.0).split(0.2)


@pytest.mark.parametrize("own_time", [False, True])
def test_pieces_of_one_recording_are_held_out_together(tmp_path, own_time):
    """Random pieces would have their neighbours in the training data."""
    whole, _ = read(tmp_path, measured())
    pieces = np.arange(len(whole)) * 5 // len(whole)
    starts = whole.t[np.searchsorted(pieces, np.arange(5))]
    data = replace(whole, trajectory=pieces, t=whole.t - starts[pieces] if own_time else whole.t)
    assert [group.tolist() for group in recordings(data)] == [[0, 1, 2, 3, 4]]
    train, test = data.split(0.2, seed=1)
    assert_array_equal(test.q, whole.split(0.2)[1].q)
    assert_array_equal(train.q, whole.split(0.2)[0].q)
    apart = replace(data, q=data.q + 0.5 * (pieces == 2)[:, None], trajectory=pieces)
    assert [group.tolist() for group in recordings(apart)] == [[0, 1], [2], [3, 4]]


# What files look like.


def test_the_columns_of_other_programs_are_found():
    for header, kind, expected in (
        (["time", "shoulder_position", "elbow_position"], "q", {"shoulder": 1, "elbow": 2}),
        (["/joint_states/a/velocity", "/joint_states/b/velocity"], "v", {"a": 0, "b": 1}),
        (["field.effort0", "field.effort1"], "tau", {"1": 0, "2": 1}),
        (["position[0]", "position[1]"], "q", {"1": 0, "2": 1}),
        (["timestamp", "actual_q_0", "actual_q_1", "actual_qd_0", "actual_qd_1"], "v", {"1": 3, "2": 4}),
        (["q1 [rad]", "q2 [rad]"], "q", {"1": 0, "2": 1}),
        (["actual_q_0", "target_q_0"], "q", {}),
    ):
        assert joint_columns(header, kind) == expected


@pytest.mark.parametrize("form", ["numbers", "names", "matlab", "matrix", "rate"])
def test_columns_are_taken_by_number_or_name(tmp_path, form):
    c = measured()
    plain, _ = read(tmp_path, c, lowpass=0)
    matrix = np.column_stack([c["t"], c["tau"], c["q"], c["v"]])
    path, chosen, more = tmp_path / "log.csv", {"t": "1", "tau": "2-7", "q": "8-13", "v": "14-19"}, {}
    if form == "numbers":
        np.savetxt(path, matrix, delimiter=",")
    elif form == "names":
        names = [f"{kind}.{joint}" for kind in ("load", "angle", "rate") for joint in ARM.joint_names]
        np.savetxt(path, matrix, delimiter=";", header=";".join(["clock", *names]))
        chosen = {"t": "clock", "tau": "load.*", "q": "angle.*", "v": "rate.*"}
    elif form == "rate":
        np.savetxt(path, matrix[:, 1:], delimiter="\t")
        chosen, more = {"tau": "1-6", "q": "7-12", "v": "13-18"}, {"rate": 1.0 / STEP}
    elif form == "matrix":
        path = tmp_path / "log.mat"
        scipy.io.savemat(path, {"data": matrix.T})
    else:
        path = tmp_path / "log.mat"
        scipy.io.savemat(path, {"log": {"time": c["t"], "angles": c["q"].T, "v": c["v"], "tau": c["tau"]}})
        chosen = {"q": "angles"}
    data = nbs.load_log(path, robot=ARM, columns=chosen, lowpass=0, **more)
    for name in ("q", "v", "tau", "a"):
        assert_allclose(getattr(data, name), getattr(plain, name), rtol=1e-9, atol=1e-9)


def test_several_files_are_as_many_recordings(tmp_path):
    c = measured()
    for k, rows in enumerate((slice(0, 3000), slice(3000, None))):
        np.savez(tmp_path / f"{k}.npz", **{name: x[rows] for name, x in c.items()})
    files = [tmp_path / "0.npz", tmp_path / "1.npz"]
    data = nbs.load_log(files, robot=ARM, window=0.064)
    assert data.trajectories == 2
    one = nbs.load_log(files[1], robot=ARM, window=0.064)
    assert_allclose(data.take(data.trajectory == 1).a, one.a, rtol=1e-9)
    only, _ = read(tmp_path, c | {"trajectory": np.arange(len(c["t"])) // 3000}, trajectories=[1], window=0.064)
    assert_allclose(only.a, one.a, rtol=1e-9)
    with pytest.raises(ArgumentError, match=r"trajectories has 7, and .* 0, 1; give some of these"):
        read(tmp_path, c | {"trajectory": np.arange(len(c["t"])) // 3000}, trajectories=[7])


@pytest.mark.parametrize("storage", ["SQLITE3", "MCAP"])
def test_bags_of_ros_are_read_joints_by_name(tmp_path, storage):
    """As a driver writes them: joints in another order, in between the states of a gripper, stamps of the epoch."""
    rosbag2, typesys = pytest.importorskip("rosbags.rosbag2"), pytest.importorskip("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    State, Header, Time = (
        store.types[name]
        for name in ("sensor_msgs/msg/JointState", "std_msgs/msg/Header", "builtin_interfaces/msg/Time")
    )
    c, order = {name: x[:1500] for name, x in measured().items()}, [2, 1, 0, 3, 4, 5]
    names = [ARM.joint_names[k] for k in order]

    def state(t, names, *values):
        stamp = 1_700_000_000_000_000_000 + round(1e9 * t)
        header = Header(Time(stamp // 10**9, stamp % 10**9), "")
        return stamp, store.serialize_cdr(State(header, names, *values), State.__msgtype__)

    with rosbag2.Writer(tmp_path / "bag", version=9, storage_plugin=rosbag2.StoragePlugin[storage]) as writer:
        topic = writer.add_connection("/joint_states", State.__msgtype__, typestore=store)
        for t, q, v, tau in zip(c["t"], c["q"], c["v"], c["tau"], strict=True):
            writer.write(topic, *state(t, names, q[order], v[order], tau[order]))
        writer.write(topic, *state(7.0, ["finger"], *3 * [np.zeros(1)]))
    (path,) = (file for file in (tmp_path / "bag").iterdir() if file.suffix in (".db3", ".mcap"))
    plain, _ = read(tmp_path, c, lowpass=0)
    with pytest.warns(UserWarning, match="messages of other joints are left out, 1 of 1501"):
        data = nbs.load_log(path, robot=ARM, lowpass=0)
    for name in ("q", "v", "tau"):
        assert_allclose(getattr(data, name), getattr(plain, name), rtol=1e-12)
    assert_allclose(data.a, plain.a, atol=1e-3)
    with pytest.raises(ArgumentError, match=r"columns has topic=/arm, and .* joint states under /joint_states"):
        nbs.load_log(path, columns={"topic": "/arm"})
    (tmp_path / "x.mcap").write_bytes(bytes(99))
    with pytest.raises(FileFormatError, match="not an intact bag"):
        nbs.load_log(tmp_path / "x.mcap")


def test_signals_in_files_of_their_own_are_put_together(tmp_path):
    """One number a line, too."""
    c = measured()
    np.savetxt(tmp_path / "time.txt", c["t"])
    np.savetxt(tmp_path / "angles.txt", c["q"], header="angles of the arm\na b c d e f")
    np.savetxt(tmp_path / "load.txt", c["tau"].ravel())
    files, chosen = (
        [tmp_path / f"{name}.txt" for name in ("time", "angles", "load")],
        {"q": "angles.txt", "tau": "load.txt"},
    )
    data = nbs.load_log(files, robot=ARM, columns=chosen | {"t": "time.txt:1"}, lowpass=0)
    plain, _ = read(tmp_path, {name: c[name] for name in ("t", "q", "tau")}, lowpass=0)
    for name in ("q", "v", "a", "tau"):
        assert_allclose(getattr(data, name), getattr(plain, name), rtol=1e-9, atol=1e-9)
    with pytest.raises(FileFormatError, match=r"angles\.txt:1-5: 5 columns of q|load.txt: .* match them"):
        nbs.load_log(files, columns=chosen | {"t": "time.txt:1", "q": "angles.txt:1-5"})
    with pytest.raises(ArgumentError, match="columns names no t; log t, q and tau"):
        nbs.load_log(files, columns=chosen)


def test_single_states_need_no_time_but_all_derivatives(tmp_path):
    _, q, v, a, tau = motion()
    some = np.random.default_rng(3).permutation(len(q))[:300]
    np.savez(tmp_path / "states.npz", q=q[some], v=v[some], a=a[some], tau=tau[some])
    data = nbs.load_log(tmp_path / "states.npz", robot=ARM, rate=0)
    assert_array_equal(data.q, q[some])
    assert data.trajectories == len(data) == 300
    tau[some[7], 0] = np.nan
    np.savez(tmp_path / "holed.npz", q=q[some], v=v[some], a=a[some], tau=tau[some])
    with pytest.warns(UserWarning, match="1 rows with entries that are missing were left out, first row 8"):
        assert_array_equal(nbs.load_log(tmp_path / "holed.npz", robot=ARM, rate=0).q, np.delete(q[some], 7, axis=0))
    with pytest.raises(FileFormatError, match="rows without times need v and a"):
        nbs.load_log(tmp_path / "states.npz", robot=ARM, rate=0, columns={"a": "-"})


def test_rows_in_which_something_is_missing_are_left_out(tmp_path):
    c = measured()
    clean, _ = read(tmp_path, c, lowpass=0)
    holes = {name: x.copy() for name, x in c.items()}
    holes["tau"][77, 3] = holes["q"][500:503, 0] = np.nan
    data, said = read(tmp_path, holes, lowpass=0)
    assert len(said) == 2
    assert "4 rows with entries that are missing were left out, first row 78" in said[0]
    assert_allclose(data.q, clean.q, atol=1e-3)


def test_times_that_stand_still_or_go_back_are_understood(tmp_path):
    """As of a recorder that writes some messages twice, and of two recordings one after the other."""
    c = measured()
    twice = np.sort(np.r_[np.arange(len(c["t"])), 1000, 2000, len(c["t"]) - 1])
    data, said = read(tmp_path, {name: x[twice] for name, x in c.items()}, lowpass=0)
    plain, _ = read(tmp_path, c, lowpass=0)
    assert len(said) == 1
    assert "3 rows with the time of the row before were left out, first row 1002" in said[0]
    assert_allclose(data.a, plain.a, atol=1e-6)
    both, said = read(tmp_path, {name: np.concatenate([x, x]) for name, x in c.items()}, lowpass=0)
    assert len(said) == 1
    assert f"time goes back between rows {len(c['t'])} and {len(c['t']) + 1}: another recording begins there" in said[0]
    assert both.trajectories == 2
    assert_array_equal(both.a[: len(plain)], plain.a)
    with pytest.raises(FileFormatError, match="time must increase along a trajectory"):
        read(tmp_path, c | {"t": c["t"][::-1]})


# In the shell.


@pytest.fixture
def shell(capsys):
    """Runs a command with its warnings, and returns what it printed."""

    def run(*words):
        with warnings.catch_warnings():
            warnings.simplefilter("default")
            assert cli.main([str(word) for word in words]) == 0
        return capsys.readouterr()

    return run


def test_a_log_is_shown_and_written_as_data(tmp_path, shell, capsys):
    c = measured()
    np.savez(tmp_path / "log.npz", **c | {"tau": c["tau"] / 100.0})
    out = tmp_path / "clean.npz"
    shown = shell("log", tmp_path / "log.npz", "--robot", "ur5", "-v").out
    assert "log.npz: 23.7" in shown
    assert "1 doubt" in shown
    assert "give --torque-gain … with the gains or gear ratios, about 100 by the masses" in shown
    assert "6000 rows, usually 250 Hz" in shown
    shown = shell("log", tmp_path / "log.npz", "--robot", "ur5", "--torque-gain", "100", "--out", out).out
    assert "no doubts" in shown
    assert f"next: nbs-pin learn {out} --robot ur5" in " ".join(shown.split("\n"))
    assert len(nbs.load_log(out, robot=ARM)) > 500
    again = ["log", str(tmp_path / "log.npz"), "--out", str(out)]
    assert "exists; give --force to replace it" in refusal(cli.main(again), capsys)


def test_the_shell_learns_from_a_log_with_options_of_python(tmp_path, shell, capsys):
    c = measured()
    columns = [c["t"], np.arange(len(c["t"])) // 2000, np.degrees(c["q"]), np.degrees(c["v"]), -c["tau"]]
    np.savetxt(tmp_path / "log.csv", np.column_stack(columns), delimiter=",")
    options = ["--columns", "t=1,trajectory=2,q=3-8,v=9-14,tau=15-20", "--torque-gain=-1", "--degrees"]
    learn = ["learn", tmp_path / "log.csv", "--robot", "ur5", "--model", "identified", "--friction", "on", *options]
    shell(*learn, "--held-out-trajectories", "2", "--lowpass", "5", "--out", tmp_path / "out")
    assert nbs.load(tmp_path / "out" / "model.nbs").nv == 6
    wrong = [str(word) for word in [*learn, "--held-out-trajectories", "7", "--out", tmp_path / "other"]]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert "has 7; give some of 0, 1, 2, not all" in refusal(cli.main(wrong), capsys)
    wrong = ["log", str(tmp_path / "log.csv"), "--columns", "q"]
    assert "--columns t=1,q=2-7,tau=8-13" in refusal(cli.main(wrong), capsys)


def test_what_no_log_is_is_refused_with_a_remedy(tmp_path):
    (tmp_path / "log.mat").write_bytes(b"MATLAB 5.0 MAT-file" + bytes(200))
    with pytest.raises(FileFormatError, match=r"log\.mat"):
        nbs.load_log(tmp_path / "log.mat")
    with pytest.raises(ArgumentError, match=r"columns has 'x'; give names for some of t, trajectory, tau, q, v, a"):
        read(tmp_path, measured(), columns={"x": "y"})
    with pytest.raises(ArgumentError, match=r"columns has q=angles, and .* correct the name"):
        read(tmp_path, measured(), columns={"q": "angles"})
    np.savetxt(tmp_path / "log.csv", np.ones((9, 13)), delimiter=",", header=",".join(["x", *"abcdefghijkl"]))
    with pytest.raises(FileFormatError, match=r"no column 'tau_1'.* name them with columns=\{'tau': 'NAME_\*'\}"):
        nbs.load_log(tmp_path / "log.csv")


def test_a_smooth_peak_in_coarse_steps_is_no_limit():
    t = np.arange(0.0, 10.0, 0.002)
    joints = Joints(["joint 1"], np.array([False]), np.array([False]))
    smooth = 0.02 * np.round(10.0 * np.sin(2.0 * np.pi * 0.3 * t)[:, None] / 0.02)
    every = np.ones((len(t), 1), dtype=bool)
    assert np.isinf(_cut(smooth, every, joints)[0]).all()
    assert _cut(np.clip(smooth, -np.inf, 7.0), every, joints)[0][1, 0] == 7.0


def rests():
    """A pendulum that moves from point to point and rests between, its torque recorded in coarse steps."""
    points, t = [0.0, 1.2, -0.4, 1.2, 0.3], np.arange(0.0, 12.0, 0.002)
    share = np.clip(np.mod(t, 3.0) - 1.0, 0.0, 1.0)
    stage = np.minimum((t // 3.0).astype(int), 3)
    steps = np.diff(points)[stage]
    smooth = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
    q = np.array(points)[stage] + steps * smooth
    v, a = np.gradient(q, 0.002), np.gradient(np.gradient(q, 0.002), 0.002)
    tau = 0.5 * a + 9.81 * np.sin(q)
    return {"t": t, "q": q[:, None], "v": v[:, None], "a": a[:, None], "tau": 0.01 * np.round(tau / 0.01)[:, None]}


def test_a_robot_that_holds_still_is_not_at_its_limit(tmp_path):
    data, said = read(tmp_path, rests(), robot=None)
    assert not any("cut off" in text for text in said)
    assert len(data) == len(rests()["t"])


def test_a_trajectory_at_rest_does_not_decide_on_the_filter(tmp_path):
    """Encoder noise of a hold is no motion; neither is nothing at all."""
    c, rng = {name: x for name, x in measured().items() if name != "v"}, np.random.default_rng(5)
    rows = 1_000
    for noise in (0.0, 1e-5):
        hold = {
            "t": c["t"][:rows],
            "q": c["q"][0] + noise * rng.standard_normal((rows, 6)),
            "tau": c["tau"][0] + 0.2 * rng.standard_normal((rows, 6)),
        }
        both = {name: np.concatenate([x, hold[name]]) for name, x in c.items()}
        both["trajectory"] = np.repeat([0, 1], [len(c["t"]), rows])
        assert 0.0 < read(tmp_path, both)[0].about["lowpass_Hz"] < 1.5 * read(tmp_path, c)[0].about["lowpass_Hz"]
    still = {name: x[:rows] for name, x in hold.items()} | {"q": np.zeros((rows, 6))}
    assert read(tmp_path, still, robot=None)[0].about["lowpass_Hz"] == 0.0


def test_units_of_time_are_seen_where_stamps_repeat_or_clocks_restart(tmp_path):
    c = {name: x for name, x in measured().items() if name != "v"} | {"t": 1e3 * measured()["t"]}
    for rows in (np.sort(np.r_[np.arange(len(c["t"])), 1000]), np.r_[np.arange(len(c["t"])), np.arange(3000)]):
        with pytest.raises(FileFormatError, match="t looks like milliseconds"):
            read(tmp_path, {name: x[rows] for name, x in c.items()})


def test_a_remedy_adds_to_what_was_given(tmp_path):
    c = measured()
    late = c | {"tau": shifted(c, 0.03)}
    (said,) = read(tmp_path, late, delay=0.06)[0].about["doubts"]
    assert re.search(r"early .*give delay=0\.0(29|3|31)$", said)
    turned = c | {"tau": c["tau"] * TURNED / 14.0}
    (said,) = read(tmp_path, turned, torque_gain=14.0)[0].about["doubts"]
    assert said.endswith("give torque_gain=[14, -14, 14, 14, 14, 14]")
    zero = c | {"q": c["q"] + np.array([0.5, np.pi / 2, 0.0, 0.0, 0.0, 0.0])}
    (said,) = read(tmp_path, zero, zero=[-0.5, 0.0, 0.0, 0.0, 0.0, 0.0])[0].about["doubts"]
    assert said.endswith(f"give zero=[-0.5, {-np.pi / 2:.6f}, 0, 0, 0, 0]")


def test_a_saved_dataset_is_questioned_too(tmp_path, shell):
    data = read(tmp_path, measured())[0]
    replace(data, tau=1e3 * data.tau, about={}).save(tmp_path / "data.npz")
    printed = shell("log", tmp_path / "data.npz", "--robot", "ur5").out
    assert "; 1 doubt" in printed
    assert "are they in N·mm" in printed


def test_recordings_keep_their_numbers_where_one_restarts(tmp_path):
    c, rows = measured(), 1_200
    t = np.concatenate([c["t"][:rows], c["t"][:rows], c["t"][:rows]])
    many = {name: np.concatenate([x[:rows], x[rows : 2 * rows], x[2 * rows : 3 * rows]]) for name, x in c.items()}
    many |= {"t": t, "trajectory": np.repeat([0, 0, 1], rows)}
    data, _ = read(tmp_path, many, lowpass=0)
    last = data.q[data.trajectory == 1]
    assert_allclose(last, many["q"][2 * rows :][-len(last) :], atol=0.1)
    assert sorted(set(data.trajectory.tolist())) == [0, 1, 2]


def test_delays_beyond_a_log_and_units_of_made_up_times_are_refused(tmp_path):
    with pytest.raises(ArgumentError, match=r"delay=9.0 s is longer than every trajectory"):
        read(tmp_path, {name: x[:1_000] for name, x in measured().items()}, delay=9.0)
    c = {name: x for name, x in measured().items() if name != "t"}
    with pytest.raises(ArgumentError, match=r"rate=250\.0 and time_unit='ms' are given"):
        read(tmp_path, c, rate=250, time_unit="ms")


@pytest.mark.parametrize("friction", [0.0, 20.0])
def test_one_joint_alone_is_turned_round_where_friction_says_so(friction):
    arm = nbs.load_robot("two_link", lock=["joint2"])
    data = nbs.collect(arm, "excited", 400, 2)
    turned = replace(data, tau=-(data.tau + friction * data.v))
    (doubt,) = log_doubts(turned, arm).doubts
    assert ("give torque_gain=-1" in doubt) == (friction > 0.0)


def test_a_filter_faster_than_the_rows_is_refused(tmp_path):
    with pytest.raises(ArgumentError, match=r"lowpass is 400 Hz, expected less than half the .* give lowpass="):
        read(tmp_path, measured(), lowpass=400.0)


@pytest.mark.parametrize("rows", [1, 2, 5])
def test_recordings_of_hardly_any_rows_are_filtered_whole(rows):
    x = np.cumsum(np.random.default_rng(0).normal(size=(200, 2)), axis=0)
    numbers = np.repeat([0, 1], [200 - rows, rows])
    found = lowpassed(Columns(np.arange(200) * 0.01, x, x, None, None, numbers), 0.01, 5.0)
    assert found.q.shape == (200, 2)
    assert np.isfinite(found.q).all()
    if rows == 1:
        assert_allclose(found.q[-1], x[-1], atol=1e-9)
