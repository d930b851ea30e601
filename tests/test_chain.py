"""The chain: every rigid tree and nothing else, exact derivatives, and trees found again from their motions."""

import functools
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies as st
from scipy.spatial.transform import Rotation

from nbs_pin.base.arrays import matvec
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.controllers.pd import PD
from nbs_pin.dynamics.chain import Chain, Tree, random_tree
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.dynamics.lagrangian import LagrangianDynamics
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.dynamics.provider import DynamicsProvider
from nbs_pin.dynamics.pseudo_inertia import coordinates
from nbs_pin.identification import chain_fit
from nbs_pin.identification.chain_fit import fit_chain
from nbs_pin.identification.collect import collect
from nbs_pin.identification.datasets import Dataset
from nbs_pin.identification.drive_choice import Wanted
from nbs_pin.identification.drive_terms import DriveTerms
from nbs_pin.identification.fit import fit, split_data
from nbs_pin.identification.fit_report import torque_errors, torque_nmse
from nbs_pin.identification.identify import explain, identify
from nbs_pin.identification.levenberg_marquardt import Normal, levenberg_marquardt
from nbs_pin.identification.measurement import Noise
from nbs_pin.identification.physical_tree import FREE, PARALLEL, RIGHT, PhysicalTree
from nbs_pin.identification.regressor import RobotGeometry
from nbs_pin.identification.tree_search import Measurements, TreeEstimate, TreeGeometry
from nbs_pin.identification.unidentifiable import unidentifiable
from nbs_pin.kernels.layout import Packed
from nbs_pin.kernels.tree_layout import BODY, tree_workspace
from nbs_pin.kernels.tree_parameters import COLUMNS, tree_derivatives
from nbs_pin.robots.robot import load_robot
from tests.test_dynamics import GANTRY, relative

TREES = [
    ((0,), (False,)),
    ((0,), (True,)),
    ((0, 1, 2), (False, False, False)),
    ((0, 1, 2), (True, True, False)),
    ((0, 1, 1, 3), (False, True, False, False)),
    ((0, 0, 1, 2, 0), (False, True, True, False, False)),
    ((0, 1, 2, 3, 3, 2), (False, False, True, False, True, False)),
]
BRANCHED = TREES[4]


def scrambled(parents, prismatic, seed=0, spread=0.05, epsilon=1e-12, rotors=False) -> Chain:
    """A random tree with bodies of any shape, and with rotors if wanted."""
    network, rng = Chain(parents, prismatic, epsilon, seed), np.random.default_rng(seed)
    for name, parameter in network.named_parameters():
        if name != "rotors" or rotors:
            parameter.data += spread * torch.from_numpy(rng.normal(size=parameter.shape))
    return network


def states(network: Chain, rows=6, seed=1) -> tuple[np.ndarray, ...]:
    """q, v, w, a."""
    rng, shape = np.random.default_rng(seed), (rows, network.nv)
    q = rng.uniform(-np.pi, np.pi, shape) * np.where(network.prismatic, 0.25, 1.0)
    return q, rng.uniform(-2.0, 2.0, shape), rng.uniform(-2.0, 2.0, shape), 5.0 * rng.normal(size=shape)


def dataset(network: Chain, samples=400, seed=0, noise=0.0, friction: JointFriction | None = None) -> Dataset:
    q, v, _, a = states(network, samples, seed)
    tau = network.compiled()(q, v, v, a) + noise * np.random.default_rng(seed).normal(size=q.shape)
    tau = tau if friction is None else tau + friction.torque(v)
    order = np.arange(samples)
    return Dataset(q, v, a, tau, 0.0 * order, order, np.array(network.parents), np.array(network.prismatic), "tree")


def errors(model: DynamicsProvider, truth: DynamicsProvider, prismatic=False) -> np.ndarray:
    """Relative Frobenius errors of M, C v and G over uniform states; of C v, of M a + C v where there is no C v."""
    rng = np.random.default_rng(99)
    q = rng.uniform(-np.pi, np.pi, (200, truth.nv)) * np.where(prismatic, 0.25, 1.0)
    v, a = rng.uniform(-2.0, 2.0, (2, *q.shape))

    def quantities(d: DynamicsProvider) -> tuple[np.ndarray, ...]:
        mass, force = d.mass_matrix(q), matvec(d.coriolis_matrix(q, v), v)
        return mass, force if np.abs(force).max() > 1e-3 else force + matvec(mass, a), d.gravity(q)

    return np.array(
        [np.linalg.norm(x - y) / np.linalg.norm(y) for x, y in zip(quantities(model), quantities(truth), strict=True)]
    )


