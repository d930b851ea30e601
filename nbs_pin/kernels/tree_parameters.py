"""How the torque of a rigid tree depends on the tree: derivatives with respect to placements and bodies.

Row i of a sample is ∂τ_i/∂(−gravity (3), then per joint: turn δ of R₀ → R₀ exp[δ]× (3), p (3), m, h (3), E (6),
armature), τ of `trees.tree_torque` at w = v: μᵀτ with μ the unit vector of joint i, as in `tree_torque_adjoint`.
"""

import numpy as np

from nbs_pin.kernels import tree_bodies as bodies
from nbs_pin.kernels.jit import kernel
from nbs_pin.kernels.layout import Packed
from nbs_pin.kernels.records import Mat, Motion, Vec
from nbs_pin.kernels.spatial import cross, dot, get, plus, put, transposed_times
from nbs_pin.kernels.tree_bodies import A_BAR, SPIN, V_BAR, A, B, Joint, R, U, joint_of
from nbs_pin.kernels.tree_layout import BASE, ROW, TREE_SIZE
from nbs_pin.kernels.trees import gather, place, spread, sweep
from nbs_pin.kernels.views import take

COLUMNS, TURN, SHIFT, INERTIA, ROTOR = 17, 0, 3, 6, 16
"""Derivatives per joint, and where those of δ, p, m, h, E and of the armature begin."""


@kernel
def inertia_bars(joint: Joint, a: float, mu: float, bar: Vec) -> None:
    """u·F + o·N of one body, F = m a + Bh and N = h × a + Σ m x × Bx, is linear in m, h, E and the armature."""
    row = joint.row
    u, a_, (x, y, z) = get(row, U), get(row, A), get(row, SPIN)
    (bxx, bxy, bxz), (byx, byy, byz), (bzx, bzy, bzz) = get(row, B), get(row, B + 3), get(row, B + 6)
    bar[INERTIA], bar[ROTOR] = dot(u, a_), a * mu
    put(bar, INERTIA + 1, plus(transposed_times(row, B, u), cross(a_, (x, y, z))))
    bar[INERTIA + 4] = byx * z - bzx * y
    bar[INERTIA + 5] = bzx * x - bxx * z + byy * z - bzy * y
    bar[INERTIA + 6] = bxx * y - byx * x + byz * z - bzz * y
    bar[INERTIA + 7] = bzy * x - bxy * z
    bar[INERTIA + 8] = bxy * y - byy * x + bzz * x - bxz * z
    bar[INERTIA + 9] = bxz * y - byz * x


@kernel
def _joint_row(motion: Motion, mu: Vec, tree: Packed, work: Vec, bars: Vec) -> None:
    """Derivatives of μᵀτ → bars, after `place`, `sweep` and `gather`."""
    spread(mu, tree, work)
    for k in range(V_BAR, ROW):
        work[k] = 0.0
    for i in range(tree.layout[TREE_SIZE] - 1, -1, -1):
        joint, q, v, a = joint_of(i, tree, work), motion.q[i], motion.v[i], motion.a[i]
        bar = bars[BASE + COLUMNS * i : BASE + COLUMNS * (i + 1)]
        inertia_bars(joint, a, mu[i], bar)
        bodies.couple(joint)
        bodies.joint_bars(joint, v, v)
        x, y, z = bodies.turn_bar(joint, v, v, a, mu[i])
        put(bar, SHIFT, bodies.shift_bar(joint, bodies.hand_bars(joint)))
        if joint.slide == 0.0:  # δ turns R₀, before Rz(q)
            c, s = np.cos(q), np.sin(q)
            put(bar, TURN, (c * x - s * y, s * x + c * y, z))
        else:  # the body travels q along R₀ z, which turns with R₀
            dx, dy, _ = transposed_times(joint.row, R, get(bar, SHIFT))
            put(bar, TURN, (x - joint.slide * q * dy, y + joint.slide * q * dx, z))
    put(bars, 0, get(work, A_BAR))


@kernel
def tree_derivatives(q: Mat, v: Mat, a: Mat, layout: Vec, weights: Vec, work: Vec, tau: Mat, rows: np.ndarray) -> None:
    """Torques M a + C v + G of many states, and how they depend on the tree.

    Args:
        q: positions [rad, m], (m, n).
        v: velocities [rad/s, m/s].
        a: accelerations [rad/s², m/s²].
        layout: of the tree, as `tree_layout.pack_tree` packs it.
        weights: of the tree.
        work: scratch space (`tree_layout.tree_workspace`).
        tau: written, the torques [N·m, N].
        rows: written, their derivatives, (m, n, 3 + 17n) in the order above.
    """
    tree, n = Packed(layout, weights), layout[TREE_SIZE]
    mu, _ = take(work[ROW * (n + 1) :], n)
    for k in range(len(q)):
        motion = Motion(q[k], v[k], v[k], a[k])
        place(motion.q, tree, work)
        sweep(motion, tree, work)
        gather(motion.a, tree, work, tau[k])
        for i in range(n):
            mu[:] = 0.0
            mu[i] = 1.0
            _joint_row(motion, mu, tree, work, rows[k, i])
