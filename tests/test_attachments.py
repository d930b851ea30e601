"""Payloads, tools and tilted bases: the same arm as one whose file has them."""

import numpy as np
import pinocchio as pin
import pytest
from commands import refusal

import nbs_pin as nbs
from nbs_pin import cli

GRIPPER = """<robot name="gripper">
<link name="palm"><inertial><origin xyz="0 0 0.03"/><mass value="0.6"/>
 <inertia ixx="1e-3" iyy="2e-3" izz="1.5e-3" ixy="0" ixz="0" iyz="0"/></inertial>
 <visual><geometry><mesh filename="palm.stl"/></geometry></visual></link>
<link name="left"><inertial><mass value="0.1"/><inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/>
 </inertial></link>
<link name="right"><inertial><mass value="0.1"/><inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/>
 </inertial></link>
<joint name="open" type="prismatic"><parent link="palm"/><child link="left"/><axis xyz="0 1 0"/>
 <origin xyz="0 0 0.1"/><limit lower="0.01" upper="0.04" effort="5" velocity="1"/></joint>
<joint name="other" type="prismatic"><parent link="palm"/><child link="right"/><axis xyz="0 -1 0"/>
 <origin xyz="0 0 0.1"/><limit lower="0.01" upper="0.04" effort="5" velocity="1"/><mimic joint="open"/></joint>
</robot>"""
LOAD = {"mass": 2.0, "com": (0.02, -0.01, 0.1), "inertia": np.diag([0.01, 0.02, 0.015])}


def states(nv):
    rng = np.random.default_rng(3)
    return rng.uniform(-2.0, 2.0, (20, nv)), rng.uniform(-1.0, 1.0, (20, nv)), rng.uniform(-9.0, 9.0, (20, nv))


def reference_torque(model, q, v, a):
    data = model.createData()
    return np.array([pin.rnea(model, data, *row) for row in zip(q, v, a, strict=True)])


