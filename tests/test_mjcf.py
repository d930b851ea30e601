"""MJCF files: the arm is the one that MuJoCo itself builds from the file, whatever engine computes it here."""

import os
import shutil
import subprocess
import sys
import warnings
import xml.etree.ElementTree as ET
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import mujoco
import numpy as np
import pinocchio as pin
import pytest

import nbs_pin as nbs
from nbs_pin.robots.rotations import about, from_quaternion, to_rpy
from nbs_pin.robots.visuals import link_visuals

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT / "tools"))

from fuzz.original import deviations, followers, joint_names, original_model  # noqa: E402

FILES = ROOT / "tests" / "data" / "mjcf"
ARMS = (
    "seven_joints", "continuous", "six_servos", "from_geoms", "universal", "gantry", "two_arms", "scara", "gripper",
    "scene", "unnamed", "meshes", "neutral",
)  # fmt: skip
IDLE = "ignore:.*no actuator drives joints"


def arm(body: str, outside: str = "") -> str:
    """A file with a joint 'a' of a body, and what else it is to hold."""
    return f"""<mujoco><compiler angle="radian"/><worldbody><body name="one"><joint name="a" range="-2 2"/>
<geom type="capsule" fromto="0 0 0 0.3 0 0.1" size="0.04"/>{body}</body></worldbody>{outside}</mujoco>"""


def loaded(tmp_path, text, name="arm.xml", **options):
    (tmp_path / name).write_text(text)
    return nbs.load_robot(tmp_path / name, **options)


def refusal(tmp_path, text, **options):
    with pytest.raises(nbs.RobotError) as caught:
        loaded(tmp_path, text, **options)
    assert "\n" not in str(caught.value)
    return str(caught.value)


# The arm is MuJoCo's.


@pytest.mark.filterwarnings(IDLE)
@pytest.mark.parametrize("name", ARMS)
def test_the_arm_is_that_of_mujoco(name):
    path = FILES / f"{name}.xml"
    model = original_model(path)
    held = dict.fromkeys(followers(model), 0.013)
    robot = nbs.load_robot(path, lock=held)
    found = deviations(robot, model, held, poses=20)
    assert max(found.values()) < 1e-12, found
    names = joint_names(model)
    assert set(robot.joint_names) == set(names) - set(held)


@pytest.mark.filterwarnings(IDLE, "ignore:.*mimic another are locked")
@pytest.mark.parametrize("name", ARMS)
def test_both_engines_build_the_same_arm(name):
    robot = nbs.load_robot(FILES / f"{name}.xml")
    plant, model = nbs.MujocoPlant(robot), nbs.PinocchioDynamics(robot)
    low, high = robot.one_turn_range
    draws = np.random.default_rng(3)
    q = draws.uniform(low, high, (10, robot.nv))
    v, tau = draws.standard_normal((2, 10, robot.nv))
    mass = model.mass_matrix(q)
    np.testing.assert_allclose(plant.mass_matrix(q), mass, atol=1e-12 * np.abs(mass).max())
    bias = np.einsum("kij,kj->ki", model.coriolis_matrix(q, v), v) + model.gravity(q)
    np.testing.assert_allclose(plant.bias(q, v), bias, atol=1e-11 * (1.0 + np.abs(bias).max()))
    a = model.forward_dynamics(q, v, tau)
    np.testing.assert_allclose(plant.acceleration(q, v, tau), a, rtol=1e-8, atol=1e-8 * np.abs(a).max())


@pytest.mark.filterwarnings(IDLE)
@pytest.mark.parametrize("name", ["universal", "gantry", "two_arms", "scara", "seven_joints"])
def test_bodies_stand_where_mujoco_puts_them(name):
    """Anchors, references and several joints of a body: the frame of every link is that of its body."""
    model, robot = original_model(FILES / f"{name}.xml"), nbs.load_robot(FILES / f"{name}.xml")
    data, ours = mujoco.MjData(model), robot.model.createData()
    q = np.random.default_rng(0).uniform(-1.0, 1.0, robot.nv)
    for joint, place in zip(robot.joint_names, q, strict=True):
        data.qpos[model.jnt_qposadr[model.joint(joint).id]] = place
    mujoco.mj_kinematics(model, data)
    pin.framesForwardKinematics(robot.model, ours, q)
    for body in range(1, model.nbody):
        frame = ours.oMf[robot.model.getFrameId(model.body(body).name, pin.FrameType.BODY)]
        np.testing.assert_allclose(frame.translation, data.xpos[body], atol=1e-14)
        np.testing.assert_allclose(frame.rotation, data.xmat[body].reshape(3, 3), atol=1e-14)


