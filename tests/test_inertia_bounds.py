"""Bounds on M(q) over all configurations: never left by sampled or adversarial poses, and not far from them."""

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pinocchio as pin
import pytest
from scipy.optimize import minimize

from nbs_pin import load_robot
from nbs_pin.base.claims import Label
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.rounding import down, exceeds_every_perturbation, largest_eigenvalue, least_eigenvalue, up
from nbs_pin.dynamics.pinocchio_tree import pack_model
from nbs_pin.dynamics.rigid_tree import RigidTree
from nbs_pin.dynamics.structure import rigid_tree_claims
from nbs_pin.inertia import multipliers
from nbs_pin.inertia.bounds import (
    determinant_bound,
    largest_inertia_bound,
    least_inertia_bound,
    pencil_bound,
    trace_bound,
    trigonometric_bound,
)
from nbs_pin.inertia.lever_arms import lever_arms
from nbs_pin.inertia.multipliers import Motions, largest_by_multipliers, least_by_multipliers, maximise
from nbs_pin.inertia.pose_grid import Plan

FEW = 20_000
"""Poses sampled by `trigonometric_bound` where the test is about truth, not tightness."""


def masses(model, poses):
    """M at each pose, whole."""
    data = model.createData()
    upper = np.array([np.triu(pin.crba(model, data, q)) for q in poses])
    return upper + np.triu(upper, 1).transpose(0, 2, 1)


def extremes(model, weight, poses, starts=2):
    """Greatest λ(W⁻¹M) and least λ(M) found by sampling and by descent from the best samples."""
    scale, options = 1.0 / np.sqrt(np.diag(weight)), {"maxiter": 15}

    def greatest(q):
        return np.linalg.eigvalsh(masses(model, np.atleast_2d(q)) * scale * scale[:, None])[:, -1]

    def least(q):
        return np.linalg.eigvalsh(masses(model, np.atleast_2d(q)))[:, 0]

    great, small = greatest(poses), least(poses)
    highest, lowest = great.max(), small.min()
    for q in poses[np.argsort(-great)[:starts]]:
        highest = max(highest, -minimize(lambda x: -greatest(x)[0], q, options=options).fun)
    for q in poses[np.argsort(small)[:starts]]:
        lowest = min(lowest, np.exp(minimize(lambda x: np.log(least(x)[0]), q, options=options).fun))
    return highest, lowest


def random_model(rng, kinds, branched=False, rotors=False):
    """A tree of random bodies: 'r' turns, 'p' slides, along random axes."""
    model, branch = pin.Model(), [0]
    for i, kind in enumerate(kinds):
        axis = rng.normal(size=3)
        axis /= np.linalg.norm(axis)
        joint = pin.JointModelRevoluteUnaligned(axis) if kind == "r" else pin.JointModelPrismaticUnaligned(axis)
        place = pin.SE3(np.linalg.qr(rng.normal(size=(3, 3)))[0], rng.uniform(-0.5, 0.5, 3))
        place.rotation = place.rotation * np.linalg.det(place.rotation)
        # A branch may grow from the current one alone: Pinocchio's CRBA takes joints depth first, as URDFs give them.
        parent = branch[int(rng.integers(0, len(branch)))] if branched else i
        index = model.addJoint(parent, joint, place, f"joint{i}")
        branch = [*branch[: branch.index(parent) + 1], index]
        size = rng.uniform(0.05, 0.3, 3)
        body = pin.Inertia.FromBox(float(rng.uniform(0.2, 3.0)), *size)
        model.appendBodyToJoint(index, body, pin.SE3(np.eye(3), rng.uniform(-0.3, 0.3, 3)))
    if rotors:
        model.armature = rng.uniform(0.05, 0.2, model.nv)
    return model


def tree_of(model, travel=0.4):
    """The model with sliding joints limited to ∓travel."""
    tree = RigidTree.of(pack_model(model))
    ends = np.where(tree.prismatic, travel, np.inf)
    return replace(tree, lower=-ends, upper=ends)


def poses_of(tree, rng, count):
    """Uniform poses, sliding joints at their ends half of the time."""
    q = rng.uniform(-np.pi, np.pi, (count, tree.nv))
    travel = np.where(tree.prismatic, tree.upper, 1.0)
    slides = np.where(rng.random(q.shape) < 0.5, np.sign(q), q / np.pi) * travel
    return np.where(tree.prismatic, slides, q)


