"""`IdentifiedDynamics.write_urdf`: the arm that the file describes is the model that was written."""

from pathlib import Path

import numpy as np
import pytest

import nbs_pin as nbs

GANTRY = str(Path(__file__).parent / "data" / "gantry.urdf")  # prismatic, revolute and continuous


def model_of(robot, *, friction=True):
    """The arm with other bodies, rotors and friction than its own."""
    own = np.array([body.toDynamicParameters() for body in list(robot.model.inertias)[1:]])
    n = np.arange(1.0, robot.nv + 1.0)
    return nbs.IdentifiedDynamics(
        robot, own * (1.0 + 0.1 * n[:, None]), nbs.JointFriction(0.3 * n, 0.2 * n) if friction else None, 0.05 * n
    )


def assert_same(model, arm, seed=0):
    again, rng = nbs.PinocchioDynamics(arm), np.random.default_rng(seed)
    q = rng.uniform(*model.robot.sampling_range, (20, arm.nv))
    v = rng.normal(size=q.shape)
    np.testing.assert_allclose(again.mass_matrix(q), model.mass_matrix(q), atol=1e-9)
    np.testing.assert_allclose(again.coriolis_matrix(q, v), model.coriolis_matrix(q, v), atol=1e-9)
    np.testing.assert_allclose(again.gravity(q), model.gravity(q), atol=1e-9)


@pytest.mark.parametrize("name", ["two_link", "panda", "ur5", "xarm7", GANTRY])
def test_the_arm_of_the_file_is_the_model(name, tmp_path):
    robot = nbs.load_robot(name)
    model = model_of(robot)
    arm = nbs.load_robot(model.write_urdf(tmp_path / "written" / "arm.urdf"), gravity=robot.gravity_vector)
    assert_same(model, arm)
    np.testing.assert_array_equal(arm.armature, model.rotor_inertia)
    np.testing.assert_array_equal(arm.damping, model.friction.viscous)
    np.testing.assert_array_equal(arm.friction, model.friction.coulomb)
    assert arm.joint_names == robot.joint_names
    for kept in ("continuous", "prismatic", "lower", "upper", "effort_limit", "velocity_limit"):
        np.testing.assert_array_equal(getattr(arm, kept), getattr(robot, kept), err_msg=kept)
    links = {frame.name for frame in robot.model.frames}
    assert {frame.name for frame in arm.model.frames} == links


def test_a_payload_a_mount_and_other_limits_are_in_the_file(tmp_path):
    robot = nbs.load_robot("ur5", base_rpy=[np.pi, 0.0, 0.0], gravity=1.62)
    robot = robot.with_payload("tool0", 2.0, [0.0, 0.0, 0.1], 1e-3).with_effort_limit(33.0)
    model = model_of(robot)
    arm = nbs.load_robot(model.write_urdf(tmp_path / "arm.urdf"), gravity=1.62)
    assert_same(model, arm)
    assert (arm.effort_limit == 33.0).all()


def test_friction_that_the_model_does_not_know_stays_as_it_is(tmp_path):
    robot = nbs.load_robot("xarm7")
    arm = nbs.load_robot(model_of(robot, friction=False).write_urdf(tmp_path / "arm.urdf"))
    np.testing.assert_array_equal(arm.damping, robot.damping)
    np.testing.assert_array_equal(arm.friction, robot.friction)


def test_what_an_adaptive_law_has_learned_is_an_arm(tmp_path):
    robot = nbs.load_robot("two_link")
    plant = nbs.MujocoPlant(robot.with_payload("tip", 0.5, inertia=1e-4))
    law = nbs.AdaptiveLaw(nbs.NeuralBackstepping.for_robot(robot), load_mass=2.0)
    run = nbs.simulate(plant, law, nbs.Sinusoid.for_robot(robot), 3.0, 0.001)
    learned = law.estimate(run.estimates[-1]).dynamics()
    arm = nbs.load_robot(learned.write_urdf(tmp_path / "arm.urdf"), gravity=robot.gravity_vector)
    assert_same(learned, arm)
    mass = sum(body.mass for body in list(arm.model.inertias)[1:])
    assert mass == pytest.approx(2.5, abs=0.1)
