"""Rotor inertia and joint friction: from the file, from arguments and from the shell, the same in every engine."""

import inspect

import numpy as np
import pytest
from commands import refusal

import nbs_pin as nbs
from nbs_pin import cli
from nbs_pin.robots.arm_file import OPTIONS

JOINT = (
    '<joint name="j{0}" type="revolute"><parent link="l{1}"/><child link="l{0}"/><origin xyz="0 0 0.3" rpy="0.3 0 0"/>'
    '<axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="60" velocity="5"/>{2}</joint>'
)
LINK = (
    '<link name="l{0}"><inertial><origin xyz="0.02 0 0.1"/><mass value="2"/>'
    '<inertia ixx="0.02" iyy="0.03" izz="0.02" ixy="0" ixz="0.001" iyz="0"/></inertial></link>'
)


def arm(folder, *dynamics, more=""):
    """An arm with these elements <dynamics>, one per joint."""
    parts = ['<robot name="arm">', '<link name="l0"/>', *(LINK.format(i + 1) for i in range(len(dynamics)))]
    parts += [JOINT.format(i + 1, i, dynamics[i]) for i in range(len(dynamics))]
    path = folder / "arm.urdf"
    path.write_text("".join([*parts, more, "</robot>"]))
    return path


def states(nv, seed=0):
    rng = np.random.default_rng(seed)
    return rng.uniform(-2.0, 2.0, (20, nv)), rng.uniform(-1.0, 1.0, (20, nv)), rng.uniform(-9.0, 9.0, (20, nv))


def test_the_armature_adds_to_the_diagonal_of_m_alone(tmp_path):
    """M = M_bodies + diag(armature); C, G and the potential energy stay (docs/theory.md §1)."""
    bare = nbs.load_robot(arm(tmp_path, "", "", ""))
    geared = bare.with_armature([0.3, 0.0, 2.0])
    q, v, a = states(3)
    one, other = nbs.PinocchioDynamics(bare), nbs.PinocchioDynamics(geared)
    difference = other.mass_matrix(q) - one.mass_matrix(q)
    np.testing.assert_allclose(difference, np.broadcast_to(np.diag([0.3, 0.0, 2.0]), difference.shape), atol=1e-14)
    np.testing.assert_allclose(other.coriolis_matrix(q, v), one.coriolis_matrix(q, v), atol=1e-14)
    np.testing.assert_allclose(other.gravity(q), one.gravity(q), atol=1e-14)
    np.testing.assert_allclose(
        other.reference_torque(q, v, v, a) - one.reference_torque(q, v, v, a), a * [0.3, 0.0, 2.0], atol=1e-12
    )


