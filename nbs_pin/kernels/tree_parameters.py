"""How the torque of a rigid tree depends on the tree: derivatives with respect to placements and bodies.

Row i of a sample is ∂τ_i/∂(−gravity (3), then per joint: turn δ of R₀ → R₀ exp[δ]× (3), p (3), m, h (3), E (6),
armature), τ of `trees.tree_torque` at w = v: μᵀτ with μ the unit vector of joint i, as in `tree_torque_adjoint`.
"""

import math

import numpy as np

from nbs_pin.kernels.jit import kernel
from nbs_pin.kernels.tree_bodies import (
    A_BAR,
    ALPHA,
    ALPHA_BAR,
    SPIN,
    V_BAR,
    W_BAR,
    A,
    B,
    F,
    N,
    U,
    V,
    couple,
    from_parent,
    hand_bars,
    joint_bars,
    to_parent,
)
from nbs_pin.kernels.tree_layout import BASE, BODY, ROW
from nbs_pin.kernels.trees import gather, place, spread, sweep

COLUMNS, INERTIA, ROTOR = 17, 6, 16
"""Derivatives per joint, and where those of m, h, E and of the armature begin, after δ (at 0) and p (at 3)."""


@kernel
def _inertia_bars(a: float, mu: float, row: np.ndarray, bar: np.ndarray) -> None:
    """u·F + o·N of one body, F = m a + Bh and N = h × a + Σ m x × Bx, is linear in m, h, E and the armature."""
    ux, uy, uz, x, y, z = row[U], row[U + 1], row[U + 2], row[SPIN], row[SPIN + 1], row[SPIN + 2]
    ax, ay, az = row[A], row[A + 1], row[A + 2]
    bxx, bxy, bxz = row[B], row[B + 1], row[B + 2]
    byx, byy, byz = row[B + 3], row[B + 4], row[B + 5]
    bzx, bzy, bzz = row[B + 6], row[B + 7], row[B + 8]
    bar[INERTIA] = ux * ax + uy * ay + uz * az
    bar[INERTIA + 1] = bxx * ux + byx * uy + bzx * uz + ay * z - az * y
    bar[INERTIA + 2] = bxy * ux + byy * uy + bzy * uz + az * x - ax * z
    bar[INERTIA + 3] = bxz * ux + byz * uy + bzz * uz + ax * y - ay * x
    bar[INERTIA + 4] = byx * z - bzx * y
    bar[INERTIA + 5] = bzx * x - bxx * z + byy * z - bzy * y
    bar[INERTIA + 6] = bxx * y - byx * x + byz * z - bzz * y
    bar[INERTIA + 7] = bzy * x - bxy * z
    bar[INERTIA + 8] = bxy * y - byy * x + bzz * x - bxz * z
    bar[INERTIA + 9] = bxz * y - byz * x
    bar[ROTOR] = a * mu


@kernel
def _turn_bars(q: float, v: float, a: float, mu: float, slide: float, row: np.ndarray, bar: np.ndarray) -> None:
    """Derivative with respect to δ: Σ ȳ × y over all y = Rᵀ(…) that the body has from its parent, before Rz(q)."""
    turn = 1.0 - slide
    kx, ky = 2.0 * row[V + 1] * v, 2.0 * row[V] * v
    rx, ry, rz = 0.0, 0.0, 0.0
    for k in range(5):
        if k == 0:  # ω, and ω' which is the same, so that their cotangents add
            at, x, y, z = V_BAR, row[V], row[V + 1], row[V + 2] - turn * v
            bx, by, bz = row[at] + row[W_BAR], row[at + 1] + row[W_BAR + 1], row[at + 2] + row[W_BAR + 2]
        else:
            if k == 1:
                at = ALPHA_BAR
                x, y, z = row[ALPHA] - 0.5 * turn * kx, row[ALPHA + 1] + 0.5 * turn * ky, row[ALPHA + 2] - turn * a
            elif k == 2:
                at, x, y, z = A_BAR, row[A] - slide * kx, row[A + 1] + slide * ky, row[A + 2] - slide * a
            elif k == 3:
                at, x, y, z = F, row[U], row[U + 1], row[U + 2] - slide * mu
            else:
                at, x, y, z = N, row[SPIN], row[SPIN + 1], row[SPIN + 2] - turn * mu
            bx, by, bz = row[at], row[at + 1], row[at + 2]
        rx += by * z - bz * y
        ry += bz * x - bx * z
        rz += bx * y - by * x
    c, s = (1.0, 0.0) if slide else (math.cos(q), math.sin(q))
    bar[0], bar[1], bar[2] = c * rx - s * ry, s * rx + c * ry, rz


