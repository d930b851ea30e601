"""Data to learn from: what a dataset may be, what the recipes really did, and what a log must not be."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from numpy.testing import assert_allclose, assert_array_equal

import nbs_pin as nbs
from nbs_pin.base.exceptions import ArgumentError, FileFormatError
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.identification.collect import collect
from nbs_pin.identification.datasets import Dataset, load_dataset, trajectory_slices
from nbs_pin.identification.excitation import configuration_box, excitation, torque_limits
from nbs_pin.identification.logs import load_log
from nbs_pin.identification.measurement import Noise, derivative, quantised
from nbs_pin.simulation.mujoco_plant import MujocoPlant
from tests.test_dynamics import GANTRY

ARRAYS = ("q", "v", "a", "tau", "t", "trajectory", "parents", "prismatic")


def made(counts=(4, 3, 5), n=2, seed=0):
    """A dataset of random numbers with trajectories of these lengths."""
    rng, size = np.random.default_rng(seed), sum(counts)
    states = (rng.standard_normal((size, n)) for _ in range(4))
    t = np.concatenate([0.1 * np.arange(k) for k in counts])
    ids = np.repeat(np.arange(len(counts)), counts)
    return Dataset(*states, t, ids, np.arange(n), np.zeros(n, dtype=bool), "made", {"seed": seed})


def torque_error(robot, data, friction=None):
    """|M a + C v + G (+ friction) − τ| by Pinocchio: MuJoCo made the data."""
    tau = nbs.inverse_dynamics(nbs.PinocchioDynamics(robot), data.q, data.v, data.a)
    return np.abs(tau + (0.0 if friction is None else friction.torque(data.v)) - data.tau)


# Datasets.


@given(
    counts=st.lists(st.integers(1, 6), min_size=2, max_size=12), share=st.floats(0.01, 0.99), seed=st.integers(0, 99)
)
@settings(max_examples=40, deadline=None)
def test_a_split_holds_out_whole_trajectories(counts, share, seed):
    data = made(counts)
    kept, held = data.split(share, seed)
    ids = np.unique(kept.trajectory), np.unique(held.trajectory)
    assert not set(ids[0]) & set(ids[1])
    assert len(kept) + len(held) == len(data)
    assert kept.trajectories + held.trajectories == data.trajectories
    assert held.trajectories == np.clip(round(share * len(counts)), 1, len(counts) - 1)
    for part in (kept, held):
        for k in np.unique(part.trajectory):
            assert_array_equal(part.q[part.trajectory == k], data.q[data.trajectory == k])


def test_a_split_is_decided_by_its_seed():
    data = made([2] * 20)
    parts = [tuple(np.unique(data.split(0.3, seed)[1].trajectory)) for seed in (0, 0, 1, 2, 3)]
    assert parts[0] == parts[1]
    assert len(set(parts)) > 1


def test_one_trajectory_is_not_split():
    with pytest.raises(ArgumentError, match="one trajectory"):
        made((9,)).split()
    with pytest.raises(ArgumentError, match=r"share is 1\.0"):
        made().split(1.0)


def test_samples_are_taken_by_any_index():
    data = made()
    assert_array_equal(data.take(slice(None, None, 3)).q, data.q[::3])
    assert_array_equal(data.take(data.t > 0.15).tau, data.tau[data.t > 0.15])
    assert (len(data), data.samples, data.nv, data.trajectories) == (12, 12, 2, 3)
    assert "12 samples of made, 3 trajectories, 2 joints" in repr(data)
    assert [(s.start, s.stop) for s in trajectory_slices(data.trajectory)] == [(0, 4), (4, 7), (7, 12)]


def test_a_file_gives_the_same_data_back(tmp_path):
    data = made()
    data.save(tmp_path / "deep" / "data.npz")
    again = load_dataset(tmp_path / "deep" / "data.npz")
    for name in ARRAYS:
        assert_array_equal(getattr(again, name), getattr(data, name))
        assert getattr(again, name).dtype == getattr(data, name).dtype
    assert (again.robot, again.about) == ("made", {"seed": 0})


NO_DATASET = [
    ({"v": np.zeros((12, 3))}, "v has shape"),
    ({"t": np.zeros(5)}, "t has shape"),
    ({"prismatic": np.zeros(3, dtype=bool)}, "prismatic has shape"),
    ({"a": np.full((12, 2), np.nan)}, "a of sample 1, joint 1 is nan"),
    ({"a": np.full((12, 2), np.inf)}, "inf"),
    ({"t": np.zeros(12)}, "sample 2 is not after sample 1"),
    ({"t": -np.arange(12.0)}, "must increase"),
    ({"trajectory": np.arange(12) % 3}, "interrupted"),
    ({"parents": np.array([0, 2])}, "joint 2 has parent 2"),
    ({"parents": np.array([1, 0])}, "joint 1 has parent 1"),
    ({"q": np.zeros((0, 2))}, "at least one"),
]
NO_NUMBERS = [
    ({"q": [[1.0, 2.0], [3.0]]}, "dataset's q is .*rows of equal length"),
    ({"tau": "none"}, "dataset's tau is 'none'"),
    ({"trajectory": np.full(12, 0.5)}, "trajectory is .*expected whole numbers"),
    ({"trajectory": np.full(12, np.nan)}, "trajectory is .*expected whole numbers"),
    ({"prismatic": [0, 2]}, "prismatic is .*expected true or false"),
]


@pytest.mark.parametrize(("change", "words"), [*NO_DATASET, *NO_NUMBERS])
def test_arrays_that_make_no_dataset_are_refused(change, words):
    with pytest.raises(ArgumentError, match=words):
        replace(made(), **change)


@pytest.mark.parametrize(("change", "words"), NO_DATASET)
def test_a_file_that_is_no_dataset_is_refused(tmp_path, change, words):
    arrays = {name: getattr(made(), name) for name in ARRAYS} | change
    np.savez(tmp_path / "x.npz", format="nbs_pin dataset 1", robot="", about="{}", **arrays)
    with pytest.raises(FileFormatError, match=words) as caught:
        load_dataset(tmp_path / "x.npz")
    assert "x.npz" in str(caught.value)


def test_numbers_of_other_kinds_become_float64():
    data = made()
    lists = replace(data, **{name: getattr(data, name).tolist() for name in ARRAYS})
    single = replace(data, **{name: getattr(data, name).astype(np.float32) for name in ARRAYS})
    whole = replace(data, q=np.ones((12, 2), dtype=int), trajectory=data.trajectory.astype(np.uint8))
    for other in (lists, single, whole):
        for name in ARRAYS:
            assert getattr(other, name).dtype == getattr(data, name).dtype
    for name in ARRAYS:
        assert_array_equal(getattr(lists, name), getattr(data, name))
        assert_allclose(getattr(single, name), getattr(data, name), rtol=1e-6)
    assert_array_equal(whole.trajectory, data.trajectory)
    assert replace(data).q is data.q


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"format": "nbs_pin run 1"}, "format"),
        ({"about": "{"}, "Expecting"),
        ({"q": "text"}, "'q' is"),
        ({"tau": None}, "no 'tau'"),
    ],
)
def test_a_file_of_another_kind_is_refused(tmp_path, change, words):
    made().save(tmp_path / "x.npz")
    stored = dict(np.load(tmp_path / "x.npz")) | change
    np.savez(tmp_path / "y.npz", **{name: x for name, x in stored.items() if x is not None})
    with pytest.raises(FileFormatError, match=words):
        load_dataset(tmp_path / "y.npz")


def test_there_must_be_a_file_and_notes_that_json_can_say(tmp_path):
    with pytest.raises(FileNotFoundError):
        load_dataset(tmp_path / "none.npz")
    with pytest.raises(ArgumentError, match="JSON"):
        replace(made(), about={"x": np.nan}).save(tmp_path / "z.npz")


# Recipes.


@pytest.mark.parametrize("recipe", ["excited", "reference", "passive", "uniform"])
@pytest.mark.parametrize("name", ["three_link", "panda", GANTRY])
def test_the_data_obey_the_arms_equation(name, recipe):
    robot = nbs.load_robot(name)
    data = collect(robot, recipe, 60, seed=3, duration=0.3, sampling=0.01 if recipe != "passive" else None)
    assert len(data) == 60
    scale = 1.0 + np.abs(data.tau).max()
    assert torque_error(robot, data).max() < 1e-11 * scale * (1.0 + np.abs(data.a).max())
    assert (np.abs(data.tau) <= robot.effort_limit).all()
    assert_array_equal(data.parents, robot.parents)
    assert_array_equal(data.prismatic, robot.prismatic)
    assert data.trajectories == {"excited": 2, "reference": 2, "passive": 1, "uniform": 60}[recipe]
    assert json.loads(json.dumps(data.about))["recipe"] == recipe


def test_the_same_seed_gives_the_same_data():
    robot = nbs.load_robot("two_link")
    first, again, other = (
        collect(robot, samples=40, seed=seed, sampling=0.01, noise=Noise(torque=0.1)) for seed in (5, 5, 6)
    )
    for name in ARRAYS:
        assert_array_equal(getattr(first, name), getattr(again, name))
    assert (first.q != other.q).all()


def test_few_samples_still_come_from_many_trajectories():
    robot = nbs.load_robot("two_link")
    data = collect(robot, samples=200, duration=0.4)
    assert data.trajectories == 20
    assert_allclose(np.diff(data.t[data.trajectory == 3]), 0.04, rtol=1e-9)
    assert data.about["sampling"] == pytest.approx(0.04)
    assert collect(robot, samples=50, sampling=0.01, duration=0.4).trajectories == 2
    assert {np.count_nonzero(data.trajectory == k) for k in range(20)} == {10}


def test_excited_motions_stay_inside_the_arm_and_reach_through_it():
    robot = nbs.load_robot("panda")
    data = collect(robot, samples=400, sampling=0.03, duration=0.6)
    assert ((data.q > robot.lower) & (data.q < robot.upper)).mean() > 0.99
    assert (np.abs(data.v).max(axis=0) < 1.5 * robot.velocity_limit).all()
    assert (data.v.std(axis=0) > 0.3).all()
    assert (np.ptp(data.q, axis=0) > 0.4 * (robot.upper - robot.lower)).all()
    assert (np.abs(data.tau) >= robot.effort_limit).mean() < 0.05


def test_the_samples_of_a_trajectory_are_one_motion():
    """q, v and a are derivatives of one another: Simpson's rule over two samples agrees."""
    data = collect(nbs.load_robot("ur5"), samples=120, sampling=0.002, duration=0.1, acceleration="differentiated")
    assert data.trajectories == 3
    for rows in trajectory_slices(data.trajectory):
        assert_allclose(np.diff(data.t[rows]), 0.002, rtol=1e-9)
        for x, rate in ((data.q, data.v), (data.v, data.a)):
            change, stated = x[rows], rate[rows]
            simpson = 0.002 / 3.0 * (stated[:-2] + 4.0 * stated[1:-1] + stated[2:])
            assert_allclose(change[2:] - change[:-2], simpson, atol=1e-3 * np.abs(simpson).max())


