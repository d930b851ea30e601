"""Claims that follow from the structure of a model: M̂ ≻ 0, and Ṁ − 2C skew (docs/theory.md §1, §6)."""

from typing import NamedTuple

import numpy as np

from nbs_pin.base.claims import Claim, Label, refuse
from nbs_pin.dynamics.rigid_tree import RigidTree
from nbs_pin.kernels.layout import Packed

POSITIVE = "M̂ ≻ 0"
SKEW = "Ṁ − 2C skew, largest deviation"
ROUNDING = 1e-10
"""Relative allowance for rounding in bodies and closed forms."""


class ModelClaims(NamedTuple):
    """Properties of a model that certificates rest on."""

    positive: Claim
    """M̂(q) ≻ 0 at every q; value: a lower bound of λ_min, or the smallest factor of a determinant [kg·m²]."""
    skew: Claim
    """Ṁ − 2C is skew; value: the largest relative deviation."""


def quadratic(positive: Claim) -> ModelClaims:
    """The claims of a model with T̂ = ½vᵀM̂(q)v and C the Christoffel matrix of M̂."""
    return ModelClaims(positive, Claim(SKEW, 0.0, "", Label.PROVED, "T̂ = ½vᵀM̂(q)v, and C is its Christoffel matrix"))


def floored(epsilon: float, because: str) -> Claim:
    """M̂ ⪰ εI by structure; raises CertificateRefused unless ε [kg·m²] is positive."""
    if not epsilon > 0.0:
        refuse(f"the model's M̂ has ε = {epsilon:g}", "εI must be positive definite: learn it with ε > 0")
    return Claim(POSITIVE, epsilon, "kg·m²", Label.PROVED, f"{because} ⪰ εI for every weight")


def rigid_tree_claims(packed: Packed | None) -> ModelClaims | None:
    """M̂ ≻ 0 of a rigid tree: det M̂ ≥ ∏ S_iᵀI_iS_i, the inertia of each body alone about its own joint's axis.

    The pivots of M̂ are S_iᵀI_i^A S_i with articulated inertias I_i^A ⪰ I_i, as every body's inertia is ⪰ 0.
    None without a tree, or if a body alone has no inertia about its joint: M̂ ≻ 0 may hold, but not by this argument.

    Raises:
        CertificateRefused: If a number is not finite or a body is not physically consistent.
    """
    if packed is None:
        return None
    if not np.isfinite(packed.weights).all():
        refuse("the arm's model has numbers that are not finite", "load the arm again")
    tree = RigidTree.of(packed)
    size = np.abs(tree.inertia).max(axis=(1, 2)) + tree.mass * (tree.centre**2).sum(axis=1)
    least = np.linalg.eigvalsh(tree.inertia)[:, 0]
    bad = (tree.mass < 0.0) | (tree.armature < 0.0) | (least < -ROUNDING * np.abs(size))
    if bad.any():
        i = int(bad.argmax())
        refuse(
            f"the body behind joint {i + 1} has mass {tree.mass[i]:.3g} kg, rotor inertia {tree.armature[i]:.3g} kg·m² "
            f"and an inertia with the eigenvalue {least[i]:.3g} kg·m²",
            "give physically consistent bodies",
        )
    about = tree.inertia[:, 2, 2] + tree.mass * (tree.centre[:, :2] ** 2).sum(axis=1)
    own = np.where(tree.prismatic, tree.mass, np.where(about > ROUNDING * size, about, 0.0)) + tree.armature
    if own.min() <= 0.0:
        return None
    because = "rigid tree: det M̂ ≥ ∏ S_iᵀI_iS_i > 0 at every q; value: the smallest factor"
    return quadratic(Claim(POSITIVE, float(own.min()), "kg·m²", Label.PROVED, because))
