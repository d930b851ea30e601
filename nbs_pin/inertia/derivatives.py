"""Bounds of ∂M/∂q_i relative to M in every pose, by an S-procedure with momenta (docs/certificates.md §13).

With rates x held fixed, the energy 2T = xᵀM(q)x changes with q_i as xᵀ∂_iM x = −2 z·(v×p + ω×l): (v, ω) is the twist of
body i and (p, l) the momentum of all bodies that it carries, both in frame i. Twists satisfy the conditions of
`multipliers`. The momentum of body k is I_k(v, ω) plus those of its children, and a joint that turns rotates a child's
momentum about z by the angle by which it rotates the parent's twist back. So all products and cross products across z
of v, ω, p, l are the same on both sides of the joint, and the z components of p and l too. No condition contains q.
"""

from itertools import combinations

import numpy as np
from jaxtyping import Float

from nbs_pin.base.arrays import JointArray
from nbs_pin.base.rounding import up
from nbs_pin.dynamics.rigid_tree import Arm, RigidTree
from nbs_pin.inertia.multipliers import Form, Motions, largest_multiple, least_by_multipliers, placed_twist

_PARALLEL = 1.0 - 1e-12
"""Least cosine between axes that count as parallel; no proof rests on it."""
_TURNED = (0, 1, 3, 4)
"""Components of a twist or a momentum across the axis."""


def inertia_derivatives(arm: Arm, weight: Float[np.ndarray, "n n"] | None = None) -> JointArray:
    """γ with −γ_iW ⪯ ∂M/∂q_i ⪯ γ_iW in every pose, 0 where M does not depend on q_i.

    inf at a joint that slides with an effect on M, at a joint that carries one, and where no multipliers are found.

    Args:
        weight: W, symmetric positive definite; None takes M(q) itself, which gives γ in 1/rad.
    """
    tree = RigidTree.of(arm)
    return np.array([_derivative(tree, {i: 1.0}, weight) for i in range(tree.nv)])


def link_derivatives(arm: Arm, known: JointArray, weight: Float[np.ndarray, "n n"] | None = None) -> JointArray:
    """The same for the rates a = Bq̇ of `link_rates`: −γ_jW ⪯ Σ_i (B⁻¹)_ij ∂M/∂q_i ⪯ γ_jW.

    Args:
        known: `inertia_derivatives` for the same W: a joint without a parallel one behind it keeps its bound.
        weight: W, symmetric positive definite; None takes M(q) itself.
    """
    tree = RigidTree.of(arm)
    turns = _parallel(tree)
    found = np.array(known, dtype=float)
    for j in range(tree.nv):
        behind = {k: -sign for k, sign in turns.items() if tree.parents[k] == j}
        if behind:
            found[j] = _derivative(tree, {j: 1.0, **behind}, weight)
    return found


def link_rates(arm: Arm) -> Float[np.ndarray, "n n"]:
    """B of the rates a = Bq̇: a_j sums those of joint j and of the joints right before it that turn about parallel axes.

    So a_j is the rate at which link j turns about such axes in space, up to the motion of what carries all of them.
    """
    tree = RigidTree.of(arm)
    rows, turns = np.eye(tree.nv), _parallel(tree)
    for k, sign in turns.items():
        rows[k] += sign * rows[tree.parents[k]]
    return rows


def _parallel(tree: RigidTree) -> dict[int, float]:
    """Joints that turn about axes parallel to that of their parent joint, with the sign; parents first."""
    along = {k: float(tree.rotation[k, 2, 2]) for k in range(tree.nv) if tree.parents[k] >= 0}
    both = {k: z for k, z in along.items() if not tree.prismatic[[k, tree.parents[k]]].any()}
    return {k: float(np.sign(z)) for k, z in both.items() if abs(z) > _PARALLEL}


def single_rates(arm: Arm, rates: Float[np.ndarray, "n n"] | None = None) -> JointArray:
    """The least C_i found with |a_i| ≤ C_i √(q̇ᵀMq̇) for all rates and in every pose; inf where none is found.

    Args:
        rates: B of a = Bq̇, None for a = q̇.
    """
    tree = RigidTree.of(arm)
    return np.array([_largest_rate(tree, np.outer(row, row)) for row in (np.eye(tree.nv) if rates is None else rates)])


def rate_bound(
    arm: Arm, weights: JointArray, single: JointArray | None = None, rates: Float[np.ndarray, "n n"] | None = None
) -> float:
    """The least C found with Σ w_i|a_i| ≤ C √(q̇ᵀMq̇) for all rates and in every pose, w ≥ 0; inf if none is found.

    (Σ w_i|a_i|)² ≤ Σ w_i · Σ w_i a_i² for any split; here the split takes the bound of each rate into account.

    Args:
        single: `single_rates` of the arm, if they are known.
        rates: B of a = Bq̇, None for a = q̇.
    """
    tree = RigidTree.of(arm)
    rows = np.eye(tree.nv) if rates is None else rates
    used = np.flatnonzero(weights > 0.0)
    if not len(used):
        return 0.0
    if not np.isfinite(weights).all():
        return np.inf
    single = np.where(weights > 0.0, single_rates(tree, rows) if single is None else single, 0.0)
    if not np.isfinite(single).all():
        return np.inf
    share = weights * single
    share = share / share.sum()
    parts = np.divide(weights**2, share, out=np.zeros(tree.nv), where=share > 0.0)
    return min(up(float(weights @ single)), _largest_rate(tree, (rows.T * parts) @ rows))


def _largest_rate(tree: RigidTree, weight: Float[np.ndarray, "n n"]) -> float:
    """√ of the least C found with q̇ᵀWq̇ ≤ C q̇ᵀMq̇."""
    least = least_by_multipliers(tree, weight).value
    return up(1.0 / np.sqrt(least)) if least > 0.0 else np.inf