def test_a_body_is_one_link_where_its_last_joint_has_no_anchor():
    described = ET.fromstring(nbs.load_robot(FILES / "seven_joints.xml").urdf.xml)
    names = ["world", *(f"link{k}" for k in range(8)), "flange"]
    assert [link.get("name") for link in described.findall("link")] == names
    described = ET.fromstring(nbs.load_robot(FILES / "universal.xml").urdf.xml)
    hip = [link.get("name") for link in described.findall("link") if "hip" in link.get("name")]
    assert hip == ["hip", "hip_hip_x", "hip_hip_y", "hip_hip_z"]


def test_numbers_of_joints_and_actuators():
    servos = nbs.load_robot(FILES / "six_servos.xml")
    assert servos.effort_limit.tolist() == [140.0, 140.0, 140.0, 28.0, 28.0, 28.0]  # the smaller of both ranges
    assert servos.armature.tolist() == [0.1, 0.1, 0.1, 0.03, 0.03, 0.03]
    np.testing.assert_allclose(servos.upper, np.radians([360, 360, 360, 90, 90, 90]), rtol=1e-15)
    assert np.isinf(servos.velocity_limit).all()
    scara = nbs.load_robot(FILES / "scara.xml")
    gears = np.array([80.0, 50.0, 400.0, 30.0])
    np.testing.assert_allclose(scara.armature, gears**2 * [2e-5, 1.5e-5, 1e-5, 0.8e-5], rtol=1e-15)
    np.testing.assert_allclose(scara.damping, gears**2 * [1e-4, 1e-4, 0.0, 0.0], rtol=1e-15)
    np.testing.assert_allclose(scara.effort_limit, gears * [1.5, 1.0, 0.6, 0.4])
    arms = nbs.load_robot(FILES / "seven_joints.xml")
    assert arms.friction.tolist() == [1.13] * 4 + [0.4] * 3
    assert arms.armature.tolist() == [0.195] * 4 + [0.074] * 3
    motors = nbs.load_robot(FILES / "universal.xml")
    assert motors.effort_limit.tolist() == [40.0, 40.0, 25.0, 40.0, 40.0, 300.0]  # the control range times the gear
    continuous = nbs.load_robot(FILES / "continuous.xml")
    assert continuous.continuous.tolist() == [True, False, True, False]
    assert continuous.effort_limit.tolist() == [105.0, 105.0, 52.0, 52.0]


def test_gravity_is_that_of_the_file_unless_it_is_given(tmp_path):
    assert nbs.load_robot(FILES / "six_servos.xml").gravity_vector.tolist() == [0.3, -0.2, -9.7]
    assert nbs.load_robot(FILES / "six_servos.xml", gravity=1.62).gravity_vector.tolist() == [0.0, 0.0, -1.62]
    off = loaded(tmp_path, arm("", '<option gravity="0 0 -5"><flag gravity="disable"/></option>'))
    assert off.gravity_vector.tolist() == [0.0, 0.0, 0.0]


def test_gravcomp_of_all_bodies_is_less_gravity(tmp_path):
    text = arm("").replace('name="one"', 'name="one" gravcomp="0.25"')
    with pytest.warns(UserWarning, match=r"gravcomp leaves 0\.75 of the weight"):
        robot = loaded(tmp_path, text)
    np.testing.assert_allclose(robot.gravity_vector, [0.0, 0.0, -0.75 * 9.81])
    assert max(deviations(robot, original_model(tmp_path / "arm.xml"), {}).values()) < 1e-12
    two = arm('<body name="two" pos="0.3 0 0" gravcomp="1"><joint name="b"/><geom size="0.1"/></body>')
    assert "'two' has gravcomp 1, and others another" in refusal(tmp_path, two)


# What MJCF says beyond a tree of bodies.

SECOND = """<body name="two" pos="0.3 0 0.1"><joint name="b" axis="0 1 0" {}/><geom size="0.1" mass="1"/>
<site name="s"/></body>"""
TENDON = '<tendon><fixed name="t" {}><joint joint="a" coef="1"/><joint joint="b" coef="0.5"/></fixed></tendon>'
WIRE = '<tendon><spatial name="w" stiffness="3"><site site="base"/><site site="s"/></spatial></tendon>'


