"""Motions along paths of the tool: they meet the path with exact derivatives, and refuse what cannot be followed."""

import numpy as np
import pinocchio as pin
import pytest
from scipy.spatial.transform import Rotation

import nbs_pin as nbs
from nbs_pin.motions.inverse_kinematics import InverseKinematics, pose_error
from nbs_pin.motions.joint_paths import SINGULAR
from nbs_pin.motions.least_time import least_time
from nbs_pin.motions.timings import Even, Smooth, Stepped
from nbs_pin.motions.tool_postures import is_held, last_frame

ARMS = [
    ("panda", "panda_hand"), ("ur5", "tool0"), ("xarm7", "link_eef"), ("z1", "link06"), ("kinova", "j2s6s200_link_6"),
    ("ur10", "tool0"), ("so101", "gripper_link"), ("two_link", "tip"), ("three_link", "tip"),
]  # fmt: skip


def begun(name, frame, **options):
    robot = nbs.load_robot(name)
    posture = nbs.tool_posture(robot, frame, **options)
    return robot, posture, robot.pose(posture, frame)[:3, 3]


def circle(name, frame, radius=0.05, **options):
    robot, posture, begin = begun(name, frame)
    path = nbs.ToolPath.circle(begin, radius, "xz" if robot.nv <= 3 else "xy")
    return robot, nbs.tool_motion(robot, path, frame, posture=posture, **options)


def tip_error(robot, motion, samples=2001):
    """Largest error of position and orientation at dense times, off the nodes."""
    t = np.linspace(0.0, motion.duration, samples)
    error = pose_error(robot.pose(motion(t).q, motion.frame), motion.pose(t))
    return np.abs(error if motion.held else error[:, :3]).max()


def check_derivatives(motion, t, step=1e-5):
    """v and a against central differences of q and v."""
    middle, ahead, behind = motion(t), motion(t + step), motion(t - step)
    np.testing.assert_allclose((ahead.q - behind.q) / (2.0 * step), middle.v, atol=1e-7)
    np.testing.assert_allclose((ahead.v - behind.v) / (2.0 * step), middle.a, atol=1e-6)


@pytest.mark.parametrize(("name", "frame"), ARMS)
def test_the_tip_draws_the_circle_and_the_joints_close_with_it(name, frame):
    robot, motion = circle(name, frame, duration=5.0)
    assert tip_error(robot, motion) < 1e-7
    np.testing.assert_allclose(motion(5.0).q, motion(0.0).q, atol=1e-10)
    check_derivatives(motion, np.linspace(0.01, 4.99, 101))
    for t in (-1.0, 0.0, 5.0, 9.0):
        assert not np.any(motion(t).v)
        assert not np.any(motion(t).a)
    nbs.check_reference(motion, robot, 5.0)


@pytest.mark.parametrize("shape", [lambda s: np.stack([0.3 + 0.2 * s, 0.1 * s, 0.4 - 0.1 * s], axis=-1)])
def test_a_line_is_straight_and_leads_where_it_says(shape):
    path = nbs.ToolPath.line([0.3, 0.0, 0.4], [0.2, 0.1, -0.1])
    s = np.linspace(0.0, 1.0, 9)
    np.testing.assert_allclose(path.curve(s), shape(s), atol=1e-15)
    assert path.length == pytest.approx(np.sqrt(0.06))


@pytest.mark.parametrize("plane", ["xy", "xz", "yz", [1.0, 2.0, -0.5]])
def test_a_circle_lies_in_its_plane_and_passes_through_its_start(plane):
    start = np.array([0.4, 0.1, 0.3])
    points = nbs.ToolPath.circle(start, 0.1, plane).curve(np.linspace(0.0, 1.0, 37))
    np.testing.assert_allclose(points[[0, -1]], [start, start], atol=1e-15)
    normal = {"xy": [0, 0, 1], "xz": [0, 1, 0], "yz": [1, 0, 0]}.get(plane, plane) if isinstance(plane, str) else plane
    np.testing.assert_allclose((points - start) @ np.array(normal), 0.0, atol=1e-15)
    centre = 0.5 * (points[0] + points[18])
    np.testing.assert_allclose(np.linalg.norm(points - centre, axis=-1), 0.1)
    assert np.linalg.norm(centre) < np.linalg.norm(start)