def _derivative(tree: RigidTree, shares: dict[int, float], weight: Float[np.ndarray, "n n"] | None) -> float:
    """γ of Σ c_k ∂M/∂q_k, for a joint and its children with their shares c."""
    joint = min(shares)
    if tree.absent[joint] and len(shares) == 1:
        return 0.0
    carried = [k for k in range(joint + 1, tree.nv) if joint in tree.path(k)]
    if tree.prismatic[joint] or tree.prismatic[carried].any():
        return np.inf
    energy, change, conditions = _momenta(tree, shares, carried)
    if not change.matrix.any():
        return 0.0
    more = len(_TURNED) * len(carried)
    unit = energy if weight is None else Motions.of(tree).rates(weight, more)
    # ±change + γ·unit ≥ 0, that is ±change − a·unit ≥ 0 with a = −γ.
    bounds = [
        -largest_multiple(Form(sign * change.matrix, change.size), unit, energy, conditions, 2 * tree.nv).value
        for sign in (1.0, -1.0)
    ]
    return up(max(*bounds, 0.0))


def _momenta(tree: RigidTree, shares: dict[int, float], carried: list[int]) -> tuple[Form, Form, list[Form]]:
    """2T, Σ c_k times its change with q_k, and the conditions, in the coordinates of `Motions` and those of momenta."""
    joint = min(shares)
    motions = Motions.of(tree)
    few = len(motions.energy.matrix)
    m = few + len(_TURNED) * len(carried)
    # In [0] the rows themselves, in [1] the sums of absolute values behind them.
    twist = _widened(motions.twists, m)
    momentum = np.zeros((2, tree.nv, 6, m))
    conditions = [Form(_wide(c.matrix, m), _wide(c.size, m), c.positive) for c in motions.conditions]
    for k in range(tree.nv - 1, joint - 1, -1):
        if k != joint and k not in carried:
            continue
        inertia = tree.spatial_inertia(k)
        momentum[0, k] += inertia @ twist[0, k]
        momentum[1, k] += np.abs(inertia) @ twist[1, k]
        if k == joint:
            continue
        first = few + len(_TURNED) * carried.index(k)
        turned = momentum[:, k].copy()
        turned[:, _TURNED] = 0.0
        turned[:, _TURNED, range(first, first + len(_TURNED))] = 1.0
        placed = placed_twist(tree, k)
        momentum[0, tree.parents[k]] += placed.T @ turned[0]
        momentum[1, tree.parents[k]] += np.abs(placed).T @ turned[1]
        seen = np.stack([placed @ twist[0, tree.parents[k]], np.abs(placed) @ twist[1, tree.parents[k]]])
        conditions += _rotated(_across(twist[:, k], momentum[:, k]), _across(seen, turned))
    change, sums = np.zeros((m, m)), np.zeros((m, m))
    for k, share in shares.items():
        v, omega, linear, angular = _across(twist[:, k], momentum[:, k])
        change += share * (_cross(v[0], linear[0]) + _cross(omega[0], angular[0]))
        sums += abs(share) * (_sums(v[1], linear[1]) + _sums(omega[1], angular[1]))
    return (
        Form(_wide(motions.energy.matrix, m), _wide(motions.energy.size, m)),
        Form(-2.0 * change, 2.0 * sums),
        conditions,
    )


def _rotated(new: list[np.ndarray], old: list[np.ndarray]) -> list[Form]:
    """Products with a momentum that a common rotation about z keeps; those of two twists are among the others."""
    forms = []
    pairs = [(a, b) for a, b in combinations(range(4), 2) if b > 1] + [(2, 2), (3, 3)]
    for a, b in pairs:
        size = _sums(new[a][1], new[b][1]) + _sums(old[a][1], old[b][1])
        forms.append(Form(_dot(new[a][0], new[b][0]) - _dot(old[a][0], old[b][0]), size))
        if a != b:
            forms.append(Form(_cross(new[a][0], new[b][0]) - _cross(old[a][0], old[b][0]), size))
    return forms


def _across(twist: Float[np.ndarray, "2 6 m"], momentum: Float[np.ndarray, "2 6 m"]) -> list[np.ndarray]:
    """v, ω, p, l across z, each with the sums behind it: (2, 2, m)."""
    return [twist[:, :2], twist[:, 3:5], momentum[:, :2], momentum[:, 3:5]]


def _dot(a: Float[np.ndarray, "2 m"], b: Float[np.ndarray, "2 m"]) -> Float[np.ndarray, "m m"]:
    form = a.T @ b
    return 0.5 * (form + form.T)


def _cross(a: Float[np.ndarray, "2 m"], b: Float[np.ndarray, "2 m"]) -> Float[np.ndarray, "m m"]:
    form = np.outer(a[0], b[1]) - np.outer(a[1], b[0])
    return 0.5 * (form + form.T)


def _sums(a: Float[np.ndarray, "2 m"], b: Float[np.ndarray, "2 m"]) -> Float[np.ndarray, "m m"]:
    """Sums of absolute values behind the entries of `_dot` and `_cross`."""
    form = np.outer(a.sum(axis=0), b.sum(axis=0))
    return form + form.T


def _wide(form: Float[np.ndarray, "few few"], m: int) -> Float[np.ndarray, "m m"]:
    wide = np.zeros((m, m))
    wide[: len(form), : len(form)] = form
    return wide


def _widened(rows: Float[np.ndarray, "2 n 6 few"], m: int) -> Float[np.ndarray, "2 n 6 m"]:
    return np.concatenate([rows, np.zeros((*rows.shape[:-1], m - rows.shape[-1]))], axis=-1)
