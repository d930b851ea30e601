"""Every arm by name is a sound model with n = nq = nv, and errors of configuration wrap where joints turn freely."""

import json
import pickle
import xml.etree.ElementTree as ET

import numpy as np
import pinocchio as pin
import pytest
import torch

from nbs_pin.base.exceptions import ArgumentError, RobotError, RobotNotFound
from nbs_pin.controllers.pid import PID
from nbs_pin.robots.catalogue import ROBOT_NAMES, find
from nbs_pin.robots.robot import configuration_difference, load_robot


@pytest.fixture(params=ROBOT_NAMES)
def robot(request):
    return load_robot(request.param)


def random_configurations(robot, count=10, seed=0):
    return np.random.default_rng(seed).uniform(*robot.sampling_range, (count, robot.nv))


def test_one_number_per_joint(robot):
    model = robot.model
    assert model.nq == model.nv == robot.nv == len(robot.joint_names) == len(robot.joints)
    assert tuple(joint.name for joint in robot.joints) == robot.joint_names == tuple(model.names)[1:]
    for limit in (robot.effort_limit, robot.velocity_limit):
        assert (limit > 0).all()
    assert (robot.lower < robot.upper).all()
    assert np.isfinite(robot.lower).all() == (not robot.continuous.any() and robot.name != "double_pendulum")
    assert (robot.damping >= 0).all()
    assert (robot.friction >= 0).all()


def test_only_missing_limits_are_replaced_for_sampling(robot):
    for sampled, limit, turn in zip(robot.sampling_range, (robot.lower, robot.upper), (-np.pi, np.pi), strict=True):
        stated = np.isfinite(limit)
        np.testing.assert_array_equal(sampled[stated], limit[stated])
        assert (sampled[~stated] == turn).all()


def test_limits_beyond_a_turn_are_sampled_as_they_are():
    lower, upper = load_robot("kinova").sampling_range
    assert upper.max() > 5.0
    assert (lower < upper).all()


@pytest.mark.parametrize("name", ["kinova", "ur5"])
def test_distinct_configurations_span_one_turn_at_most(name):
    robot = load_robot(name)
    (lower, upper), (low, high) = robot.sampling_range, robot.one_turn_range
    np.testing.assert_allclose(high - low, np.minimum(upper - lower, 2.0 * np.pi))
    np.testing.assert_allclose(low + high, lower + upper, atol=1e-12)
    within = (upper - lower) < 2.0 * np.pi
    np.testing.assert_array_equal(low[within], lower[within])


@pytest.mark.parametrize("limit", [3.0, np.inf, [5.0, np.inf], np.array([1.0, 2.0])])
def test_other_effort_limits_make_the_same_arm(limit):
    robot = load_robot("two_link")
    weak = robot.with_effort_limit(limit)
    np.testing.assert_array_equal(weak.effort_limit, np.full(2, limit))
    test_pinocchio_carries_our_limits(weak)
    np.testing.assert_array_equal(robot.effort_limit, robot.model.upperEffortLimit)
    assert (robot.effort_limit == 100.0).all()
    assert (weak.sha256, weak.source, weak.options) == (robot.sha256, robot.source, robot.options)
    np.testing.assert_array_equal(weak.gravity_vector, weak.model.gravity.linear)
    assert PID.for_robot(weak).effort_limit.tolist() == weak.effort_limit.tolist()


def test_each_joint_gets_its_own_effort_limit():
    np.testing.assert_array_equal(load_robot("panda").with_effort_limit(range(1, 8)).effort_limit, np.arange(1.0, 8.0))


@pytest.mark.parametrize("limit", [0.0, -1.0, np.nan, [1.0], [1.0, 0.0], [1.0, np.nan], [[1.0, 2.0]], "strong"])
def test_effort_limits_that_are_none_are_refused(limit):
    with pytest.raises(ArgumentError, match="effort limit is"):
        load_robot("two_link").with_effort_limit(limit)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("two_link", {}),
        ("panda", {}),
        ("ur5", {"gravity": 1.62}),
        ("ur5", {"gravity": iter([0.0, 1.0, -9.0]), "lock": "wrist_3_joint"}),
        ("three_link", {"lock": ["joint3"], "zero_limits": "unlimited"}),
    ],
)
def test_an_arm_is_loaded_again_from_what_it_keeps(name, options):
    robot = load_robot(name, **options)
    stored = json.loads(json.dumps(robot.options))
    assert stored.keys() == options.keys()
    assert load_robot(robot.source, **stored).sha256 == robot.sha256


def test_an_arm_from_a_file_is_found_from_anywhere(tmp_path, monkeypatch):
    (tmp_path / "arm.urdf").write_bytes(find("three_link").path.read_bytes())
    monkeypatch.chdir(tmp_path)
    robot = load_robot("arm.urdf")
    monkeypatch.chdir("/")
    assert load_robot(robot.source).sha256 == robot.sha256