@pytest.mark.parametrize(
    ("joint", "outside", "told", "lock"),
    [
        ('stiffness="3"', "", "joint 'b' has a spring of stiffness 3", ["b"]),
        ('springdamper="0.1 1"', "", "joint 'b' has a spring", ["b"]),
        ('damping="1 0.2"', "", "joint 'b' has damping that is not proportional to its speed", ["b"]),
        ("", '<option density="1.2"/>', "it moves in a fluid of density 1.2", ["a", "b"]),
        ("", TENDON.format('damping="2"'), "tendon 't' has damping, which couples joints", ["a", "b"]),
        ("", TENDON.format('stiffness="0 0.3"'), "tendon 't' has stiffness, which couples joints", ["a", "b"]),
        ('stiffness="0 0.3"', "", "joint 'b' has a spring of stiffness 0", ["b"]),
        ("", TENDON.format('armature="2"'), "tendon 't' has armature, which couples joints", ["a", "b"]),
        ("", WIRE, "tendon 'w' has stiffness, which couples joints", ["a", "b"]),
        (
            "",
            '<equality><connect name="c" body1="one" body2="two" anchor="0 0 0"/></equality>',
            "equality 'c' closes a loop",
            ["b"],
        ),
        ("", '<equality><weld site1="s" site2="base"/></equality>', "equality 1 closes a loop", ["a", "b"]),
        (
            "",
            '<equality><joint joint1="b" joint2="a" polycoef="0 1 0.3 0 0"/></equality>',
            "couples joint 'b' by more than a straight line",
            ["b"],
        ),
        ("", '<equality><joint joint1="b" polycoef="0.4"/></equality>', "keeps joint 'b' at 0.4", ["b"]),
        ("", TENDON.format("") + '<equality><tendon tendon1="t"/></equality>', "couples joints in a way", ["a", "b"]),
        (
            "",
            TENDON.format("") + '<actuator><motor tendon="t" armature="0.1"/></actuator>',
            "actuator 1 has armature but no joint",
            ["a", "b"],
        ),
    ],
)
def test_what_else_moves_the_arm_is_refused_unless_its_joints_are_locked(joint, outside, told, lock, tmp_path):
    third = '<body name="three" pos="0 0.2 0"><joint name="free"/><geom size="0.1"/></body>'
    text = arm(SECOND.format(joint), outside).replace("<worldbody>", f'<worldbody><site name="base"/>{third}')
    message = refusal(tmp_path, text)
    assert told in message
    everything = "fluid" in told or "no joint" in told
    assert everything != (f"lock what moves with it (lock={lock!r})" in message)
    if not everything:
        robot = loaded(tmp_path, text, lock=dict.fromkeys(lock, 0.2))
        model = original_model(tmp_path / "arm.xml")
        for stiffness in (model.tendon_stiffness, model.tendon_stiffnesspoly, model.jnt_stiffness):
            stiffness[:] = 0.0  # it acts on what is locked
        assert max(deviations(robot, model, dict.fromkeys(lock, 0.2)).values()) < 1e-12


def test_one_refusal_names_all_that_must_be_locked(tmp_path):
    third = '<body name="three" pos="0 0.2 0"><joint name="c"/><geom size="0.1"/></body>'
    text = arm(SECOND.format('stiffness="3"') + third.replace("/>", ' stiffness="1"/>', 1))
    message = refusal(tmp_path, text)
    assert "joint 'b' has a spring of stiffness 3 (and 1 more such parts)" in message
    assert "(lock=['b', 'c'])" in message
    assert loaded(tmp_path, text, lock=["b", "c"]).joint_names == ("a",)


def test_a_part_that_is_switched_off_is_no_part(tmp_path):
    off = '<option><flag spring="disable" damper="disable" equality="disable" frictionloss="disable"/></option>'
    outside = off + '<equality><connect body1="one" body2="two" anchor="0 0 0"/></equality>'
    robot = loaded(tmp_path, arm(SECOND.format('stiffness="3" damping="2" frictionloss="1"'), outside))
    assert robot.damping.tolist() == robot.friction.tolist() == [0.0, 0.0]
    inactive = '<equality><connect body1="one" body2="two" anchor="0 0 0" active="false"/></equality>'
    assert loaded(tmp_path, arm(SECOND.format(""), inactive)).nv == 2