@kernel
def _position_bars(x: float, y: float, z: float, row: np.ndarray, up: np.ndarray, bar: np.ndarray) -> None:
    """Derivative with respect to p, with R ā in x, y, z: Bᵀ R ā + R F × o of the parent."""
    fx, fy, fz = to_parent(row, row[F], row[F + 1], row[F + 2])
    sx, sy, sz = up[SPIN], up[SPIN + 1], up[SPIN + 2]
    bar[3] = up[B] * x + up[B + 3] * y + up[B + 6] * z + fy * sz - fz * sy
    bar[4] = up[B + 1] * x + up[B + 4] * y + up[B + 7] * z + fz * sx - fx * sz
    bar[5] = up[B + 2] * x + up[B + 5] * y + up[B + 8] * z + fx * sy - fy * sx


@kernel
def _joint_row(
    q: np.ndarray,
    v: np.ndarray,
    a: np.ndarray,
    mu: np.ndarray,
    layout: np.ndarray,
    weights: np.ndarray,
    work: np.ndarray,
    bars: np.ndarray,
) -> None:
    """Derivatives of μᵀτ → bars, after `place`, `sweep` and `gather`."""
    spread(mu, layout, work)
    for k in range(V_BAR, ROW):
        work[k] = 0.0
    for i in range(layout[0] - 1, -1, -1):
        at, slide = layout[1 + 2 * i] * ROW, float(layout[2 + 2 * i])
        up, row = work[at : at + ROW], work[ROW * (i + 1) : ROW * (i + 2)]
        bar = bars[BASE + COLUMNS * i : BASE + COLUMNS * (i + 1)]
        _inertia_bars(a[i], mu[i], row, bar)
        couple(weights[BASE + BODY * i : BASE + BODY * (i + 1)], row)
        joint_bars(slide, v[i], v[i], row)
        _turn_bars(q[i], v[i], a[i], mu[i], slide, row, bar)
        x, y, z = hand_bars(row, up)
        _position_bars(x, y, z, row, up, bar)
        if slide:  # the body travels q along R₀ z, which turns with R₀
            x, y, _ = from_parent(row, bar[3], bar[4], bar[5])
            bar[0] -= q[i] * y
            bar[1] += q[i] * x
    bars[0], bars[1], bars[2] = work[A_BAR], work[A_BAR + 1], work[A_BAR + 2]


@kernel
def tree_derivatives(
    q: np.ndarray,
    v: np.ndarray,
    a: np.ndarray,
    layout: np.ndarray,
    weights: np.ndarray,
    work: np.ndarray,
    tau: np.ndarray,
    rows: np.ndarray,
) -> None:
    """Rows (m, n) of states → torques M a + C v + G (m, n) and their derivatives (m, n, 3 + 17n)."""
    n = layout[0]
    mu = work[ROW * (n + 1) : ROW * (n + 1) + n]
    for k in range(len(q)):
        place(q[k], layout, weights, work)
        sweep(v[k], v[k], a[k], layout, weights, work)
        gather(a[k], layout, weights, work, tau[k])
        for i in range(n):
            mu[:] = 0.0
            mu[i] = 1.0
            _joint_row(q[k], v[k], a[k], mu, layout, weights, work, rows[k, i])