def test_waypoints_with_orientations_are_passed_in_position_and_orientation():
    robot, posture, begin = begun("panda", "panda_hand")
    first = Rotation.from_matrix(robot.pose(posture, "panda_hand")[:3, :3])
    turns = [
        Rotation.from_rotvec(0.3 * np.array(axis)) * first for axis in ([0, 0, 0], [0, 0, 1], [0, 1, 0], [1, 0, 0])
    ]
    points = begin + np.array([[0, 0, 0], [-0.05, 0.1, 0.05], [-0.1, 0.05, 0.1], [-0.1, -0.05, 0.05]])
    path = nbs.ToolPath.through(points, [turn.as_quat() for turn in turns])
    motion = nbs.tool_motion(robot, path, "panda_hand", posture=posture, duration=4.0)
    assert tip_error(robot, motion) < 1e-6
    check_derivatives(motion, np.linspace(0.01, 3.99, 57))
    knots = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=-1))])
    poses = robot.pose(motion.joints(knots / knots[-1]), "panda_hand")
    np.testing.assert_allclose(poses[:, :3, 3], points, atol=1e-7)
    np.testing.assert_allclose(poses[:, :3, :3], [turn.as_matrix() for turn in turns], atol=1e-7)
    as_matrices = nbs.ToolPath.through(points, np.array([turn.as_matrix() for turn in turns]))
    np.testing.assert_allclose(as_matrices.turning(np.array(0.3)), path.turning(np.array(0.3)), atol=1e-12)


@pytest.mark.parametrize("ending", ["csv", "npz"])
def test_a_file_with_times_is_followed_in_its_own_time(tmp_path, ending):
    robot, _, begin = begun("ur5", "tool0")
    t = np.linspace(10.0, 14.0, 81)
    points = begin + 0.1 * np.stack([np.cos(t - 10.0) - 1.0, np.sin(t - 10.0), 0.0 * t], axis=-1)
    file = tmp_path / f"path.{ending}"
    if ending == "npz":
        np.savez(file, t=t, **dict(zip("xyz", points.T, strict=True)))
    else:
        np.savetxt(file, np.column_stack([points, t]), delimiter=",", header="x,y,z,t", comments="")
    motion = nbs.tool_motion(robot, nbs.load_tool_path(file), "tool0")
    assert motion.duration == pytest.approx(4.0)
    assert tip_error(robot, motion) < 1e-6
    poses = robot.pose(motion(t - 10.0).q, "tool0")
    np.testing.assert_allclose(poses[:, :3, 3], points, atol=1e-6)
    np.testing.assert_allclose(poses[:, :3, :3], np.broadcast_to(poses[0, :3, :3], (81, 3, 3)), atol=1e-6)
    check_derivatives(motion, np.linspace(0.1, 3.9, 77))


def test_a_file_with_times_that_begins_in_motion_is_refused():
    robot, posture, begin = begun("ur5", "tool0")
    t = np.linspace(0.0, 0.2, 21)
    points = begin + np.outer(t, [0.0, 1.0, 0.0])
    with pytest.raises(nbs.ArgumentError, match=r"begins with the velocity .* of joint '\w+', where the arm rests"):
        nbs.tool_motion(robot, nbs.ToolPath.through(points, times=t), "tool0", posture=posture)
    slower = nbs.tool_motion(robot, nbs.ToolPath.through(points, times=t), "tool0", posture=posture, duration=3.0)
    assert not slower(0.0).v.any()


def test_a_position_alone_leaves_the_orientation_free():
    robot, posture, begin = begun("panda", "panda_hand", orientation="free")
    path = nbs.ToolPath.line(begin, [0.0, 0.15, 0.1])
    free = nbs.tool_motion(robot, path, "panda_hand", posture=posture, orientation="free", duration=3.0)
    held = nbs.tool_motion(robot, path, "panda_hand", posture=posture, orientation="hold", duration=3.0)
    assert tip_error(robot, free) < 1e-7
    assert tip_error(robot, held) < 1e-7
    turned = pose_error(robot.pose(free(3.0).q, "panda_hand"), held.pose(3.0))[3:]
    assert np.linalg.norm(turned) > 0.05
    # with the choice, the arm stays nearer to the posture
    assert np.linalg.norm(free(3.0).q - posture) < np.linalg.norm(held(3.0).q - posture)