def test_two_branches_on_one_torso_are_bounded_by_multipliers():
    """The solver's default merging of cliques panics on this tree, with an exception that is no `Exception`."""
    model = pin.Model()
    for axis, parent in zip(np.eye(3)[[2, 1, 1, 1, 2]], [0, 1, 1, 3, 4], strict=True):
        place = pin.SE3(np.eye(3), np.array([0.0, 0.0, 0.3]))
        joint = model.addJoint(parent, pin.JointModelRevoluteUnaligned(axis), place, f"joint{model.njoints}")
        model.appendBodyToJoint(
            joint, pin.Inertia.FromBox(1.0, 0.1, 0.1, 0.1), pin.SE3(np.eye(3), np.array([0, 0, 0.1]))
        )
    highest, lowest = extremes(model, np.eye(5), np.random.default_rng(0).uniform(-np.pi, np.pi, (2000, 5)), 1)
    assert highest <= largest_by_multipliers(tree_of(model), np.eye(5)).value <= 1.1 * highest
    assert lowest / 1.1 <= least_by_multipliers(tree_of(model)).value <= lowest


@pytest.mark.parametrize("name", ["two_link", "panda", "ur5", "so100", "double_pendulum"])
def test_no_pose_leaves_the_bounds(name):
    robot, rng = load_robot(name), np.random.default_rng(1)
    weight = np.diag(rng.uniform(0.5, 2.0, robot.nv) * np.diag(masses(robot.model, np.zeros((1, robot.nv)))[0]))
    highest, lowest = extremes(robot.model, weight, rng.uniform(-np.pi, np.pi, (2000, robot.nv)), 1)
    above, below = largest_inertia_bound(robot, weight), least_inertia_bound(robot)
    assert above.label is below.label is Label.PROVED
    assert highest <= above.value <= 1.1 * highest
    assert lowest / 1.1 <= below.value <= lowest
    # Each of the others is true alone, by a proof that shares nothing with that of the best.
    assert highest <= trace_bound(robot, weight)
    assert above.value <= trigonometric_bound(robot, weight, FEW) <= 2.0 * highest
    assert max(pencil_bound(robot), determinant_bound(robot)) <= lowest


@pytest.mark.parametrize(("name", "ratio"), [("panda", 1.02), ("ur5", 1.01)])
def test_bounds_are_close(name, ratio):
    robot, rng = load_robot(name), np.random.default_rng(2)
    eye = np.eye(robot.nv)
    highest, lowest = extremes(robot.model, eye, rng.uniform(-np.pi, np.pi, (3000, robot.nv)))
    assert highest <= largest_inertia_bound(robot, eye).value <= ratio * highest
    assert lowest / ratio <= least_inertia_bound(robot).value <= lowest
    assert trace_bound(robot, eye) <= 2.3 * highest


@pytest.mark.parametrize("branched", [False, True])
@pytest.mark.parametrize("kinds", ["rrrr", "prrr", "rprp", "pprr", "rppr", "rrrp", "p", "r"])
def test_trees_of_turning_and_sliding_joints(kinds, branched):
    rng = np.random.default_rng(len(kinds) + 10 * kinds.count("p") + branched)
    model = random_model(rng, kinds, branched, rotors=branched)
    tree = tree_of(model)
    poses = poses_of(tree, rng, 2000)
    whole = masses(model, poses)
    root = np.sqrt(rng.uniform(0.5, 2.0, tree.nv))
    great = np.linalg.eigvalsh(whole / root / root[:, None])[:, -1].max()
    trace = np.trace(whole / root**2, axis1=1, axis2=2).max()
    small = np.linalg.eigvalsh(whole)[:, 0].min()
    weight = np.diag(root**2)
    assert great <= trigonometric_bound(tree, weight, 3000) <= 3.0 * great
    assert trace <= trace_bound(tree, weight) <= 1.7 * trace
    assert 0.0 < determinant_bound(tree) <= small
    assert 0.0 < pencil_bound(tree) <= small
    least, most = least_inertia_bound(tree).value, largest_inertia_bound(tree, np.eye(tree.nv)).value
    top = np.linalg.eigvalsh(whole)[:, -1].max()
    assert 0.999 * max(pencil_bound(tree), determinant_bound(tree)) < least <= small
    assert top <= most <= 1.2 * top
    assert great <= largest_inertia_bound(tree, weight).value <= 1.2 * great


