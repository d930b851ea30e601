"""Proved bounds of the inertia matrix over all configurations: a₁W ⪯ M(q) ⪯ a₂W (docs/certificates.md §6).

Revolute joints may turn fully, prismatic joints move within their limits. M includes the bodies and rotor armature.
"""

import numpy as np
from jaxtyping import Float

from nbs_pin.base.arrays import JointArray
from nbs_pin.base.claims import Claim, Label
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.rounding import diagonal_below, down, largest_eigenvalue, up
from nbs_pin.dynamics.rigid_tree import Arm, RigidTree
from nbs_pin.inertia.lever_arms import lever_arms
from nbs_pin.inertia.multipliers import largest_by_multipliers, least_by_multipliers
from nbs_pin.inertia.pose_grid import pose_grid_bound

POSES = 150_000
"""Largest number of poses that `trigonometric_bound` samples."""
MULTIPLIERS = "energy of the bodies and conditions on their twists that hold in every pose, by multipliers"


def largest_inertia_bound(arm: Arm, weight: Float[np.ndarray, "n n"]) -> Claim:
    """Upper bound of max_q λ_max(W^-½ M(q) W^-½), so that M(q) ⪯ value·W.

    By multipliers, else the smaller of `trace_bound` and `trigonometric_bound`; inf, with the reason, if M depends on a
    prismatic joint without limits.

    Args:
        weight: W, symmetric positive definite, usually D₀ [N·m·s/rad], which gives 1/κ [s]; I gives a₂ [kg·m²].

    Raises:
        ArgumentError: If W is not symmetric positive definite.
    """
    tree = RigidTree.of(arm)
    name = "largest inertia over W, max λ(W^-½MW^-½)"
    _check_weight(weight, tree.nv)
    if len(tree.endless):
        because = f"joint {int(tree.endless[0]) + 1} slides without position limits, so the inertia has no upper bound"
        return Claim(name, np.inf, "", Label.PROVED, because)
    found = largest_by_multipliers(tree, weight)
    if np.isfinite(found.value):
        return Claim(name, up(found.value), "", Label.PROVED, MULTIPLIERS, evidence=found.multipliers)
    bounds = {
        "trace of W⁻¹M by the largest lever arms": trace_bound(tree, weight),
        "finitely many poses, with a bound of trigonometric polynomials": trigonometric_bound(tree, weight),
    }
    because = min(bounds, key=lambda key: bounds[key])
    return Claim(name, bounds[because], "", Label.PROVED, because)


def least_inertia_bound(arm: Arm, weight: Float[np.ndarray, "n n"] | None = None) -> Claim:
    """Lower bound of min_q λ_min(W^-½ M(q) W^-½), so that M(q) ⪰ value·W.

    By multipliers, else the larger of `pencil_bound` and `determinant_bound` ÷ λ_max(W); 0, with the reason, if no
    method gives a positive bound.

    Args:
        weight: W, symmetric positive definite; None is I, which gives a₁ [kg·m², kg for prismatic joints].

    Raises:
        ArgumentError: If W is not symmetric positive definite.
    """
    tree = RigidTree.of(arm)
    weight = np.eye(tree.nv) if weight is None else weight
    _check_weight(weight, tree.nv)
    name, found = "least inertia over W, min λ(W^-½MW^-½)", least_by_multipliers(tree, weight)
    if found.value > 0.0:
        return Claim(name, down(found.value), "", Label.PROVED, MULTIPLIERS, evidence=found.multipliers)
    bounds = {
        "speeds of the bodies (pencil)": pencil_bound(tree),
        "determinant by articulated inertias": determinant_bound(tree),
    }
    because = max(bounds, key=lambda key: bounds[key])
    value = down(max(bounds[because], 0.0) / largest_eigenvalue(weight))
    if value == 0.0:
        because = "no positive bound: a body has no inertia of its own, or a joint slides without position limits"
    return Claim(name, value, "", Label.PROVED, because)


def trace_bound(arm: Arm, weight: Float[np.ndarray, "n n"]) -> float:
    """Upper bound of max_q trace(W⁻¹M(q)); a W that is not diagonal is replaced by a diagonal matrix ⪯ W."""
    tree = RigidTree.of(arm)
    return up(_trace(tree, 1.0 / diagonal_below(weight)))


def trigonometric_bound(arm: Arm, weight: Float[np.ndarray, "n n"], poses: int = POSES) -> float:
    """Upper bound of max_q λ_max(W^-½MW^-½) from equally spaced poses (`pose_grid_bound`), inf if there is none."""
    tree = RigidTree.of(arm)
    if len(tree.endless) or not tree.physical:
        return np.inf
    # Bounds the condition number of W scaled to a unit diagonal, for the rounding of its Cholesky factor.
    spread = tree.nv * float(np.max(np.diag(weight) / diagonal_below(weight)))
    return up(pose_grid_bound(tree, weight, poses)) * (1.0 + 64.0 * tree.nv * np.finfo(float).eps * spread)


