"""Two engines on one arm, published data, conservation of energy, and the ways a simulation can break."""

import copy
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch

import nbs_pin as nbs
from nbs_pin.base.exceptions import ArgumentError, RobotError, SimulationDiverged
from nbs_pin.dynamics.equations import bias, energy, forward_dynamics
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.robots.robot import load_robot
from nbs_pin.simulation.dynamics_plant import DynamicsPlant
from nbs_pin.simulation.integrators import INTEGRATORS
from nbs_pin.simulation.mujoco_plant import MujocoPlant
from tests.test_simulation import Law

GANTRY = str(Path(__file__).parent / "data" / "gantry.urdf")  # prismatic, revolute and continuous
PUBLISHED = {  # docs/theory.md §8: row k is the state after k − 1 steps of 1 ms
    2: (-6.2168733e-06, 7.9008678e-06, -2.2411318e-06),
    100: (-0.06075149, 0.07693954, -0.0214924),
    1000: (-1.8019171, -0.5408098, -0.14177133),
    5000: (-3.257532, 0.5981221, 2.3077562),
    10012: (-1.9568236, -2.260467, -20.141457),
}


@pytest.fixture(scope="module")
def panda():
    return load_robot("panda")


def middle(robot):
    inside = np.isfinite(robot.lower) & np.isfinite(robot.upper)
    return np.where(inside, 0.5 * (np.where(inside, robot.lower, 0.0) + np.where(inside, robot.upper, 0.0)), 0.3)


def run_of(plant, dynamics, duration):
    """Gravity compensated, and some newton metres on each joint, in proportion to its inertia, at 2 to 5 rad/s."""
    rng, q0, n = np.random.default_rng(0), middle(dynamics.robot), dynamics.nv
    inertia = np.diagonal(dynamics.mass_matrix(q0))
    amplitude, frequency = rng.uniform(1.0, 3.0, n) * inertia, rng.uniform(2.0, 5.0, n)
    law = Law(lambda q, v, ref: dynamics.gravity(q), n)
    given = {"disturbance": nbs.SinusoidalTorque(amplitude, frequency, rng.uniform(-3.0, 3.0, n)), "q0": q0}
    return nbs.simulate(plant, law, nbs.Hold(q0), duration, 0.001, effort_limit=np.inf, **given)