def slope(function, size: int, h: float = 1e-3) -> np.ndarray:
    """Derivatives of `function` at 0 by sixth-order central differences, the last axis being that of its argument."""
    columns = []
    for e in h * np.eye(size):
        parts = [s * (function(k * e) - function(-k * e)) for k, s in ((1, 45.0), (2, -9.0), (3, 1.0))]
        columns.append(sum(parts) / (60.0 * h))
    return np.stack(columns, axis=-1)


# The definition.


def placed_bodies(network: Chain, q: np.ndarray) -> np.ndarray:
    """T_j L_j (n, 4, 4) at one q, by SciPy."""
    bodies, frames = [], [np.eye(4)]
    for j in range(network.nv):
        joint, place = np.eye(4), np.eye(4)
        if network.prismatic[j]:
            joint[2, 3] = q[j]
        else:
            joint[:3, :3] = Rotation.from_rotvec([0.0, 0.0, q[j]]).as_matrix()
        place[:3, :3] = Rotation.from_rotvec(network.turns[j].detach().numpy()).as_matrix()
        place[:3, 3] = network.positions[j].detach().numpy()
        frames.append(frames[network.parents[j]] @ place @ joint)
        bodies.append(frames[-1] @ np.tril(network.factors[j].detach().numpy()))
    return np.array(bodies)


@pytest.mark.parametrize("tree", TREES)
def test_energies_are_those_of_the_bodies(tree):
    """T̂ = ½ Σ ‖Ṫ_j L_j‖² + ½ε‖v‖² and V̂ = −Σ g·T_j L_j(L_jᵀ)₄, T_j by another hand and Ṫ_j by differences."""
    network = scrambled(*tree, epsilon=0.3)
    q, v, _, _ = states(network, 1)
    rate = slope(lambda t: placed_bodies(network, q[0] + t * v[0]), 1)
    kinetic = 0.5 * np.square(rate).sum() + 0.15 * np.square(v).sum()
    np.testing.assert_allclose(network.kinetic(*map(torch.from_numpy, (q, v)))[0].item(), kinetic, rtol=1e-9)
    factors = network.factors.detach().tril().numpy()
    moments = np.einsum("jik,jk->ji", placed_bodies(network, q[0]), factors[:, 3])[:, :3].sum(0)
    potential = -moments @ network.field.detach().numpy()
    np.testing.assert_allclose(network.potential(torch.from_numpy(q))[0].item(), potential, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("tree", TREES)
def test_the_definition_and_the_kernels_are_one(tree):
    for seed in range(3):
        network = scrambled(*tree, seed, epsilon=0.01, rotors=True)
        arguments = states(network, seed=seed)
        expected = network.torque(*map(torch.from_numpy, arguments)).detach().numpy()
        assert relative(network.compiled()(*arguments) - expected, expected) < 1e-12


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10_000), st.floats(0.0, 30.0))
def test_inertia_has_its_floor_for_absurd_parameters(seed, spread):
    network = scrambled(*TREES[seed % len(TREES)], seed, spread, epsilon=0.1)
    mass = network.mass_matrix(torch.from_numpy(states(network, 3, seed)[0])).detach().numpy()
    least = np.linalg.eigvalsh(mass)[:, 0]
    assert (least >= 0.1 - 1e-14 * np.abs(mass).max((1, 2)) * network.nv).all()


def chain_of(robot) -> Chain:
    """The arm as a chain: its placements and bodies put in by hand."""
    weights = PinocchioDynamics(robot).packed_tree().weights
    network = Chain(robot.parents, robot.prismatic, epsilon=1e-12)
    with torch.no_grad():
        network.field.copy_(torch.from_numpy(-weights[:3]))
        for j, row in enumerate(weights[3:].reshape(robot.nv, BODY)):
            network.turns[j] = torch.from_numpy(Rotation.from_matrix(row[:9].reshape(3, 3)).as_rotvec())
            network.positions[j] = torch.from_numpy(row[9:12])
            body = np.empty((4, 4))
            body[np.triu_indices(3)] = row[16:22]
            body[:3, 3], body[3, 3] = row[13:16], row[12]
            body = np.triu(body) + np.triu(body, 1).T
            network.factors[j] = torch.from_numpy(np.linalg.cholesky(body + 1e-13 * np.eye(4)))
    return network


