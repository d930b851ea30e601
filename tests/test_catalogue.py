"""Descriptions of the catalogue's own arms against the makers' tables: flange, mass, reach, limits and bodies."""

import warnings

import numpy as np
import pinocchio as pin
import pytest

import nbs_pin as nbs
from nbs_pin.controllers.neural_backstepping import NeuralBackstepping
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.robots.robot import load_robot
from nbs_pin.robots.visuals import link_visuals

HALF = np.pi / 2.0
IIWA = [(0, 0.36, -HALF), (0, 0, HALF), (0, 0.42, HALF), (0, 0, -HALF), (0, 0.4, -HALF), (0, 0, HALF), (0, 0.126, 0)]
FR3 = [(0, 0.333, 0), (0, 0, -HALF), (0, 0.316, HALF), (0.0825, 0, HALF), (-0.0825, 0.384, -HALF), (0, 0, HALF)]
FR3 += [(0.088, 0.107, HALF)]  # Franka Control Interface, "Denavit–Hartenberg parameters": Craig's convention
GEN3 = [(0, -(0.1564 + 0.1284), HALF), (0, -(0.0054 + 0.0064), HALF), (0, -(0.2104 + 0.2104), HALF)]
GEN3 += [(0, -(0.0064 + 0.0064), HALF), (0, -(0.2084 + 0.1059), HALF), (0, 0, HALF), (0, -(0.1059 + 0.0615), np.pi)]
PUBLISHED = {  # mass with base [kg], reach [m], largest speeds [°/s] and torques [N·m]: the makers' data sheets
    "fr3": (17.8, 0.855, (150, 150, 150, 150, 301, 239, 301), (87, 87, 87, 87, 12, 12, 12)),
    "ur3e": (11.2, 0.5, (180, 180, 180, 360, 360, 360), (56, 56, 28, 12, 12, 12)),
    "ur5e": (20.6, 0.85, (180, 180, 180, 180, 180, 180), (150, 150, 150, 28, 28, 28)),
    "ur10e": (33.5, 1.3, (120, 120, 180, 180, 180, 180), (330, 330, 150, 56, 56, 56)),
    "gen3": (8.2, 0.902, (80, 80, 80, 80, 70, 70, 70), (56.7, 56.7, 56.7, 56.7, 29.4, 29.4, 29.4)),
    "iiwa14": (29.9, 0.82, (85, 85, 100, 75, 130, 135, 135), (320, 320, 176, 176, 110, 40, 40)),
}
FLANGE = {"fr3": "fr3_link8", "gen3": "end_effector_link", "iiwa14": "iiwa_link_ee_kuka"}


def universal(d1, a2, a3, d4, d5, d6):
    """Rows (a, d, α) of the maker's table for its six-joint arms."""
    return [(0, d1, HALF), (a2, 0, 0), (a3, 0, 0), (0, d4, HALF), (0, d5, -HALF), (0, d6, 0)]


UNIVERSAL = {  # Universal Robots, "DH parameters for calculations of kinematics and dynamics"
    "ur3e": universal(0.15185, -0.24355, -0.2132, 0.13105, 0.08535, 0.0921),
    "ur5e": universal(0.1625, -0.425, -0.3922, 0.1333, 0.0997, 0.0996),
    "ur10e": universal(0.1807, -0.6127, -0.57155, 0.17415, 0.11985, 0.11655),
}


def turned(axis, angle):
    """The homogeneous matrix of a turn about x (0) or z (2)."""
    matrix, (i, j) = np.eye(4), {0: (1, 2), 2: (0, 1)}[axis]
    matrix[i, i] = matrix[j, j] = np.cos(angle)
    matrix[i, j], matrix[j, i] = -np.sin(angle), np.sin(angle)
    return matrix


def moved(axis, distance):
    matrix = np.eye(4)
    matrix[axis, 3] = distance
    return matrix


def denavit_hartenberg(rows, q):
    """Rot_z(q) Trans_z(d) Trans_x(a) Rot_x(α), row by row."""
    pose = np.eye(4)
    for (a, d, alpha), angle in zip(rows, q, strict=True):
        pose = pose @ turned(2, angle) @ moved(2, d) @ moved(0, a) @ turned(0, alpha)
    return pose


def craig(rows, q):
    """Rot_x(α) Trans_x(a) Rot_z(q) Trans_z(d), row by row."""
    pose = np.eye(4)
    for (a, d, alpha), angle in zip(rows, q, strict=True):
        pose = pose @ turned(0, alpha) @ moved(0, a) @ turned(2, angle) @ moved(2, d)
    return pose


def by_table(name, q):
    """Pose of the flange at q by the maker's Denavit-Hartenberg table."""
    if name == "fr3":
        return craig(FR3, q)
    if name == "gen3":  # User guide, "DH parameters": a first row without a joint, then θ = q1, q2 + π, …, q7 + π
        return turned(0, np.pi) @ denavit_hartenberg(GEN3, q + np.pi * np.array([0, 1, 1, 1, 1, 1, 1]))
    if name == "iiwa14":
        return denavit_hartenberg(IIWA, q)
    return turned(2, np.pi) @ denavit_hartenberg(UNIVERSAL[name], q)  # ROS turns the maker's base by half a turn