@pytest.mark.parametrize("name", [*nbs.ROBOT_NAMES, GANTRY])
def test_mujoco_and_pinocchio_agree_on_mass_bias_and_acceleration(name):
    robot = load_robot(name)
    mujoco, dynamics = MujocoPlant(robot), PinocchioDynamics(robot)
    q, v, tau = np.random.default_rng(1).normal(size=(3, 5, robot.nv))
    tau = bias(dynamics, q, v) + np.einsum("bij,bj->bi", dynamics.mass_matrix(q), tau)
    np.testing.assert_allclose(mujoco.mass_matrix(q), dynamics.mass_matrix(q), rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(mujoco.bias(q, v), bias(dynamics, q, v), rtol=1e-10, atol=1e-10)
    ours = forward_dynamics(dynamics, q, v, tau)
    np.testing.assert_allclose(mujoco.acceleration(q, v, tau), ours, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("integrator", ["euler", "implicitfast"])
def test_semi_implicit_euler_is_mujocos_euler(panda, integrator):
    dynamics = PinocchioDynamics(panda)
    plants = MujocoPlant(panda, integrator), DynamicsPlant(dynamics, "semi_implicit_euler")
    theirs, ours = (run_of(plant, dynamics, 0.3) for plant in plants)
    np.testing.assert_allclose(theirs.q, ours.q, rtol=0, atol=1e-10)


def test_three_link_passes_through_the_published_rows():
    plant = MujocoPlant(load_robot("three_link"))
    q = v = zero = np.zeros(3)
    for steps in range(1, max(PUBLISHED)):
        q, v = plant.step(q, v, zero, 0.001)
        if steps + 1 in PUBLISHED:
            np.testing.assert_allclose(q, PUBLISHED[steps + 1], rtol=0, atol=1e-6)


@pytest.mark.parametrize("make", [lambda r: MujocoPlant(r), lambda r: DynamicsPlant(PinocchioDynamics(r))])
def test_rk4_conserves_energy_to_fourth_order(make):
    robot = load_robot("three_link")
    dynamics, plant, zero = PinocchioDynamics(robot), make(robot), np.zeros(3)
    drift = []
    for step in (0.002, 0.001):
        states = [(zero, zero)]
        for _ in range(round(0.8 / step)):
            states.append(plant.step(*states[-1], zero, step))
        total = energy(dynamics, *np.swapaxes(states, 0, 1))
        drift.append(np.abs(total - total[0]).max())
    assert drift[0] < 1e-7
    assert drift[0] > 15.0 * drift[1]


@pytest.mark.parametrize(("name", "order"), [("rk4", 4), ("semi_implicit_euler", 1), ("euler", 1)])
def test_integrators_have_their_order_on_an_oscillator(name, order):
    def error(h):
        q, v = np.array([1.0]), np.array([0.0])
        for _ in range(round(1.0 / h)):
            q, v = INTEGRATORS[name](lambda q, v: -q, q, v, h)
        return abs(q[0] - np.cos(1.0)) + abs(v[0] + np.sin(1.0))

    assert np.log2(error(0.05) / error(0.025)) == pytest.approx(order, abs=0.15)


def test_a_step_of_a_batch_is_the_stack_of_its_rows(panda):
    q, v, tau = np.random.default_rng(2).normal(size=(3, 2, 3, 7))
    for plant in (MujocoPlant(panda), DynamicsPlant(PinocchioDynamics(panda), friction=JointFriction.of(panda))):
        q1, v1 = plant.step(q, v, tau, 0.001)
        alone = plant.step(q[1, 2], v[1, 2], tau[1, 2], 0.001)
        np.testing.assert_array_equal((q1[1, 2], v1[1, 2]), alone)


@pytest.mark.parametrize("joint_friction", ["drop", "keep"])
def test_a_mujoco_step_depends_on_its_arguments_alone(joint_friction):
    plant = MujocoPlant(load_robot("z1"), joint_friction=joint_friction)
    first, other = np.random.default_rng(3).normal(size=(2, 3, plant.nv))
    before = plant.step(*first, 0.001)
    plant.step(*other, 0.002)
    np.testing.assert_array_equal(plant.step(*first, 0.001), before)
    with pytest.raises(SimulationDiverged):
        plant.step(first[0], first[1] + 1e12, first[2], 0.001)
    np.testing.assert_array_equal(plant.step(*first, 0.001), before)
    for twin in (pickle.loads(pickle.dumps(plant)), copy.deepcopy(plant)):
        np.testing.assert_array_equal(twin.step(*first, 0.001), before)


def test_kept_friction_is_integrated_implicitly():
    assert MujocoPlant(load_robot("xarm7"), joint_friction="keep").integrator == "implicitfast"
    assert MujocoPlant(load_robot("xarm7")).integrator == "rk4"


def test_kept_damping_is_the_urdfs():
    robot = load_robot("double_pendulum")
    assert robot.damping.min() > 0.0
    assert robot.friction.max() == 0.0
    friction = JointFriction.of(robot)
    v, zero = np.array([1.0, -2.0]), np.zeros(2)
    kept = MujocoPlant(robot, joint_friction="keep").acceleration(zero, v, zero)
    np.testing.assert_allclose(kept, MujocoPlant(robot).acceleration(zero, v, -friction.torque(v)), rtol=1e-12)
    plant = DynamicsPlant(PinocchioDynamics(robot), friction=friction)
    same = MujocoPlant(robot, "rk4", joint_friction="keep")
    np.testing.assert_allclose(plant.step(zero, v, zero, 1e-3), same.step(zero, v, zero, 1e-3), atol=1e-12)


def test_kept_dry_friction_is_coulomb_friction_on_light_and_heavy_joints():
    """A sliding joint feels its whole Coulomb torque, whatever the inertia behind it."""
    robot = load_robot("z1")
    q, v = middle(robot), np.full(robot.nv, 0.5)
    friction = JointFriction.of(robot)
    push = PinocchioDynamics(robot).reference_torque(q, v, v, 0.0 * v) + friction.torque(v)
    accelerations = MujocoPlant(robot, joint_friction="keep").acceleration(q, v, push)
    free = MujocoPlant(robot).acceleration(q, v, push - friction.torque(v))
    assert np.abs(free).max() < 1e-10
    assert np.abs(accelerations).max() < 1e-3 * np.abs(MujocoPlant(robot).acceleration(q, v, push)).max()


def test_kept_dry_friction_holds_an_arm_that_otherwise_falls():
    robot = load_robot("z1")
    q, zero = middle(robot), np.zeros(robot.nv)
    tau = PinocchioDynamics(robot).gravity(q) + 0.5 * robot.friction
    assert (robot.friction > 0.0).all()
    held = MujocoPlant(robot, joint_friction="keep").acceleration(q, zero, tau)
    free = MujocoPlant(robot).acceleration(q, zero, tau)
    assert np.abs(held).max() < 0.2 * np.abs(free).max()  # soft: about a tenth leaks


def test_friction_takes_energy_and_comes_in_both_array_kinds():
    friction = JointFriction(np.array([0.5, 0.0]), np.array([1.0, 2.0]), 0.1)
    v = np.linspace(-2.0, 2.0, 41)[:, None] * np.ones(2)
    torque = friction.torque(v)
    assert (torque * v).sum(axis=-1).min() == 0.0
    np.testing.assert_allclose(torque[-1], [2.0, 2.0], rtol=1e-12)
    tensor = torch.tensor(v, requires_grad=True)
    np.testing.assert_allclose(friction.torque(tensor).detach(), torque, rtol=0, atol=1e-15)
    friction.torque(tensor).sum().backward()
    np.testing.assert_allclose(tensor.grad[20], [0.5 + 10.0, 20.0], rtol=1e-12)


def test_gravity_is_the_robots():
    robot = load_robot("panda", gravity=[1.0, -2.0, 3.0])
    q = middle(robot)
    expected = PinocchioDynamics(robot).gravity(q)
    np.testing.assert_allclose(MujocoPlant(robot).bias(q, 0.0 * q), expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("joint_friction", ["drop", "keep"])
@pytest.mark.parametrize(("beyond", "torque"), [(-0.5, 20.0), (0.5, 0.0)])
def test_limits_of_effort_and_position_are_none_of_mujocos(panda, joint_friction, beyond, torque):
    q, tau = panda.upper + beyond, torque * panda.effort_limit
    expected = forward_dynamics(PinocchioDynamics(panda), q, 0 * q, tau)
    plant = MujocoPlant(panda, joint_friction=joint_friction)
    np.testing.assert_allclose(plant.acceleration(q, 0 * q, tau), expected, rtol=1e-9)


NOT_FINITE = [(k, value, "expected finite") for k in range(3) for value in (np.nan, np.inf)]


@pytest.mark.parametrize(
    ("argument", "value", "cause"), [*NOT_FINITE, (0, 1e15, "QPOS"), (1, 1e15, "QVEL"), (2, 1e15, "QACC")]
)
def test_numbers_that_mujoco_cannot_take_are_raised_with_their_cause(panda, argument, value, cause):
    arguments = np.zeros((3, 7))
    arguments[argument, 3] = value
    with pytest.raises(SimulationDiverged, match=cause):
        MujocoPlant(panda).step(*arguments, 0.001)


def test_a_provider_that_leaves_the_finite_numbers_raises(panda):
    with pytest.raises(SimulationDiverged, match="PinocchioDynamics, euler"):
        DynamicsPlant(PinocchioDynamics(panda), "euler").step(np.zeros(7), np.full(7, 1e200), np.zeros(7), 0.001)


def test_unknown_choices_are_refused(panda):
    dynamics = PinocchioDynamics(panda)
    with pytest.raises(ArgumentError, match="2 joints, the arm has 7"):
        DynamicsPlant(dynamics, friction=JointFriction(np.ones(2), np.ones(2)))
    # The annotations are executed in tests, and refuse first what the constructor refuses for a user.
    for make in (MujocoPlant, lambda *a: DynamicsPlant(dynamics, *a[1:])):
        with pytest.raises((ArgumentError, TypeError), match="rk5"):
            make(panda, "rk5")
    with pytest.raises((ArgumentError, TypeError), match="some"):
        MujocoPlant(panda, joint_friction="some")


@pytest.mark.parametrize(
    ("viscous", "coulomb", "transition"),
    [([-1.0], [0.0], 0.1), ([1.0], [np.nan], 0.1), ([1.0], [0.0, 1.0], 0.1), ([1.0], [1.0], 0.0)],
)
def test_impossible_friction_is_refused(viscous, coulomb, transition):
    with pytest.raises((ArgumentError, TypeError)):
        JointFriction(np.array(viscous), np.array(coulomb), transition)


def test_an_arm_that_mujoco_cannot_build_is_refused_by_name(panda):
    broken = panda.urdf.xml.replace(b"<mass value=", b"<mass value='0' was=")
    robot = copy.copy(panda)
    object.__setattr__(robot, "urdf", type(panda.urdf)(**{**vars(panda.urdf), "xml": broken}))
    with pytest.raises(RobotError, match="MuJoCo cannot build"):
        MujocoPlant(robot)
