"""The extreme eigenvalues of the inertia matrix over all poses, by an S-procedure (docs/certificates.md §6).

The kinetic energy is a constant quadratic form in the bodies' twists, each in its own frame. A revolute joint about z
maps the twist (v, ω) of its parent, placed at the joint, to that of the body: v_z is kept, ω_z gains q̇, and rotation of
the other components keeps ‖v_⊥‖², ‖ω_⊥‖², v_⊥·ω_⊥ and z·(v_⊥×ω_⊥). A prismatic joint at position s keeps ω, adds q̇ to
v_z and s ω×z to v_⊥. These are linear and quadratic conditions without q. Hence, for any multipliers h, energy −
a q̇ᵀWq̇ + Σ h·(forms that are zero) ⪰ 0 on all twists proves aW ⪯ M(q) for all q; upper bounds follow likewise. A
semidefinite program, solved by clarabel, finds good multipliers, and its result is checked here.
"""

from dataclasses import dataclass
from typing import NamedTuple

import clarabel
import numpy as np
from jaxtyping import Bool, Float
from scipy import sparse

from nbs_pin.base.rounding import exceeds_every_perturbation
from nbs_pin.dynamics.rigid_tree import RigidTree, cross

REACH = 1e4
"""Largest multiplier, for forms and energy scaled to order one: larger ones gain nothing and lose precision."""
MARGINS = (1e-7, 1e-6, 1e-5)
"""Margins of positive definiteness, for energy scaled to order one, tried in turn until a solution is proved."""
TIME_LIMIT = 4.0
"""Longest time of one solution [s]; other bounds stand behind it."""
NOTHING = 1e-10
"""Entries below this are zero for the solver, which decomposes the matrix by sparsity, but not for the proof."""


@dataclass(frozen=True, eq=False)
class Form:
    """A quadratic form of the motions, and bounds of the sums of absolute values behind its entries."""

    matrix: Float[np.ndarray, "m m"]
    size: Float[np.ndarray, "m m"]
    positive: bool = False
    """Whether the form is ≤ 0 instead of 0 on the motions of the arm, so that its multiplier must be ≥ 0."""


@dataclass(frozen=True, eq=False)
class Motions:
    """Twists that satisfy the linear conditions, in coordinates x, and quadratic conditions that hold in every pose."""

    energy: Form
    """2T, rotors included."""
    moving: list[int]
    """Indices of q̇ in x."""
    conditions: list[Form]
    twists: Float[np.ndarray, "2 n 6 m"]
    """Twist (v, ω) of each body in its frame as rows in x, and the sums of absolute values behind them."""

    @classmethod
    def of(cls, tree: RigidTree) -> "Motions":
        """The motions of a tree in any pose."""
        free = [_free(tree, i) for i in range(tree.nv)]
        starts = np.cumsum([0, *(len(rows) for rows in free)])
        moving = [int(start) - 1 for start in starts[1:]]
        own, sums, conditions = np.zeros((2, tree.nv, 6, starts[-1])), np.zeros((starts[-1],) * 2), []
        energy = np.zeros_like(sums)
        for i, p in enumerate(tree.parents.tolist()):
            placed = placed_twist(tree, i)
            # own[0] holds the twists and own[1] the sums of absolute values behind them.
            seen = np.stack([placed @ own[0, p], np.abs(placed) @ own[1, p]])
            own[:, i] = seen
            for row, column in zip(free[i], range(starts[i], starts[i + 1]), strict=True):
                if column != moving[i]:
                    own[:, i, row] = 0.0
                own[:, i, row, column] = 1.0
            inertia = tree.spatial_inertia(i)
            energy += own[0, i].T @ inertia @ own[0, i]
            sums += own[1, i].T @ np.abs(inertia) @ own[1, i]
            for matrix in (energy, sums):
                matrix[moving[i], moving[i]] += tree.armature[i]
            conditions += _conditions(tree, i, own[:, i], seen)
        return cls(Form(energy, sums), moving, conditions, own)

    def rates(self, weight: Float[np.ndarray, "n n"], more: int = 0) -> Form:
        """q̇ᵀWq̇ in x, followed by `more` further coordinates."""
        form = np.zeros((len(self.energy.matrix) + more,) * 2)
        form[np.ix_(self.moving, self.moving)] = weight
        return Form(form, np.abs(form))


class Extreme(NamedTuple):
    """A bound of the inertia, and the multipliers that prove it."""

    value: float
    multipliers: tuple[float, ...] | None = None
    """One per condition of `Motions`, for forms in SI units; None without a proof."""


