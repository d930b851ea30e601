"""Frames of arms: poses and Jacobians by name against Pinocchio's own, finite differences and each other."""

import numpy as np
import pinocchio as pin
import pytest

import nbs_pin as nbs

ARMS = ["two_link", "three_link", "panda", "ur5", "xarm7", "kinova", "so100", "talos_left_arm"]


def samples(robot, count=4):
    return np.random.default_rng(1).uniform(*robot.one_turn_range, (count, robot.nv))


@pytest.mark.parametrize("name", ARMS)
def test_the_jacobian_is_the_derivative_of_the_pose_of_every_frame(name):
    robot, step = nbs.load_robot(name), 1e-6
    for frame in robot.frames:
        for q in samples(robot, 2):
            J = robot.jacobian(q, frame)
            ahead, behind = (robot.pose(q + sign * step * np.eye(robot.nv), frame) for sign in (1.0, -1.0))
            np.testing.assert_allclose((ahead - behind)[:, :3, 3].T / (2.0 * step), J[:3], atol=1e-8)
            turns = ahead[:, :3, :3] @ behind[:, :3, :3].swapaxes(-1, -2)
            angles = np.array([pin.log3(turn) for turn in turns]).T / (2.0 * step)
            np.testing.assert_allclose(angles, J[3:], atol=1e-8)


@pytest.mark.parametrize("name", ARMS)
def test_poses_are_those_of_pinocchios_frames(name):
    robot = nbs.load_robot(name)
    data, q = robot.model.createData(), samples(robot, 1)[0]
    pin.framesForwardKinematics(robot.model, data, q)
    for index, frame in list(enumerate(robot.model.frames))[1:]:
        if frame.type == pin.FrameType.BODY:
            np.testing.assert_allclose(robot.pose(q, frame.name), data.oMf[index].homogeneous, atol=1e-14)


def test_every_link_and_joint_of_the_description_is_a_frame():
    robot = nbs.load_robot("panda")
    assert {"panda_link0", "panda_joint7", "panda_hand_joint", "panda_hand", "panda_finger_joint1"} <= set(robot.frames)
    assert set(robot.joint_names) < set(robot.frames)


def test_joints_beyond_a_frame_do_not_move_it():
    robot = nbs.load_robot("panda")
    assert robot.supporting("panda_link4").tolist() == [True] * 4 + [False] * 3
    J = robot.jacobian(samples(robot), "panda_link4")
    assert not J[..., 4:].any()
    assert np.abs(J[..., :4]).max() > 0.1


def test_batches_are_rows_one_by_one():
    robot = nbs.load_robot("ur5")
    q = samples(robot, 6).reshape(2, 3, 6)
    poses, jacobians = robot.pose(q, "tool0"), robot.jacobian(q, "tool0")
    assert poses.shape == (2, 3, 4, 4)
    assert jacobians.shape == (2, 3, 6, 6)
    np.testing.assert_array_equal(poses[1, 2], robot.pose(q[1, 2], "tool0"))
    np.testing.assert_array_equal(jacobians[1, 2], robot.jacobian(q[1, 2], "tool0"))
    assert robot.pose(np.zeros((0, 6)), "tool0").shape == (0, 4, 4)


def test_an_unknown_frame_is_refused_with_the_nearest_names():
    robot = nbs.load_robot("panda")
    with pytest.raises(nbs.ArgumentError, match=r"no link or joint 'panda_hnd'; did you mean panda_hand") as refused:
        robot.pose(np.zeros(7), "panda_hnd")
    assert "\n" not in str(refused.value)
    with pytest.raises(nbs.ArgumentError, match=r"expected \(\.\.\., 7\)"):
        robot.jacobian(np.zeros(6), "panda_hand")
