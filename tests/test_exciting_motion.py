"""Exciting motions: their gradient, the limits that they keep, and the number that they are judged by."""

import numpy as np
import pinocchio as pin
import pytest
import torch
from numpy.testing import assert_allclose

import nbs_pin as nbs
from nbs_pin import cli
from nbs_pin.dynamics.pseudo_inertia import inertial_parameters, symmetric
from nbs_pin.identification import exciting_motion as planning
from nbs_pin.identification.excitation_problem import Problem, Weight
from nbs_pin.identification.exciting_motion import exciting_motion
from nbs_pin.identification.torch_regressor import TorchRegressor
from nbs_pin.motions.fourier import Fourier, at_rest
from nbs_pin.motions.references import resting_posture
from nbs_pin.robots.collisions import SelfDistances
from tests.commands import check_results_are_kept_unless_forced, printed_by, summary
from tests.random_arms import random_arm

QUICK = {"duration": 4.0, "band": 1.0, "starts": 1}
TWO = nbs.load_robot("two_link")
FOLDABLE = """<robot name="foldable"><link name="base"/>{}</robot>"""


@pytest.fixture(scope="module")
def foldable(tmp_path_factory):
    """A chain of bars in a plane, whose third can hit the first."""
    parts = []
    for i, parent in enumerate(("base", "bar1", "bar2"), 1):
        shape = '<origin xyz="0.15 0 0"/><geometry><box size="0.24 0.04 0.04"/></geometry>'
        body = '<inertial><origin xyz="0.15 0.01 0"/><mass value="1"/><inertia ixx="0.001" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>'  # noqa: E501
        parts.append(
            f'<link name="bar{i}">{body}<collision>{shape}</collision></link><joint name="j{i}" type="revolute">'
            f'<origin xyz="{0.3 * (i > 1)} 0 0"/><parent link="{parent}"/><child link="bar{i}"/><axis xyz="0 0 1"/>'
            f'<limit lower="{-2.9 + 2.4 * (i > 1)}" upper="2.9" effort="20" velocity="3"/></joint>'
        )
    path = tmp_path_factory.mktemp("arms") / "foldable.urdf"
    path.write_text(FOLDABLE.format("".join(parts)))
    return nbs.load_robot(path)


def problem_of(robot, monkeypatch, **options):
    """The problem that `exciting_motion` searches."""
    made = []

    def stop(problem, *_):
        made.append(problem)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(planning, "search", stop)
        with pytest.raises(KeyboardInterrupt):
            exciting_motion(robot, **QUICK, **options)
    return made[0]


@pytest.mark.parametrize("seed", range(3))
def test_the_regressor_is_pinocchios(seed, tmp_path):
    robot = random_arm(seed, tmp_path)
    q, v, a = np.random.default_rng(seed).normal(size=(3, 5, robot.nv))
    data = robot.model.createData()
    expected = [pin.computeJointTorqueRegressor(robot.model, data, *row) for row in zip(q, v, a, strict=True)]
    found = TorchRegressor(robot)(*map(torch.from_numpy, (q, v, a)))
    assert_allclose(found, expected, atol=1e-12 * np.abs(expected).max())


@pytest.mark.parametrize(("arm", "power"), [(0, 4.0), (1, 16.0), ("foldable", 8.0)])
def test_the_gradient_is_that_of_the_value(arm, power, foldable, tmp_path, monkeypatch):
    robot = foldable if arm == "foldable" else random_arm(arm, tmp_path, joints=3)
    problem, weight = problem_of(robot, monkeypatch), Weight(10.0, power, 5)
    rng = np.random.default_rng(0)
    x, along = 0.5 * rng.normal(size=(2, np.prod(problem.shape)))
    step = 1e-5
    (ahead, _), (behind, _), (_, slope) = (problem.value(y, weight) for y in (x + step * along, x - step * along, x))
    assert slope @ along == pytest.approx((ahead - behind) / (2.0 * step), rel=1e-4)


def test_a_fourier_series_is_at_rest_at_its_ends_and_has_its_derivatives():
    coefficients = at_rest(4) @ np.random.default_rng(0).normal(size=(6, 2))
    motion = Fourier(np.array([0.3, -0.2]), coefficients[:4], coefficients[4:], 5.0)
    ends = motion(np.array([-1.0, 0.0, 5.0, 7.0]))
    assert_allclose(ends.q - ends.q[0], 0.0, atol=1e-12)
    assert_allclose([ends.v, ends.a], 0.0, atol=1e-12)
    t, h = np.linspace(0.1, 4.9, 50), 1e-5
    before, here, after = (motion(t + shift) for shift in (-h, 0.0, h))
    assert_allclose((after.q - before.q) / (2 * h), here.v, atol=1e-8)
    assert_allclose((after.v - before.v) / (2 * h), here.a, atol=1e-8)
    assert (np.abs(after.a - before.a) / (2 * h) <= motion.largest_jerk + 1e-6).all()