def least_by_multipliers(tree: RigidTree, weight: Float[np.ndarray, "n n"] | None = None) -> Extreme:
    """Nearly tight lower bound of min_q λ_min(W^-½ M(q) W^-½), W = I by default; 0 if no multipliers are found."""
    found = _extreme(tree, np.eye(tree.nv) if weight is None else weight, 1.0)
    return found if found.value > 0.0 else Extreme(0.0)


def largest_by_multipliers(tree: RigidTree, weight: Float[np.ndarray, "n n"]) -> Extreme:
    """Nearly tight upper bound of max_q λ_max(W^-½ M(q) W^-½); inf if no multipliers are found."""
    found = _extreme(tree, weight, -1.0)
    return Extreme(-found.value, found.multipliers) if found.value < 0.0 else Extreme(np.inf)


def signed_least_by_multipliers(tree: RigidTree, weight: Float[np.ndarray, "n n"]) -> float:
    """Lower bound, of either sign, of min_q λ_min(W^-½ M(q) W^-½), for energies that may be negative; −inf if none."""
    return _extreme(tree, weight, 1.0).value


def _extreme(tree: RigidTree, weight: Float[np.ndarray, "n n"], sign: float) -> Extreme:
    """The largest a found with sign·2T ≥ a q̇ᵀWq̇ for all motions; −inf if none is found."""
    motions = Motions.of(tree)
    energy = Form(sign * motions.energy.matrix, motions.energy.size)
    return largest_multiple(energy, motions.rates(weight), motions.energy, motions.conditions, tree.nv)


def largest_multiple(form: Form, unit: Form, energy: Form, conditions: list[Form], terms: int) -> Extreme:
    """The largest a found with form − a·unit ≥ 0 on all motions that satisfy the conditions; −inf without one.

    energy: 2T, for the scales of the motions. terms: length of the sums behind the entries, for their rounding errors.
    """
    m = len(form.matrix)
    diagonal = np.abs(np.diag(energy.matrix))
    scale = 1.0 / np.sqrt(diagonal + 1e-3 * diagonal.mean())
    scales = scale * scale[:, None]
    rated = -unit.matrix * scales
    factor = 1.0 / float(np.linalg.norm(rated, 2))
    scaled = [condition.matrix * scales for condition in conditions]
    norms = np.array([max(float(np.linalg.norm(x)), 1e-300) for x in scaled])
    matrices = np.array([factor * rated, *(x / norm for x, norm in zip(scaled, norms, strict=True))])
    positive = np.array([False, *(condition.positive for condition in conditions)])
    constant, best = form.matrix * scales, Extreme(-np.inf)
    for margin in MARGINS:
        y, solved = maximise(constant - margin * np.eye(m), matrices, positive)
        sums = form.size + np.abs(y[0]) * factor * unit.size
        for h, norm, condition in zip(y[1:], norms, conditions, strict=True):
            sums = sums + abs(h) / norm * condition.size
        # The largest row sum of the errors of the entries is no less than their spectral norm.
        radius = 16.0 * (m + terms) * np.finfo(float).eps * float((sums * scales).sum(axis=1).max())
        if exceeds_every_perturbation(constant + np.tensordot(y, matrices, 1), radius):
            # Undoing the scaling is a congruence, so these multipliers prove it for the forms as they are.
            found = Extreme(float(y[0]) * factor, tuple((y[1:] / norms).tolist()))
            best = max(best, found, key=lambda extreme: extreme.value)
            if solved:
                break
    return best


def maximise(
    constant: Float[np.ndarray, "m m"], terms: Float[np.ndarray, "k m m"], positive: Bool[np.ndarray, " k"]
) -> tuple[Float[np.ndarray, " k"], bool]:
    """Maximise y[0] subject to A₀ + Σ y_i A_i ⪰ 0, |y_i| ≤ REACH for i > 0.

    Returns:
        y, guaranteed only to be finite and ≥ 0 where `positive`, and whether the solver reports success.
    """
    k, m = len(terms), len(constant)
    column, row = np.tril_indices(m)  # the upper triangle, column by column
    flat = np.concatenate([constant[None], terms])[:, row, column] * np.where(row == column, 1.0, np.sqrt(2.0))
    flat[np.abs(flat) < NOTHING] = 0.0
    ones = np.eye(k)
    sides = np.concatenate([-flat[1:].T, -ones[positive], ones[1:], -ones[1:]])
    limits = np.concatenate([flat[0], np.zeros(positive.sum()), np.full(2 * k - 2, REACH)])
    cones = [clarabel.PSDTriangleConeT(m), clarabel.NonnegativeConeT(len(limits) - len(row))]
    nothing, matrix = sparse.csc_array((k, k)), sparse.csc_array(sides)
    try:
        found = clarabel.DefaultSolver(nothing, -ones[0], matrix, limits, cones, _settings()).solve()
    except BaseException as error:  # a panic of the solver is no Exception
        if isinstance(error, KeyboardInterrupt | SystemExit | MemoryError):
            raise
        return np.zeros(k), False
    y = np.nan_to_num(np.array(found.x), posinf=0.0, neginf=0.0)
    return np.where(positive, np.maximum(y, 0.0), y), found.status == clarabel.SolverStatus.Solved