def test_a_payload_is_a_body_fixed_to_its_link():
    """M a + C v + G with the load is that of Pinocchio with the body appended to the last joint."""
    robot = nbs.load_robot("ur5")
    loaded = robot.with_payload("tool0", **LOAD)
    model = robot.model.copy()
    frame = model.frames[model.getFrameId("tool0")]
    body = pin.Inertia(LOAD["mass"], np.array(LOAD["com"]), LOAD["inertia"])
    model.appendBodyToJoint(frame.parentJoint, body, frame.placement)
    q, v, a = states(6)
    dynamics = nbs.PinocchioDynamics(loaded)
    torque = dynamics.reference_torque(q, v, v, a)
    np.testing.assert_allclose(torque, reference_torque(model, q, v, a), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(nbs.MujocoPlant(loaded).mass_matrix(q), dynamics.mass_matrix(q), atol=1e-12)
    assert loaded.with_payload("tool0", 1e-3).model.inertias[6].mass < loaded.model.inertias[6].mass
    assert nbs.load_robot(loaded.source, **loaded.options).sha256 == loaded.sha256


def test_payloads_at_several_links_add_up():
    robot = nbs.load_robot("panda")
    both = robot.with_payload("panda_link4", 1.0).with_payload("panda_hand", 2.0)
    assert sum(inertia.mass for inertia in both.model.inertias) == pytest.approx(
        3.0 + sum(inertia.mass for inertia in robot.model.inertias)
    )


@pytest.mark.parametrize("rpy", [(np.pi, 0.0, 0.0), (0.0, np.pi / 2.0, 0.0), (0.4, -0.3, 1.1)])
def test_a_tilted_base_turns_gravity(rpy):
    """M and C stay; G is that of the arm in its own frame with Rᵀg; the tip is turned by R and shifted."""
    robot = nbs.load_robot("panda")
    tilted = nbs.load_robot("panda", base_rpy=rpy, base_xyz=(0.1, 0.2, 0.9))
    turn = pin.rpy.rpyToMatrix(*rpy)
    same = nbs.load_robot("panda", gravity=turn.T @ [0.0, 0.0, -9.81])
    q, v, _ = states(7)
    one, other, plain = (nbs.PinocchioDynamics(arm) for arm in (tilted, same, robot))
    np.testing.assert_allclose(one.gravity(q), other.gravity(q), atol=1e-12)
    np.testing.assert_allclose(one.mass_matrix(q), plain.mass_matrix(q), atol=1e-12)
    np.testing.assert_allclose(one.coriolis_matrix(q, v), plain.coriolis_matrix(q, v), atol=1e-12)
    np.testing.assert_allclose(nbs.MujocoPlant(tilted).bias(q, 0.0 * v), one.gravity(q), atol=1e-11)

    def tip(arm):
        data = arm.model.createData()
        pin.framesForwardKinematics(arm.model, data, q[0])
        return data.oMf[arm.model.getFrameId("panda_hand")].translation

    np.testing.assert_allclose(tip(tilted), turn @ tip(robot) + [0.1, 0.2, 0.9], atol=1e-12)


@pytest.mark.parametrize("name", ["ur5", "z1", "xarm7"])
def test_mujoco_mounts_arms_whose_root_is_called_world(name):
    """MuJoCo takes a link of that name for the world, wherever it is."""
    tilted = nbs.load_robot(name, base_rpy=(0.4, -0.3, 1.1), base_xyz=(0.1, 0.2, 0.9))
    assert "world" in tilted.frames
    q, v, tau = states(tilted.nv)
    given = nbs.MujocoPlant(tilted).acceleration(q, v, tau)
    np.testing.assert_allclose(given, nbs.PinocchioDynamics(tilted).forward_dynamics(q, v, tau), rtol=1e-9, atol=1e-9)


@pytest.mark.filterwarnings("ignore:.*joints that mimic another are locked")
def test_a_tool_is_the_arm_with_its_links(tmp_path):
    """The fingers are locked at the end of their range nearest to zero; the total is that of one body at the flange."""
    file = tmp_path / "gripper.urdf"
    file.write_text(GRIPPER)
    robot = nbs.load_robot("ur5")
    with pytest.warns(UserWarning, match=r"tool's joints are locked: 'open' at 0.01; .*lock=\{'open': "):
        held = robot.with_tool(file, "tool0", xyz=(0.0, 0.0, 0.02), rpy=(0.0, 0.0, 0.5))
    assert held.joint_names == robot.joint_names
    whole = pin.buildModelFromXML(GRIPPER)
    data = whole.createData()
    pin.computeTotalMass(whole, data)
    at = np.array([0.01, 0.01])
    pin.ccrba(whole, data, at, np.zeros(2))
    model = robot.model.copy()
    frame = model.frames[model.getFrameId("tool0")]
    base = pin.SE3(pin.rpy.rpyToMatrix(0.0, 0.0, 0.5), np.array([0.0, 0.0, 0.02]))
    body = whole.inertias[0]
    for i in (1, 2):
        body += data.oMi[i].act(whole.inertias[i])
    model.appendBodyToJoint(frame.parentJoint, body, frame.placement * base)
    q, v, a = states(6)
    torque = nbs.PinocchioDynamics(held).reference_torque(q, v, v, a)
    np.testing.assert_allclose(torque, reference_torque(model, q, v, a), rtol=1e-12, atol=1e-12)
    with pytest.warns(UserWarning, match="tool's joints are locked"):
        again = nbs.load_robot(held.source, **held.options)
    assert again.sha256 == held.sha256
    assert str(tmp_path / "palm.stl") in held.urdf.xml.decode()


@pytest.mark.filterwarnings("ignore:.*joints that mimic another are locked")
def test_a_tool_with_the_arm_s_own_names_is_renamed(tmp_path):
    file = tmp_path / "twin.urdf"
    file.write_text(GRIPPER.replace('"palm"', '"link1"'))
    held = nbs.load_robot("two_link", tool={"file": str(file), "frame": "tip"}, lock={"gripper_open": 0.02})
    assert held.joint_names == ("joint1", "joint2")
    assert 'name="gripper_link1"' in held.urdf.xml.decode()


@pytest.mark.parametrize(
    ("options", "error", "said"),
    [
        ({"payload": {"tol0": 1.0}}, nbs.RobotError, "no link 'tol0' for the payload; give one such as tool0"),
        ({"payload": -1.0}, nbs.ArgumentError, "payload is -1.0, expected a mass"),
        ({"payload": {"tool0": {"mass": 1.0, "inertia": [[1, 2], [3, 4]]}}}, nbs.ArgumentError, "inertia"),
        ({"payload": {"tool0": {"mass": 1.0, "inertia": [1.0, 1.0, 3.0]}}}, nbs.RobotError, "not a physical body"),
        ({"payload": {"tool0": {"mass": 1.0, "com": [0.0, np.nan, 0.0]}}}, nbs.ArgumentError, "com"),
        ({"base_rpy": [1.0, 2.0]}, nbs.ArgumentError, "base_rpy is .*three finite numbers"),
        ({"tool": 3}, nbs.ArgumentError, "tool is 3, expected the path of a description"),
        ({"tool": {"file": "nothing.urdf", "frame": "tool0"}}, nbs.RobotNotFound, "nothing.urdf: no such file"),
    ],
)
def test_wrong_attachments_are_refused(options, error, said):
    with pytest.raises(error, match=said):
        nbs.load_robot("ur5", **options)


def test_the_last_link_must_be_the_only_one():
    with pytest.raises(nbs.RobotError, match=r"last links .*payload=\{'panda_hand_tcp': 2.0\}"):
        nbs.load_robot("panda", payload=1.0)


def test_the_shell_attaches_and_tilts(tmp_path, capsys):
    out = ["--out", str(tmp_path / "out"), "--duration", "0.1"]
    words = [
        "--payload",
        "0.5@tip:0,0,0.1",
        "--payload",
        "0.2@link1",
        "--base-rpy=3.14159,0,0",
        "--limits",
        "*.effort=300",
    ]
    assert cli.main(["track", "two_link", *words, *out]) == 0
    run = nbs.Run.load(tmp_path / "out" / "run.npz")
    robot = nbs.load_robot("two_link").with_payload("tip", 0.5, (0.0, 0.0, 0.1)).with_payload("link1", 0.2)
    assert run.robot_options["base_rpy"] == [3.14159, 0.0, 0.0]
    assert run.robot_options["payload"] == robot.options["payload"]
    capsys.readouterr()
    for wrong in ("--payload=x@tip", "--payload=2@tip:1,2", "--base-rpy=1,2", "--tool=@tip"):
        assert wrong.partition("=")[0] in refusal(cli.main(["track", "two_link", wrong]), capsys)