@pytest.mark.parametrize(("seed", "share", "acceleration"), [(0, 0.8, None), (3, 0.5, 4.0), (5, 1.0, None)])
def test_limits_are_kept_between_the_instants_of_the_search(seed, share, acceleration, tmp_path):
    robot = random_arm(seed, tmp_path, joints=3)
    motion = exciting_motion(robot, **QUICK, share=share, acceleration=acceleration, seed=seed)
    moved = motion(np.linspace(0.0, 4.0, 7919))
    lower, upper = robot.one_turn_range
    assert (np.abs(moved.q - 0.5 * (lower + upper)) <= 0.5 * share * (upper - lower)).all()
    assert (np.abs(moved.v) <= share * robot.velocity_limit).all()
    assert (np.abs(moved.a) <= share * (acceleration or np.inf)).all()
    data = robot.model.createData()
    torque = np.array([pin.rnea(robot.model, data, *row) for row in zip(*moved, strict=True)])
    drag = robot.damping * moved.v + robot.friction * np.sign(moved.v)
    for tau in (torque, torque + drag):
        assert (np.abs(tau) <= share * robot.effort_limit).all()
    assert_allclose([x[[0, -1]] for x in moved[1:]], 0.0, atol=1e-9)


@pytest.mark.parametrize("seed", [2])
def test_the_condition_number_is_that_of_pinocchios_regressor(seed, tmp_path, monkeypatch):
    robot = random_arm(seed, tmp_path, joints=3)
    options = {"friction": False, "offset": False, "rotor_inertia": False}
    units = problem_of(robot, monkeypatch, **options).units
    motion = exciting_motion(robot, **QUICK, **options)
    data = robot.model.createData()
    moved = motion(np.linspace(0.0, 4.0, 500, endpoint=False))
    rows = np.array([pin.computeJointTorqueRegressor(robot.model, data, *row) for row in zip(*moved, strict=True)])
    factors = units.expected.bodies
    bodies = [[inertial_parameters(L @ symmetric(e) @ L.T) for e in np.eye(10)] for L in factors]
    columns = np.zeros((30, 30))
    for i, parameters in enumerate(bodies):
        columns[10 * i : 10 * i + 10, 10 * i : 10 * i + 10] = np.transpose(parameters)
    design = (rows / robot.effort_limit[:, None]).reshape(-1, 30) @ columns
    values = np.linalg.svd(design, compute_uv=False)
    assert values[0] / values[motion.unknowns - 1] == pytest.approx(motion.condition, rel=1e-3)
    assert (values[motion.unknowns :] < 1e-9 * values[0]).all()


def test_it_beats_random_phases_and_one_seed_finds_one_motion(foldable, monkeypatch):
    problem, rng = problem_of(foldable, monkeypatch, clearance=None), np.random.default_rng(0)
    t, drawn = np.linspace(0.0, 4.0, 400, endpoint=False), []
    for _ in range(9):
        motion = problem.motion(0.3 * rng.normal(size=problem.shape))
        drawn.append(problem.units.condition(motion(t)))
    first, again, other = (exciting_motion(foldable, **QUICK, clearance=None, seed=seed) for seed in (4, 4, 5))
    assert first.condition < 0.5 * np.median(drawn)
    assert first.condition == again.condition != other.condition
    assert_allclose(first(t).q, again(t).q, rtol=0, atol=0)


def test_bodies_stay_clear_of_each_other(foldable):
    hull = SelfDistances(foldable, resting_posture(foldable), 0.0)
    assert ("bar1", "bar3") in hull.pairs
    q = np.random.default_rng(0).uniform(-2.5, 2.5, (40, 3))
    along, distances = np.array([0.3, -0.5, 0.8]), hull(q)
    _, slopes = hull.below(q, np.full(len(hull.pairs), np.inf))
    outside = distances > 1e-3
    slope = (hull(q + 1e-6 * along) - hull(q - 1e-6 * along)) / 2e-6
    assert np.max(np.abs(slopes @ along - slope)[outside]) < 1e-6
    t = np.linspace(0.0, 4.0, 3001)
    free = exciting_motion(foldable, **QUICK, clearance=None, seed=2)
    assert hull(free(t).q).min() < 0.0
    clear = exciting_motion(foldable, **QUICK, clearance=0.02, seed=2)
    assert hull(clear(t).q).min() > 0.02 - 1e-4
    assert clear.nearest == ("bar1", "bar3")
    assert clear.clearance == pytest.approx(hull(clear(t).q).min(), abs=1e-4)