@pytest.mark.parametrize("name", ["ur5", GANTRY])
def test_with_the_parameters_of_an_arm_the_chain_is_the_arm(name):
    """Every arm is in the class."""
    robot = load_robot(name)
    truth, model = PinocchioDynamics(robot), LagrangianDynamics(chain_of(robot))
    assert errors(model, truth, robot.prismatic).max() < 1e-9
    q = states(model.network)[0]
    assert np.ptp(model.potential_energy(q) - truth.potential_energy(q)) < 1e-9


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (((0, 2), (False, False)), r"parents \[0, 2\] .* do not form a tree"),
        (((-1,), (False,)), "do not form a tree"),
        (((0, 1), (False,)), "do not form a tree"),
        (((0,), (False,), 0.0), "epsilon is 0.0"),
        (((0,), (False,), float("nan")), "epsilon is nan"),
    ],
)
def test_what_makes_no_tree_is_refused(arguments, words):
    with pytest.raises(ArgumentError, match=words):
        Chain(*arguments)


# Derivatives of the torque with respect to the tree.


def shifted(tree: Packed, step: np.ndarray) -> Packed:
    """The tree a step away, in the columns of `tree_derivatives`."""
    weights = tree.weights.copy()
    weights[:3] += step[:3]
    for row, moved in zip(weights[3:].reshape(-1, BODY), step[3:].reshape(-1, COLUMNS), strict=True):
        row[:9] = (row[:9].reshape(3, 3) @ Rotation.from_rotvec(moved[:3]).as_matrix()).ravel()
        row[9:] += moved[3:]
    return Packed(tree.layout, weights)