@pytest.mark.parametrize("joint_friction", ["drop", "keep"])
def test_engines_agree_on_the_whole_joint(tmp_path, joint_friction):
    """v̇ of MuJoCo is that of Pinocchio with armature and viscous friction."""
    stated = ['<dynamics damping="0.4" armature="0.5"/>', '<dynamics motor_inertia="1e-4" gear_ratio="100"/>', ""]
    robot = nbs.load_robot(arm(tmp_path, *stated))
    np.testing.assert_allclose(robot.armature, [0.5, 1.0, 0.0])
    np.testing.assert_array_equal(robot.damping, [0.4, 0.0, 0.0])
    q, v, tau = states(3)
    plant = nbs.MujocoPlant(robot, joint_friction=joint_friction)
    net = tau - robot.damping * v * (joint_friction == "keep")
    expected = nbs.PinocchioDynamics(robot).forward_dynamics(q, v, net)
    np.testing.assert_allclose(plant.acceleration(q, v, tau), expected, rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(plant.mass_matrix(q), nbs.PinocchioDynamics(robot).mass_matrix(q), atol=1e-13)


def test_the_rotor_of_a_transmission_is_felt_times_its_squared_reduction(tmp_path):
    """URDF states the reduction in the actuator, ros2_control in the joint."""
    more = (
        '<transmission name="t"><joint name="j1"/><actuator name="m"><mechanicalReduction>100</mechanicalReduction>'
        '</actuator></transmission><ros2_control name="c" type="system"><transmission name="u"><joint name="j2">'
        "<mechanical_reduction>-50.0</mechanical_reduction></joint></transmission></ros2_control>"
    )
    path = arm(tmp_path, "", '<dynamics damping="1"/>', "", more=more)
    robot = nbs.load_robot(path, rotor_inertia={"j1": 2e-5, "j2": 4e-5}, armature={"j3": 0.7})
    np.testing.assert_allclose(robot.armature, [0.2, 0.1, 0.7])
    with pytest.raises(nbs.RobotError, match=r"'j3': a rotor inertia .* no transmission .*armature=\{'j3'"):
        nbs.load_robot(path, rotor_inertia=1e-5)


@pytest.mark.parametrize("place", ["<actuator name='m'>{}</actuator>", "{}", None])
def test_every_place_of_a_reduction_is_read(tmp_path, place):
    """In the actuator (ROS), in the transmission (PR2) or in its joint (ros2_control): the same rotor behind it."""
    reduction = "<mechanicalReduction>-50.0</mechanicalReduction>"
    inside = f"<joint name='j1'>{reduction if place is None else ''}</joint>{(place or '').format(reduction)}"
    path = arm(tmp_path, "", "", more=f"<transmission name='t'>{inside}</transmission>")
    assert nbs.load_robot(path).urdf.without_rotor == ("j1",)
    assert nbs.load_robot(path, armature={"j1": 0.0}).urdf.without_rotor == ()
    known = nbs.load_robot(path, rotor_inertia={"j1": 1e-4})
    np.testing.assert_allclose(known.armature, [0.25, 0.0])
    with pytest.raises(nbs.RobotError, match="behind a gear of -50 is beyond reason"):
        nbs.load_robot(path, rotor_inertia={"j1": 1e9})


def test_what_is_given_replaces_what_the_file_states(tmp_path):
    path = arm(tmp_path, '<dynamics damping="1" friction="2" armature="3"/>', '<dynamics damping="4"/>')
    robot = nbs.load_robot(path, viscous_friction={"j2": 0.0}, coulomb_friction={"*": 0.5, "j1": 0.25}, armature=0.125)
    np.testing.assert_array_equal([robot.damping, robot.friction, robot.armature], [[1, 0], [0.25, 0.5], [0.125] * 2])
    again = nbs.load_robot(robot.source, **robot.options)
    assert again.sha256 == robot.sha256 != nbs.load_robot(path).sha256
    changed = robot.with_friction(coulomb={"j2": 7.0}, viscous=[1.0, 2.0]).with_armature({"j2": 9.0})
    np.testing.assert_array_equal(
        [changed.damping, changed.friction, changed.armature], [[1, 2], [0.25, 7], [0.125, 9]]
    )


@pytest.mark.parametrize(
    ("dynamics", "said"),
    [
        ('<dynamics armature="-1"/>', "armature '-1.0' is not a finite number >= 0"),
        ('<dynamics armature="nan"/>', "armature 'nan' is not"),
        ('<dynamics motor_inertia="1" gear_ratio="x"/>', "gear_ratio 'x' is not a finite number"),
        ('<dynamics armature="1e30"/>', "beyond 1e\\+09"),
    ],
)
def test_wrong_drives_are_refused(tmp_path, dynamics, said):
    with pytest.raises(nbs.RobotError, match=rf"arm.urdf:1: joint 'j1': .*{said}"):
        nbs.load_robot(arm(tmp_path, dynamics))


@pytest.mark.parametrize("wrong", [-1.0, np.nan, {"j1": "x"}, "0.1", {"*": np.inf}, {1: 2.0}, 1e10])
def test_wrong_numbers_are_refused(tmp_path, wrong):
    for name in ("armature", "rotor_inertia", "viscous_friction", "coulomb_friction"):
        with pytest.raises(nbs.ArgumentError, match=f"{name} is .*give for instance"):
            nbs.load_robot(arm(tmp_path, ""), **{name: wrong})
    with pytest.raises(nbs.RobotError, match="no joint 'j9' for armature"):
        nbs.load_robot(arm(tmp_path, ""), armature={"j9": 1.0})


def test_a_law_and_its_gains_know_the_rotor(tmp_path):
    """K, D₀ follow M_e = 1/(M⁻¹)_ii, which the armature raises, and the arm tracks as well as before."""
    bare = nbs.load_robot(arm(tmp_path, "", "", ""))
    geared = bare.with_armature(1.5)
    q = np.zeros(3)
    light, heavy = (nbs.NeuralBackstepping.for_robot(robot) for robot in (bare, geared))
    gradient = [np.abs(law.torque(q, q, q + 0.01, q, q)) for law in (light, heavy)]
    assert (gradient[1] > gradient[0]).all()
    reference = nbs.Sinusoid.for_robot(geared)
    run = nbs.simulate(nbs.MujocoPlant(geared), heavy, reference, 2.0, 0.001)
    assert np.abs(run.q - run.q_ref).max() < 1e-5


def test_a_file_beside_the_description_adds_to_it(tmp_path):
    """A .toml file is an arm: its options are those of load_robot, paths are relative to it."""
    arm(tmp_path, "", "")
    file = tmp_path / "mine.toml"
    file.write_text(
        'description = "arm.urdf"\ngravity = 1.62\nbase_rpy = [3.14159, 0, 0]\n'
        "[armature]\nj1 = 0.25\n[coulomb_friction]\n'*' = 0.5\n[payload.l2]\nmass = 1.5\ncom = [0, 0, 0.1]\n"
    )
    robot = nbs.load_robot(file)
    same = nbs.load_robot(
        tmp_path / "arm.urdf", gravity=1.62, base_rpy=[3.14159, 0, 0], armature={"j1": 0.25}, coulomb_friction=0.5,
        payload={"l2": {"mass": 1.5, "com": [0, 0, 0.1]}},
    )  # fmt: skip
    assert robot.sha256 == same.sha256
    assert nbs.load_robot(file, gravity=9.81).gravity_vector[2] == -9.81
    assert nbs.load_robot(robot.source, **robot.options).sha256 == robot.sha256
    for text, said in (
        ("gravity = 3", "names no description"),
        (
            'description = "arm.urdf"\ncoulomb_friktion = 2',
            "'coulomb_friktion' is no option .*; give description, coulomb_friction",
        ),
        ("x = [", "is not TOML"),
        ('description = "mine.toml"', "is a .toml file too"),
    ):
        file.write_text(text)
        with pytest.raises(nbs.RobotError, match=said):
            nbs.load_robot(file)


def test_what_is_given_by_name_is_added_to_the_file_and_one_number_takes_its_place(tmp_path):
    arm(tmp_path, "", "")
    file = tmp_path / "mine.toml"
    file.write_text(
        'description = "arm.urdf"\n[armature]\nj1 = 0.25\n[payload.l2]\nmass = 1.5\n[limits.j1]\neffort = 7\n'
    )
    more = nbs.load_robot(file, armature={"j2": 1.0}, limits={"j1": {"velocity": 2.0}}, payload={"l1": 1.0})
    np.testing.assert_array_equal(more.armature, [0.25, 1.0])
    assert (more.effort_limit[0], more.velocity_limit[0]) == (7.0, 2.0)
    assert sum(body.mass for body in more.model.inertias) == pytest.approx(4.0 + 1.5 + 1.0)
    same = nbs.load_robot(more.source, **more.options)
    assert same.sha256 == more.sha256
    np.testing.assert_array_equal(same.effort_limit, more.effort_limit)
    one = nbs.load_robot(file, armature=0.5, payload={})
    np.testing.assert_array_equal(one.armature, [0.5, 0.5])
    assert sum(body.mass for body in one.model.inertias) == pytest.approx(4.0)
    assert nbs.load_robot(one.source, **one.options).sha256 == one.sha256
    every = nbs.load_robot(file, armature={"*": 1.0, "j2": 2.0}, limits={"*": {"effort": 50.0}})
    np.testing.assert_array_equal(every.armature, [1.0, 2.0])
    np.testing.assert_array_equal(every.effort_limit, [50.0, 50.0])
    again = nbs.load_robot(every.source, **every.options)
    assert again.sha256 == every.sha256
    np.testing.assert_array_equal(again.effort_limit, every.effort_limit)
    file.write_text('description = "panda"\nlock = ["panda_joint7"]\n')  # beside the fingers, which panda locks
    assert nbs.load_robot(file).joint_names == nbs.load_robot("panda").joint_names[:6]


def test_a_file_can_state_every_argument():
    assert (*inspect.signature(nbs.load_robot).parameters,)[1:] == OPTIONS


def test_the_shell_takes_what_an_error_names(tmp_path, capsys):
    path = str(arm(tmp_path, "", ""))
    out = ["--out", str(tmp_path / "out"), "--force", "--duration", "0.1"]
    assert "--armature j1=…" in refusal(cli.main(["track", path, "--rotor-inertia", "1e-5", *out]), capsys)
    words = ["--armature", "j1=0.5", "--coulomb-friction", "0.1", "--viscous-friction", "j2=1"]
    assert cli.main(["track", path, *words, *out]) == 0
    run = nbs.Run.load(tmp_path / "out" / "run.npz")
    assert run.robot_options == {"armature": {"j1": 0.5}, "coulomb_friction": 0.1, "viscous_friction": {"j2": 1.0}}


@pytest.mark.parametrize(
    "words", ["--armature=1,2", "--armature=j1=x", "--coulomb-friction=-1", "--viscous-friction=j1=,j2=3"]
)
def test_wrong_words_name_their_flag(words, capsys):
    line = refusal(cli.main(["track", "two_link", words]), capsys)
    assert words.split("=")[0] in line
    assert "JOINT=NUMBER" in line


@pytest.mark.parametrize("model", ["identify", "chain"])
def test_rotors_of_the_arm_are_found_without_asking(tmp_path, model):
    """M, C and G of a learned model are those of the geared arm: a rotor is no body of the tree."""
    robot = nbs.load_robot(arm(tmp_path, "", "")).with_armature([0.6, 0.25])
    data = nbs.collect(robot, "uniform", 400)
    learned = nbs.identify(data, robot) if model == "identify" else nbs.fit(data, "chain", robot=robot, starts=1)
    q, v, a = states(2)
    truth = nbs.PinocchioDynamics(robot)
    np.testing.assert_allclose(learned.mass_matrix(q), truth.mass_matrix(q), atol=1e-6)
    np.testing.assert_allclose(learned.reference_torque(q, v, v, a), truth.reference_torque(q, v, v, a), atol=1e-5)