def test_what_it_excites_is_identified():
    motion = exciting_motion(TWO, **QUICK)
    noise = nbs.Noise(torque=0.2)
    data = nbs.collect(TWO, "reference", 400, reference=motion, noise=noise)
    assert (len(data), data.trajectories) == (400, 1)
    assert_allclose(data.q, motion(data.t).q, atol=0.05)
    found = nbs.identify(data, TWO)
    assert found.report.excited == found.report.base_parameters
    q, v, a = np.random.default_rng(0).uniform(-1.5, 1.5, (3, 50, 2))
    truth, seen = (nbs.inverse_dynamics(model, q, v, a) for model in (nbs.PinocchioDynamics(TWO), found))
    assert_allclose(seen, truth, atol=0.01 * np.abs(truth).max())


@pytest.mark.parametrize("calls", [0, 10, 60])
def test_ctrl_c_keeps_the_best_so_far(calls, monkeypatch):
    value, left = Problem.value, [calls]

    def interrupted(self, *arguments):
        left[0] -= 1
        if left[0] < 0:
            raise KeyboardInterrupt
        return value(self, *arguments)

    monkeypatch.setattr(Problem, "value", interrupted)
    if calls < 20:  # within the first start
        with pytest.raises(KeyboardInterrupt):
            exciting_motion(TWO, **QUICK)
        return
    motion = exciting_motion(TWO, **QUICK)
    assert motion.interrupted
    nbs.check_reference(motion, TWO, motion.duration)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"band": 0.1}, "hold 1 multiples"),
        ({"duration": 1000.0}, "hold 1000 multiples"),
        ({"duration": np.nan}, "duration is nan"),
        ({"band": np.inf}, "band is inf"),
        ({"share": 1.5}, "share is 1.5"),
        ({"acceleration": [1.0, 2.0, 3.0]}, "acceleration"),
        ({"acceleration": 0.0}, "acceleration is 0.0"),
        ({"clearance": -1.0}, "clearance is -1.0"),
        ({"starts": 0}, "starts is 0"),
    ],
)
def test_bad_options_are_refused(options, words):
    with pytest.raises(nbs.ArgumentError, match=words):
        exciting_motion(TWO, **options)


@pytest.mark.parametrize(
    ("robot", "words"),
    [
        (lambda: TWO.with_effort_limit([0.01, 9.0]), "'joint1' cannot hold the arm with 80 % of its effort, 0.008 N·m"),
        (lambda: TWO.with_friction(coulomb=[1.0, 90.0]), "Coulomb friction 90 N·m of joint 'joint2' takes all of 80 %"),
    ],
)
def test_arms_that_cannot_move_are_refused(robot, words):
    with pytest.raises(nbs.ArgumentError, match=words):
        exciting_motion(robot(), **QUICK)


def test_the_command_writes_a_motion_that_track_and_collect_follow(tmp_path, capsys):
    folder = tmp_path / "x"

    def run(out, *options):
        words = ["excite", "two_link", "--duration", "2", "--starts", "1", "--out", str(out), "-v", *options]
        return cli.main(words)

    check_results_are_kept_unless_forced(run, folder, ("--seed", "3"), "another motion", capsys)
    figures = summary(folder)["figures"]
    expected = exciting_motion(TWO, duration=2.0, starts=1, seed=3)
    assert figures["condition_number"] == expected.condition
    assert sorted(path.name for path in folder.iterdir()) == ["excitation.png", "motion.csv", "summary.json"]
    read = nbs.load_reference(folder / "motion.csv", TWO)
    t = np.linspace(0.0, 2.0, 77)
    assert_allclose(read(t).a, expected(t).a, atol=1e-4 * np.abs(expected(t).a).max())
    said = printed_by("track", "two_link", "--reference", folder / "motion.csv", "--out", tmp_path / "y")
    assert "converged" in said
    assert max(summary(tmp_path / "y")["figures"]["outside_position_range_rad"]) == 0.0
    printed_by("collect", "two_link", "--recipe", "reference", "--reference", folder / "motion.csv", "--samples", "200",
               "--out", tmp_path / "z")  # fmt: skip
    assert summary(tmp_path / "z")["figures"]["trajectories"] == 1


def test_a_reference_needs_its_recipe():
    with pytest.raises(nbs.ArgumentError, match="recipe='reference'"):
        nbs.collect(TWO, reference=nbs.Hold([0.0, 0.0]))