def pencil_bound(arm: Arm) -> float:
    """Lower bound of min_q λ_min(M(q)) from the speeds of the bodies.

    2T ≥ Σ m_i‖v_i‖² + e_i‖ω_i‖² with v_i of the centre of mass and e_i the smallest inertia about it, and for p the
    parent of i, |q̇_i| ≤ ‖ω_i‖ + ‖ω_p‖ at a revolute joint and |q̇_i| ≤ ‖v_i‖ + ‖v_p‖ + R_i‖ω_p‖ with R_i ≥ ‖c_i − c_p‖
    at a prismatic joint.
    """
    tree = RigidTree.of(arm)
    n = tree.nv
    energies = np.concatenate([tree.mass, tree.least_inertia])
    shares = np.zeros((n, 2 * n))
    for i, p in enumerate(tree.parents.tolist()):
        own = i if tree.prismatic[i] else n + i
        shares[i, own] = 1.0
        if p >= 0:
            shares[i, own - i + p] = 1.0
            shares[i, n + p] += _apart(tree, i) if tree.prismatic[i] else 0.0
    used = shares.any(axis=0)
    if not tree.physical:
        return 0.0
    if not (energies[used] > 0.0).all() or not np.isfinite(shares).all():
        return down(float(tree.armature.min()))
    scaled = shares[:, used] / np.sqrt(energies[used])
    return down(1.0 / largest_eigenvalue(scaled @ scaled.T) + float(tree.armature.min()))


def determinant_bound(arm: Arm) -> float:
    """Lower bound of min_q λ_min(M(q)) from λ_min ≥ det·((n−1)/tr)^(n−1) and det M ≥ ∏ d_i.

    d_i = s_iᵀI_is_i is the inertia of body i alone about (along) its joint. The larger of the bounds from M and from M
    scaled by upper bounds of M_ii to a diagonal ≤ 1, which suits joints of different size.
    """
    tree = RigidTree.of(arm)
    n = tree.nv
    greatest = largest_diagonal(tree)
    trace = min(_trace(tree, np.ones(n)), float(greatest.sum()))
    if not np.isfinite(trace):
        return 0.0
    about = tree.inertia[:, 2, 2] + tree.mass * (tree.centre[:, :2] ** 2).sum(1)
    own = np.where(tree.prismatic, tree.mass, about) + tree.armature
    if not (own > 0.0).all():
        return 0.0
    plain = np.log(own).sum() + (n - 1) * np.log(max(n - 1, 1) / trace)
    scaled = np.log(own / greatest).sum() + (n - 1) * np.log(max(n - 1, 1) / n) + np.log(greatest.min())
    return down(float(np.exp(max(plain, scaled))))


def largest_diagonal(arm: Arm, shares: Float[np.ndarray, "n n"] | None = None) -> JointArray:
    """Upper bounds of max_q M_ii(q) [kg·m², kg] for each joint; inf as in `largest_inertia_bound`.

    shares: `body_shares` of the arm, if they are known.
    """
    tree = RigidTree.of(arm)
    shares = body_shares(tree) if shares is None else shares
    return np.asarray(up(1.0) * (shares.sum(axis=1) + tree.armature))


def body_shares(arm: Arm) -> Float[np.ndarray, "n n"]:
    """Upper bounds, by lever arms, of what body k adds to M_ii in any pose: row i, column k [kg·m², kg]."""
    tree = RigidTree.of(arm)
    return np.array([_body_traces(tree, row) for row in np.eye(tree.nv)])


def _trace(tree: RigidTree, weights: JointArray) -> float:
    """Upper bound of Σ_i w_i M_ii over all poses, rotors included."""
    return float(_body_traces(tree, weights).sum() + weights @ tree.armature)


def _body_traces(tree: RigidTree, weights: JointArray) -> JointArray:
    """Upper bounds of each body's share of Σ_i w_i M_ii over all poses: mass at its lever arms, and inertia."""
    if len(tree.endless) or not tree.physical:
        return np.full(tree.nv, np.inf)
    levers = lever_arms(tree, weights)
    turning = np.where(tree.prismatic, 0.0, weights)
    total = np.zeros(tree.nv)
    for k in range(tree.nv):
        largest = max(largest_eigenvalue(tree.inertia[k]), 0.0)
        own = turning[k] * tree.inertia[k, 2, 2]
        total[k] = tree.mass[k] * levers[k](tree.centre[k]) + own + largest * turning[tree.path(k)[1:]].sum()
    return total


def _apart(tree: RigidTree, i: int) -> float:
    """Upper bound of ‖c_i − c_parent‖ [m] for a prismatic joint; 0 if the parent never turns: it then has no effect."""
    if tree.absent[i]:
        return 0.0
    ends = np.array([tree.lower[i], tree.upper[i]])
    if not np.isfinite(ends).all():
        return np.inf
    rotation, position = tree.placed(i, ends)
    return float(np.linalg.norm(position + rotation @ tree.centre[i] - tree.centre[tree.parents[i]], axis=1).max())


def _check_weight(weight: Float[np.ndarray, "n n"], nv: int) -> None:
    """Raise ArgumentError unless W is (nv, nv), symmetric and positive definite by more than rounding."""
    symmetric = weight.shape == (nv, nv) and np.isfinite(weight).all() and np.array_equal(weight, weight.T)
    if not (symmetric and (np.diag(weight) > 0.0).all() and (diagonal_below(weight) > 0.0).all()):
        raise ArgumentError(f"the weight is not a symmetric positive definite ({nv}, {nv}) matrix; give D₀ or I.")