def derivatives(tree: Packed, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Torques (rows, n) and their table (rows, n, parameters)."""
    size = 3 + COLUMNS * int(tree.layout[0])
    tau, table = np.full(q.shape, np.nan), np.full((*q.shape, size), np.nan)
    tree_derivatives(q, v, a, *tree, np.full(tree_workspace(tree), np.nan), tau, table)
    return tau, table


@st.composite
def any_tree(draw) -> tuple[tuple[int, ...], tuple[bool, ...]]:
    """One to five joints, serial or branched anywhere."""
    n = draw(st.integers(1, 5))
    parents = tuple(draw(st.integers(0, i)) for i in range(n))
    return parents, tuple(draw(st.lists(st.booleans(), min_size=n, max_size=n)))


@settings(max_examples=25, deadline=None)
@given(any_tree(), st.integers(0, 10_000))
def test_derivatives_with_respect_to_the_tree_are_slopes(tree, seed):
    network = scrambled(*tree, seed, 0.3, epsilon=0.2)
    packed, torque = network.packed_tree(), network.compiled()
    q, v, _, a = states(network, 2, seed)
    tau, table = derivatives(packed, q, v, a)
    np.testing.assert_allclose(tau, torque(q, v, v, a), rtol=1e-12, atol=1e-12)

    def moved(step: np.ndarray) -> np.ndarray:
        return replace(torque, weights=shifted(packed, step).weights)(q, v, v, a)

    expected = slope(moved, table.shape[-1])
    assert relative(table - expected, expected) < 1e-9


# Guesses.


def guess_and_data(tree=BRANCHED, kinds=2) -> tuple[TreeEstimate, Measurements]:
    """A guess away from the tree that moved, and what was measured of that."""
    network = scrambled(*tree)
    data, rng = dataset(network, 40), np.random.default_rng(5)
    scale = rng.uniform(0.5, 2.0, network.nv)
    terms = DriveTerms.of(network.nv, *("viscous", "coulomb")[:kinds], transition=0.3)
    factors = terms.factors(data)
    measured = Measurements(data.q, data.v, data.a, data.tau, scale, factors)
    guess = TreeEstimate.of(random_tree(network.nv, rng), network.packed_tree().layout, kinds)
    return replace(guess, drag=rng.uniform(0.5, 2.0, guess.drag.shape)), measured


def parameters(guess: TreeEstimate) -> int:
    return 3 + 16 * len(guess.bodies) - 6 + guess.drag.size


@pytest.mark.parametrize("tree", TREES)
@pytest.mark.parametrize("kinds", [0, 2])
def test_normal_equations_of_a_guess_are_those_of_its_residuals(tree, kinds):
    guess, data = guess_and_data(tree, kinds)
    residual = guess.residual(data) / data.scale
    rows = -slope(lambda step: guess.moved(step).residual(data) / data.scale, parameters(guess))
    found = guess.normal(data)
    np.testing.assert_allclose(found.cost, np.square(residual).mean(), rtol=1e-12)
    np.testing.assert_allclose(guess.cost(data), found.cost, rtol=1e-12)
    gradient = np.einsum("rjp,rj->p", rows, residual) / residual.size
    assert relative(found.gradient - gradient, gradient) < 1e-9
    hessian = np.einsum("rjp,rjk->pk", rows, rows) / residual.size
    assert relative(found.hessian - hessian, hessian) < 1e-9


def test_normal_equations_are_sums_over_chunks():
    guess, few = guess_and_data()
    repeats = np.tile(np.arange(40), 30)
    many = guess.normal(few.some(repeats))
    for ours, theirs in zip(many, guess.normal(few), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("tree", TREES)
def test_the_frame_of_the_base_does_not_matter(tree):
    """A guess has joint 0 in the base frame, and gives the torque of the tree that it was made of."""
    network = scrambled(*tree, epsilon=1e-15)
    arrays = Tree(*(getattr(network, name).detach().numpy() for name in Tree._fields))
    arrays = arrays._replace(factors=np.tril(arrays.factors))
    guess = TreeEstimate.of(arrays, network.packed_tree().layout, 0)
    np.testing.assert_array_equal(guess.positions[0], 0.0)
    np.testing.assert_allclose(guess.rotations[0], np.eye(3), atol=1e-15)
    data = dataset(network, 20)
    unit = Measurements(data.q, data.v, data.a, data.tau, np.ones(network.nv), np.zeros((0, *data.q.shape)))
    assert relative(guess.residual(unit), data.tau) < 1e-12
    again = Chain(network.parents, network.prismatic, 1e-15)
    with torch.no_grad():
        for name, value in guess.tree(np.linalg.cholesky(guess.bodies))._asdict().items():
            getattr(again, name).copy_(torch.from_numpy(value))
    assert relative(again.compiled()(data.q, data.v, data.v, data.a) - data.tau, data.tau) < 1e-12


@pytest.mark.parametrize("kinds", [0, 2])
def test_the_regressor_of_a_guess_gives_its_torque(kinds):
    guess, data = guess_and_data(kinds=kinds)
    rows = guess.regressor(data.q, data.v, data.a)
    frictionless = replace(guess, drag=0.0 * guess.drag)
    expected = data.tau - frictionless.residual(data)
    assert relative(rows @ coordinates(guess.bodies).ravel() - expected, expected) < 1e-12


def test_the_regressor_of_an_arms_own_geometry_spans_pinocchios():
    """Joint frames differ in the direction of their axes' x alone: the same torques are linear in both."""
    robot = load_robot("panda")
    layout, weights = PinocchioDynamics(robot).packed_tree()
    joints, bodies = weights[3:].reshape(robot.nv, BODY), np.tile(np.eye(4), (robot.nv, 1, 1))
    places = joints[:, :9].reshape(-1, 3, 3), joints[:, 9:12]
    guess = TreeEstimate(layout, weights[:3], *places, bodies, np.zeros((0, robot.nv)))
    q, v, _, a = states(Chain(robot.parents, robot.prismatic), 40)
    ours, theirs = (x.regressor(q, v, a).reshape(-1, 10 * robot.nv) for x in (guess, RobotGeometry(robot)))
    left = theirs - ours @ np.linalg.lstsq(ours, theirs, rcond=1e-12)[0]
    assert relative(left, theirs) < 1e-9
    assert np.linalg.matrix_rank(ours, tol=1e-9 * np.linalg.norm(ours)) == 43


@functools.cache
def physical_and_data() -> tuple[PhysicalTree, Measurements]:
    """Bodies as `explain` finds them for the geometry of a guess."""
    network = scrambled(*BRANCHED)
    data = dataset(network, 60, noise=1.0, friction=JointFriction(np.full(4, 0.5), np.full(4, 0.5), 0.3))
    guess, _ = guess_and_data(kinds=3)
    bodies = explain(TreeGeometry(guess), data, Wanted(True, True, False, 0.3), 0.3)
    measured = Measurements(data.q, data.v, data.a, data.tau, bodies.report.noise, bodies.terms.factors(data))
    return PhysicalTree(guess, bodies.factors, bodies.scalars, bodies.terms.signed, bodies.expected, 0.3), measured


def free_tree() -> PhysicalTree:
    start, _ = physical_and_data()
    return start.moved(0.1 * np.random.default_rng(0).normal(size=parameters(start.guess)))


def held_tree() -> PhysicalTree:
    """The tree with one axis parallel to its parent's and one at a right angle to it."""
    tree, _ = physical_and_data()
    rotations = tree.guess.rotations.copy()
    rotations[1] = Rotation.from_rotvec([0.0, 0.0, 0.4]).as_matrix()
    rotations[2] = Rotation.from_euler("zx", [0.7, 0.5 * np.pi]).as_matrix()
    return replace(tree, guess=replace(tree.guess, rotations=rotations), angles=(FREE, PARALLEL, RIGHT, FREE))


@pytest.mark.parametrize(("tree", "held"), [(free_tree, 0), (held_tree, 3)])
def test_the_slope_of_a_physical_tree_is_that_of_its_cost(tree, held):
    tree, (_, data) = tree(), physical_and_data()
    size = parameters(tree.guess) - held
    expected = slope(lambda step: np.array(tree.moved(step).cost(data)), size)
    found = tree.normal(data)
    assert relative(-2.0 * found.gradient - expected, expected) < 1e-8
    np.testing.assert_allclose(found.cost, tree.cost(data), rtol=1e-14)
    np.testing.assert_allclose(tree.moved(np.zeros(size)).cost(data), tree.cost(data), rtol=1e-12)


def test_bodies_that_explain_the_data_are_where_a_physical_tree_rests():
    """One objective, written twice: bodies and friction that minimise the convex one are stationary here."""
    tree, data = physical_and_data()
    own = np.ones(parameters(tree.guess), dtype=bool)
    own[:3] = False
    for joint in range(1, 4):
        own[3 + 16 * joint - 6 : 3 + 16 * joint] = False  # placements

    def decrement(tree: PhysicalTree) -> float:
        normal = tree.normal(data)
        gradient, hessian = normal.gradient[own], normal.hessian[np.ix_(own, own)]
        return float(np.sqrt(gradient @ np.linalg.solve(hessian, gradient) * data.q.size / tree.strength))

    assert decrement(tree) < 0.1
    assert decrement(replace(tree, drag=1.5 * tree.drag)) > 1.0


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), st.floats(0.0, 3.0))
def test_a_physical_tree_stays_physical(seed, size):
    tree, _ = physical_and_data()
    step = size * np.random.default_rng(seed).normal(size=parameters(tree.guess))
    moved = tree.moved(step)
    assert (np.linalg.det(moved.factors) != 0.0).all()
    assert (moved.drag > 0.0)[~moved.signed].all()
    np.testing.assert_allclose(
        moved.guess.rotations @ moved.guess.rotations.swapaxes(1, 2), np.tile(np.eye(3), (4, 1, 1)), atol=1e-12
    )


