"""Loops of laws and plants over some time: what they follow, what falls, and two engines on one arm."""

import numpy as np
import pytest

import nbs_pin as nbs
from nbs_pin.controllers.neural_backstepping import DAMPINGS, NeuralBackstepping
from nbs_pin.controllers.pid import PID
from nbs_pin.controllers.potential import POTENTIALS
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.robots.robot import load_robot
from nbs_pin.simulation.dynamics_plant import DynamicsPlant
from nbs_pin.simulation.mujoco_plant import MujocoPlant
from tests.laws import EVERY as LAWS
from tests.test_controllers import ARMS
from tests.test_networks import randomise
from tests.test_plants import GANTRY, run_of


@pytest.mark.parametrize("law", LAWS.values(), ids=LAWS)
@pytest.mark.parametrize("arm", ARMS)
def test_defaults_follow_a_moving_reference(law, arm):
    """Out of the box: from the reference's start, every law stays near it in the truth its model believes."""
    robot = load_robot(arm)
    reference = nbs.Sinusoid.for_robot(robot, amplitude=0.2)
    run = nbs.simulate(nbs.DynamicsPlant(PinocchioDynamics(robot)), law(robot), reference, 0.5, 0.001)
    error = np.abs(robot.difference(run.q, run.q_ref)).max()
    modelled = law not in (LAWS["pid"], LAWS["pd-gravity"])
    assert error < (1e-3 if modelled else 0.15)


@pytest.mark.parametrize("damping", DAMPINGS)
@pytest.mark.parametrize("potential", POTENTIALS)
def test_storage_never_rises_for_any_weights(potential, damping):
    """Theorem 1 in simulation: without disturbance V falls from starts far away, whatever the weights."""
    robot = load_robot("two_link")
    dynamics = PinocchioDynamics(robot)
    controller = NeuralBackstepping.for_robot(robot, dynamics, potential=potential, damping=damping, bandwidth=3.0)
    randomise(controller, seed=5, gain=0.5)
    check_storage_falls(controller)


def check_storage_falls(controller: NeuralBackstepping) -> None:
    """Along motions of two joints from twenty starts far away."""
    dynamics = controller.dynamics
    starts = np.random.default_rng(1).uniform(-2.0, 2.0, (20, 2))
    hold = nbs.Hold(np.zeros(2))
    run = nbs.simulate(nbs.DynamicsPlant(dynamics), controller, hold, 0.3, 1e-3, q0=starts, effort_limit=np.inf)
    storage = controller.storage(run.q, run.v, run.q_ref, run.v_ref)[::10]
    assert (storage[1:] < storage[:-1]).all()
    assert (storage[-1] < 0.5 * storage[0]).all()


def test_pid_removes_the_offset_of_an_unknown_load():
    robot = load_robot("two_link")
    plant, hold = nbs.DynamicsPlant(PinocchioDynamics(robot)), nbs.Hold(np.array([0.3, 0.4]))
    run = nbs.simulate(plant, PID.for_robot(robot, period=0.004), hold, 5.0, 0.004, plant_step=0.004)
    assert np.abs(run.q[-1] - run.q_ref[-1]).max() < 1e-4


@pytest.mark.parametrize("name", [*nbs.ROBOT_NAMES, GANTRY])
def test_mujoco_and_pinocchio_move_every_arm_alike(name):
    robot = load_robot(name)
    dynamics = PinocchioDynamics(robot)
    ours, theirs = (run_of(plant, dynamics, 0.5) for plant in (DynamicsPlant(dynamics), MujocoPlant(robot)))
    assert np.abs(ours.q[-1] - ours.q[0]).max() > 0.05
    np.testing.assert_allclose((theirs.q, theirs.v), (ours.q, ours.v), rtol=0, atol=1e-10, equal_nan=False)
