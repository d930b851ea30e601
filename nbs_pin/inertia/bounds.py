"""Bounds on the inertia matrix over all configurations, proved: M(q) ⪯ a₂W and M(q) ⪰ a₁I (docs/certificates.md).

Joints that turn are let turn fully, joints that slide move within their limits. M is that of the rigid bodies and the
rotors' armature.
"""

import numpy as np
from jaxtyping import Float

from nbs_pin.base.arrays import JointArray
from nbs_pin.base.claims import Claim, Label
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.rounding import down, largest_eigenvalue, least_eigenvalue, up
from nbs_pin.dynamics.rigid_tree import Arm, RigidTree
from nbs_pin.inertia.lever_arms import lever_arms
from nbs_pin.inertia.multipliers import largest_by_multipliers, least_by_multipliers
from nbs_pin.inertia.pose_grid import pose_grid_bound

POSES = 150_000
"""Poses that `trigonometric_bound` looks at, at most."""
MULTIPLIERS = "energy of the bodies and what no pose changes of their twists, by multipliers"


def largest_inertia_bound(arm: Arm, weight: Float[np.ndarray, "n n"]) -> Claim:
    """At least max_q λ_max(W^-½ M(q) W^-½), so that M(q) ⪯ value·W: by multipliers, else the better of two others.

    weight: W, symmetric positive definite, usually D₀ [N·m·s/rad]; the value is then 1/κ [s]. I gives a₂ [kg·m²].
    The value is inf, with the reason, where a joint slides without end. Raises ArgumentError for a W that is none.
    """
    tree = RigidTree.of(arm)
    name = "largest inertia over W, max λ(W^-½MW^-½)"
    _check_weight(weight, tree.nv)
    if len(tree.endless):
        because = f"joint {int(tree.endless[0]) + 1} slides without a stated end, so inertia has no bound"
        return Claim(name, np.inf, "", Label.PROVED, because)
    value = up(largest_by_multipliers(tree, weight))
    if np.isfinite(value):
        return Claim(name, value, "", Label.PROVED, MULTIPLIERS)
    bounds = {
        "trace of W⁻¹M by the greatest lever arms": trace_bound(tree, weight),
        "finitely many poses, a trigonometric polynomial between them": trigonometric_bound(tree, weight),
    }
    because = min(bounds, key=lambda key: bounds[key])
    return Claim(name, bounds[because], "", Label.PROVED, because)


def least_inertia_bound(arm: Arm, weight: Float[np.ndarray, "n n"] | None = None) -> Claim:
    """At most min_q λ_min(W^-½ M(q) W^-½): by multipliers, else the better of two others ÷ λ_max(W).

    weight: W, None for I: a₁ [kg·m², or kg along a joint that slides]. The value is 0, with the reason, where all say
    nothing. Raises ArgumentError for a W that is not symmetric positive definite.
    """
    tree = RigidTree.of(arm)
    weight = np.eye(tree.nv) if weight is None else weight
    _check_weight(weight, tree.nv)
    name, value = "least inertia over W, min λ(W^-½MW^-½)", down(least_by_multipliers(tree, weight))
    if value > 0.0:
        return Claim(name, value, "", Label.PROVED, MULTIPLIERS)
    bounds = {
        "speeds of the bodies alone (pencil)": pencil_bound(tree),
        "determinant by articulated inertias": determinant_bound(tree),
    }
    because = max(bounds, key=lambda key: bounds[key])
    value = down(max(bounds[because], 0.0) / largest_eigenvalue(weight))
    if value == 0.0:
        because = "a body without inertia of its own, or travel without end, leaves no bound above 0"
    return Claim(name, value, "", Label.PROVED, because)


def trace_bound(arm: Arm, weight: Float[np.ndarray, "n n"]) -> float:
    """At least max_q trace(W⁻¹M(q)) for a diagonal W; for any other, with its diagonal scaled down below it."""
    tree = RigidTree.of(arm)
    return up(float(np.sum(_body_traces(tree, 1.0 / _diagonal_below(weight)))))


def trigonometric_bound(arm: Arm, weight: Float[np.ndarray, "n n"], poses: int = POSES) -> float:
    """At least max_q λ_max(W^-½MW^-½) from its values at equally spaced poses (`pose_grid`).

    The value is inf where a joint slides without end.
    """
    tree = RigidTree.of(arm)
    if len(tree.endless) or not tree.physical:
        return np.inf
    # What the Cholesky factor of W can lose, for W scaled to a unit diagonal.
    spread = tree.nv * float(np.max(np.diag(weight) / _diagonal_below(weight)))
    return up(pose_grid_bound(tree, weight, poses)) * (1.0 + 64.0 * tree.nv * np.finfo(float).eps * spread)