def test_held_angles_stay():
    tree = held_tree()
    size = parameters(tree.guess) - 3
    moved = tree.moved(0.5 * np.random.default_rng(0).normal(size=size)).guess.rotations
    np.testing.assert_allclose(moved[1, :, 2], [0.0, 0.0, 1.0], atol=1e-14)
    np.testing.assert_allclose(moved[2, 2, 2], 0.0, atol=1e-14)
    assert np.abs(moved[3] - tree.guess.rotations[3]).max() > 0.01


# Levenberg–Marquardt.


def descend(residual, start, **options):
    """Least squares of a function of numbers, derivatives by differences."""

    def normal(x: np.ndarray) -> Normal:
        left, rows = residual(x), slope(lambda step: residual(x + step), len(x), 1e-3)
        return Normal(left @ left / left.size, -rows.T @ left / left.size, rows.T @ rows / left.size)

    def cost(x: np.ndarray) -> float:
        return float(np.mean(np.square(residual(x))))

    return levenberg_marquardt(np.array(start), normal, cost, np.add, **options)


def valley(x: np.ndarray) -> np.ndarray:
    return np.array([10.0 * (x[1] - x[0] ** 2), 1.0 - x[0]])


DESIGN, TARGET = np.random.default_rng(0).normal(size=(12, 4)), np.random.default_rng(1).normal(size=12)
LEAST = {
    "Rosenbrock's valley": (valley, [-1.2, 1.0], [1.0, 1.0], 1e-14),
    "a linear problem": (lambda x: DESIGN @ x - TARGET, np.zeros(4), np.linalg.lstsq(DESIGN, TARGET)[0], 1e-7),
    "x₀ + x₁ alone is seen, x₂ not at all": (lambda x: (x[0] + x[1] - 3.0) * np.ones(2), [1, 0, 7], [2, 1, 7], 1e-10),
    "√x, of which there is none at the first steps": (lambda x: np.sqrt(x - 0.97) - 0.2, [5.0], [1.01], 1e-10),
    "nothing": (lambda x: np.ones(3), [1.0, 2.0], [1.0, 2.0], 0.0),
}


@pytest.mark.parametrize("case", LEAST)
def test_a_descent_ends_at_the_least_squares(case):
    residual, start, least, tolerance = LEAST[case]
    with np.errstate(invalid="ignore"):
        end = descend(residual, start, stall=1e-12)
    np.testing.assert_allclose(end.at, least, rtol=0, atol=tolerance)
    assert end.history[-1] == end.cost
    assert (np.diff(end.history) <= 0.0).all()