def test_the_passive_data_are_the_authors():
    """Rows of the authors' published swing of three links (docs/theory.md §8): rest at zero, u = 0, RK4 at 1 ms."""
    data = collect(nbs.load_robot("three_link"), "passive", 1000)
    assert not data.tau.any()
    assert_allclose(data.t[:3], [0.0, 0.001, 0.002])
    assert_allclose(data.q[1], [-6.2168733e-06, 7.9008678e-06, -2.2411318e-06], atol=3e-9)
    assert_allclose(data.q[99], [-0.06075149, 0.07693954, -0.0214924], atol=3e-7)
    assert_allclose(data.q[999], [-1.8019171, -0.5408098, -0.14177133], atol=3e-7)


def test_uniform_states_fill_the_box():
    robot = nbs.load_robot("panda")
    data = collect(robot, "uniform", 2000, speed=1.5)
    lower, upper = configuration_box(robot)
    share = (data.q - lower) / (upper - lower)
    assert share.min() >= 0.0
    assert share.max() <= 1.0
    assert_allclose(share.mean(axis=0), 0.5, atol=0.03)
    assert_allclose(share.var(axis=0), 1.0 / 12.0, atol=0.01)
    assert_allclose(data.v.var(axis=0), 1.5**2 / 3.0, rtol=0.1)
    assert np.abs(data.v).max() <= 1.5
    turn = configuration_box(nbs.load_robot("three_link"))
    assert_allclose(turn[1], np.pi)
    assert_allclose(turn[0], -np.pi)