@pytest.mark.parametrize("seed", range(3))
def test_any_weight(seed):
    rng = np.random.default_rng(seed)
    model = random_model(rng, "rrrr")
    factor = rng.normal(size=(4, 4))
    weight = factor @ factor.T + 0.1 * np.eye(4)
    values = np.linalg.eigvals(np.linalg.solve(weight, masses(model, rng.uniform(-np.pi, np.pi, (2000, 4))))).real
    packed = pack_model(model)
    assert values.max() <= trigonometric_bound(packed, weight, 3000) <= 2.0 * values.max()
    assert values.max() <= trace_bound(packed, weight)
    assert values.min() / 1.2 <= least_inertia_bound(packed, weight).value <= values.min()
    assert values.max() <= largest_inertia_bound(packed, weight).value <= 1.2 * values.max()


def test_bounds_scale_with_the_weight():
    robot = load_robot("ur3")
    eye = np.eye(robot.nv)
    for bound in (trace_bound, trigonometric_bound, lambda arm, w: largest_inertia_bound(arm, w).value):
        assert bound(robot, 4.0 * eye) == pytest.approx(0.25 * bound(robot, eye), rel=1e-3)


def test_lever_arms_are_those_of_the_poses():
    robot, rng = load_robot("panda"), np.random.default_rng(3)
    tree, model = RigidTree.of(robot), robot.model
    data, weights = model.createData(), rng.uniform(0.5, 2.0, robot.nv)
    tip = rng.uniform(-0.3, 0.3, 3)
    tree = replace(tree, centre=np.vstack([tree.centre[:-1], tip]))
    claimed = float(lever_arms(tree, weights)[-1](tip))
    found = 0.0
    for q in rng.uniform(-np.pi, np.pi, (3000, robot.nv)):
        pin.forwardKinematics(model, data, q)
        point = data.oMi[robot.nv].act(tip)
        arms = [np.cross(frame.rotation[:, 2], point - frame.translation) for frame in list(data.oMi)[1:]]
        found = max(found, float(weights @ np.sum(np.square(arms), axis=1)))
    assert found <= claimed <= 1.25 * found


@pytest.mark.parametrize("angle", np.linspace(0.0, np.pi / 24.0, 7))
def test_lever_arms_reach_between_the_corners_of_their_polygons(angle):
    """Of two parallel axes a distance 1 apart, a point 1 beyond the second is at most 2 from the first."""
    model = pin.Model()
    for i, place in enumerate((np.zeros(3), np.array([np.cos(angle), np.sin(angle), 0.0]))):
        model.addJoint(i, pin.JointModelRZ(), pin.SE3(np.eye(3), place), f"joint{i}")
        model.appendBodyToJoint(i + 1, pin.Inertia.FromSphere(1.0, 0.1), pin.SE3(np.eye(3), np.array([1.0, 0.0, 0.0])))
    claimed = float(lever_arms(RigidTree.of(pack_model(model)), np.array([1.0, 0.0]))[-1](np.array([1.0, 0.0, 0.0])))
    assert 4.0 <= claimed <= 1.1 * 4.0


def test_a_rotor_alone_is_an_inertia():
    """A body without inertia about its own axis leaves M̂ ≻ 0 to its rotor."""
    model = pin.Model()
    model.addJoint(0, pin.JointModelRZ(), pin.SE3.Identity(), "joint")
    model.appendBodyToJoint(1, pin.Inertia(1.0, np.array([0.0, 0.0, 0.2]), np.zeros((3, 3))), pin.SE3.Identity())
    assert rigid_tree_claims(pack_model(model)) is None
    model.armature = np.array([0.3])
    assert rigid_tree_claims(pack_model(model)).positive.value == pytest.approx(0.3)


@pytest.mark.parametrize("kinds", ["rrrr", "rprp", "pprr"])
def test_conditions_and_energy_are_those_of_every_pose(kinds):
    """On the arm's own motions the energy is q̇ᵀM(q)q̇ and every condition is 0, or ≤ 0 inside the travel."""
    rng = np.random.default_rng(8)
    model = random_model(rng, kinds, branched=True, rotors=True)
    tree = tree_of(model)
    motions = Motions.of(tree)
    for q in poses_of(tree, rng, 20):
        v = rng.normal(size=tree.nv)
        x = coordinates(tree, motions, q, v)
        mass = masses(model, q[None])[0]
        assert np.allclose(x[motions.moving], v)
        assert x @ motions.energy.matrix @ x == pytest.approx(v @ mass @ v, rel=1e-10)
        for form in motions.conditions:
            value, size = float(x @ form.matrix @ x), float(np.abs(x) @ form.size @ np.abs(x))
            assert (value <= 1e-12 * size) if form.positive else (abs(value) <= 1e-12 * size)