def test_a_descent_ends_when_nothing_is_gained_or_when_it_is_told():
    assert (np.diff(descend(valley, [-1.2, 1.0]).history) < 0.0).all()
    assert descend(np.ones_like, [1.0, 2.0]).history == [1.0]
    assert len(descend(valley, [-1.2, 1.0], iterations=3).history) == 4
    assert descend(valley, [-1.2, 1.0], tolerance=0.5).cost <= 0.5
    assert len(descend(valley, [-1.2, 1.0], patience=2, stall=0.9999).history) < 12


# Trees from their motions.


@pytest.mark.parametrize("tree", TREES)
@pytest.mark.parametrize("seed", [0, 1])
def test_any_tree_is_found_from_its_motions(tree, seed):
    network = scrambled(*tree, seed)
    found = fit_chain(dataset(network, 200), seed)
    assert errors(*map(LagrangianDynamics, (found.network, network)), network.prismatic).max() < 1e-8
    assert found.bodies.unidentifiable == ()
    assert found.friction is None
    assert found.costs.min() == found.history[-1]
    assert 1 <= len(found.costs) <= 64
    assert len(found.costs) <= found.evaluations


def test_the_gantry_is_found_from_its_motions():
    robot = load_robot(GANTRY)
    model = fit(collect(robot, "uniform", 400), "chain", robot=robot)
    assert errors(model, PinocchioDynamics(robot), robot.prismatic).max() < 1e-8
    assert model.report.test_nmse < 1e-16


def test_friction_is_found_with_the_tree():
    network, rng = scrambled(*BRANCHED, 3), np.random.default_rng(0)
    friction = JointFriction(rng.uniform(0.2, 2.0, 4), rng.uniform(0.2, 2.0, 4), 0.05)
    found = fit_chain(dataset(network, friction=friction), friction=True, transition=0.05)
    np.testing.assert_allclose(found.friction.viscous, friction.viscous, rtol=1e-8)
    np.testing.assert_allclose(found.friction.coulomb, friction.coulomb, rtol=1e-8)
    assert found.friction.transition == 0.05
    assert errors(*map(LagrangianDynamics, (found.network, network)), network.prismatic).max() < 1e-8


def unknowns(network: Chain) -> int:
    """How many directions of its parameters a tree's torque depends on."""
    q, v, _, a = states(network, 300, seed=5)
    _, table = derivatives(network.packed_tree(), q, v, a)
    rows = table.reshape(-1, 3 + COLUMNS * network.nv)
    rows = np.delete(rows, range(3 + COLUMNS - 1, rows.shape[1], COLUMNS), axis=1)  # without armature
    values = np.linalg.svd(rows / np.maximum(np.linalg.norm(rows, axis=0), 1e-12), compute_uv=False)
    return int((values > 1e-8 * values[0]).sum())


@pytest.mark.parametrize("tree", [TREES[2], BRANCHED])
@pytest.mark.parametrize(("seed", "samples"), [(0, 400), (1, 1_600)])
def test_no_unbiased_estimate_is_better_in_noise(tree, seed, samples):
    """White noise σ leaves Σ ‖τ̂ − τ‖² = σ²χ²_p at the samples for p unknowns, the bound of Cramér and Rao."""
    network, noise = scrambled(*tree, seed), 0.2
    clean, noisy = dataset(network, samples, seed), dataset(network, samples, seed, noise)
    found = fit_chain(noisy, seed, friction=False, offset=False, rotor_inertia=False)
    tau = found.network.compiled()(clean.q, clean.v, clean.v, clean.a)
    p = unknowns(network)
    assert np.square((tau - clean.tau) / noise).sum() < p + 5.0 * np.sqrt(2.0 * p)
    np.testing.assert_allclose(found.bodies.noise, noise, rtol=4.0 / np.sqrt(2.0 * samples) + p / samples)


def test_an_arm_found_in_noise_is_about_as_good_as_one_of_known_geometry():
    robot, ratios = load_robot("three_link"), []
    truth = PinocchioDynamics(robot)
    for seed in range(3):
        data = collect(robot, "uniform", 200, seed, noise=Noise(torque=0.5))
        known, found = identify(data, robot), LagrangianDynamics(fit_chain(data, seed, starts=4).network)
        ratios.append(errors(found, truth) / errors(known, truth))
    assert (np.median(ratios, axis=0) < 3.0).all()


@pytest.mark.parametrize(("samples", "seed"), [(500, 0), (600, 0), (700, 1), (800, 0), (900, 2), (1_000, 0)])
def test_noise_and_arm_are_found_however_long_the_recording(samples, seed):
    """With four of these recordings no physical bodies fit the placements that arbitrary bodies have found."""
    robot, noise = load_robot("three_link"), 0.5
    data, _ = split_data(collect(robot, "excited", samples, seed, noise=Noise(encoder=2**-16, torque=noise)))
    found = fit_chain(data)
    np.testing.assert_allclose(found.bodies.noise, noise, rtol=0.25)  # the accelerations have some too
    left = torque_errors(LagrangianDynamics(found.network), data, found.friction)
    assert (np.sqrt(np.square(left).mean(axis=0)) < 1.15 * found.bodies.noise).all()
    assert errors(LagrangianDynamics(found.network), PinocchioDynamics(robot)).max() < 0.02