@pytest.mark.parametrize(("joint", "kind"), [("<freejoint/>", "floating"), ('<joint type="ball"/>', "ball")])
def test_a_free_or_ball_joint_is_refused_unless_it_is_locked(joint, kind, tmp_path):
    text = arm("").replace(
        '<body name="one">', f'<body pos="0 0 1" quat="1 1 0 0">{joint}<geom size="0.1"/><body name="one">'
    )
    text = text.replace("</worldbody>", "</body></worldbody>")
    message = refusal(tmp_path, text)
    assert f"type '{kind}' is not supported" in message
    assert "lock=['joint1']" in message
    robot = loaded(tmp_path, text, lock=["joint1"])
    assert robot.joint_names == ("a",)
    np.testing.assert_allclose(robot.model.jointPlacements[1].translation, [0, 0, 1])


def test_a_joint_that_follows_another_is_locked_and_named():
    with pytest.warns(UserWarning, match=r"gripper\.xml:11: joints that mimic .* 'finger2' \(of 'finger1', at 0\.01\)"):
        robot = nbs.load_robot(FILES / "gripper.xml")
    held = {"finger2": 0.01}
    assert max(deviations(robot, original_model(FILES / "gripper.xml"), held).values()) < 1e-12
    given = nbs.load_robot(FILES / "gripper.xml", lock={"finger1": 0.02, "finger2": 0.03})
    model = original_model(FILES / "gripper.xml")
    assert max(deviations(given, model, {"finger1": 0.02, "finger2": 0.03}).values()) < 1e-12


def test_joints_that_nothing_drives_are_named_where_others_are_driven():
    with pytest.warns(UserWarning, match=r"no actuator drives joints 'waist', 'right_shoulder', 'right_elbow'"):
        nbs.load_robot(FILES / "two_arms.xml")


def test_the_models_that_mujoco_ships_are_named_in_words():
    path = Path(mujoco.__file__).parent / "testdata" / "model.xml"
    with pytest.raises(
        nbs.RobotError, match=r"joint 'hipz_0' has a spring of stiffness 10 \(and 8 more such parts\); remove its"
    ):
        nbs.load_robot(path)


# Links without mass.

CROSSED = """<robot name="crossed"><link name="base"/><link name="cross"/><link name="arm"><inertial><mass value="2"/>
<origin xyz="0.1 0 0.2"/><inertia ixx="0.02" iyy="0.03" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="x" type="revolute"><parent link="base"/><child link="cross"/><axis xyz="1 0 0"/><origin rpy="0.1 0.2 0"/>
<limit lower="-1" upper="1" effort="9" velocity="3"/></joint><joint name="y" type="{kind}"><parent link="cross"/>
<child link="arm"/><axis xyz="{axis}"/><origin xyz="0 0.1 0.05" rpy="0 0.3 0.1"/><limit lower="-1" upper="1" effort="9"
velocity="3"/></joint></robot>"""


@pytest.mark.parametrize(("kind", "axis"), [("revolute", "0 1 0"), ("prismatic", "0 0.6 0.8")])
def test_a_link_without_mass_between_joints_loads_if_m_is_positive_definite(kind, axis, tmp_path):
    robot = loaded(tmp_path, CROSSED.format(kind=kind, axis=axis), "crossed.urdf")
    plant, model = nbs.MujocoPlant(robot), nbs.PinocchioDynamics(robot)
    q, v, tau = np.random.default_rng(0).uniform(-1.0, 1.0, (3, 5, 2))
    np.testing.assert_allclose(plant.mass_matrix(q), model.mass_matrix(q), atol=1e-14)
    np.testing.assert_allclose(plant.acceleration(q, v, tau), model.forward_dynamics(q, v, tau), rtol=1e-10)


def test_a_link_without_mass_is_refused_where_m_is_singular(tmp_path):
    same = CROSSED.format(kind="revolute", axis="1 0 0").replace('<origin xyz="0 0.1 0.05" rpy="0 0.3 0.1"/>', "")
    assert "not finite and positive definite" in refusal_of(tmp_path, same)
    shape = '<link name="cross"><visual><geometry><sphere radius="0.1"/></geometry></visual></link>'
    forgotten = CROSSED.format(kind="revolute", axis="0 1 0").replace('<link name="cross"/>', shape)
    assert "moves link 'cross', which has no mass though it has a shape" in refusal_of(tmp_path, forgotten)
    bare = CROSSED.format(kind="revolute", axis="0 1 0")
    bare = bare[: bare.index("<inertial>")] + bare[bare.index("</inertial>") + 11 :]
    assert "moves link 'cross', which has no mass" in refusal_of(tmp_path, bare)