def coordinates(tree, motions, q, v):
    """The coordinates x of the motion v at the pose q: the free components of each body's twist, joint by joint."""
    twists, x = [], []
    for i, p in enumerate(tree.parents.tolist()):
        rotation, position = (array[0] for array in tree.placed(i, q[i : i + 1]))
        linear, angular = (np.zeros(3), np.zeros(3)) if p < 0 else twists[p]
        linear, angular = rotation.T @ (linear + np.cross(angular, position)), rotation.T @ angular
        (linear if tree.prismatic[i] else angular)[2] += v[i]
        twists.append((linear, angular))
        both = np.concatenate([linear, angular])
        if tree.prismatic[i]:
            x += [v[i]] if tree.absent[i] else [both[0], both[1], v[i]]
        else:
            x += [v[i]] if p < 0 else [both[0], both[1], both[3], both[4], v[i]]
    return np.array(x)


@pytest.mark.parametrize("size", [1, 2, 5])
def test_the_solver_finds_what_is_known(size):
    """The greatest y with A ⪰ y1 is λ_min(A), and beside B ⪰ y1 with a multiplier h ≥ 0 of −1 it stays so."""
    rng = np.random.default_rng(size)
    matrix = rng.normal(size=(size, size))
    matrix = matrix + matrix.T
    ones = np.eye(size)
    y, solved = maximise(matrix, np.array([-ones, -ones]), np.array([False, True]))
    assert solved
    assert y[0] == pytest.approx(np.linalg.eigvalsh(matrix)[0], rel=1e-6)
    assert 0.0 <= y[1] <= 1e-6
    y, solved = maximise(matrix, np.array([-ones, ones]), np.array([False, False]))
    assert y[0] == pytest.approx(np.linalg.eigvalsh(matrix)[0] + multipliers.REACH, rel=1e-6)


def test_multipliers_that_prove_nothing_are_not_believed(monkeypatch):
    """Whatever the solver says, no bound exceeds the truth: here its bound is raised and its multipliers are scaled."""
    tree = RigidTree.of(load_robot("three_link"))
    honest = least_by_multipliers(tree).value
    for raised, scaled in [(1.01, 1.0), (1.0, 0.9), (1e3, 0.0)]:

        def lie(*problem, raised=raised, scaled=scaled):
            y, _ = maximise(*problem)
            return np.append(raised * y[0], scaled * y[1:]), True

        monkeypatch.setattr(multipliers, "maximise", lie)
        assert least_by_multipliers(tree).value == 0.0 < honest


def test_endless_travel_has_no_largest_inertia_but_a_least_one():
    model = random_model(np.random.default_rng(4), "rpr")
    claim = largest_inertia_bound(pack_model(model), np.eye(3))
    assert claim.value == np.inf
    assert "slides" in claim.because
    assert trace_bound(pack_model(model), np.eye(3)) == np.inf
    poses = np.random.default_rng(4).uniform(-4.0, 4.0, (2000, 3))
    assert 0.0 < least_inertia_bound(pack_model(model)).value <= np.linalg.eigvalsh(masses(model, poses))[:, 0].min()


def test_travel_that_changes_nothing_may_be_endless():
    model = random_model(np.random.default_rng(5), "ppr")
    packed = pack_model(model)
    great = np.linalg.eigvalsh(masses(model, np.random.default_rng(5).uniform(-3, 3, (500, 3))))[:, -1].max()
    assert great <= largest_inertia_bound(packed, np.eye(3)).value <= 1.2 * great


def test_point_masses():
    """Three point masses on axes through one point: some poses let a joint move nothing, so a₁ = 0 is all there is."""
    model = pin.Model()
    for i in range(3):
        kind = pin.JointModelRZ() if i % 2 else pin.JointModelRX()
        joint = model.addJoint(i, kind, pin.SE3.Identity(), f"joint{i}")
        body = pin.Inertia(1.0, np.array([0.0, 0.0, 1.0]), np.zeros((3, 3)))
        model.appendBodyToJoint(joint, body, pin.SE3.Identity())
    claim = least_inertia_bound(pack_model(model))
    assert claim.value == 0.0
    assert "inertia" in claim.because


