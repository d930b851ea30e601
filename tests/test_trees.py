"""Rigid trees as machine code: Pinocchio's numbers on every arm, on any tree, and derivatives that are exact."""

import numpy as np
import pinocchio as pin
import pytest
import torch

from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.dynamics.analytic import AnalyticDynamics
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.dynamics.pinocchio_tree import pack_model
from nbs_pin.dynamics.provider import DynamicsProvider
from nbs_pin.kernels.layout import Packed
from nbs_pin.kernels.records import Motion, State
from nbs_pin.kernels.tree_layout import Link, pack_tree, tree_workspace
from nbs_pin.kernels.trees import tree_acceleration, tree_acceleration_adjoint, tree_torque, tree_torque_adjoint
from nbs_pin.robots.catalogue import ROBOT_NAMES
from nbs_pin.robots.robot import load_robot
from tests.test_dynamics import GANTRY, make, relative

TREES = range(24)
"""Seeds of random trees."""


def random_model(seed: int) -> pin.Model:
    """1 to 9 joints of both kinds about random axes, serial (even seeds) or branched, with armature and any gravity.

    A branch starts at the base or on the way to the last joint: Pinocchio wants all joints behind a joint in one row.
    """
    rng = np.random.default_rng(seed)
    model = pin.Model()
    for i in range(1 + seed % 9):
        way = [i]
        while seed % 2 and way[-1] > 0:
            way.append(model.parents[way[-1]])
        parent = int(rng.choice(way))
        axis = rng.normal(size=3)
        axis /= np.linalg.norm(axis)
        kind = pin.JointModelPrismaticUnaligned if rng.random() < 0.3 else pin.JointModelRevoluteUnaligned
        joint = model.addJoint(parent, kind(axis), pin.SE3.Random(), f"joint_{i}")
        body = pin.Inertia.FromEllipsoid(rng.uniform(0.5, 3.0), *rng.uniform(0.1, 0.6, 3))
        model.appendBodyToJoint(joint, body, pin.SE3(pin.exp3(rng.normal(size=3)), 0.3 * rng.normal(size=3)))
    model.gravity.linear = 9.0 * rng.normal(size=3)
    model.armature = rng.uniform(0.0, 0.5, model.nv)
    return model


def vectors(n: int, count: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(count, n))


def torque(tree: Packed, q: np.ndarray, v: np.ndarray, w: np.ndarray, a: np.ndarray) -> np.ndarray:
    tau = np.full(len(q), np.nan)
    tree_torque(Motion(q, v, w, a), tree, np.full(tree_workspace(tree), np.nan), tau)
    return tau