@pytest.mark.parametrize("name", ["panda", "xarm7"])
def test_a_redundant_arm_takes_the_configuration_nearest_to_its_posture(name):
    """No move within the null space of the frame comes nearer, by the function that the module states."""
    frame = last_frame(nbs.load_robot(name))
    robot, posture, _ = begun(name, frame)
    inverse = InverseKinematics(robot, frame, posture, True)
    pose = robot.pose(posture, frame)
    pose[:3, 3] += [-0.1, 0.1, 0.05]
    found = inverse.solve(posture, pose)
    assert found.exact
    slope, _ = inverse._attraction(found.q)
    null = np.linalg.svd(inverse.jacobian(found.q))[2][6:]
    np.testing.assert_allclose(null @ slope, 0.0, atol=1e-9)
    assert np.abs(slope).max() > 1e-2


def test_pink_finds_a_pose_far_away_within_the_limits():
    robot = nbs.load_robot("panda")
    posture = nbs.tool_posture(robot, "panda_hand")
    goal = robot.pose(posture + np.array([0.9, 0.5, -0.6, 0.5, 0.4, -0.5, 0.8]), "panda_hand")
    inverse = InverseKinematics(robot, "panda_hand", posture, True)
    near = inverse.solution(inverse.approach(posture, goal), goal)
    assert max(near.missed, near.turned) < 1e-2
    assert ((near.q >= robot.lower) & (near.q <= robot.upper)).all()
    assert inverse.solve(posture, goal).exact


def test_a_path_that_leaves_the_workspace_is_refused_at_the_point_where_it_does():
    """Two links of length 1 reach 2 m: a line through their plane is lost where it crosses that circle."""
    robot, posture, begin = begun("two_link", "tip")
    outwards = np.array([1.0, 0.0, 0.0])
    with pytest.raises(nbs.ArgumentError, match=r"is (singular|out of reach)") as refused:
        nbs.tool_motion(robot, nbs.ToolPath.line(begin, 2.0 * outwards), "tip", posture=posture)
    said = np.array([float(x) for x in str(refused.value).split("x, y, z = ")[1].split(" m")[0].split(",")])
    shoulder = robot.pose(posture, "joint1")[:3, 3]
    assert np.linalg.norm(said - shoulder) == pytest.approx(2.0, abs=2e-3)
    assert np.linalg.norm(np.cross(said - begin, outwards)) < 1e-3


def test_a_singular_point_is_refused_where_the_jacobian_says():
    robot = nbs.load_robot("ur5")
    posture = np.array([0.0, -1.2, 1.6, -2.0, -0.4, 0.0])  # the wrist passes through q5 = 0 on the way
    target = posture + np.array([0.0, 0.0, 0.0, 0.0, 0.8, 0.0])
    poses = np.array([robot.pose(q, "tool0") for q in np.linspace(posture, target, 9)])
    path = nbs.ToolPath.through(poses[:, :3, 3], poses[:, :3, :3])
    with pytest.raises(nbs.ArgumentError, match=r"singular|can follow|out of reach") as refused:
        nbs.tool_motion(robot, path, "tool0", posture=posture)
    assert "% of it" in str(refused.value)
    assert InverseKinematics(robot, "tool0", posture, True).steadiness(np.zeros(6)) < SINGULAR


def test_a_joint_limit_is_refused_with_joint_and_point():
    robot = nbs.load_robot("ur5", limits={"shoulder_pan_joint": {"lower": -0.2, "upper": 0.2}})
    posture = np.array([0.0, -1.2, 1.6, -2.0, -1.5, 0.0])
    begin = robot.pose(posture, "tool0")[:3, 3]
    with pytest.raises(nbs.ArgumentError, match=r"of joint 'shoulder_pan_joint', outside \[-0\.2, 0\.2\]") as refused:
        nbs.tool_motion(robot, nbs.ToolPath.line(begin, [0.0, 0.4, 0.0]), "tool0", posture=posture)
    assert "x, y, z = " in str(refused.value)


