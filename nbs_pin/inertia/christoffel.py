"""Bounds, entry by entry, of how M and G change with the pose, by lever arms (docs/certificates.md §15).

For a point p of the arm, Γ_ijk = ½(∂_kM_ij + ∂_jM_ik − ∂_iM_jk) = ∫ ∂_ip·∂_j∂_kp dm and ∂_jG_i = −∫ g·∂_i∂_jp dm. With
j between the base and k, ∂_j∂_kp is ∂_kp turned by joint j: at most as long, and 0 for a joint j that slides. Only the
bodies behind all of the joints count, and over each body ∫|∂_ip|² dm is its share of M_ii.
"""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Float

from nbs_pin.base.rounding import up
from nbs_pin.dynamics.rigid_tree import Arm, RigidTree


def christoffel_bounds(arm: Arm, shares: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n n"]:
    """Upper bounds of |Γ_ijk| in every pose; entry i of C(q, a)b is Σ Γ_ijk a_j b_k.

    shares: `body_shares` of the arm.
    """
    tree = RigidTree.of(arm)
    behind, found = _behind(tree), np.zeros((tree.nv,) * 3)
    for j, k, turned, bodies in _bends(tree):
        found[:, j, k] = np.where(behind & bodies, _mean(shares, shares[turned]), 0.0).sum(axis=1)
    return np.asarray(up(1.0) * found)


def gravity_bounds(arm: Arm, shares: Float[np.ndarray, "n n"], gravity: float) -> Float[np.ndarray, "n n"]:
    """Upper bounds of |∂G_i/∂q_j| in every pose, for the acceleration of gravity [m/s²]; shares as above."""
    tree = RigidTree.of(arm)
    found = np.zeros((tree.nv,) * 2)
    for i, j, turned, bodies in _bends(tree):
        found[i, j] = _mean(gravity * tree.mass[bodies], gravity * shares[turned, bodies]).sum()
    return np.asarray(up(1.0) * found)


def _mean(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """√(ab), 0 where a body has no mass even if b has no bound."""
    none = (a == 0.0) | (b == 0.0)
    return np.asarray(np.sqrt(np.where(none, 0.0, a) * np.where(none, 0.0, b)))


def _behind(tree: RigidTree) -> Bool[np.ndarray, "n n"]:
    """Whether joint i moves body k: row i, column k."""
    return np.array([[i in tree.path(k) for k in range(tree.nv)] for i in range(tree.nv)])


def _bends(tree: RigidTree) -> Iterator[tuple[int, int, int, Bool[np.ndarray, " n"]]]:
    """Joints j and k for which ∂_j∂_kp is not 0, the one whose ∂p the other turns, and the bodies behind both."""
    behind = _behind(tree)
    for j, k in np.ndindex(tree.nv, tree.nv):
        near, far = (j, k) if behind[j, k] else (k, j)
        if behind[near, far] and not tree.prismatic[near]:
            yield j, k, far, behind[j] & behind[k]