def flange(robot, q):
    """Pose of the flange at q by the URDF."""
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, q)
    return data.oMf[robot.model.getFrameId(FLANGE.get(robot.name, "tool0"))].homogeneous


@pytest.fixture(scope="module", params=PUBLISHED)
def arm(request):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return load_robot(request.param)


def test_the_flange_is_where_the_makers_table_has_it(arm):
    rng = np.random.default_rng(0)
    rounded = arm.name == "gen3"  # the guide states tenths of a millimetre and leaves out an offset of 0.35 mm
    for q in (np.zeros(arm.nv), *rng.uniform(*arm.sampling_range, (50, arm.nv))):
        ours, theirs = flange(arm, q), by_table(arm.name, q)
        np.testing.assert_allclose(ours[:3, :3], theirs[:3, :3], rtol=0, atol=1e-12)
        np.testing.assert_allclose(ours[:3, 3], theirs[:3, 3], rtol=0, atol=1e-3 if rounded else 1e-12)


def test_mass_and_reach_are_those_of_the_data_sheet(arm):
    mass, reach, *_ = PUBLISHED[arm.name]
    base = arm.model.inertias[0].mass
    assert abs(pin.computeTotalMass(arm.model) + base - mass) < 0.06 * mass
    shoulder = arm.model.jointPlacements[1] * arm.model.jointPlacements[2].translation
    samples = np.random.default_rng(0).uniform(*arm.sampling_range, (4000, arm.nv))
    farthest = max(np.linalg.norm(flange(arm, q)[:3, 3] - shoulder) for q in samples)
    assert 0.95 * reach < farthest < 1.25 * reach  # makers measure to the wrist or to the flange


def test_limits_are_those_of_the_data_sheet(arm):
    *_, speeds, torques = PUBLISHED[arm.name]
    np.testing.assert_allclose(np.rad2deg(arm.velocity_limit), speeds, rtol=0.005)
    np.testing.assert_array_equal(arm.effort_limit, torques)


def test_rotor_inertia_is_the_rotors_behind_its_gear():
    """Drake's estimate for the iiwa, motors and gears of the DLR LWR III."""
    ratio, rotor = np.array([160, 160, 160, 160, 100, 160, 160]), np.array([1.321e-4] * 5 + [4.54e-5] * 2)
    np.testing.assert_allclose(load_robot("iiwa14").armature, ratio**2 * rotor, rtol=1e-12)


@pytest.mark.parametrize(("name", "with_rotors", "without"), [("fr3", 0.17, 0.5), ("gen3", 0.04, 1.0)])
def test_rotor_inertia_makes_a_bound_useful(name, with_rotors, without):
    """‖z1‖ for 5 N·m on every joint [rad], without joint friction."""
    robot = load_robot(name).with_friction(0.0, 0.0)
    bare = robot.with_armature(0.0)
    errors = [nbs.certify(NeuralBackstepping.for_robot(arm), np.full(arm.nv, 5.0)).error for arm in (robot, bare)]
    assert errors[0] < with_rotors
    assert errors[1] > without


def test_the_default_motion_is_within_the_limits_with_rotors_and_friction(arm):
    motion, dynamics, friction = nbs.Sinusoid.for_robot(arm), PinocchioDynamics(arm), nbs.JointFriction.of(arm)
    for t in np.linspace(0.0, 6.3, 200):
        wanted = motion(t)
        torque = nbs.inverse_dynamics(dynamics, wanted.q, wanted.v, wanted.a) + friction.torque(wanted.v)
        assert (np.abs(torque) < 0.6 * arm.effort_limit).all()
        assert (np.abs(wanted.v) < 0.6 * arm.velocity_limit).all()


def test_every_link_is_a_body_that_can_exist(arm):
    for inertia in arm.model.inertias[1:]:
        moments = np.linalg.eigvalsh(inertia.inertia)
        assert inertia.mass > 0.1
        assert moments[0] > 0.0
        assert moments[0] + moments[1] > moments[2]
        density = np.linalg.eigvalsh(inertia.toPseudoInertia().toMatrix())
        assert density[0] > 0.0


def test_every_moving_link_is_drawn_by_shapes_around_it(arm):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        visuals = link_visuals(arm)
    frames = {frame.name: frame for frame in arm.model.frames if frame.type == pin.FrameType.BODY}
    drawn = {frames[visual.link].parentJoint for visual in visuals}
    assert drawn == set(range(arm.model.njoints))
    for joint in range(1, arm.model.njoints):
        points = [
            visual.vertices @ visual.placement[:3, :3].T + visual.placement[:3, 3]
            for visual in visuals
            if frames[visual.link].parentJoint == joint
        ]
        low, high = np.concatenate(points).min(axis=0), np.concatenate(points).max(axis=0)
        lever = arm.model.inertias[joint].lever
        assert ((low - 0.03 < lever) & (lever < high + 0.03)).all(), (arm.model.names[joint], low, lever, high)