def test_a_duration_too_short_is_refused_with_joint_time_and_one_that_is_enough():
    robot, posture, begin = begun("panda", "panda_hand")
    path = nbs.ToolPath.circle(begin, 0.1)
    with pytest.raises(nbs.ArgumentError, match=r"velocity .* of joint '\w+' at t = .*; give at least duration=") as no:
        nbs.tool_motion(robot, path, "panda_hand", posture=posture, duration=0.5)
    enough = float(str(no.value).split("duration=")[1].split()[0])
    motion = nbs.tool_motion(robot, path, "panda_hand", posture=posture, duration=enough)
    share = np.abs(motion(np.linspace(0.0, enough, 5001)).v) / robot.velocity_limit
    assert 0.9 < share.max() <= 1.0


def test_the_duration_advised_to_a_path_with_times_is_enough_too():
    """With its own times the path was even; with a duration it begins and ends at rest, and is faster between."""
    robot, posture, begin = begun("panda", "panda_hand")
    angle = np.linspace(0.0, 2.0 * np.pi, 81)
    circle = begin + 0.1 * np.stack([np.cos(angle) - 1.0, np.sin(angle), 0.0 * angle], axis=-1)
    path = nbs.ToolPath.through(circle, times=np.linspace(0.0, 0.3, 81))
    with pytest.raises(nbs.ArgumentError, match="give at least duration=") as no:
        nbs.tool_motion(robot, path, "panda_hand", posture=posture)
    enough = float(str(no.value).split("duration=")[1].split()[0])
    limited = robot.with_effort_limit(np.inf)
    motion = nbs.tool_motion(limited, path, "panda_hand", posture=posture, duration=enough)
    assert 0.5 < (np.abs(motion(np.linspace(0.0, enough, 5001)).v) / robot.velocity_limit).max() <= 1.0


def test_the_joints_stay_within_their_limits_between_the_nodes_of_the_spline():
    """A limit that a joint passes between nodes alone is seen: all extremes of the spline are looked at."""
    robot, posture, begin = begun("ur5", "tool0")
    path = nbs.ToolPath.circle(begin, 0.1)
    joints = nbs.tool_motion(robot, path, "tool0", posture=posture).joints
    turns = joints.turns()
    np.testing.assert_allclose(np.abs(joints(turns, 1)).min(axis=-1), 0.0, atol=1e-6)
    dense, extremes = joints(np.linspace(0.0, 1.0, 100_001)), joints(np.append(turns, [0.0, 1.0]))
    assert (dense.max(axis=0) <= extremes.max(axis=0) + 1e-12).all()
    assert (dense.min(axis=0) >= extremes.min(axis=0) - 1e-12).all()
    nodes = joints(np.linspace(0.0, 1.0, 2 ** int(np.log2(len(joints.spline.c))) + 1))
    passed = int(np.argmax(extremes.max(axis=0) - nodes.max(axis=0)))
    between = float(0.5 * (extremes[:, passed].max() + nodes[:, passed].max()))
    name = robot.joint_names[passed]
    with pytest.raises(nbs.ArgumentError, match=f"of joint '{name}', outside"):
        nbs.tool_motion(nbs.load_robot("ur5", limits={name: {"upper": between}}), path, "tool0", posture=posture)


@pytest.mark.parametrize(("options", "said"), [
    ({"fastest": True, "duration": 3.0}, "fastest=True finds the duration of the path; omit duration=3.0"),
    ({"acceleration": 5.0}, "acceleration=5.0 is for the motion of least time; give fastest=True too"),
    ({"fastest": True, "acceleration": [1.0, 2.0, 3.0]}, "acceleration has 3 numbers for the 2 joints of two_link"),
])  # fmt: skip
def test_settings_of_time_that_contradict_each_other_are_refused(options, said):
    with pytest.raises(nbs.ArgumentError, match=said):
        circle("two_link", "tip", radius=0.3, **options)