def refusal_of(tmp_path, text):
    with pytest.raises(nbs.RobotError) as caught:
        loaded(tmp_path, text, "arm.urdf")
    return str(caught.value)


# Rotations.


def test_roll_pitch_yaw_gives_the_rotation_again_in_every_attitude():
    draws = np.random.default_rng(0)
    for k in range(2000):
        rotation = from_quaternion(draws.standard_normal(4))
        if k % 2:  # near gimbal lock
            pitch = draws.choice([-1, 1]) * np.pi / 2 + draws.choice([-1, 1]) * 10.0 ** draws.uniform(-18, -3)
            about_z, about_y = about(np.array([0.0, 0, 1]), draws.uniform(-3, 3)), about(np.array([0.0, 1, 0]), pitch)
            rotation = about_z @ about_y @ about(np.array([1.0, 0, 0]), draws.uniform(-3, 3))
        roll, pitch, yaw = to_rpy(rotation)
        again = (
            about(np.array([0.0, 0, 1]), yaw) @ about(np.array([0.0, 1, 0]), pitch) @ about(np.array([1.0, 0, 0]), roll)
        )
        np.testing.assert_allclose(again, rotation, atol=2e-15)


# Files.


def test_the_root_element_says_what_a_file_is(tmp_path):
    assert loaded(tmp_path, arm(""), "arm.urdf").joint_names == ("a",)
    shutil.copy(ROOT / "urdf" / "two_link.urdf", tmp_path / "two.xml")
    assert nbs.load_robot(tmp_path / "two.xml").joint_names == ("joint1", "joint2")


def test_meshes_that_weigh_nothing_may_be_missing_and_others_may_not(tmp_path):
    robot = nbs.load_robot(FILES / "seven_joints.xml")
    with pytest.warns(UserWarning, match=r"link 'link\d' is drawn as a capsule: .* was not found"):
        link_visuals(robot)
    for name in ("meshes.xml", "assets"):
        (shutil.copytree if name == "assets" else shutil.copy)(FILES / name, tmp_path / name)
    (tmp_path / "assets" / "wedge.obj").unlink()
    with pytest.raises(
        nbs.RobotError, match=r"body 'first': its mass is that of mesh 'wedge\.obj', which was not found"
    ):
        nbs.load_robot(tmp_path / "meshes.xml")


def test_errors_name_the_line_of_a_name_that_contains_another(tmp_path):
    text = arm('\n<body>\n<joint name="a_b" damping="-1"/><joint name="b" pos="0 1 0"/><geom size="0.1"/></body>')
    assert "arm.xml:4: joint 'a_b': dynamics damping '-1.0'" in refusal(tmp_path, text)


def test_errors_name_the_line_of_what_has_no_name(tmp_path):
    text = arm('\n<body>\n<joint damping="-1"/><geom size="0.1"/></body>')
    assert "arm.xml:4: joint 'joint2': dynamics damping '-1.0'" in refusal(tmp_path, text)