def pencil_bound(arm: Arm) -> float:
    """At most min_q λ_min(M(q)), from the bodies' speeds alone.

    2T ≥ Σ m_i‖v_i‖² + e_i‖ω_i‖², with v_i of the centre of mass and e_i the least inertia about it, while |q̇_i| is at
    most ‖ω_i‖ + ‖ω_p‖ for a joint that turns, p its parent, and ‖v_i‖ + ‖v_p‖ + R_i‖ω_p‖, R_i ≥ ‖c_i − c_p‖, for one
    that slides.
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
    """At most min_q λ_min(M(q)), from λ_min ≥ det·((n−1)/tr)^(n−1) and det M ≥ ∏ d_i.

    d_i = s_iᵀI_is_i is the inertia of body i alone about (along) its joint. Taken of M, and of M scaled by the greatest
    M_ii to a diagonal of at most 1, which suits joints of unlike size.
    """
    tree = RigidTree.of(arm)
    n = tree.nv
    greatest = np.array([np.sum(_body_traces(tree, row)) for row in np.eye(n)])
    trace = min(float(np.sum(_body_traces(tree, np.ones(n)))), float(greatest.sum()))
    if not np.isfinite(trace):
        return 0.0
    about = tree.inertia[:, 2, 2] + tree.mass * (tree.centre[:, :2] ** 2).sum(1)
    own = np.where(tree.prismatic, tree.mass, about) + tree.armature
    if not (own > 0.0).all():
        return 0.0
    plain = np.log(own).sum() + (n - 1) * np.log(max(n - 1, 1) / trace)
    scaled = np.log(own / greatest).sum() + (n - 1) * np.log(max(n - 1, 1) / n) + np.log(greatest.min())
    return down(float(np.exp(max(plain, scaled))))


def _body_traces(tree: RigidTree, weights: JointArray) -> JointArray:
    """At least Σ_i w_i M_ii over all poses, by body: its mass on its greatest lever arms, its inertia, its rotor."""
    if len(tree.endless) or not tree.physical:
        return np.full(tree.nv, np.inf)
    levers = lever_arms(tree, weights)
    turning = np.where(tree.prismatic, 0.0, weights)
    total = weights * tree.armature
    for k in range(tree.nv):
        largest = max(largest_eigenvalue(tree.inertia[k]), 0.0)
        own = turning[k] * tree.inertia[k, 2, 2]
        total[k] += tree.mass[k] * levers[k](tree.centre[k]) + own + largest * turning[tree.path(k)[1:]].sum()
    return total


def _apart(tree: RigidTree, i: int) -> float:
    """‖c_i − c_parent‖ at most [m], for a joint that slides; 0 where the parent never turns and it does not matter."""
    if tree.absent[i]:
        return 0.0
    ends = np.array([tree.lower[i], tree.upper[i]])
    if not np.isfinite(ends).all():
        return np.inf
    rotation, position = tree.placed(i, ends)
    return float(np.linalg.norm(position + rotation @ tree.centre[i] - tree.centre[tree.parents[i]], axis=1).max())


def _diagonal_below(weight: Float[np.ndarray, "n n"]) -> JointArray:
    """A diagonal below W: W's own if it is diagonal, else that times λ_min of W scaled to a unit diagonal."""
    diagonal = np.diag(weight)
    if np.array_equal(weight, np.diag(diagonal)):
        return diagonal
    root = np.sqrt(diagonal)
    return diagonal * least_eigenvalue(weight / root / root[:, None])


def _check_weight(weight: Float[np.ndarray, "n n"], nv: int) -> None:
    """Raises ArgumentError unless W is (nv, nv), symmetric and positive definite beyond rounding."""
    symmetric = weight.shape == (nv, nv) and np.isfinite(weight).all() and np.array_equal(weight, weight.T)
    if not (symmetric and (np.diag(weight) > 0.0).all() and (_diagonal_below(weight) > 0.0).all()):
        raise ArgumentError(f"the weight is not a symmetric positive definite matrix ({nv}, {nv}); give e.g. D₀ or I.")