def test_an_arm_without_limits_is_given_some():
    robot = nbs.load_robot("double_pendulum")
    assert np.isinf(robot.effort_limit).all()
    limit = torque_limits(robot)
    data = collect(robot, samples=100, sampling=0.01)
    assert (np.isfinite(limit) & (limit > 0.0)).all()
    assert (np.abs(data.tau) <= limit).all()
    assert_array_equal(torque_limits(nbs.load_robot("ur5")), nbs.load_robot("ur5").effort_limit)


def test_friction_stays_in_the_torque():
    robot = nbs.load_robot("ur5")
    friction = JointFriction(np.full(6, 0.8), np.full(6, 0.4), transition=1e-6)
    data = collect(robot, samples=300, sampling=0.01, friction=friction)
    sliding = np.abs(data.v) > 0.05
    assert torque_error(robot, data, friction)[sliding].max() < 2e-3
    assert np.median(torque_error(robot, data)[sliding]) > 0.4
    xarm = nbs.load_robot("xarm7")
    own = collect(xarm, "uniform", 300, friction=True)
    sliding = np.abs(own.v) > 0.05
    assert torque_error(xarm, own, JointFriction.of(xarm, transition=1e-6))[sliding].max() < 2e-3
    assert own.about["friction"]["viscous"] == [10.0, 10.0, 5.0, 5.0, 5.0, 2.0, 2.0]
    assert collect(robot, "uniform", 2).about["friction"] is None


