"""Arms that nobody tuned, with rotors, friction and any mount, track at once."""

import numpy as np
import pytest
from random_arms import random_arm

import nbs_pin as nbs

SMALL = 1e-4
"""RMS error of any joint with known friction [rad, m]."""


@pytest.mark.parametrize("seed", [1, 3, 9])
def test_a_random_arm_tracks_untuned(seed, tmp_path):
    """In MuJoCo, whose Coulomb friction is a constraint, and with the friction that the law feeds forward."""
    robot = random_arm(seed, tmp_path)
    assert robot.armature.all()
    friction, reference = nbs.JointFriction.of(robot), nbs.Sinusoid.for_robot(robot)
    law = nbs.NeuralBackstepping.for_robot(robot, friction=friction)
    same = nbs.DynamicsPlant(nbs.PinocchioDynamics(robot), "rk4", friction)
    for plant, small in ((nbs.MujocoPlant(robot, joint_friction="keep"), SMALL), (same, 1e-2 * SMALL)):
        run = nbs.simulate(plant, law, reference, 1.5, 0.001)
        assert nbs.metrics.rms_error(run, 0.75).max() <= small


@pytest.mark.parametrize("seed", range(12))
def test_engines_agree_on_random_arms(seed, tmp_path):
    """M, C v + G and v̇ of MuJoCo are those of Pinocchio, with rotors, on branches, sliding joints and tilted bases."""
    robot = random_arm(100 + seed, tmp_path)
    rng, plant, dynamics = np.random.default_rng(seed), nbs.MujocoPlant(robot), nbs.PinocchioDynamics(robot)
    q = rng.uniform(*robot.sampling_range, (10, robot.nv))
    v, tau = rng.uniform(-1.0, 1.0, (2, 10, robot.nv))
    mass = dynamics.mass_matrix(q)
    np.testing.assert_allclose(plant.mass_matrix(q), mass, atol=1e-12 * np.abs(mass).max())
    bias = dynamics.reference_torque(q, v, v, np.zeros_like(v))
    np.testing.assert_allclose(plant.bias(q, v), bias, atol=1e-12 * max(np.abs(bias).max(), 1.0))
    a = dynamics.forward_dynamics(q, v, tau)
    np.testing.assert_allclose(plant.acceleration(q, v, tau), a, rtol=1e-8, atol=1e-9 * np.abs(a).max())
