"""The least eigenvalue of the inertia matrix over all poses, from what poses cannot change (docs/certificates.md).

The kinetic energy is a constant quadratic form of the bodies' twists, each in its own frame. A joint that turns about z
takes its parent's twist (v, ω), placed at the joint, to the body's: v_z is kept, ω_z gains q̇, and the turn of the other
two components keeps ‖v_⊥‖², ‖ω_⊥‖², v_⊥·ω_⊥ and z·(v_⊥×ω_⊥). A joint that slides by s keeps ω, adds q̇ to v_z and
s ω×z to v_⊥. These are linear and quadratic conditions without q, so energy + Σ h·(what is zero) ⪰ a‖q̇‖² on all twists
proves a ⪯ M(q) everywhere, for any multipliers h; a descent finds good ones.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize

from nbs_pin.certificates.rigid_tree import RigidTree, cross
from nbs_pin.certificates.rounding import largest_eigenvalue, least_eigenvalue

KEPT = 0.999
"""Share of the multipliers found that is used, so that the form stays clear of 0: at least 1 − KEPT of the energy."""
SHARPNESS = (4.0, 16.0, 64.0, 256.0)
"""Powers p by which λ_max is replaced by (Σ λᵖ)^(1/p) for the descent, one after the other."""


@dataclass(frozen=True, eq=False)
class Motions:
    """All twists that the linear conditions allow, as coordinates x, and what is known of them."""

    energy: Float[np.ndarray, "m m"]
    """xᵀ energy x = 2T, rotors included."""
    rates: Float[np.ndarray, "n m"]
    """q̇ = rates x."""
    forms: Float[np.ndarray, "k m m"]
    """Quadratic conditions xᵀ form x = 0, or ≤ 0 where `signed`."""
    signed: Float[np.ndarray, " k"]
    """1 for a condition ≤ 0, whose multiplier must be ≥ 0; else 0."""

    @classmethod
    def of(cls, tree: RigidTree) -> "Motions":
        """The motions of a tree in any pose."""
        n = tree.nv
        own = np.eye(6 * n).reshape(n, 6, 6 * n)
        seen = np.array([_placed(tree, i) @ own[tree.parents[i]] for i in range(n)])
        gained = own - seen
        rates = gained[np.arange(n), np.where(tree.prismatic, 2, 5)]
        zero = np.vstack([gained[i][_kept(tree, i)] for i in range(n)])
        free = np.linalg.svd(zero)[2][len(zero) :].T
        forms = [form for i in range(n) for form in _forms(tree, i, own[i], seen[i])]
        energy = (rates.T * tree.armature) @ rates
        for i in range(n):
            energy += own[i].T @ tree.spatial_inertia(i) @ own[i]
        matrices = np.array([free.T @ form @ free for form, _ in forms]).reshape(len(forms), *[free.shape[1]] * 2)
        return cls(free.T @ energy @ free, rates @ free, matrices, np.array([signed for _, signed in forms]))


def least_by_multipliers(tree: RigidTree) -> float:
    """At most min_q λ_min(M(q)), at least 0; 0 where a motion without energy is not excluded by linear conditions."""
    motions = Motions.of(tree)
    if least_eigenvalue(motions.energy) <= 0.0:
        return 0.0
    factor = np.linalg.inv(np.linalg.cholesky(motions.energy))
    forms, rates = factor @ motions.forms @ factor.T, motions.rates @ factor.T
    forms = forms / np.maximum(np.linalg.norm(forms, axis=(1, 2)), 1e-300)[:, None, None]
    multipliers = KEPT * _multipliers(forms, rates, motions.signed > 0.0)
    energy = np.eye(len(factor)) + np.tensordot(multipliers, forms, 1)
    # What the rounding of the congruence can change, with the energy scaled to 1.
    size = 1.0 + np.abs(multipliers).sum() + largest_eigenvalue(rates @ rates.T) / _greatest(energy, rates)
    condition = np.linalg.norm(motions.energy, 2) * np.linalg.norm(factor, 2) ** 2
    slack = 64.0 * len(factor) * np.finfo(float).eps * condition * size
    bound = 1.0 / _greatest(energy, rates)
    for share in 2.0 ** -np.arange(30.0, 0.0, -1.0):
        least = bound * (1.0 - share)
        if least_eigenvalue(energy - least * rates.T @ rates) > slack:
            return least
    return 0.0


def _multipliers(
    forms: Float[np.ndarray, "k m m"], rates: Float[np.ndarray, "n m"], signed: np.ndarray
) -> Float[np.ndarray, " k"]:
    """Multipliers h for which λ_max(rates (1 + Σ h form)⁻¹ ratesᵀ) is small, by descent from h = 0."""
    first = _greatest(np.eye(rates.shape[1]), rates)

    def cost(x: np.ndarray, power: float) -> tuple[float, np.ndarray]:
        h = np.where(signed, x * x, x)
        energy = np.eye(rates.shape[1]) + np.tensordot(h, forms, 1)
        if np.linalg.eigvalsh(energy)[0] <= 0.0:
            return 1e6, np.zeros_like(x)
        solved = np.linalg.solve(energy, rates.T)
        values, vectors = np.linalg.eigh(rates @ solved)
        shares = np.maximum(values / values[-1], 1e-300) ** power
        total = shares.sum()
        directions = solved @ vectors
        slopes = -np.einsum("ak,jab,bk,k->j", directions, forms, directions, shares / total / values, optimize=True)
        value = float(np.log(values[-1] / first) + np.log(total) / power)
        return value, np.where(signed, 2.0 * x, 1.0) * slopes

    x = np.where(signed, 1e-2, 0.0)
    for power in SHARPNESS if len(forms) else ():
        x = minimize(cost, x, args=(power,), jac=True, method="BFGS", options={"maxiter": 100}).x
    return np.where(signed, x * x, x)


def _greatest(energy: Float[np.ndarray, "m m"], rates: Float[np.ndarray, "n m"]) -> float:
    """λ_max(rates energy⁻¹ ratesᵀ): the most ‖q̇‖² per energy."""
    return float(np.linalg.eigvalsh(rates @ np.linalg.solve(energy, rates.T))[-1])


def _placed(tree: RigidTree, i: int) -> Float[np.ndarray, "6 6"]:
    """The parent's twist as that of frame i at q_i = 0; 0 on the base."""
    placed = np.zeros((6, 6))
    if tree.parents[i] >= 0:
        back = tree.rotation[i].T
        placed[:3, :3] = placed[3:, 3:] = back
        placed[:3, 3:] = -back @ cross(tree.position[i])
    return placed