@pytest.mark.filterwarnings(IDLE)
def test_errors_name_the_file_and_the_line_where_it_is_written(tmp_path):
    shutil.copytree(FILES, tmp_path, dirs_exist_ok=True)
    limb = tmp_path / "assets" / "limb.xml"
    limb.write_text(limb.read_text().replace('range="-1.7 2.1"', 'range="-1.7 2e20"'))
    with pytest.raises(nbs.RobotError, match=r"limb\.xml:6: joint 'left_shoulder': limit upper 2e\+20 is beyond"):
        nbs.load_robot(tmp_path / "two_arms.xml")
    arm_file = tmp_path / "arm_of_scene.xml"
    arm_file.write_text(arm_file.read_text().replace('name="lift" axis', 'name="lift" damping="-1" axis'))
    with pytest.raises(nbs.RobotError, match=r"arm_of_scene\.xml:11: joint 'lift': dynamics damping '-1\.0'"):
        nbs.load_robot(tmp_path / "scene.xml")


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (arm("", '<include file="none.xml"/>'), "file 'none.xml' was not found"),
        (arm("", '<include file="arm.xml"/>'), "is included twice"),
        (arm('<replicate count="70"><replicate count="70"><site/></replicate></replicate>' * 30), "too large"),
        (arm('<replicate count="1e9"><site/></replicate>'), "count '1e9' is not a whole number"),
        (
            arm("", '<asset><hfield name="h" nrow="30000" ncol="30000" size="1 1 1 1"/></asset>'),
            "nrow '30000' is beyond",
        ),
        (arm("", '<size nuser_body="300000000"/>'), "nuser_body '300000000' is beyond"),
        (arm("", '<asset><mesh name="m" builtin="plate" params="100000 100000"/></asset>'), "params '100000 100000'"),
        (arm('<flexcomp name="f" type="grid" count="9 9 9"/>'), "<flexcomp> is deformable"),
        (arm('<body pos="0 0 1" quat="0 1e-9 0 0"/>'), "quaternion has the length 1e-09"),
        (arm('<body><joint ref="1e300"/><geom size="0.1"/></body>'), "ref 1e+300 is beyond"),
        (arm('<body pos="nan 0 0"/>'), "is not 3 finite numbers"),
        (arm('<body><geom size="0.1" pos="1e9 0 0"/></body>'), "its centre of mass is 1e+09 m away"),
        (arm("<joint/><joint/>").replace("<joint/>", "<join/>"), "MuJoCo cannot read it (Schema violation"),
        ("<!DOCTYPE a []>" + arm(""), "DTD and entities are not allowed"),
        ("<mujoco/>", "0 movable joints"),
        ("<mujoco>", "not well-formed XML"),
    ],
)
def test_files_that_give_no_arm_are_refused_in_one_sentence(text, told, tmp_path):
    assert told in refusal(tmp_path, text)


def test_files_in_files_are_not_nested_too_deeply(tmp_path):
    deep, end = "<body>" * 60, "</body>" * 60
    (tmp_path / "one.xml").write_text(f'<mujocoinclude>{deep}<include file="two.xml"/>{end}</mujocoinclude>')
    (tmp_path / "two.xml").write_text(f"<mujocoinclude>{deep}<site/>{end}</mujocoinclude>")
    assert "too deep: more than 128 nested elements" in refusal(tmp_path, arm(f'{deep}<include file="one.xml"/>{end}'))
    assert loaded(tmp_path, arm('<body pos="0 0 1"><include file="two.xml"/></body>')).nv == 1


def test_nothing_is_printed_and_no_file_is_left(tmp_path):
    code = (
        "import sys, warnings, nbs_pin as nbs\n"
        "warnings.simplefilter('ignore')\n"
        "for name in sys.argv[1:]:\n"
        "    try: nbs.load_robot(name)\n"
        "    except nbs.RobotError: pass\n"
    )
    (tmp_path / "bad").mkdir()
    (tmp_path / "bad" / "bad.xml").write_text(arm('<body><joint axis="0 0 0"/><geom size="0.1"/></body>'))
    work = tmp_path / "work"
    work.mkdir()
    names = [str(path) for path in (*FILES.glob("*.xml"), tmp_path / "bad" / "bad.xml")]
    done = subprocess.run([sys.executable, "-c", code, *names], cwd=work, capture_output=True, check=True, env=None)
    assert (done.stdout, done.stderr) == (b"", b"")
    assert not list(work.iterdir())


def test_broken_files_are_refused_or_give_the_arm_of_mujoco():
    """A short form of `make fuzz-descriptions`."""
    command = [sys.executable, str(ROOT / "tools" / "fuzz_descriptions.py"), "--format", "mjcf", "--count", "150"]
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [*command, "--workers", "1"], capture_output=True, text=True, check=False, env=environment, timeout=300
    )
    assert done.returncode == 0, done.stdout
    counts = {words[1]: int(words[0]) for words in map(str.split, done.stdout.splitlines()) if words[0].isdecimal()}
    assert counts["refused"] > 50
    assert counts["accepted"] > 20


# What is built on it.