def test_arms_with_few_joints_are_told_what_they_can_do():
    robot, posture, begin = begun("two_link", "tip")
    with pytest.raises(nbs.ArgumentError, match=r"2 joints .* varies in 3 directions.*orientation='free'"):
        nbs.tool_motion(robot, nbs.ToolPath.line(begin, [0.0, 0.0, 0.1]), "tip", posture=posture, orientation="hold")
    with pytest.raises(nbs.ArgumentError, match="out of reach"):  # across its plane
        nbs.tool_motion(robot, nbs.ToolPath.line(begin, [0.0, 0.1, 0.0]), "tip", posture=posture)
    three, posture, begin = begun("three_link", "tip", orientation="hold")
    normal = np.cross(*InverseKinematics(three, "tip", posture, False).directions[:, :3])
    held = nbs.tool_motion(three, nbs.ToolPath.circle(begin, 0.2, normal), "tip", posture=posture, orientation="hold")
    assert held.held
    assert tip_error(three, held) < 1e-7


def test_timings_are_consistent_in_s_speed_and_acceleration():
    grid = np.linspace(0.0, 1.0, 11)
    speed = np.concatenate([[0.0], np.random.default_rng(3).uniform(0.5, 2.0, 9), [0.0]])
    for timing in (Smooth(2.0), Even(2.0), Stepped(grid, speed)):
        t = np.linspace(0.0, timing.duration, 1500)[1:-1]
        step = 1e-7
        _, ds, dds = timing(t)
        ahead, behind = timing(t + step), timing(t - step)
        np.testing.assert_allclose((ahead.s - behind.s) / (2 * step), ds, atol=1e-5)
        smooth = np.abs((ahead.ds - behind.ds) / (2 * step) - dds) < 1e-4
        assert smooth.mean() > 0.99  # not where the acceleration steps
        assert timing(np.array([0.0, timing.duration])).s.tolist() == [0.0, 1.0]
        assert (np.abs(ds) <= timing.largest[0] * (1 + 1e-12)).all()
        assert (np.abs(dds) <= timing.largest[1] * (1 + 1e-12)).all()


def test_the_stated_jerk_bounds_the_jerk():
    _, motion = circle("ur5", "tool0", duration=3.0)
    t = np.linspace(0.0, 3.0, 20001)
    jerk = np.abs(np.diff(motion(t).a, axis=0)).max(axis=0) / (t[1] - t[0])
    assert (jerk <= motion.largest_jerk + 1e-6).all()  # differences of a are rounded
    assert (motion.largest_jerk < 10.0 * jerk.max()).all()


def torques(robot, motion, t):
    data = robot.model.createData()
    return np.array([pin.rnea(robot.model, data, *row) for row in zip(*motion(t), strict=True)])


@pytest.mark.parametrize(("name", "frame"), [arm for arm in ARMS if arm[0] in ("panda", "ur5", "z1", "two_link")])
def test_the_least_time_keeps_every_limit_between_its_points_and_one_is_reached(name, frame):
    robot, motion = circle(name, frame, fastest=True)
    t = np.random.default_rng(0).uniform(0.0, motion.duration, 20_000)
    shares = np.maximum(
        np.abs(motion(t).v) / robot.velocity_limit, np.abs(torques(robot, motion, t)) / robot.effort_limit
    )
    assert shares.max() <= 1.0
    # a motion of least time is at some limit nearly always
    assert (shares.max(axis=-1) > 0.99).mean() > 0.9
    assert tip_error(robot, motion) < 1e-7
    assert not motion(motion.duration).v.any()
    slow = nbs.tool_motion(robot, motion.path, frame, posture=motion(0.0).q)
    assert motion.duration < slow.duration