def test_pinocchio_carries_our_limits(robot):
    model = robot.model
    np.testing.assert_array_equal(model.lowerPositionLimit, robot.lower)
    np.testing.assert_array_equal(model.upperPositionLimit, robot.upper)
    np.testing.assert_array_equal(model.upperEffortLimit, robot.effort_limit)
    np.testing.assert_array_equal(model.lowerEffortLimit, -robot.effort_limit)
    np.testing.assert_array_equal(model.upperVelocityLimit, robot.velocity_limit)
    np.testing.assert_array_equal(model.lowerVelocityLimit, -robot.velocity_limit)


def test_the_dynamics_are_those_of_the_file(robot):
    """Rewriting the URDF changes no number: M, bias and gravity as Pinocchio reads the untouched file.

    Locked joints are removed by Pinocchio's own reduction; a continuous joint is (cos q, sin q) there. Pinocchio reads
    no rotor inertia.
    """
    model = pin.buildModelFromUrdf(str(robot.urdf.path))
    for joint in ET.parse(robot.urdf.path).getroot().iter("joint"):
        if joint.find("dynamics") is not None and model.existJointName(joint.get("name")):
            at = model.joints[model.getJointId(joint.get("name"))].idx_v
            model.armature[at] = float(joint.find("dynamics").get("armature", "0"))
    locked = [model.getJointId(name) for name in find(robot.source).options.get("lock", ())]
    if locked:
        model = pin.buildReducedModel(model, locked, pin.neutral(model))
    model.gravity.linear = robot.gravity_vector
    data, own = model.createData(), robot.model.createData()
    for q in random_configurations(robot):
        v = np.cos(q)
        nqs = [joint.nq for joint in list(model.joints)[1:]]
        raw = np.concatenate([[x] if nq == 1 else [np.cos(x), np.sin(x)] for x, nq in zip(q, nqs, strict=True)])
        mass = pin.crba(robot.model, own, q)
        np.testing.assert_allclose(mass, pin.crba(model, data, raw), atol=1e-13)
        np.testing.assert_allclose(pin.nle(robot.model, own, q, v), pin.nle(model, data, raw, v), atol=1e-11)
        assert np.linalg.eigvalsh(mass)[0] > 0


def test_a_robot_pickles(robot):
    copy = pickle.loads(pickle.dumps(robot))
    q = random_configurations(robot, 1)[0]
    np.testing.assert_array_equal(
        pin.crba(copy.model, copy.model.createData(), q), pin.crba(robot.model, robot.model.createData(), q)
    )
    assert copy.sha256 == robot.sha256
    assert copy.joints == robot.joints
    assert copy.model == robot.model


def test_known_arms():
    panda = load_robot("panda")
    assert panda.joint_names == tuple(f"panda_joint{i}" for i in range(1, 8))
    np.testing.assert_array_equal(panda.effort_limit, [87, 87, 87, 87, 12, 12, 12])
    assert load_robot("kinova").continuous.tolist() == [True, False, False, True, False, True]
    pendulum = load_robot("double_pendulum")
    assert np.isinf(pendulum.effort_limit).all()
    assert np.isinf(pendulum.upper).all()
    np.testing.assert_array_equal(pendulum.damping, [0.05, 0.05])
    assert repr(panda) == "Robot('panda', 7 joints, 17.5 kg, effort 12 to 87 N·m)"


def test_the_papers_arm_has_the_papers_mass_matrix():
    robot = load_robot("two_link")
    q = np.array([0.4, -1.1])
    c = np.cos(q[1])
    mass = pin.crba(robot.model, robot.model.createData(), q)
    np.testing.assert_allclose(mass, [[3 + 2 * c, 1 + c], [1 + c, 1]], atol=1e-11)
    np.testing.assert_array_equal(robot.gravity_vector, [0, 0, -9.8])


def test_locking():
    panda = load_robot("panda", lock=["panda_joint7"])
    assert panda.joint_names == tuple(f"panda_joint{i}" for i in range(1, 7))  # nor the catalogue's fingers
    wide = load_robot("panda", lock={"panda_finger_joint1": 0.02})
    assert wide.joint_names == load_robot("panda").joint_names
    assert wide.sha256 != load_robot("panda").sha256
    assert load_robot("ur5", lock="wrist_3_joint").nv == 5
    with pytest.warns(UserWarning, match=r"mimic another are locked: 'panda_finger_joint2' \(of 'panda_finger_joint1'"):
        assert load_robot("panda", lock=[]).nv == 8
    with pytest.raises(RobotError, match=r"ur5_robot\.urdf.*no joint 'wrist_4_joint' for lock.*wrist_3_joint"):
        load_robot("ur5", lock=["wrist_4_joint"])


