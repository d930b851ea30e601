"""±∂M/∂q_i ⪯ γ_iM and ⪯ γ_iW in every pose, and bounds of the rates by the kinetic energy."""

import numpy as np
import pinocchio as pin
import pytest

from nbs_pin import load_robot
from nbs_pin.dynamics.pinocchio_tree import pack_model
from nbs_pin.dynamics.rigid_tree import RigidTree
from nbs_pin.inertia.bounds import body_shares, largest_diagonal
from nbs_pin.inertia.christoffel import christoffel_bounds, gravity_bounds
from nbs_pin.inertia.derivatives import inertia_derivatives, rate_bound
from tests.test_inertia_bounds import masses, random_model

STEP = 1e-5


def slopes(model, poses, i):
    """∂M/∂q_i at each pose, by central differences."""
    shift = STEP * np.eye(model.nv)[i]
    return (masses(model, poses + shift) - masses(model, poses - shift)) / (2.0 * STEP)


def over(matrix, weight):
    """Largest |λ(W⁻¹A)| of each symmetric A."""
    root = np.linalg.inv(np.linalg.cholesky(weight))
    return np.abs(np.linalg.eigvalsh(root @ matrix @ np.swapaxes(root, -1, -2))).max(axis=-1)


@pytest.mark.parametrize("seed", range(6))
def test_no_pose_of_a_random_tree_changes_its_inertia_faster(seed):
    rng = np.random.default_rng(seed)
    model = random_model(rng, "r" * int(rng.integers(2, 6)), branched=seed % 2 == 1, rotors=seed % 3 == 0)
    tree, weight = RigidTree.of(pack_model(model)), np.diag(rng.uniform(0.1, 3.0, model.nv))
    poses = rng.uniform(-np.pi, np.pi, (300, model.nv))
    relative, by_weight = inertia_derivatives(tree), inertia_derivatives(tree, weight)
    for i in range(model.nv):
        slope = slopes(model, poses, i)
        assert over(slope, masses(model, poses)).max() <= relative[i] + 1e-6
        assert over(slope, weight).max() <= by_weight[i] + 1e-6


@pytest.mark.parametrize("joints", ["rrr", "rrrrr", "prr", "ppr", "rrrr"])
def test_no_pose_of_a_random_tree_has_larger_christoffel_symbols_or_slopes_of_gravity(joints):
    rng = np.random.default_rng(len(joints))
    model = random_model(rng, joints, branched=joints == "rrrr", rotors=True)
    n, data, tree = model.nv, model.createData(), RigidTree.of(pack_model(model))
    poses = rng.uniform(-np.pi, np.pi, (200, n))
    shares = body_shares(tree)
    assert (masses(model, poses).diagonal(axis1=1, axis2=2) <= largest_diagonal(tree, shares)).all()
    bound, steepest = christoffel_bounds(tree, shares), gravity_bounds(tree, shares, 9.81)
    change = np.array([slopes(model, poses, k) for k in range(n)])  # k, pose, i, j
    found = 0.5 * (np.einsum("kpij->pijk", change) + np.einsum("jpik->pijk", change) - np.einsum("ipjk->pijk", change))
    assert np.abs(found).max() > 0.01
    assert (np.abs(found) <= bound + 1e-6).all()
    steps = STEP * np.eye(n)
    for q in poses:
        ahead, behind = ([pin.computeGeneralizedGravity(model, data, x).copy() for x in q + s * steps] for s in (1, -1))
        slope = (np.array(ahead) - behind).T / (2.0 * STEP)
        assert (np.abs(slope) <= steepest + 1e-5).all()


def test_christoffel_symbols_of_two_rods_are_within_a_factor_of_two():
    """|Γ_122| = m l₁ l₂ at a right angle, and the bound is that of the stretched arm, m (l₁ + l₂) l₂."""
    robot = load_robot("two_link")
    bound = christoffel_bounds(robot, body_shares(robot))[0, 1, 1]
    assert slopes(robot.model, np.array([[0.3, 0.5 * np.pi]]), 1)[0, 0, 1] == pytest.approx(-1.0)
    assert 2.0 <= bound <= 2.01


def test_the_bound_of_two_links_is_attained():
    assert inertia_derivatives(load_robot("two_link")) == pytest.approx([0.0, 1.0], abs=1e-5)


def test_ur5_is_within_a_tenth_of_what_poses_find_at_the_joints_that_matter():
    robot = load_robot("ur5")
    poses = np.random.default_rng(0).uniform(-np.pi, np.pi, (4000, 6))
    mass, bounds = masses(robot.model, poses), inertia_derivatives(robot)
    for i, slack in ((1, 1.25), (2, 1.25), (3, 1.25), (5, 1.05)):
        assert bounds[i] <= slack * over(slopes(robot.model, poses, i), mass).max()


def test_a_joint_on_the_base_changes_nothing_and_sliding_ones_are_not_covered():
    rng = np.random.default_rng(1)
    assert inertia_derivatives(pack_model(random_model(rng, "rrp"))).tolist() == [0.0, np.inf, np.inf]
    slides_first = inertia_derivatives(pack_model(random_model(rng, "prr")))
    assert slides_first[0] == 0.0
    assert np.isfinite(slides_first).all()


@pytest.mark.parametrize("seed", range(4))
def test_weighted_rates_are_bounded_by_the_energy(seed):
    rng = np.random.default_rng(seed)
    model = random_model(rng, "r" * int(rng.integers(2, 6)))
    weights = rng.uniform(0.0, 2.0, model.nv) * (rng.uniform(size=model.nv) > 0.3)
    bound = rate_bound(pack_model(model), weights)
    mass = masses(model, rng.uniform(-np.pi, np.pi, (500, model.nv)))
    signs = np.array(np.meshgrid(*[[-1.0, 1.0]] * model.nv)).reshape(model.nv, -1).T * weights
    # The largest Σ w|v| with vᵀMv = 1 is that of sᵀM⁻¹s over signs s.
    found = np.einsum("si,kij,sj->ks", signs, np.linalg.inv(mass), signs).max(initial=0.0)
    assert np.sqrt(found) <= bound * (1.0 + 1e-9)


def test_no_weight_asks_nothing_and_an_unknown_one_is_not_bounded():
    robot = load_robot("two_link")
    assert rate_bound(robot, np.zeros(2)) == 0.0
    assert rate_bound(robot, np.array([np.inf, 1.0])) == np.inf