def test_the_least_time_is_that_of_toppra_itself():
    """Its duration is at most 1/0.95 of what toppra finds alone, whose own torques exceed the limits between points."""
    import toppra

    robot, motion = circle("panda", "panda_hand", radius=0.1, fastest=True)
    data, n = robot.model.createData(), robot.nv

    class Path(toppra.interpolator.AbstractGeometricPath):
        dof, path_interval = n, np.array([0.0, 1.0])

        def __call__(self, s, order=0):
            return motion.joints(np.asarray(s), order)

    both = [np.stack([-limit, limit], axis=-1) for limit in (robot.effort_limit, robot.velocity_limit)]
    dynamics = lambda *x: pin.rnea(robot.model, data, *x)  # noqa: E731
    limits = [toppra.constraint.JointTorqueConstraint(dynamics, both[0], np.zeros(n)),
              toppra.constraint.JointVelocityConstraint(both[1])]  # fmt: skip
    alone = toppra.algorithm.TOPPRA(limits, Path(), gridpoints=np.linspace(0, 1, 501), solver_wrapper="seidel",
                                    parametrizer="ParametrizeConstAccel").compute_trajectory(0, 0)  # fmt: skip
    assert 0.98 * alone.duration < motion.duration < alone.duration / 0.95


def test_accelerations_and_margins_are_kept_as_well():
    robot, posture, begin = begun("panda", "panda_hand")
    path, margins = nbs.ToolPath.circle(begin, 0.1), nbs.Margins(0.1, 0.5, [40.0, 30.0, 30.0, 30.0, 5.0, 5.0, 5.0])
    free = nbs.tool_motion(robot, path, "panda_hand", posture=posture, fastest=True)
    motion = nbs.tool_motion(
        robot, path, "panda_hand", posture=posture, fastest=True, acceleration=8.0, margins=margins
    )
    t = np.linspace(0.0, motion.duration, 20_001)
    q, v, a = motion(t)
    assert np.abs(a).max() <= 8.0
    assert (np.abs(v) <= robot.velocity_limit - 0.5).all()
    assert (np.abs(torques(robot, motion, t)) <= robot.effort_limit - margins.effort).all()
    assert ((q >= robot.lower + 0.1) & (q <= robot.upper - 0.1)).all()
    assert np.abs(a).max() > 7.9
    assert motion.duration > free.duration


def test_a_motion_that_cannot_be_kept_is_refused_with_joint_and_share():
    robot, posture, begin = begun("panda", "panda_hand")
    path = nbs.ToolPath.circle(begin, 0.05)
    weight = np.abs(pin.computeGeneralizedGravity(robot.model, robot.model.createData(), posture))
    heavy = robot.with_effort_limit(np.where(np.arange(7) == 1, 0.8 * weight[1], robot.effort_limit))
    with pytest.raises(
        nbs.ArgumentError, match=r"'panda_joint2' needs .* N·m to hold its weight .*% are missing"
    ) as no:
        nbs.tool_motion(heavy, path, "panda_hand", posture=posture, fastest=True)
    assert float(str(no.value).split("motion: ")[1].split(" %")[0]) == pytest.approx(25.0, abs=3.0)
    with pytest.raises(nbs.ArgumentError, match=r"takes 138 % of the velocity limit of joint 'panda_joint1'"):
        nbs.tool_motion(robot, path, "panda_hand", posture=posture, margins=nbs.Margins(velocity=3.0))
    bare, joints = nbs.load_robot("double_pendulum"), nbs.tool_motion(robot, path, "panda_hand", posture=posture).joints
    with pytest.raises(nbs.ArgumentError, match=r"of double_pendulum has no effort limit"):
        least_time(bare, joints)


def test_margins_change_the_limits_and_nothing_else():
    robot = nbs.load_robot("ur5")
    less = nbs.Margins(position=0.1, velocity=0.2, effort=3.0).of(robot)
    np.testing.assert_allclose(less.effort_limit, robot.effort_limit - 3.0)
    np.testing.assert_allclose(less.velocity_limit, robot.velocity_limit - 0.2)
    np.testing.assert_allclose(less.lower, robot.lower + 0.1)
    np.testing.assert_allclose(less.model.upperPositionLimit, robot.upper - 0.1)
    assert less.sha256 == robot.sha256
    assert less.joint_names == robot.joint_names