def test_gravity_is_a_number_or_a_vector():
    np.testing.assert_array_equal(load_robot("ur5", gravity=1.62).gravity_vector, [0, 0, -1.62])
    tilted = load_robot("ur5", gravity=[0.0, 1.0, -9.0])
    np.testing.assert_array_equal(tilted.model.gravity.linear, [0, 1, -9])
    np.testing.assert_array_equal(load_robot("ur5", gravity=0.0).gravity_vector, np.zeros(3))


@pytest.mark.parametrize("gravity", [np.nan, np.inf, [0.0, 0.0], [0.0, 0.0, np.nan], [1.0, 2.0, 3.0, 4.0]])
def test_gravity_that_is_none_is_refused(gravity):
    with pytest.raises(ArgumentError, match=r"gravity is .* expected one finite number"):
        load_robot("two_link", gravity=gravity)


def test_gravity_that_cannot_be_iterated_over_is_refused():
    def broken():
        yield 0.0
        raise RuntimeError("no number")

    with pytest.raises(ArgumentError, match="gravity is a generator, which cannot be iterated over"):
        load_robot("two_link", gravity=broken())


def test_the_fingerprint_follows_the_dynamics_alone(tmp_path):
    robot = load_robot("three_link")
    text = robot.urdf.path.read_text()
    redrawn, heavier = tmp_path / "redrawn.urdf", tmp_path / "heavier.urdf"
    redrawn.write_text(text.replace("0.35 0.45 0.60 1", "1 0 0 1").replace('xyz="0.5 0 0"', 'xyz="5e-1  0 0"'))
    heavier.write_text(text.replace('<mass value="1"/>', '<mass value="1.001"/>', 1))
    assert load_robot("three_link").sha256 == load_robot(redrawn).sha256 == robot.sha256
    others = [load_robot(heavier), load_robot("three_link", gravity=9.8), load_robot("three_link", lock=["joint3"])]
    assert len({robot.sha256, *(other.sha256 for other in others)}) == 4


def test_what_is_not_found_says_what_exists(tmp_path):
    with pytest.raises(RobotNotFound, match="no robot 'pandas': did you mean panda") as caught:
        load_robot("pandas")
    assert all(name in str(caught.value) for name in ROBOT_NAMES)
    assert isinstance(caught.value, FileNotFoundError)
    with pytest.raises(RobotNotFound, match=r"no file '.*gone\.urdf'"):
        load_robot(tmp_path / "gone.urdf")
    with pytest.raises(RobotNotFound, match=r"is a directory; give one file in it \(it contains no \.urdf\)"):
        load_robot(tmp_path)
    (tmp_path / "arm.urdf").write_text("<robot/>")
    with pytest.raises(RobotNotFound, match=r"give one file in it \(arm\.urdf\)"):
        load_robot(tmp_path)
    with pytest.raises(RobotError, match=r"cannot read 'xxx.*File name too long"):
        load_robot("x" * 5000)
    with pytest.raises(RobotNotFound, match="is a directory"):
        load_robot("")


CONTINUOUS = np.array([True, False])


def test_the_difference_wraps_on_continuous_joints_alone():
    rng = np.random.default_rng(0)
    q, q_ref = rng.uniform(-50, 50, (2, 200, 2))
    z1 = configuration_difference(q, q_ref, CONTINUOUS)
    plain = q - q_ref
    np.testing.assert_allclose(z1[:, 0], np.arctan2(np.sin(plain[:, 0]), np.cos(plain[:, 0])), atol=1e-12)
    np.testing.assert_array_equal(z1[:, 1], plain[:, 1])
    np.testing.assert_array_equal(configuration_difference(q, q_ref, None), plain)
    same = configuration_difference(torch.from_numpy(q), torch.from_numpy(q_ref), CONTINUOUS)
    np.testing.assert_allclose(same.numpy(), z1, atol=1e-15)


@pytest.mark.parametrize("kind", [np.asarray, torch.as_tensor])
@pytest.mark.parametrize(
    ("z", "wrapped"), [(np.pi, np.pi), (-np.pi, np.pi), (0.0, 0.0), (2 * np.pi, 0.0), (-3.0, -3.0)]
)
def test_the_interval_is_open_below_and_closed_above(kind, z, wrapped):
    q = kind(np.array([z, z]))
    z1 = configuration_difference(q, kind(np.zeros(2)), CONTINUOUS)
    assert type(z1) is type(q)
    np.testing.assert_array_equal(np.asarray(z1), [wrapped, z])


def test_the_difference_has_unit_gradient():
    q = torch.tensor([[4.0, 4.0], [-9.0, 0.1]], dtype=torch.float64, requires_grad=True)
    z1 = configuration_difference(q, torch.zeros_like(q), CONTINUOUS)
    assert z1[0, 0] < 0
    torch.testing.assert_close(torch.autograd.grad(z1.sum(), q)[0], torch.ones_like(q), rtol=0, atol=0)


def test_a_home_that_is_not_there_is_a_sentence():
    with pytest.raises(RobotNotFound, match="~nouser-of-this-name/x"):
        load_robot("~nouser-of-this-name/x.urdf")