def test_torques_that_no_arm_needs_are_explained_no_worse_than_by_none():
    """A joint that pulls where it should push; only unphysical bodies do, which must not count for all."""
    data = collect(load_robot("three_link"), "uniform", 300, seed=0, noise=Noise(torque=0.5))
    data = replace(data, tau=data.tau * [1.0, -1.0, 1.0])
    found = fit_chain(data, starts=8, friction=False, offset=False, rotor_inertia=False)
    assert torque_nmse(LagrangianDynamics(found.network), data) < 1.0


def test_parallel_axes_are_held_parallel_in_noise():
    """The arm moves in a plane; without this the noise tilts its axes. One seed in four or so speaks against it."""
    data = collect(load_robot("three_link"), "uniform", 300, seed=2, noise=Noise(torque=0.5))
    held, free = (fit_chain(data, starts=8, right_angles=right).network for right in (True, False))
    for network, exact in ((held, True), (free, False)):
        axes = Rotation.from_rotvec(network.turns.detach().numpy()[1:]).as_matrix()[:, :2, 2]
        assert (np.abs(axes).max() < 1e-12) == exact


@pytest.fixture(scope="module")
def noisy() -> tuple[Dataset, Chain]:
    """Data of a tree, and the tree found in them with seed 7."""
    data = dataset(scrambled(*TREES[3], 2), 200, noise=0.1)
    return data, fit_chain(data, 7, starts=8).network


def test_the_same_seed_finds_the_same_tree(noisy):
    data, found = noisy
    for ours, theirs in zip(found.parameters(), fit_chain(data, 7, starts=8).network.parameters(), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=0.0, atol=0.0)


def test_the_units_of_torque_do_not_matter(noisy):
    data, one = noisy
    thousand = fit_chain(replace(data, tau=1e3 * data.tau), 7, starts=8).network
    arguments = states(one)
    ours, theirs = (x.compiled()(*arguments) for x in (one, thousand))
    assert relative(1e3 * ours - theirs, theirs) < 1e-4


def test_still_poses_say_nothing_of_moments_of_inertia():
    network = scrambled(*BRANCHED)
    data = dataset(network)
    still = replace(data, v=0.0 * data.v, a=0.0 * data.a, tau=LagrangianDynamics(network).gravity(data.q))
    found = fit_chain(still)
    assert found.bodies.excited < found.bodies.base_parameters
    assert any("joint 1" in line for line in found.bodies.unidentifiable)
    model = LagrangianDynamics(found.network)
    mass = model.mass_matrix(data.q)
    assert np.linalg.eigvalsh(mass).min() > -1e-14 * np.abs(mass).max()
    assert errors(model, LagrangianDynamics(network), network.prismatic)[2] < 1e-6


def test_torques_that_never_change_are_data_too():
    """One pose held again and again: any tree of that weight."""
    network = scrambled(*BRANCHED)
    q = np.full((60, 4), 0.3)
    tau = LagrangianDynamics(network).gravity(q)
    found = fit_chain(replace(dataset(network, 60), q=q, v=0.0 * q, a=0.0 * q, tau=tau))
    np.testing.assert_allclose(LagrangianDynamics(found.network).gravity(q), tau, rtol=1e-6)
    assert found.bodies.unidentifiable


@pytest.mark.parametrize(
    ("change", "options", "words"),
    [
        ({}, {"starts": 0}, "starts is 0"),
        ({}, {"transition": 0.0}, "transition is 0"),
        ({}, {"regularisation": -1.0}, "regularisation is -1"),
        ({}, {"epsilon": 0.0}, "epsilon is 0"),
        ({"tau": np.zeros((8, 4))}, {}, "arms of every scale move alike"),
        ({}, {"starts": 1}, "samples of 4 joints are too few"),
    ],
)
def test_what_cannot_be_fitted_is_refused(change, options, words):
    with pytest.raises(ArgumentError, match=words):
        fit_chain(replace(dataset(scrambled(*BRANCHED), 8), **change), **options)


# The model.