def test_a_plant_takes_friction_of_any_size():
    robot = nbs.load_robot("z1")
    own = JointFriction.of(robot)
    q, v = np.full(7, 0.2), np.full(7, 0.5)
    kept, given, dropped = (
        MujocoPlant(robot, joint_friction=choice).acceleration(q, v, np.zeros(7)) for choice in ("keep", own, "drop")
    )
    assert_allclose(given, kept, rtol=1e-12)
    assert np.abs(dropped - kept).max() > 1.0
    assert MujocoPlant(robot, joint_friction=own).integrator == "implicitfast"
    with pytest.raises(ArgumentError, match="for 2 joints"):
        MujocoPlant(robot, joint_friction=JointFriction(np.ones(2), np.ones(2)))


# Instruments.


@given(degree=st.integers(0, 5), seed=st.integers(0, 999))
@settings(max_examples=20, deadline=None)
def test_derivatives_are_exact_for_polynomials(degree, seed):
    shape = np.random.default_rng(seed).standard_normal(degree + 1)
    t = 0.01 * np.arange(30)
    for order in (1, 2):
        measured = derivative(np.polyval(shape, t)[:, None], 0.01, 11, order)[:, 0]
        assert_allclose(measured, np.polyval(np.polyder(shape, order), t), atol=1e-8)
    with pytest.raises(ArgumentError, match="too few"):
        derivative(np.zeros((5, 1)), 0.01, 11)


def test_differentiated_data_are_those_of_the_simulator():
    robot = nbs.load_robot("three_link")
    data = collect(robot, samples=200, sampling=0.01, acceleration="differentiated")
    assert np.sqrt((torque_error(robot, data) ** 2).mean()) < 1e-3 * data.tau.std()
    assert len(data) == 200
    assert data.about["acceleration"] == "differentiated"