def test_meshes_and_capsules_are_drawn_where_mujoco_has_them():
    path = FILES / "meshes.xml"
    robot, model = nbs.load_robot(path), original_model(path)
    with pytest.warns(UserWarning, match="links 'foot', 'first' are drawn as capsules: .* was not found"):
        found = link_visuals(robot)
    visuals = {link: [visual for visual in found if visual.link == link] for link in ("first", "second")}
    for body in ("first", "second"):
        geom = int(model.body(body).geomadr[0])
        mesh = int(model.geom_dataid[geom])
        first = int(model.mesh_vertadr[mesh])
        vertices = model.mesh_vert[first : first + int(model.mesh_vertnum[mesh])].astype(float)
        theirs = vertices @ from_quaternion(model.geom_quat[geom]).T + model.geom_pos[geom]
        drawn = visuals[body][0]
        ours = drawn.vertices @ drawn.placement[:3, :3].T + drawn.placement[:3, 3]
        gaps = np.linalg.norm(ours[:, None] - theirs[None], axis=-1)
        assert gaps.min(axis=1).max() < 1e-6  # MuJoCo keeps vertices in single precision
        assert gaps.min(axis=0).max() < 1e-6
    np.testing.assert_allclose(visuals["first"][0].color, (0.9, 0.4, 0.1, 1.0), atol=1e-7)


def test_a_capsule_is_drawn_as_a_cylinder_with_round_ends(tmp_path):
    robot = loaded(tmp_path, arm(""))
    points = [v.vertices @ v.placement[:3, :3].T + v.placement[:3, 3] for v in link_visuals(robot) if v.link == "one"]
    assert len(points) == 3
    start, end = np.zeros(3), np.array([0.3, 0.0, 0.1])
    along = np.clip(np.concatenate(points) @ end / (end @ end), 0.0, 1.0)
    away = np.linalg.norm(np.concatenate(points) - start - along[:, None] * end, axis=1)
    assert away.max() < 0.04 + 1e-12
    assert away.max() > 0.04 - 1e-12
    reach = np.concatenate(points) @ end / np.linalg.norm(end)
    np.testing.assert_allclose([reach.min(), reach.max()], [-0.04, np.linalg.norm(end) + 0.04], atol=1e-4)


def test_a_box_is_drawn_with_whole_edges(tmp_path):
    robot = loaded(tmp_path, arm('<body name="two"><geom type="box" size="0.1 0.2 0.3" pos="0 1 0" mass="1"/></body>'))
    (drawn,) = (visual for visual in link_visuals(robot) if visual.link == "two")
    np.testing.assert_allclose(np.ptp(drawn.vertices, axis=0), [0.2, 0.4, 0.6])
    np.testing.assert_allclose(drawn.placement[:3, 3], [0.0, 1.0, 0.0])


def test_an_ellipsoid_is_drawn_with_its_axes(tmp_path):
    text = arm(
        '<body name="two"><geom type="ellipsoid" size="0.1 0.2 0.3" pos="0 1 0" euler="0.1 0.2 0.3" mass="1"/></body>'
    )
    robot = loaded(tmp_path, text)
    (drawn,) = (visual for visual in link_visuals(robot) if visual.link == "two")
    geom = original_model(tmp_path / "arm.xml").geom(1)
    points = drawn.vertices @ drawn.placement[:3, :3].T + drawn.placement[:3, 3]
    own = (points - geom.pos) @ from_quaternion(geom.quat) / [0.1, 0.2, 0.3]
    np.testing.assert_allclose(np.linalg.norm(own, axis=1), 1.0, rtol=1e-12)


def test_a_failure_within_mujoco_leaves_nothing_behind(tmp_path):
    """MuJoCo 4.0 loops in its handler of warnings after such a failure, at the next file with a NaN in this thread."""
    (tmp_path / "bad.xml").write_text(arm("", '<asset><model name="x"/></asset>'))
    (tmp_path / "nan.xml").write_text(arm('<body pos="nan 0 0"/>'))
    code = """
import sys, pathlib, nbs_pin as nbs
from nbs_pin.robots.mjcf_files import MjcfFiles
from nbs_pin.robots.mjcf_model import compile_mjcf
bad = pathlib.Path(sys.argv[1])
for read, path in ((compile_mjcf, MjcfFiles(bad, [bad])), (nbs.load_robot, sys.argv[2])):
    try: read(path)
    except nbs.RobotError as error: print(error)
"""
    names = [str(tmp_path / name) for name in ("bad.xml", "nan.xml")]
    command = [sys.executable, "-c", code, *names]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120)
    assert "unknown exception" in done.stdout
    assert "is not 3 finite numbers" in done.stdout