def test_a_law_on_the_model_runs_as_machine_code_and_is_the_law_on_the_arm():
    robot = load_robot("three_link")
    model = fit(collect(robot, "uniform", 300), "chain", robot=robot, friction=True)
    gains = {"feedforward": "reference", "kp": np.full(3, 20.0), "kd": np.full(3, 10.0)}
    laws = [PD(dynamics, **gains) for dynamics in (model, PinocchioDynamics(robot))]
    q, v, q_ref, v_ref = states(model.network, 5)
    ours, theirs = (law.torque(q, v, q_ref, v_ref, 0.0 * q) for law in laws)
    assert relative(ours - theirs, theirs) < 1e-9
    plain = laws[0].torque(*(torch.from_numpy(x) for x in (q, v, q_ref, v_ref, 0.0 * q))).detach().numpy()
    assert relative(ours - plain, ours) < 1e-12
    assert model.packed_tree() is not None


def test_rotors_behind_gears_are_found_with_the_tree():
    robot, rotors = load_robot("two_link"), np.array([0.3, 0.7])
    data = collect(robot, "uniform", 300, 0)
    data = replace(data, tau=data.tau + rotors * data.a)
    fitted = fit(data, "chain", rotor_inertia=True)
    q = np.random.default_rng(1).uniform(-np.pi, np.pi, (20, 2))
    expected = PinocchioDynamics(robot).mass_matrix(q) + np.diag(rotors)
    np.testing.assert_allclose(fitted.mass_matrix(q), expected, atol=1e-9)
    np.testing.assert_allclose(fitted.network.rotors[1] ** 2, 0.7, rtol=0.3)  # the first one's share is its body's
    without = fit(data, "chain", starts=8, rotor_inertia=False)
    assert without.report.train_nmse > 1e-4  # no tree of bodies has rotors


def test_joints_that_never_move_do_not_spoil_the_others():
    robot, moves = load_robot("three_link"), np.arange(3) < 2
    data = collect(robot, "uniform", 300, 0)
    q, v, a = np.where(moves, data.q, 0.7), data.v * moves, data.a * moves
    tau = PinocchioDynamics(robot).reference_torque(q, v, v, a)
    report = fit(replace(data, q=q, v=v, a=a, tau=tau), "chain", seed=0).report
    assert report.train_nmse < 1e-12
    assert report.stopped == "converged"


def test_a_small_box_leaves_what_lies_elsewhere_open():
    robot = load_robot("ur5")
    network, data = chain_of(robot), collect(robot, "uniform", 60, 0)
    small = replace(data, q=0.02 * data.q / np.pi)
    assert unidentifiable(network, small)[0].startswith("inertia of joint 1: ")
    assert unidentifiable(network, data) == ()


def test_noise_alone_is_said_to_be_noise():
    data = collect(load_robot("two_link"), "uniform", 100, 0)
    noise = np.random.default_rng(0).normal(size=data.tau.shape)
    report = fit(replace(data, tau=noise), "chain", starts=8).report
    assert report.unidentifiable[0].startswith("everything: ")
    assert report.train_nmse > 0.9


def test_ctrl_c_goes_on_with_the_best_tree_so_far(monkeypatch):
    data, descended = dataset(scrambled(*TREES[0]), 100, noise=0.5), []

    def interrupted(*arguments, **options):
        if "patience" in options:  # a descent of the search, from a random tree
            descended.append(arguments)
            if len(descended) > 8:
                raise KeyboardInterrupt
        return levenberg_marquardt(*arguments, **options)

    monkeypatch.setattr("nbs_pin.identification.chain_fit.levenberg_marquardt", interrupted)
    monkeypatch.setattr("nbs_pin.identification.chain_fit._settled", lambda costs: False)
    found = fit_chain(data)
    assert found.stopped == "interrupted"
    assert len(found.costs) == 8
    descended[:] = [()] * 8
    with pytest.raises(KeyboardInterrupt):  # nothing yet to go on with
        fit_chain(data)


@pytest.mark.parametrize("whole", [0, 1, 2])
def test_ctrl_c_after_the_search_keeps_the_best_bodies_so_far(whole, monkeypatch):
    data, tried, plain = dataset(scrambled(*TREES[2]), 100, noise=0.5), [], chain_fit._tried

    def interrupted(*arguments, **options):
        if len(tried) == whole:
            raise KeyboardInterrupt
        tried.append(plain(*arguments, **options)._replace(reached=False))
        return tried[-1]

    monkeypatch.setattr(chain_fit, "_tried", interrupted)
    monkeypatch.setattr(chain_fit, "_settled", lambda costs: len(costs) >= 8)
    if whole == 0:
        with pytest.raises(KeyboardInterrupt):
            fit_chain(data)
        return
    found = fit_chain(data)
    assert found.stopped == "interrupted"
    best = min(tried, key=lambda one: one.cost)
    assert found.bodies is best.bodies.report
    assert len(tried) == whole