def test_noise_is_what_it_is_said_to_be():
    robot, step = nbs.load_robot("ur5"), 2.0 * np.pi * 2.0**-16

    def data(**settings):
        return collect(robot, samples=300, sampling=0.01, **settings)

    def error(data):
        return (data.a - nbs.forward_dynamics(nbs.PinocchioDynamics(robot), data.q, data.v, data.tau)).std()

    clean, noisy, rounded = data(), data(noise=Noise(torque=0.5)), data(noise=Noise(encoder=2.0**-16))
    assert_array_equal(noisy.q, clean.q)
    assert_allclose((noisy.tau - clean.tau).std(axis=0), 0.5, rtol=0.15)
    assert_allclose(rounded.q / step, np.round(rounded.q / step), atol=1e-6)
    assert rounded.about["acceleration"] == "differentiated"
    assert 1e-3 < error(rounded) < 0.1
    assert error(rounded) > 10.0 * error(data(acceleration="differentiated"))


def test_an_encoder_rounds_turns_and_metres():
    q = np.array([[0.1234, 0.1234]])
    rounded = quantised(q, 0.01, np.array([False, True]))
    assert_allclose(rounded, [[0.04 * np.pi, 0.12]])
    assert quantised(q, 0.0, np.array([False, True])) is q


def test_excitation_is_inside_the_ranges_and_its_derivatives_are_right():
    robot, rng = nbs.load_robot("panda"), np.random.default_rng(1)
    t, h = np.linspace(0.0, 3.0, 400), 1e-6
    for _ in range(5):
        motion = excitation(robot, rng, 2.0)
        at, after, before = motion(t), motion(t + h), motion(t - h)
        assert (at.q >= robot.lower).all()
        assert (at.q <= robot.upper).all()
        assert_allclose(at.v, (after.q - before.q) / (2 * h), atol=1e-7)
        assert_allclose(at.a, (after.v - before.v) / (2 * h), atol=1e-6)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"recipe": "lively"}, "recipe 'lively' is unknown"),
        ({"samples": 0}, "samples is 0"),
        ({"speed": -1.0}, "speed"),
        ({"sampling": 0.0015}, "whole number"),
        ({"duration": 0.005}, "make it longer"),
        ({"duration": -1.0}, "duration"),
        ({"acceleration": "guessed"}, "acceleration 'guessed' is unknown"),
        ({"acceleration": "simulator", "noise": Noise(encoder=1e-4)}, "rounded encoders"),
        ({"recipe": "uniform", "noise": Noise(encoder=1e-4)}, "nothing to differentiate"),
        ({"friction": JointFriction(np.ones(3), np.ones(3))}, "for 3 joints"),
    ],
)
def test_settings_that_do_not_fit_are_refused(options, words):
    with pytest.raises(ArgumentError, match=words):
        collect(nbs.load_robot("two_link"), **({"samples": 10} | options))


@pytest.mark.parametrize("noise", [{"encoder": -1e-3}, {"encoder": 0.7}, {"torque": -1.0}, {"torque": np.inf}])
def test_noise_that_cannot_be_is_refused(noise):
    with pytest.raises(ArgumentError, match=r"Noise: (encoder|torque) is"):
        Noise(**noise)


# Logs.


@pytest.fixture(scope="module")
def measured():
    """Three short trajectories of ur5, a sample every 5 ms."""
    return collect(nbs.load_robot("ur5"), samples=300, sampling=0.005, duration=0.5, acceleration="differentiated")


@pytest.fixture
def log(tmp_path, measured):
    """Writes these trajectories with changes, None leaving an array out, and returns the path."""

    def written(**changes):
        arrays = {name: getattr(measured, name) for name in ARRAYS[:6]} | changes
        np.savez(tmp_path / "log.npz", **{name: x for name, x in arrays.items() if x is not None})
        return tmp_path / "log.npz"

    return written


def columns(data, names=None, leave_out=()):
    """The CSV columns of a dataset; joints by name or by number."""
    table = {name: getattr(data, name) for name in ("t", "trajectory") if name not in leave_out}
    for kind in ("q", "v", "a", "tau"):
        for i, x in enumerate(() if kind in leave_out else getattr(data, kind).T):
            table[f"{kind}_{names[i]}" if names else f"{kind}{i + 1}"] = x
    return table