@pytest.mark.parametrize("weight", [np.eye(3), -np.eye(2), np.array([[1.0, 0.5], [0.4, 1.0]]), np.ones((2, 2))])
def test_a_weight_that_is_none_is_refused(weight):
    with pytest.raises(ArgumentError, match="weight"):
        largest_inertia_bound(load_robot("two_link"), weight)


@pytest.mark.parametrize("angles", [3, 4, 5, 7, 12])
def test_polynomials_that_are_nowhere_negative_between_samples(angles):
    """|a + b e^{iθ} + c e^{2iθ}|² over a fine grid never exceeds the sampled maximum times the factor; sharp at a peak
    halfway between samples."""
    rng, factor = np.random.default_rng(6), Plan(0, 1, angles).factor
    coefficients = rng.normal(size=(500, 3, 2)) @ np.array([1.0, 1j])
    fine = np.linspace(0.0, 2.0 * np.pi, 2001)
    coarse = 2.0 * np.pi * np.arange(angles) / angles
    at = [np.abs(coefficients @ np.exp(1j * np.outer(range(3), t))) ** 2 for t in (fine, coarse)]
    assert np.all(at[0].max(1) <= factor * at[1].max(1))
    if angles % 2 == 0:
        peak = 1.0 + np.cos(2.0 * (coarse - np.pi / angles))
        assert factor * peak.max() == pytest.approx(2.0)


def pivots(matrix, shift):
    """Those of A − shift·I in rational numbers, up to the first that is not positive."""
    lower = np.tril(matrix) + np.tril(matrix, -1).T
    a = [[Fraction(x) - (Fraction(shift) if i == j else 0) for j, x in enumerate(row)] for i, row in enumerate(lower)]
    found = []
    for k in range(len(a)):
        found.append(a[k][k])
        if a[k][k] <= 0:
            break
        for i in range(k + 1, len(a)):
            factor = a[i][k] / a[k][k]
            a[i] = [x - factor * y for x, y in zip(a[i], a[k], strict=True)]
    return found


@pytest.mark.parametrize("seed", range(40))
def test_a_verified_matrix_is_positive_definite_in_exact_arithmetic(seed):
    """Matrices at the edge: an eigenvalue within some ε of the radius, on either side, and entries of all sizes."""
    rng = np.random.default_rng(seed)
    n, radius = int(rng.integers(2, 7)), float(rng.choice([0.0, 1e-14, 1e-9, 1e-3]))
    vectors = np.linalg.qr(rng.normal(size=(n, n)))[0]
    values = 10.0 ** rng.uniform(-6.0, 2.0, n)
    values[0] = radius + float(rng.choice([-1.0, 1.0])) * 10.0 ** rng.uniform(-17.0, -11.0)
    matrix = (vectors * values) @ vectors.T
    if exceeds_every_perturbation(matrix, radius):
        assert all(pivot > 0 for pivot in pivots(matrix, radius))
    lacking = max(0.0, radius - values.min()) + 1e-12 * values.max() * n
    assert exceeds_every_perturbation(matrix + lacking * np.eye(n), radius)


@pytest.mark.parametrize("matrix", [np.diag([1.0, -1e-300]), np.diag([1.0, np.nan]), np.zeros((2, 2))])
def test_what_is_not_positive_definite_is_not_verified(matrix):
    assert not exceeds_every_perturbation(matrix, 0.0)
    assert not exceeds_every_perturbation(np.eye(2), np.nan)


def test_rounding_goes_the_safe_way():
    rng = np.random.default_rng(7)
    for n in (1, 4, 9):
        q, _ = np.linalg.qr(rng.normal(size=(n, n)))
        values = np.sort(rng.uniform(-1.0, 1.0, n))
        matrix = (q * values) @ q.T
        matrix = 0.5 * (matrix + matrix.T)
        assert values[0] - 1e-12 <= least_eigenvalue(matrix) < values[0]
        assert values[-1] < largest_eigenvalue(matrix) <= values[-1] + 1e-12
    assert down(-1.0) < -1.0 < up(-1.0)
    assert down(1.0) < 1.0 < up(1.0)
