"""Identification: what clean data say exactly, what noisy data say well, and what data do not say at all."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.controllers.pd import PD
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.dynamics.identified import IdentifiedDynamics
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.dynamics.pseudo_inertia import BASIS, coordinates, inertial_parameters, pseudo_inertia, symmetric
from nbs_pin.identification.collect import collect
from nbs_pin.identification.consistent_fit import consistent_fit
from nbs_pin.identification.datasets import Dataset
from nbs_pin.identification.identify import identify
from nbs_pin.identification.measurement import Noise
from nbs_pin.robots.robot import Robot, load_robot
from tests.test_chain import errors
from tests.test_dynamics import GANTRY

REAL = Noise(encoder=2.0**-16, torque=0.5)


def states(nv: int, samples: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    q, v = rng.uniform(-np.pi, np.pi, (samples, nv)), rng.uniform(-2.0, 2.0, (samples, nv))
    return q, v, 5.0 * rng.normal(size=(samples, nv))


def dataset(robot: Robot, q: np.ndarray, v: np.ndarray, a: np.ndarray, tau: np.ndarray) -> Dataset:
    order = np.arange(len(q))
    return Dataset(q, v, a, tau, 0.0 * order, order, robot.parents, robot.prismatic, robot.name)


def clean(robot: Robot, samples: int = 300, friction: JointFriction | None = None, noise: object = 0.0) -> Dataset:
    """Independent states and their torque, with friction and noise of a standard deviation per joint."""
    q, v, a = states(robot.nv, samples)
    tau = PinocchioDynamics(robot).reference_torque(q, v, v, a) + noise * np.random.default_rng(1).normal(size=q.shape)
    return dataset(robot, q, v, a, tau if friction is None else tau + friction.torque(v))


def unlike(robot: Robot) -> Robot:
    """The arm with other bodies: its geometry is all that is left of it."""
    model, rng = robot.model.copy(), np.random.default_rng(5)
    for i in range(1, model.njoints):
        model.inertias[i] = pin.Inertia.FromSphere(rng.uniform(0.1, 9.0), 0.3)
    return replace(robot, model=model)


# Pseudo-inertias.


def test_the_basis_is_orthonormal_and_coordinates_undo_it():
    np.testing.assert_allclose(np.einsum("kij,lij->kl", BASIS, BASIS), np.eye(10), atol=1e-15)
    x = np.random.default_rng(0).normal(size=(3, 10))
    np.testing.assert_allclose(coordinates(symmetric(x)), x, atol=1e-15)


def test_a_pseudo_inertia_is_the_second_moment_of_mass():
    rng = np.random.default_rng(1)
    points, masses = rng.normal(size=(6, 3)), rng.uniform(0.1, 2.0, 6)
    body = sum((pin.Inertia(m, x, np.zeros((3, 3))) for m, x in zip(masses, points, strict=True)), pin.Inertia.Zero())
    ends = np.hstack([points, np.ones((6, 1))])
    expected = np.einsum("p,pi,pj->ij", masses, ends, ends)
    np.testing.assert_allclose(pseudo_inertia(body.toDynamicParameters()), expected, atol=1e-13)
    np.testing.assert_allclose(inertial_parameters(expected), body.toDynamicParameters(), atol=1e-13)


# The convex fit.


def objective(design, target, bodies, scalars, strength):
    x = np.concatenate([coordinates(bodies).ravel(), scalars])
    divergence = np.trace(bodies, axis1=1, axis2=2).sum() - np.linalg.slogdet(bodies)[1].sum()
    return 0.5 * np.square(design @ x - target).sum() + strength * (divergence + (scalars - np.log(scalars)).sum())


@pytest.mark.parametrize("strength", [1e-2, 3.0])
def test_the_fit_is_the_minimum_of_its_objective(strength):
    rng = np.random.default_rng(2)
    design, target = rng.normal(size=(15, 23)), 3.0 * rng.normal(size=15)
    fit = consistent_fit(design, target, 2, strength)
    bodies = fit.factors @ fit.factors.swapaxes(1, 2)
    least = objective(design, target, bodies, fit.scalars, strength)
    assert fit.decrement < 0.1
    for _ in range(50):
        s = 0.03 * rng.normal(size=23)
        moved = fit.factors @ (np.eye(4) + symmetric(s[:20].reshape(2, 10))) @ fit.factors.swapaxes(1, 2)
        assert objective(design, target, moved, fit.scalars * (1.0 + s[20:]), strength) > least


def test_without_data_the_fit_is_what_was_expected():
    fit = consistent_fit(np.zeros((1, 21)), np.zeros(1), 2, 1.0)
    np.testing.assert_allclose(fit.factors, np.tile(np.eye(4), (2, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(fit.scalars, 1.0, atol=1e-12)


def test_exact_data_override_what_was_expected_and_bounds_hold():
    rng = np.random.default_rng(3)
    root = rng.normal(size=(1, 4, 4))
    truth = np.concatenate([coordinates(root @ root.swapaxes(1, 2)).ravel(), [4.0, 0.0]])
    design = 1e9 * rng.normal(size=(30, 12))
    fit = consistent_fit(design, design @ truth, 1, 1.0)
    found = np.concatenate([coordinates(fit.factors @ fit.factors.swapaxes(1, 2)).ravel(), fit.scalars])
    np.testing.assert_allclose(found, truth, atol=1e-7)
    assert fit.scalars[1] > 0.0


# Clean data.


@pytest.mark.parametrize(
    ("name", "base"), [("two_link", 6), ("three_link", 9), ("ur5", 36), ("panda", 43), ("xarm7", 43), (GANTRY, 11)]
)
def test_clean_data_give_the_arm_to_rounding_and_its_own_bodies_are_not_looked_at(name, base):
    robot = load_robot(name)
    model = identify(clean(robot), unlike(robot))
    assert errors(model, PinocchioDynamics(robot)).max() < 1e-10
    assert (model.report.base_parameters, model.report.excited, model.report.unidentifiable) == (base, base, ())
    assert model.report.train_nmse < 1e-20
    assert np.linalg.eigvalsh(pseudo_inertia(model.parameters)).min() > -1e-12


@pytest.mark.parametrize("name", ["three_link", "panda"])
def test_motions_in_mujoco_give_the_arm_to_rounding(name):
    robot = load_robot(name)
    model = identify(collect(robot, "excited", 600, seed=1), robot)
    assert errors(model, PinocchioDynamics(robot)).max() < 1e-8


def test_friction_and_rotors_are_found_with_the_inertias():
    robot = load_robot("ur5")
    rng = np.random.default_rng(6)
    friction = JointFriction(rng.uniform(0.5, 3.0, 6), rng.uniform(0.5, 3.0, 6), transition=0.05)
    rotors = rng.uniform(0.1, 0.5, 6)
    data = clean(robot, friction=friction)
    data = replace(data, tau=data.tau + rotors * data.a)
    model = identify(data, robot, friction=True, rotor_inertia=True, transition=0.05)
    assert model.friction is not None
    np.testing.assert_allclose(model.friction.viscous, friction.viscous, rtol=1e-8)
    np.testing.assert_allclose(model.friction.coulomb, friction.coulomb, rtol=1e-8)
    q, v, a = states(6, 50, seed=1)
    truth = PinocchioDynamics(robot).reference_torque(q, v, v, a) + rotors * a
    np.testing.assert_allclose(model.reference_torque(q, v, v, a), truth, atol=1e-8 * np.abs(truth).max())


def test_friction_that_is_not_there_is_not_found():
    robot = load_robot("three_link")
    model = identify(clean(robot), robot, friction=True)
    assert model.friction is not None
    assert max(model.friction.viscous.max(), model.friction.coulomb.max()) < 1e-8
    assert errors(model, PinocchioDynamics(robot)).max() < 1e-8
    assert identify(clean(robot), robot).friction is None


# Noisy data.


@pytest.mark.parametrize(("name", "worst"), [("three_link", 0.01), ("ur5", 0.04)])
def test_a_noisy_arm_with_friction_is_identified(name, worst):
    robot = load_robot(name)
    friction = JointFriction(np.full(robot.nv, 2.0), np.full(robot.nv, 1.0))
    data, truth = collect(robot, "excited", 1_000, seed=2, noise=REAL, friction=friction), PinocchioDynamics(robot)
    model = identify(data, robot, friction=True)
    assert errors(model, truth).max() < worst
    assert model.friction is not None
    np.testing.assert_allclose(model.friction.viscous, 2.0, atol=0.3)
    np.testing.assert_allclose(model.friction.coulomb, 1.0, atol=0.3)
    # Not the sensor's 0.5 alone: rounded angles, smoothed accelerations and sticking joints are noise to the arm, too.
    left = data.tau - truth.reference_torque(data.q, data.v, data.v, data.a) - friction.torque(data.v)
    scale = 1.4826 * np.median(np.abs(left), axis=0)  # some samples are outliers, and those beyond 4 count less
    weight = np.minimum(1.0, 4.0 * scale / np.maximum(np.abs(left), 1e-300))
    expected = np.sqrt((weight * np.square(left)).mean(axis=0))
    np.testing.assert_allclose(model.report.noise, expected, rtol=0.05)
    assert (model.report.noise > 0.45).all()


def test_the_noise_of_a_sensor_is_estimated():
    robot, noise = load_robot("ur5"), np.geomspace(0.1, 5.0, 6)
    found = identify(clean(robot, 2_000, noise=noise), robot).report.noise
    np.testing.assert_allclose(found, noise, rtol=4.0 / np.sqrt(2.0 * 2_000))  # four standard errors of an estimate


def test_noise_falls_with_the_root_of_the_samples():
    robot = load_robot("xarm7")
    few, many = (clean(robot, samples, noise=0.5) for samples in (200, 3_200))
    few, many = (errors(identify(data, robot), PinocchioDynamics(robot)) for data in (few, many))
    assert (many < 0.5 * few).all()


@pytest.mark.parametrize("name", ["two_link", "ur5", GANTRY])
@pytest.mark.parametrize("seed", [0, 1])
def test_the_mass_of_all_bodies_is_within_its_deviation(name, seed):
    """A joint of the gantry lifts them all; no torque of the others depends on the sum."""
    robot = load_robot(name)
    model = identify(collect(robot, "uniform", 300, seed, noise=Noise(torque=0.3)), robot)
    true, found = sum(body.mass for body in robot.model.inertias), model.parameters[:, 0].sum()
    assert abs(found - true) < 4.0 * model.report.mass_deviation
    assert (model.report.mass_deviation < 0.01 * found) == (name == GANTRY)
    assert model.report.mass_deviation <= model.report.parameter_deviations[:, 0].sum()


def test_a_noisy_joint_does_not_spoil_the_others():
    robot, noise = load_robot("ur5"), np.array([50.0, 0.01, 0.01, 0.01, 0.01, 0.01])
    model = identify(clean(robot, 400, noise=noise), robot)
    np.testing.assert_allclose(model.report.noise, noise, rtol=0.2)
    assert errors(model, PinocchioDynamics(robot)).max() < 0.02


def test_the_units_of_torque_do_not_matter():
    robot = load_robot("three_link")
    data = clean(robot, friction=JointFriction(np.ones(3), np.ones(3)), noise=1.0)
    one, thousand = (identify(replace(data, tau=c * data.tau), robot, friction=True) for c in (1.0, 1e3))
    np.testing.assert_allclose(thousand.parameters, 1e3 * one.parameters, rtol=1e-5, atol=1e-5)
    assert one.friction is not None
    assert thousand.friction is not None
    np.testing.assert_allclose(thousand.friction.coulomb, 1e3 * one.friction.coulomb, rtol=1e-5)


def test_the_order_of_the_samples_does_not_matter():
    robot = load_robot("three_link")
    data = clean(robot, 1_500, noise=1.0)
    shuffle = np.random.default_rng(1).permutation(1_500)
    models = [identify(data.take(k), robot) for k in (slice(None), shuffle)]
    np.testing.assert_allclose(models[0].parameters, models[1].parameters, rtol=1e-6, atol=1e-8)


# Data that do not say everything.


def test_still_poses_say_nothing_of_moments_of_inertia():
    robot = load_robot("two_link")
    q, v, a = states(2, 200)
    data = dataset(robot, q, 0.0 * v, 0.0 * a, PinocchioDynamics(robot).gravity(q))
    model = identify(data, robot)
    assert (model.report.base_parameters, model.report.excited) == (6, 4)
    assert len(model.report.unidentifiable) == 2
    assert all("I" in line for line in model.report.unidentifiable)
    assert errors(model, PinocchioDynamics(robot))[2] < 1e-8
    assert np.linalg.eigvalsh(model.mass_matrix(q)).min() > 0.0


def test_a_joint_that_never_moves_keeps_the_friction_expected_of_it():
    robot = load_robot("three_link")
    q, v, a = states(3, 400)
    q[:, 1], v[:, 1], a[:, 1] = 0.3, 0.0, 0.0
    friction = JointFriction(np.ones(3), np.ones(3))
    tau = PinocchioDynamics(robot).reference_torque(q, v, v, a) + friction.torque(v)
    model = identify(dataset(robot, q, v, a, tau), robot, friction=True)
    unidentifiable = " ".join(model.report.unidentifiable)
    joint = robot.joint_names[1]
    assert f"viscous({joint})" in unidentifiable
    assert f"coulomb({joint})" in unidentifiable
    assert model.friction is not None
    np.testing.assert_allclose(model.friction.viscous[[0, 2]], 1.0, rtol=1e-8)
    assert model.friction.viscous[1] < 20.0


def test_few_noisy_samples_give_bodies_that_exist():
    robot = load_robot("xarm7")
    model = identify(collect(robot, "excited", 300, seed=3, noise=REAL), robot)
    assert model.report.unidentifiable
    assert np.linalg.eigvalsh(pseudo_inertia(model.parameters)).min() > 0.0
    q, _, _ = states(7, 200)
    assert np.linalg.eigvalsh(model.mass_matrix(q)).min() > 0.0


# Refusals.


LIGHT = load_robot("two_link", gravity=0.0)


def still(robot: Robot) -> Dataset:
    data = clean(robot)
    return replace(data, v=0.0 * data.v, a=0.0 * data.a)


def without_torque(robot: Robot) -> Dataset:
    data = clean(robot)
    return replace(data, tau=0.0 * data.tau)


@pytest.mark.parametrize(
    ("data", "robot", "settings", "words"),
    [
        (clean(load_robot("two_link")), load_robot("three_link"), {}, "2 joints and three_link 3"),
        (clean(load_robot("three_link")), load_robot(GANTRY), {}, "the joints of the data are .* and those of"),
        (collect(load_robot("panda"), "uniform", 40), load_robot("xarm7"), {}, "the data are of panda, not of xarm7"),
        (without_torque(LIGHT), LIGHT, {}, "inertias of every scale explain such a motion"),
        (still(LIGHT), LIGHT, {}, "neither moves nor carries weight"),
        (clean(LIGHT), LIGHT, {"transition": 0.0}, "transition is 0"),
        (clean(LIGHT), LIGHT, {"regularisation": 0.0}, "regularisation is 0"),
    ],
)
def test_what_identifies_nothing_is_refused(data, robot, settings, words):
    with pytest.raises(ArgumentError, match=words):
        identify(data, robot, **settings)


def test_too_few_samples_are_refused():
    robot = load_robot("panda")
    with pytest.raises(ArgumentError, match=r"12 samples of 7 joints are too few for 43 .* give 13 or more"):
        identify(clean(robot, 12), robot)
    assert identify(clean(robot, 13), robot).report.samples == 13


# The model.


def own_parameters(robot: Robot) -> np.ndarray:
    return np.array([robot.model.inertias[i + 1].toDynamicParameters() for i in range(robot.nv)])


@pytest.mark.parametrize("name", ["panda", GANTRY])
def test_with_the_arms_own_parameters_the_model_is_the_arm(name):
    robot = load_robot(name)
    model = IdentifiedDynamics(unlike(robot), own_parameters(robot))
    truth = PinocchioDynamics(robot)
    assert errors(model, truth).max() < 1e-13
    q, v, a = states(robot.nv, 5)
    np.testing.assert_allclose(model.potential_energy(q), truth.potential_energy(q), atol=1e-11)
    np.testing.assert_allclose(model.forward_dynamics(q, v, truth.reference_torque(q, v, v, a)), a, atol=1e-8)
    np.testing.assert_allclose(model.packed_tree().weights, truth.packed_tree().weights, atol=1e-12)


def test_a_law_on_the_model_runs_as_machine_code():
    robot = load_robot("ur5")
    rotors = np.full(6, 0.2)
    model = IdentifiedDynamics(robot, own_parameters(robot), rotor_inertia=rotors)
    q, v, a = states(6, 1)
    law = PD(model, feedforward="reference", kp=np.full(6, 10.0), kd=np.full(6, 1.0))
    arguments = (q[0], v[0], q[0] + 0.1, v[0], a[0])
    np.testing.assert_allclose(law.compile().torque(*arguments), law.torque(*arguments), rtol=1e-12)
    added = model.mass_matrix(q[0]) - PinocchioDynamics(robot).mass_matrix(q[0])
    np.testing.assert_allclose(added, np.diag(rotors), atol=1e-13)
    assert model.robot is robot

    class Changed(IdentifiedDynamics):
        pass

    assert Changed(robot, own_parameters(robot)).packed_tree() is None


def test_the_callers_robot_and_arrays_are_left_alone():
    robot = load_robot("two_link")
    before, parameters = own_parameters(robot), 2.0 * own_parameters(robot)
    model = IdentifiedDynamics(robot, parameters)
    parameters[:] = 0.0
    np.testing.assert_array_equal(own_parameters(robot), before)
    np.testing.assert_allclose(model.gravity(np.zeros(2)), 2.0 * PinocchioDynamics(robot).gravity(np.zeros(2)))


@pytest.mark.parametrize(
    "row",
    [
        [-1.0, 0, 0, 0, 1, 0, 1, 0, 0, 1],
        [1.0, 0, 0, 0, 1, 0, 1, 0, 0, 3],  # triangle inequality
        [np.nan, 0, 0, 0, 1, 0, 1, 0, 0, 1],
    ],
)
def test_bodies_that_cannot_exist_are_refused(row):
    robot = load_robot("two_link")
    parameters = own_parameters(robot)
    parameters[1] = row
    with pytest.raises(ArgumentError, match="no distribution of mass has"):
        IdentifiedDynamics(robot, parameters)


def test_wrong_numbers_of_joints_are_refused():
    robot = load_robot("two_link")
    with pytest.raises(ArgumentError, match=r"parameters have shape \(1, 10\), expected \(2, 10\)"):
        IdentifiedDynamics(robot, own_parameters(robot)[:1])
    with pytest.raises(ArgumentError, match="friction is for 3 joints"):
        IdentifiedDynamics(robot, own_parameters(robot), JointFriction(np.ones(3), np.ones(3)))
    with pytest.raises(ArgumentError, match="expected 2 finite numbers"):
        IdentifiedDynamics(robot, own_parameters(robot), rotor_inertia=np.array([1.0, -1.0]))