def write_csv(path, table):
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(table)
        writer.writerows(zip(*([repr(float(x)) for x in column] for column in table.values()), strict=True))
    return path


def test_a_log_is_read_whatever_the_order_of_its_columns(tmp_path, measured, log):
    robot = nbs.load_robot("ur5")
    table = columns(measured, robot.joint_names)
    shuffled = {name: table[name] for name in sorted(table)}
    for number, variant in enumerate((table, shuffled, columns(measured))):
        data = load_log(write_csv(tmp_path / f"{number}.csv", variant), robot=robot)
        for name in ARRAYS:
            assert_array_equal(getattr(data, name), getattr(measured, name))
        assert data.robot == "ur5"
    assert_array_equal(load_log(log()).tau, measured.tau)
    turned = {name: getattr(measured, name)[:, ::-1] for name in ARRAYS[:4]}
    assert_array_equal(load_log(log(joint_names=robot.joint_names[::-1], **turned), robot=robot).q, measured.q)


def test_a_dataset_and_a_run_are_logs(tmp_path, measured):
    measured.save(tmp_path / "data.npz")
    assert_array_equal(load_log(tmp_path / "data.npz").q, measured.q)
    assert_array_equal(load_log(tmp_path / "data.npz", robot=nbs.load_robot("ur5")).q, measured.q)
    for other, words in (("ur10", "of ur5, not of ur10"), ("three_link", "6 joints and three_link 3")):
        with pytest.raises(FileFormatError, match=rf"data\.npz: .*{words}"):
            load_log(tmp_path / "data.npz", robot=nbs.load_robot(other))
    robot = nbs.load_robot("two_link")
    law = nbs.PD.for_robot(robot)
    run = nbs.simulate(MujocoPlant(robot), law, nbs.Sinusoid.for_robot(robot, 3.0), 0.5, 0.001)
    run.save(tmp_path / "run.npz")
    with pytest.warns(UserWarning, match="one trajectory"):
        data = load_log(tmp_path / "run.npz", robot=robot)
    assert data.about["differentiated"] == ["a"]
    assert torque_error(robot, data).max() < 0.02 * np.abs(data.tau).max()


@pytest.mark.parametrize("leave_out", [("a",), ("v", "a")])
def test_what_is_not_logged_is_differentiated(tmp_path, measured, leave_out):
    robot = nbs.load_robot("ur5")
    path = write_csv(tmp_path / "log.csv", columns(measured, leave_out=leave_out))
    data = load_log(path, robot=robot, window=0.05)
    assert data.about["differentiated"] == list(leave_out)
    assert data.trajectories == measured.trajectories
    assert len(data) == len(measured) - 10 * measured.trajectories  # five samples are half a window
    rows = np.concatenate([np.arange(s.start + 5, s.stop - 5) for s in trajectory_slices(measured.trajectory)])
    assert_allclose(data.a, measured.a[rows], atol=0.02 * measured.a.std())
    assert_allclose(data.v, measured.v[rows], atol=1e-3)
    with pytest.raises(FileFormatError, match="too short"):
        load_log(path, window=2.0)


DEGREES = 180.0 / np.pi
SPOILT = {
    "all in degrees": ({"q": DEGREES, "v": DEGREES, "a": DEGREES}, "looks like degrees; give degrees=True"),
    "v in degrees": ({"v": DEGREES, "a": DEGREES}, "v of joint .* convert v from degrees"),
    "a in degrees": ({"a": DEGREES}, "a of joint .* convert a from degrees"),
    "v turned round": ({"v": -1.0}, "signs is wrong, so correct v"),
    "a in other units": ({"a": 0.1}, "a of joint .* changes 10 times"),
    "a at random": ({"a": "shuffled"}, "a of joint .* leave a out"),
}


@pytest.mark.parametrize("fault", SPOILT)
def test_units_that_disagree_are_refused(measured, log, fault):
    factors, words = SPOILT[fault]
    order = np.random.default_rng(0).permutation(len(measured))
    arrays = {name: getattr(measured, name) for name in factors}
    changes = {name: x[order] if factors[name] == "shuffled" else factors[name] * x for name, x in arrays.items()}
    with pytest.raises(FileFormatError, match=words):
        load_log(log(**changes), robot=nbs.load_robot("ur5"))


