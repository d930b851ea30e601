"""Rigid trees of revolute and prismatic joints (`tree_layout.py`): torques and accelerations, and the adjoint of each.

Because C(q, v) w is symmetric in v and w, M(q) a + C(q, v) w + G(q) with the Christoffel C (docs/theory.md §1) is one
Newton–Euler pass in which the products of velocities are polarised: outwards the motions, inwards the forces. Its
adjoint is one more pass outwards and inwards (`tree_bodies.py`).

`work` holds a row for the base, which is at rest but for a = −gravity, and one per joint.
"""

import math

import numpy as np

from nbs_pin.kernels.jit import kernel
from nbs_pin.kernels.tree_bodies import (
    COMPOSITE,
    SPIN,
    V_BAR,
    A,
    F,
    N,
    P,
    U,
    V,
    couple,
    from_parent,
    hand_bars,
    hand_force,
    join,
    joint_bars,
    load,
    move,
    slide_bar,
    to_parent,
    turn_bar,
)
from nbs_pin.kernels.tree_layout import ARMATURE, BASE, BODY, MASS, ROW, tree_workspace

__all__ = ["tree_acceleration", "tree_acceleration_adjoint", "tree_torque", "tree_torque_adjoint", "tree_workspace"]


@kernel
def place(q: np.ndarray, layout: np.ndarray, weights: np.ndarray, work: np.ndarray) -> None:
    """R and p of every joint → work."""
    for i in range(layout[0]):
        body, row = weights[BASE + BODY * i : BASE + BODY * (i + 1)], work[ROW * (i + 1) : ROW * (i + 2)]
        c, s, slide = 1.0, 0.0, 0.0
        if layout[2 + 2 * i]:
            slide = q[i]
        else:
            c, s = math.cos(q[i]), math.sin(q[i])
        for k in range(3):
            x, y, z = body[3 * k], body[3 * k + 1], body[3 * k + 2]
            row[3 * k], row[3 * k + 1], row[3 * k + 2] = c * x + s * y, c * y - s * x, z
            row[P + k] = body[9 + k] + slide * z


@kernel
def sweep(
    v: np.ndarray, w: np.ndarray, a: np.ndarray, layout: np.ndarray, weights: np.ndarray, work: np.ndarray
) -> None:
    """Motion and force of every body alone, outwards, from R and p in work."""
    for k in range(V, ROW):  # loops: an assignment to a slice would first ask whether the two overlap
        work[k] = 0.0
    for k in range(3):
        work[A + k] = weights[k]
    for i in range(layout[0]):
        at = layout[1 + 2 * i] * ROW
        row = work[ROW * (i + 1) : ROW * (i + 2)]
        move(float(layout[2 + 2 * i]), v[i], w[i], a[i], work[at : at + ROW], row)
        load(weights[BASE + BODY * i : BASE + BODY * (i + 1)], row)


@kernel
def gather(a: np.ndarray, layout: np.ndarray, weights: np.ndarray, work: np.ndarray, tau: np.ndarray) -> None:
    """The torque of every joint, inwards, after `sweep`; tau may be a."""
    for i in range(layout[0] - 1, -1, -1):
        at = layout[1 + 2 * i] * ROW
        row = work[ROW * (i + 1) : ROW * (i + 2)]
        along = row[F + 2] if layout[2 + 2 * i] else row[N + 2]
        tau[i] = along + weights[BASE + BODY * i + ARMATURE] * a[i]
        hand_force(row, work[at : at + ROW])


@kernel
def tree_torque(
    q: np.ndarray,
    v: np.ndarray,
    w: np.ndarray,
    a: np.ndarray,
    layout: np.ndarray,
    weights: np.ndarray,
    work: np.ndarray,
    tau: np.ndarray,
) -> None:
    """M(q) a + C(q, v) w + G(q) → tau [N·m], by one polarised Newton–Euler pass; C is the Christoffel one."""
    place(q, layout, weights, work)
    sweep(v, w, a, layout, weights, work)
    gather(a, layout, weights, work, tau)


@kernel
def spread(mu: np.ndarray, layout: np.ndarray, work: np.ndarray) -> None:
    """The velocities u and o of every body at the joint velocity μ."""
    for i in range(layout[0]):
        at, slide = layout[1 + 2 * i] * ROW, float(layout[2 + 2 * i])
        up, row = work[at : at + ROW], work[ROW * (i + 1) : ROW * (i + 2)]
        x, y, z = up[SPIN], up[SPIN + 1], up[SPIN + 2]
        px, py, pz = row[P], row[P + 1], row[P + 2]
        ux, uy, uz = from_parent(row, up[U] + y * pz - z * py, up[U + 1] + z * px - x * pz, up[U + 2] + x * py - y * px)
        x, y, z = from_parent(row, x, y, z)
        row[U], row[U + 1], row[U + 2] = ux, uy, uz + slide * mu[i]
        row[SPIN], row[SPIN + 1], row[SPIN + 2] = x, y, z + (1.0 - slide) * mu[i]
        for k in range(V_BAR, ROW):
            row[k] = 0.0