def test_several_threads_may_load_at_once():
    before = list(warnings.filters)
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(nbs.load_robot, [FILES / "unnamed.xml", FILES / "scara.xml"] * 8))
    assert [robot.nv for robot in found] == [4, 4] * 8
    assert len({robot.sha256 for robot in found}) == 2
    assert warnings.filters == before


def test_inertial_axes_that_mujoco_takes_to_be_the_body_s(tmp_path):
    """Within 1e-6 MuJoCo computes as if both frames were one, and the arm is as it computes."""
    inertial = '<inertial pos="0.1 0 0.2" quat="1e6 0.2 0 0" mass="2" diaginertia="0.02 0.03 0.011"/>'
    robot = loaded(tmp_path, arm(f'<body><joint axis="0 1 0.5"/>{inertial}</body>'))
    assert max(deviations(robot, original_model(tmp_path / "arm.xml"), {}).values()) < 1e-12


def test_a_run_and_a_controller_of_it_are_loaded_with_it_again(tmp_path):
    robot = nbs.load_robot(FILES / "continuous.xml", gravity=3.7)
    law = nbs.PID.for_robot(robot)
    nbs.save(law, tmp_path / "law.nbs")
    again = nbs.load(tmp_path / "law.nbs")
    assert again.robot.sha256 == robot.sha256
    assert again.robot.gravity_vector.tolist() == [0.0, 0.0, -3.7]


def test_a_tool_may_be_mjcf(tmp_path):
    hand = """<mujoco model="hand"><worldbody><body name="palm"><geom type="box" size="0.03 0.04 0.05" mass="0.6"/>
<body name="thumb" pos="0 0 0.05"><joint name="thumb" type="slide" axis="0 1 0" range="0.01 0.05" stiffness="4"/>
<geom type="box" size="0.01 0.01 0.03" mass="0.1"/></body></body></worldbody></mujoco>"""
    (tmp_path / "hand.xml").write_text(hand)
    bare = nbs.load_robot(FILES / "six_servos.xml")
    with pytest.warns(UserWarning, match=r"the tool's joints are locked: 'hand_thumb' at 0\.01"):
        robot = bare.with_tool(tmp_path / "hand.xml", "wrist_3")
    assert robot.joint_names == bare.joint_names
    assert sum(x.mass for x in robot.model.inertias) == pytest.approx(sum(x.mass for x in bare.model.inertias) + 0.7)


# Names in robot_descriptions.


@pytest.fixture
def descriptions(tmp_path, monkeypatch):
    """A package robot_descriptions with one arm, one without files and one that cannot be fetched."""
    package = tmp_path / "robot_descriptions"
    package.mkdir()
    names = ["scara_mj_description", "empty_description", "far_description"]
    (package / "__init__.py").write_text(f"DESCRIPTIONS = {dict.fromkeys(names)!r}")
    (package / "scara_mj_description.py").write_text(f"MJCF_PATH = {str(FILES / 'scara.xml')!r}")
    (package / "empty_description.py").write_text("")
    (package / "far_description.py").write_text("raise OSError('could not resolve host\\nfatal')")
    for name in [name for name in sys.modules if name.split(".")[0] == "robot_descriptions"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield
    for name in [name for name in sys.modules if name.split(".")[0] == "robot_descriptions"]:
        monkeypatch.delitem(sys.modules, name, raising=False)


def test_arms_of_robot_descriptions_by_name(descriptions):
    robot = nbs.load_robot("robot_descriptions:scara_mj_description")
    assert (robot.name, robot.source) == ("scara", "robot_descriptions:scara_mj_description")
    assert robot.sha256 == nbs.load_robot(FILES / "scara.xml").sha256
    assert robot.with_armature(0.5).armature.tolist() == [0.5] * 4


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("scara", "no description 'scara' in robot_descriptions; give one such as scara_mj_description"),
        ("far_description", "cannot fetch 'far_description' (could not resolve host fatal); connect to the network"),
        ("empty_description", "has no file in MJCF, URDF or xacro"),
    ],
)
def test_what_robot_descriptions_lacks_is_said(name, told, descriptions):
    with pytest.raises(nbs.RobotError) as caught:
        nbs.load_robot(f"robot_descriptions:{name}")
    assert told in str(caught.value)


def test_without_the_package_its_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "robot_descriptions", None)
    with pytest.raises(nbs.MissingExtra, match=r"pip install 'nbs-pin\[descriptions\]'"):
        nbs.load_robot("robot_descriptions:fr3_mj_description")
