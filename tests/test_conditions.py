"""Conditions that laws are judged under: the true arm differs in what its condition says, and in nothing else."""

import numpy as np
import pinocchio as pin
import pytest

import nbs_pin as nbs
from nbs_pin.benchmarks.conditions import CONDITIONS, Condition, with_other_bodies
from nbs_pin.robots.places import tool_frame

ARMS = ("two_link", "panda", "gen3")


def drawn(seed=0):
    return np.random.default_rng(seed)


def states(robot, count=5):
    low, high = robot.one_turn_range
    return drawn(1).uniform(low, high, (count, robot.nv))


@pytest.mark.parametrize("arm", ARMS)
@pytest.mark.parametrize("name", ["nominal", "delay", "encoders", "limits", "friction"])
def test_bodies_are_those_of_the_description_unless_the_condition_says_otherwise(arm, name):
    robot = nbs.load_robot(arm)
    plant, model = CONDITIONS[name].plant(robot, drawn()), nbs.PinocchioDynamics(robot)
    q = states(robot)
    np.testing.assert_allclose(plant.mass_matrix(q), model.mass_matrix(q), rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(plant.bias(q, 0.0 * q), model.gravity(q), rtol=1e-10, atol=1e-9)


@pytest.mark.parametrize("arm", ARMS)
def test_a_load_is_a_point_mass_at_the_end_of_the_arm(arm):
    robot = nbs.load_robot(arm)
    plant, model = CONDITIONS["load"].plant(robot, drawn()), nbs.PinocchioDynamics(robot)
    for q in states(robot):
        lift = 2.0 * robot.jacobian(q, tool_frame(robot))[:3].T @ -robot.gravity_vector
        np.testing.assert_allclose(plant.bias(q, 0.0 * q), model.gravity(q) + lift, rtol=1e-9, atol=1e-8)


@pytest.mark.parametrize("arm", ARMS)
def test_other_bodies_are_off_by_their_share_and_rotors_and_limits_stay(arm):
    robot, p = nbs.load_robot(arm), 0.05
    other = with_other_bodies(robot, p, drawn())
    assert other.name == robot.name
    assert np.array_equal(other.effort_limit, robot.effort_limit)
    np.testing.assert_allclose(other.armature, robot.armature, rtol=1e-12)
    np.testing.assert_allclose(other.gravity_vector, robot.gravity_vector)
    signs = []
    for ours, theirs in zip(list(robot.model.inertias)[1:], list(other.model.inertias)[1:], strict=True):
        signs.append(theirs.mass / ours.mass)
        np.testing.assert_allclose(np.abs(theirs.lever - ours.lever), p * np.abs(ours.lever), rtol=1e-6, atol=1e-12)
        share = np.trace(theirs.inertia) / np.trace(ours.inertia)
        assert min(abs(share - 1.0 - p), abs(share - 1.0 + p)) < 1e-9
    assert all(min(abs(x - 1.0 - p), abs(x - 1.0 + p)) < 1e-9 for x in signs)
    again = with_other_bodies(robot, p, drawn())
    assert pin.crba(again.model, again.model.createData(), states(robot)[0]) == pytest.approx(
        pin.crba(other.model, other.model.createData(), states(robot)[0]), rel=1e-14
    )


def test_friction_brakes_with_its_share_of_the_effort():
    robot = nbs.load_robot("panda")
    condition = CONDITIONS["friction"]
    friction = condition.friction_of(robot)
    at_full_speed = friction.torque(robot.velocity_limit)
    np.testing.assert_allclose(at_full_speed, 2.0 * 0.02 * robot.effort_limit, rtol=1e-9)
    plant, free = condition.plant(robot, drawn()), CONDITIONS["nominal"].plant(robot, drawn())
    q, v = states(robot, 1)[0], 0.5 * robot.velocity_limit
    slowed = free.acceleration(q, v, np.zeros(7)) - plant.acceleration(q, v, np.zeros(7))
    np.testing.assert_allclose(free.mass_matrix(q) @ slowed, friction.torque(v), rtol=0.02)


def test_an_arm_without_limits_has_no_friction():
    robot = nbs.load_robot("double_pendulum")
    friction = Condition("friction", "", friction=0.02).friction_of(robot)
    assert not friction.coulomb.any()
    assert not friction.viscous.any()


def test_weak_drives_give_what_the_motion_takes_and_no_more_than_the_arm_has():
    robot = nbs.load_robot("panda")
    needed = np.array([10.0, 80.0, 1.0, 20.0, 1.0, 3.0, 0.5])
    limit = CONDITIONS["limits"].effort_limit(robot, needed)
    np.testing.assert_allclose(limit, [12.0, 87.0, 8.7, 24.0, 1.2, 3.6, 1.2])
    assert np.array_equal(CONDITIONS["nominal"].effort_limit(robot, needed), robot.effort_limit)