@kernel
def tree_torque_adjoint(
    q: np.ndarray,
    v: np.ndarray,
    w: np.ndarray,
    a: np.ndarray,
    mu: np.ndarray,
    layout: np.ndarray,
    weights: np.ndarray,
    work: np.ndarray,
    q_bar: np.ndarray,
    v_bar: np.ndarray,
    w_bar: np.ndarray,
    a_bar: np.ndarray,
) -> None:
    """Add the derivatives of μᵀτ, τ of `tree_torque`, with respect to q, v, w and a to the arrays named last."""
    place(q, layout, weights, work)
    sweep(v, w, a, layout, weights, work)
    spread(mu, layout, work)
    for i in range(layout[0] - 1, -1, -1):
        at, slide = layout[1 + 2 * i] * ROW, layout[2 + 2 * i]
        body = weights[BASE + BODY * i : BASE + BODY * (i + 1)]
        up, row = work[at : at + ROW], work[ROW * (i + 1) : ROW * (i + 2)]
        couple(body, row)
        dv, dw, da = joint_bars(float(slide), v[i], w[i], row)
        v_bar[i] += dv
        w_bar[i] += dw
        a_bar[i] += da + body[ARMATURE] * mu[i]
        x, y, z = hand_bars(row, up)
        q_bar[i] += slide_bar(x, y, z, row, up) if slide else turn_bar(v[i], w[i], row)
        hand_force(row, up)


@kernel
def _mass(layout: np.ndarray, weights: np.ndarray, work: np.ndarray, mass: np.ndarray) -> None:
    """The lower triangle of M(q) from R and p in work, by composite bodies: column i is the load of a unit a_i."""
    for i in range(layout[0]):
        start, at = ROW * (i + 1) + COMPOSITE, BASE + BODY * i
        for k in range(ARMATURE - MASS):
            work[start + k] = weights[at + MASS + k]
        for j in range(layout[0]):
            mass[i, j] = 0.0
    for i in range(layout[0] - 1, -1, -1):
        row = work[ROW * (i + 1) : ROW * (i + 2)]
        at, hx, hy = COMPOSITE + 4, row[COMPOSITE + 1], row[COMPOSITE + 2]
        if layout[2 + 2 * i]:
            fx, fy, fz, x, y, z = 0.0, 0.0, row[COMPOSITE], hy, -hx, 0.0
            mass[i, i] = fz
        else:
            fx, fy, fz, x, y, z = -hy, hx, 0.0, -row[at + 2], -row[at + 4], row[at] + row[at + 3]
            mass[i, i] = z
        mass[i, i] += weights[BASE + BODY * i + ARMATURE]
        j = i
        while layout[1 + 2 * j] > 0:
            arm = work[ROW * (j + 1) : ROW * (j + 2)]
            j = layout[1 + 2 * j] - 1
            px, py, pz = arm[P], arm[P + 1], arm[P + 2]
            fx, fy, fz = to_parent(arm, fx, fy, fz)
            x, y, z = to_parent(arm, x, y, z)
            x, y, z = x + py * fz - pz * fy, y + pz * fx - px * fz, z + px * fy - py * fx
            mass[i, j] = fz if layout[2 + 2 * j] else z
        up = layout[1 + 2 * i] * ROW
        join(row, work[up : up + ROW])


@kernel
def _factorise(matrix: np.ndarray) -> None:
    """The lower triangle of a positive definite matrix becomes its Cholesky factor; not a number where it is none."""
    for i in range(len(matrix)):
        row = matrix[i]
        rest = row[i]
        for j in range(i):
            other, share = matrix[j], row[j]
            for k in range(j):
                share -= row[k] * other[k]
            share /= other[j]
            row[j] = share
            rest -= share * share
        row[i] = math.sqrt(rest)


@kernel
def _solve(factor: np.ndarray, x: np.ndarray) -> None:
    """Solve LLᵀ x = b, with b in x."""
    n = len(factor)
    for i in range(n):
        total = x[i]
        for k in range(i):
            total -= factor[i, k] * x[k]
        x[i] = total / factor[i, i]
    for i in range(n - 1, -1, -1):
        total = x[i] / factor[i, i]
        x[i] = total
        for k in range(i):
            x[k] -= factor[i, k] * total


@kernel
def tree_acceleration(
    q: np.ndarray,
    v: np.ndarray,
    tau: np.ndarray,
    layout: np.ndarray,
    weights: np.ndarray,
    work: np.ndarray,
    factor: np.ndarray,
    a: np.ndarray,
) -> None:
    """M(q)⁻¹(τ − C(q, v) v − G(q)) → a, and the Cholesky factor L of M = LLᵀ, zero above, → factor (n, n)."""
    place(q, layout, weights, work)
    a[:] = 0.0
    sweep(v, v, a, layout, weights, work)
    gather(a, layout, weights, work, a)
    for i in range(layout[0]):
        a[i] = tau[i] - a[i]
    _mass(layout, weights, work, factor)
    _factorise(factor)
    _solve(factor, a)


@kernel
def tree_acceleration_adjoint(
    q: np.ndarray,
    v: np.ndarray,
    a: np.ndarray,
    a_bar: np.ndarray,
    layout: np.ndarray,
    weights: np.ndarray,
    work: np.ndarray,
    factor: np.ndarray,
    q_bar: np.ndarray,
    v_bar: np.ndarray,
    tau_bar: np.ndarray,
) -> None:
    """Add the derivatives of āᵀa, a of `tree_acceleration`, with respect to q, v and τ to the arrays named last.

    a and factor: as `tree_acceleration` left them at this q. With μ = M⁻¹ā, δ(āᵀa) = μᵀ(δτ − δ(M a + C v + G)).
    """
    n = layout[0]
    at = ROW * (n + 1)
    mu, unused = work[at : at + n], work[at + n : at + 2 * n]
    mu[:] = a_bar
    _solve(factor, mu)
    for i in range(n):
        tau_bar[i] += mu[i]
        mu[i], unused[i] = -mu[i], 0.0
    tree_torque_adjoint(q, v, v, a, mu, layout, weights, work[:at], q_bar, v_bar, v_bar, unused)