@pytest.mark.parametrize("name", [name for name in nbs.ROBOT_NAMES if name != "double_pendulum"])
def test_the_posture_is_inside_the_limits_away_from_singular_ones_and_light(name):
    robot = nbs.load_robot(name)
    q = nbs.tool_posture(robot)
    assert ((q > robot.lower) & (q < robot.upper)).all()
    load = np.abs(pin.computeGeneralizedGravity(robot.model, robot.model.createData(), q)) / robot.effort_limit
    assert load.max() < 0.8
    frame = last_frame(robot)
    assert InverseKinematics(robot, frame, q, is_held(robot, frame, None)).steadiness(q) > 10.0 * SINGULAR


@pytest.mark.parametrize(("name", "frame"), [("panda", "panda_hand"), ("ur5", "tool0"), ("xarm7", "link_eef")])
def test_a_circle_is_drawn_in_mujoco_within_a_tenth_of_a_millimetre(name, frame):
    """Radius 0.1 m, orientation held, the default law at 1 kHz; the beginning of 5 s is enough to see it here."""
    robot, motion = circle(name, frame, radius=0.1, duration=5.0)
    law = nbs.NeuralBackstepping.for_robot(robot)
    run = nbs.simulate(nbs.MujocoPlant(robot), law, motion, 2.5, 0.001)
    errors = nbs.tool_errors(run, robot)
    assert run.info["tool"] == {"frame": frame, "orientation": "hold", "path": "circle of radius 0.1 m"}
    assert errors.figures()["rms_position_error_m"] < 1e-6
    assert errors.orientation.max() < 1e-5
    shown = robot.pose(run.q, frame)[:, :3, 3] - motion.pose(run.t)[:, :3, 3]
    np.testing.assert_allclose(np.linalg.norm(shown, axis=-1), errors.position, atol=1e-7)


BAD_PATHS = {
    "at least two": lambda: nbs.ToolPath.through([[0.1, 0.2, 0.3]]),
    "points 1 and 2 of the path are the same": lambda: nbs.ToolPath.through([[0.0, 0.0, 0.0]] * 2),
    "points 2 and 3 are nearer to each other than": lambda: nbs.ToolPath.through(
        [[0.0, 0, 0], [1e20, 0, 0], [1e20, 1e-3, 0], [0, 0, 0]]
    ),
    "increasing": lambda: nbs.ToolPath.through([[0.0, 0, 0], [1.0, 0, 0]], times=[1.0, 1.0]),
    "orientation of point 2 is no rotation": lambda: nbs.ToolPath.through(
        [[0.0, 0, 0], [1.0, 0, 0]], [[0, 0, 0, 1.0], [0, 0, 0, 2.0]]
    ),
    "1 orientations for 2 points": lambda: nbs.ToolPath.through([[0.0, 0, 0], [1.0, 0, 0]], [[0, 0, 0, 1.0]]),
    "displacement is zero": lambda: nbs.ToolPath.line([0.0, 0, 0], [0.0, 0, 0]),
    "plane 'up' is unknown": lambda: nbs.ToolPath.circle([0.3, 0, 0], 0.1, "up"),
    "radius is -1": lambda: nbs.ToolPath.circle([0.3, 0, 0], -1.0),
}


@pytest.mark.parametrize("words", BAD_PATHS)
def test_what_is_no_path_is_refused_in_one_sentence(words):
    with pytest.raises(nbs.ArgumentError, match=words) as refused:
        BAD_PATHS[words]()
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(("text", "words"), [
    ("a,b,c\n1,2,3\n", "expected 'x', 'y', 'z'"),
    ("x,y,z\n1,2,3\n", "at least two"),
    ("x,y,z\n1,2,3\n1,2,nan\n", "'z' is not one finite number for each of 2 rows"),
    ("x,y,z,qx,qw\n1,2,3,0,1\n1,2,4,0,1\n", "without qy, qz"),
    ("t,x,y,z\n1,1,2,3\n1,1,2,4\n", "increasing"),
])  # fmt: skip
def test_what_is_no_file_of_a_path_is_refused_with_the_file(tmp_path, text, words):
    file = tmp_path / "path.csv"
    file.write_text(text)
    with pytest.raises(nbs.FileFormatError, match=words) as refused:
        nbs.load_tool_path(file)
    assert str(file) in str(refused.value)