def _settings() -> clarabel.DefaultSettings:
    """Silent, single-threaded, and with tighter tolerances than clarabel's defaults, since y[0] may be small.

    Cliques are merged along their tree: the default search over their graph panics on some trees with two branches, and
    takes minutes for a humanoid of 29 joints that is solved in half a second otherwise, with the same result.
    """
    settings = clarabel.DefaultSettings()
    settings.verbose, settings.max_threads = False, 1
    settings.tol_gap_abs, settings.tol_gap_rel, settings.tol_feas = 1e-12, 1e-7, 1e-9
    settings.chordal_decomposition_merge_method = "parent_child"
    settings.time_limit = TIME_LIMIT
    return settings


def placed_twist(tree: RigidTree, i: int) -> Float[np.ndarray, "6 6"]:
    """Matrix from the parent's twist to that of frame i at q_i = 0; zero on the base."""
    placed = np.zeros((6, 6))
    if tree.parents[i] >= 0:
        back = tree.rotation[i].T
        placed[:3, :3] = placed[3:, 3:] = back
        placed[:3, 3:] = -back @ cross(tree.position[i])
    return placed


def _free(tree: RigidTree, i: int) -> list[int]:
    """Components of the twist (v, ω) that are not linear in the parent's twist, that along q̇ last."""
    if tree.prismatic[i]:
        return [2] if tree.absent[i] else [0, 1, 2]
    return [5] if tree.parents[i] < 0 else [0, 1, 3, 4, 5]


def _conditions(
    tree: RigidTree, i: int, own: Float[np.ndarray, "2 6 m"], seen: Float[np.ndarray, "2 6 m"]
) -> list[Form]:
    """Quadratic conditions on the twists of body i and its parent; [0] holds twists, [1] sums of absolute values."""
    if tree.absent[i]:
        return []
    if not tree.prismatic[i]:
        pairs = [(0, 0, 1, 1, 1.0), (3, 3, 4, 4, 1.0), (0, 3, 1, 4, 1.0), (0, 4, 1, 3, -1.0)]
        return [
            Form(
                _pair(own[0], *pair) - _pair(seen[0], *pair),
                _pair(own[1], *pair[:4], 1.0) + _pair(seen[1], *pair[:4], 1.0),
            )
            for pair in pairs
        ]
    return _sliding_conditions(tree, i, own, seen)


def _sliding_conditions(
    tree: RigidTree, i: int, own: Float[np.ndarray, "2 6 m"], seen: Float[np.ndarray, "2 6 m"]
) -> list[Form]:
    """v_⊥ gains s g with g = ω×z: the gain is parallel to g, and (s − lower)(s − upper)‖g‖² ≤ 0 for bounded travel."""
    gain, sums = own[0, :2] - seen[0, :2], own[1, :2] + seen[1, :2]
    g, size = np.array([seen[0, 4], -seen[0, 3]]), seen[1, [4, 3]]
    rows, totals = np.vstack([gain, g]), np.vstack([sums, size])
    forms = [Form(_pair(rows, 0, 3, 1, 2, -1.0), _pair(totals, 0, 3, 1, 2, 1.0))]
    low, high = float(tree.lower[i]), float(tree.upper[i])
    if np.isfinite([low, high]).all():
        within = (gain - low * g).T @ (gain - high * g)
        most = (sums + abs(low) * size).T @ (sums + abs(high) * size)
        forms.append(Form(0.5 * (within + within.T), 0.5 * (most + most.T), positive=True))
    return forms


def _pair(rows: Float[np.ndarray, "c m"], a: int, b: int, c: int, d: int, sign: float) -> Float[np.ndarray, "m m"]:
    """The quadratic form x_a x_b + sign·x_c x_d of rows of x."""
    form = np.outer(rows[a], rows[b]) + sign * np.outer(rows[c], rows[d])
    return 0.5 * (form + form.T)