def _kept(tree: RigidTree, i: int) -> list[int]:
    """Components of the twist that joint i passes on as they are; behind a base at rest, all that it does not move."""
    if tree.prismatic[i]:
        return [0, 1, 3, 4, 5] if tree.absent[i] else [3, 4, 5]
    return [0, 1, 2, 3, 4] if tree.parents[i] < 0 else [2]


def _forms(
    tree: RigidTree, i: int, own: Float[np.ndarray, "6 m"], seen: Float[np.ndarray, "6 m"]
) -> list[tuple[Float[np.ndarray, "m m"], float]]:
    """Quadratic conditions at joint i: forms that are 0, and one that is ≤ 0, marked 1, for a joint that slides."""
    if tree.parents[i] < 0 or (tree.prismatic[i] and tree.absent[i]):
        return []
    if not tree.prismatic[i]:
        pairs = [(0, 0, 1, 1), (3, 3, 4, 4), (0, 3, 1, 4), (0, 4, 1, 3)]
        signs = (1.0, 1.0, 1.0, -1.0)
        return [(_pair(own, *p, s) - _pair(seen, *p, s), 0.0) for p, s in zip(pairs, signs, strict=True)]
    # v_⊥ gains s g, g = ω×z: it is parallel to g, and (s − lower)(s − upper)‖g‖² ≤ 0.
    gain, g = (own - seen)[:2], np.array([seen[4], -seen[3]])
    forms = [(_pair(np.vstack([gain, g]), 0, 3, 1, 2, -1.0), 0.0)]
    ends = np.array([tree.lower[i], tree.upper[i]])
    if np.isfinite(ends).all():
        within = (gain - ends[0] * g).T @ (gain - ends[1] * g)
        forms.append((0.5 * (within + within.T), 1.0))
    return forms


def _pair(twist: Float[np.ndarray, "c m"], a: int, b: int, c: int, d: int, sign: float) -> Float[np.ndarray, "m m"]:
    """The quadratic form x_a x_b + sign·x_c x_d of the twist's components."""
    form = np.outer(twist[a], twist[b]) + sign * np.outer(twist[c], twist[d])
    return 0.5 * (form + form.T)