def acceleration(tree: Packed, q: np.ndarray, v: np.ndarray, tau: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The acceleration and the factor."""
    a, factor = np.full(len(q), np.nan), np.full((len(q), len(q)), np.nan)
    tree_acceleration(State(q, v), tau, tree, np.full(tree_workspace(tree), np.nan), factor, a)
    return a, factor


def torque_bars(tree: Packed, *arguments: np.ndarray) -> np.ndarray:
    """Derivatives of μᵀτ with respect to q, v, w, a; arguments: q, v, w, a, μ."""
    bars = np.zeros((4, len(arguments[0])))
    *motion, mu = arguments
    tree_torque_adjoint(Motion(*motion), mu, tree, np.full(tree_workspace(tree), np.nan), Motion(*bars))
    return bars


def acceleration_bars(tree: Packed, q: np.ndarray, v: np.ndarray, tau: np.ndarray, a_bar: np.ndarray) -> np.ndarray:
    """Derivatives of āᵀa with respect to q, v, τ."""
    bars = np.zeros((3, len(q)))
    a, factor = acceleration(tree, q, v, tau)
    work = np.full(tree_workspace(tree), np.nan)
    tree_acceleration_adjoint(State(q, v), a, a_bar, tree, work, factor, State(*bars[:2]), bars[2])
    return bars


def slopes(function, cotangent: np.ndarray, *arguments: np.ndarray, h: float = 1e-3) -> np.ndarray:
    """Derivatives of cotangentᵀ function by sixth-order central differences."""
    found = np.zeros((len(arguments), len(arguments[0])))
    for k, i in np.ndindex(*found.shape):
        for step, share in ((1, 45.0), (2, -9.0), (3, 1.0)):
            for sign in (1.0, -1.0):
                moved = [x.copy() for x in arguments]
                moved[k][i] += sign * step * h
                found[k, i] += sign * share * (cotangent @ function(*moved)) / (60.0 * h)
    return found


def pinocchio_torque(model: pin.Model, q: np.ndarray, v: np.ndarray, w: np.ndarray, a: np.ndarray) -> np.ndarray:
    data = model.createData()
    return pin.rnea(model, data, q, 0.0 * v, a) + pin.computeCoriolisMatrix(model, data, q, v) @ w


@pytest.fixture(scope="module", params=[*ROBOT_NAMES, GANTRY, "analytic", "analytic_uneven"])
def dynamics(request) -> DynamicsProvider:
    return make(request.param)


# Every model that is a tree.


def test_torque_and_acceleration_are_those_of_the_model(dynamics):
    tree = dynamics.packed_tree()
    for seed in range(5):
        q, v, w, a = vectors(dynamics.nv, 4, seed)
        expected = dynamics.reference_torque(q, v, w, a)
        assert relative(torque(tree, q, v, w, a) - expected, expected) < 1e-12
        found, factor = acceleration(tree, q, v, expected)
        again = torque(tree, q, v, v, found)  # forward dynamics of a light wrist is only as good as M's condition
        assert relative(again - expected, expected) < 1e-12
        mass = dynamics.mass_matrix(q)
        assert relative(factor @ factor.T - mass, mass) < 1e-12
        assert not np.triu(factor, 1).any()


def test_adjoints_are_the_vector_jacobian_products_of_the_model(dynamics):
    tree = dynamics.packed_tree()
    for seed in range(3):
        q, v, w, a, mu = vectors(dynamics.nv, 5, seed)
        tensors = [torch.tensor(x, requires_grad=True) for x in (q, v, w, a)]
        expected = torch.autograd.grad(dynamics.reference_torque(*tensors), tensors, torch.tensor(mu))
        for found, gradient in zip(torque_bars(tree, q, v, w, a, mu), expected, strict=True):
            assert relative(found - gradient.numpy(), gradient.numpy()) < 1e-10
        q, v, tau = tensors[:3]
        expected = torch.autograd.grad(dynamics.forward_dynamics(q, v, tau), [q, v, tau], torch.tensor(mu))
        bars = acceleration_bars(tree, *(x.detach().numpy() for x in (q, v, tau)), mu)
        for found, gradient in zip(bars, expected, strict=True):
            assert relative(found - gradient.numpy(), gradient.numpy()) < 1e-10


def test_the_two_link_arm_in_closed_form_is_the_urdf_arm():
    q, v, w, a = vectors(2, 4, 0)
    found = torque(AnalyticDynamics().packed_tree(), q, v, w, a)
    expected = torque(PinocchioDynamics(load_robot("two_link")).packed_tree(), q, v, w, a)
    assert relative(found - expected, expected) < 1e-12


@pytest.mark.parametrize("base", [PinocchioDynamics, AnalyticDynamics])
def test_a_subclass_is_no_tree(base):
    """It may have changed an equation, and the kernels would not know."""

    class Other(base):
        def gravity(self, q):
            return 0.0 * q

    arguments = (load_robot("two_link"),) if base is PinocchioDynamics else ()
    assert base(*arguments).packed_tree() is not None
    assert Other(*arguments).packed_tree() is None


# Any tree.


@pytest.mark.parametrize("seed", TREES)
def test_random_trees_are_pinocchios(seed):
    model = random_model(seed)
    tree, data = pack_model(model), model.createData()
    q, v, w, a = 2.0 * vectors(model.nv, 4, seed)
    expected = pinocchio_torque(model, q, v, w, a)
    assert relative(torque(tree, q, v, w, a) - expected, expected) < 1e-12
    tau = expected
    expected = pin.aba(model, data, q, v, tau)
    found, factor = acceleration(tree, q, v, tau)
    assert relative(found - expected, expected) < 1e-12
    mass = pin.crba(model, data, q)
    assert relative(factor - np.linalg.cholesky(mass), mass) < 1e-12


@pytest.mark.parametrize("seed", TREES)
def test_adjoints_are_the_derivatives(seed):
    model = random_model(seed)
    tree, data = pack_model(model), model.createData()
    q, v, w, a, mu = vectors(model.nv, 5, seed)
    expected = slopes(lambda *x: pinocchio_torque(model, *x), mu, q, v, w, a)
    assert relative(torque_bars(tree, q, v, w, a, mu) - expected, expected) < 1e-9
    jacobians = pin.computeABADerivatives(model, data, q, v, w)
    expected = np.array([jacobian.T @ mu for jacobian in jacobians])
    assert relative(acceleration_bars(tree, q, v, w, mu) - expected, expected) < 1e-11


def test_pinocchios_own_derivatives_are_the_slopes_of_the_kernel():
    """The differences above go through Pinocchio's functions: here through the kernel's."""
    tree = pack_model(random_model(7))
    q, v, w, mu = vectors(len(tree.weights) // 23, 4, 0)
    expected = slopes(lambda *x: acceleration(tree, *x)[0], mu, q, v, w)
    assert relative(acceleration_bars(tree, q, v, w, mu) - expected, expected) < 1e-8


@pytest.mark.parametrize("seed", TREES)
def test_coriolis_is_symmetric_in_its_two_velocities(seed):
    model = random_model(seed)
    tree, (q, v, w, a) = pack_model(model), vectors(model.nv, 4, seed)
    tau = torque(tree, q, v, w, a)
    assert relative(torque(tree, q, w, v, a) - tau, tau) < 1e-14


def test_adjoints_add_to_what_is_there():
    tree = pack_model(random_model(5))
    n = int(tree.layout[0])
    q, v, w, a, mu, *start = vectors(n, 9, 0)
    work = np.full(tree_workspace(tree), np.nan)
    bars = [x.copy() for x in start]
    tree_torque_adjoint(Motion(q, v, w, a), mu, tree, work, Motion(*bars))
    np.testing.assert_allclose(np.subtract(bars, start), torque_bars(tree, q, v, w, a, mu), rtol=1e-11, atol=1e-11)
    a, factor = acceleration(tree, q, v, w)
    bars = [x.copy() for x in start[:3]]
    tree_acceleration_adjoint(State(q, v), a, mu, tree, work, factor, State(*bars[:2]), bars[2])
    np.testing.assert_allclose(
        np.subtract(bars, start[:3]), acceleration_bars(tree, q, v, w, mu), rtol=1e-11, atol=1e-11
    )


def test_one_array_may_collect_both_velocities():
    tree = pack_model(random_model(6))
    q, v, a, mu = vectors(int(tree.layout[0]), 4, 0)
    q_bar, both, a_bar = np.zeros((3, len(q)))
    bars = Motion(q_bar, both, both, a_bar)
    tree_torque_adjoint(Motion(q, v, v, a), mu, tree, np.full(tree_workspace(tree), np.nan), bars)
    expected = torque_bars(tree, q, v, v, a, mu)
    np.testing.assert_allclose(both, expected[1] + expected[2], rtol=1e-13)


def test_arguments_are_left_alone():
    tree = pack_model(random_model(8))
    given = vectors(int(tree.layout[0]), 5, 0)
    before, packed = given.copy(), Packed(*(x.copy() for x in tree))
    torque_bars(tree, *given)
    acceleration_bars(tree, *given[:4])
    np.testing.assert_array_equal(given, before)
    for kept, part in zip(packed, tree, strict=True):
        np.testing.assert_array_equal(kept, part)


def test_a_tree_without_positive_inertia_gives_no_number():
    model = random_model(3)
    model.armature = np.full(model.nv, -100.0)
    q, v, tau = vectors(model.nv, 3, 0)
    a, _ = acceleration(pack_model(model), q, v, tau)
    assert np.isnan(a).all()


# What is no tree of these joints.


@pytest.mark.parametrize(
    "joint", [pin.JointModelSpherical(), pin.JointModelRUBX(), pin.JointModelFreeFlyer(), pin.JointModelHX(0.1)]
)
def test_other_joints_are_refused_by_name(joint):
    model = pin.Model()
    model.addJoint(0, joint, pin.SE3.Identity(), "odd")
    with pytest.raises(ArgumentError, match=r"joint 'odd' is a Joint.*lock it"):
        pack_model(model)


def test_a_child_before_its_parent_is_refused():
    link = Link(1, False, np.array([0.0, 0.0, 2.0]), np.eye(3), np.zeros(3), 1.0, np.ones(3), np.eye(3))
    with pytest.raises(ArgumentError, match="link 0 has parent 1"):
        pack_tree([link], np.zeros(3))