def test_degrees_are_converted_when_said(measured, log):
    arrays = {name: DEGREES * getattr(measured, name) for name in ("q", "v", "a")}
    path = log(**arrays)
    data = load_log(path, degrees=True)
    assert_allclose(data.q, measured.q, rtol=1e-12)
    assert_allclose(data.a, measured.a, rtol=1e-12)
    sliding = load_log(path, degrees=True, prismatic=[True, *5 * [False]])
    assert_array_equal(sliding.q[:, 0], arrays["q"][:, 0])
    assert sliding.prismatic.tolist() == [True, *5 * [False]]
    with pytest.raises(ArgumentError, match="prismatic has 1 entries"):
        load_log(path, degrees=True, prismatic=[True])


def test_noisy_but_right_logs_pass(measured, log):
    rng = np.random.default_rng(0)
    noise = {"q": 1e-4, "v": 0.02, "a": 0.5}
    arrays = {k: getattr(measured, k) + s * rng.standard_normal(measured.q.shape) for k, s in noise.items()}
    assert len(load_log(log(**arrays))) == len(measured)


def test_logs_from_which_nothing_can_be_learned_are_told(tmp_path, measured, log):
    one = measured.take(measured.trajectory == 0)
    with pytest.warns(UserWarning, match="one trajectory"):
        load_log(write_csv(tmp_path / "one.csv", columns(one, leave_out=("trajectory",))))
    with pytest.warns(UserWarning, match="only zero torque"):
        load_log(log(tau=0 * measured.tau))


LOG = "t,trajectory,q1,q2,v1,v2,tau1,tau2"
ROWS = "".join(f"\n{0.1 * k:g},0,{0.1 * k:g},0,1,0,{k},1" for k in range(9))


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("tau2", "torque2", "no column 'tau_2'"),
        ("t,", "clock,", "no column 't' of times"),
        ("v2", "w2", "no column 'v_2'"),
        ("0.1,0,", "0.1,0.5,", "whole number"),
        ("0.1,0,", "nan,0,", "t of sample 2 is nan"),
        ("0.1,0,", "0.1,0,7,", "row 2 has"),
        ("0.1,0,", "0.1,x,", "row 2"),
        ("q2", "q1", "'q1' twice, expected each name once"),
        (ROWS, "", "rows of numbers"),
        (LOG + ROWS, "", "header"),
    ],
)
def test_a_csv_that_is_no_log_is_refused(tmp_path, old, new, words):
    path = tmp_path / "log.csv"
    path.write_text(LOG + ROWS)
    with pytest.warns(UserWarning, match="one trajectory"):
        assert len(load_log(path)) == 3
    assert old in LOG + ROWS
    path.write_text((LOG + ROWS).replace(old, new, 1))
    with pytest.raises(FileFormatError, match=words) as caught:
        load_log(path)
    assert "log.csv" in str(caught.value)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda d: {"tau": d.tau[:, :2]}, "'tau' is"),
        (lambda d: {"q": np.zeros((0, 6))}, "beside q"),
        (lambda d: {"q": d.q.astype(str)}, "'q' is"),
        (lambda d: {"trajectory": d.trajectory + 0.5}, "whole number"),
        (lambda d: {"joint_names": ["a", "b"]}, "2 joint_names"),
        (lambda d: {"joint_names": list("abcdef")}, r"joints \(a, b, c"),
        (lambda d: {"tau": None}, "no 'tau'"),
    ],
)
def test_arrays_that_are_no_log_are_refused(measured, log, change, words):
    with pytest.raises(FileFormatError, match=words):
        load_log(log(**change(measured)), robot=nbs.load_robot("ur5"))


def test_other_suffixes_are_refused(tmp_path):
    (tmp_path / "x.pdf").write_text("t")
    with pytest.raises(FileFormatError, match=r"expected one of \.csv"):
        load_log(tmp_path / "x.pdf")
