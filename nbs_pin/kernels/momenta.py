"""Generalised momentum of rigid trees, and the momentum observer's step (docs/theory.md §9).

Behind joint i, its body and all further ones have the momentum F and the angular momentum N about the origin of the
joint's frame. With S the axis of the joint, p_i = S·(F, N); and as q_i enters the kinetic energy T = ½vᵀM v only
through the motion (u, o) of the parent as seen in that frame, ∂T/∂q_i = (F, N)·((u, o) × S):

    revolute    p_i = N·z,  ∂T/∂q_i = F·(u × z) + N·(o × z)
    prismatic   p_i = F·z,  ∂T/∂q_i = F·(o × z)

which is (Cᵀv)_i for the Christoffel C. Gravity needs the mass and the first moment of the same bodies.
"""

import numpy as np
from numba import boolean, float64, int64, void

from nbs_pin.kernels.jit import compile_for, inlined, kernel
from nbs_pin.kernels.layout import Packed
from nbs_pin.kernels.records import Mat, State, Vec
from nbs_pin.kernels.spatial import add, cross, dot, get, plus, put, scaled, times, transposed_times
from nbs_pin.kernels.tree_bodies import (
    COMPOSITE,
    SPIN,
    A,
    F,
    Joint,
    N,
    P,
    R,
    U,
    along,
    hand_force,
    joint_of,
    second_moments,
)
from nbs_pin.kernels.tree_layout import ARMATURE, FIRST, MASS, ROW, TREE_SIZE
from nbs_pin.kernels.trees import place

GAIN, VISCOUS, COULOMB, TRANSITION, CONSTANTS = range(5)
"""Rows of an observer's constants, and how many: K_o [1/s], friction [N·m·s/rad, N·m], its transition [rad/s]."""
MOMENTUM, KNOWN, TORQUE, MEMORY = range(4)
"""Rows of what an observer remembers, and how many: p, β and the estimate."""

_INTS, _VEC, _MAT = int64[::1], float64[::1], float64[:, ::1]


def compile_momenta() -> None:
    """Compile the entry points for float64, so that no first call waits for the compiler."""
    compile_for(tree_momenta, void(_MAT, _MAT, _INTS, _VEC, _VEC, _MAT, _MAT))
    compile_for(filtered, void(_VEC, _VEC, _MAT, _MAT))
    compile_for(observe, boolean(_VEC, _VEC, _VEC, float64, _MAT, _INTS, _VEC, _VEC, _MAT, _MAT))


@inlined
def _move(joint: Joint, v: float) -> None:
    """The velocities u and o of a body, its momenta F and N, −gravity, m and h, all in its own frame."""
    body, row, up, slide = joint.body, joint.row, joint.up, joint.slide
    ux, uy, uz = transposed_times(row, R, plus(get(up, U), cross(get(up, SPIN), get(row, P))))
    x, y, z = transposed_times(row, R, get(up, SPIN))
    u, o = (ux, uy, uz + slide * v), (x, y, z + (1.0 - slide) * v)
    h, (ex, ey, ez) = get(body, FIRST), second_moments(body)
    spread = plus(scaled(ex[0] + ey[1] + ez[2], o), scaled(-1.0, (dot(ex, o), dot(ey, o), dot(ez, o))))
    put(row, U, u)
    put(row, SPIN, o)
    put(row, F, plus(scaled(body[MASS], u), cross(o, h)))
    put(row, N, plus(cross(h, u), spread))
    put(row, A, transposed_times(row, R, get(up, A)))
    row[COMPOSITE] = body[MASS]
    put(row, COMPOSITE + 1, h)


@kernel
def tree_momentum(state: State, tree: Packed, work: Vec, p: Vec, beta: Vec) -> None:
    """p = M(q) v and C(q, v)ᵀv − G(q) = ∂/∂q(½vᵀM v − V) → p, beta; two passes over the bodies, without a matrix."""
    n = tree.layout[TREE_SIZE]
    place(state.q, tree, work)
    for k in range(ROW):  # the base is at rest
        work[k] = 0.0
    put(work, A, get(tree.weights, 0))
    for i in range(n):
        _move(joint_of(i, tree, work), state.v[i])
    for i in range(n - 1, -1, -1):
        joint = joint_of(i, tree, work)
        row, up, slide = joint.row, joint.up, joint.slide
        force, moment, m, h = get(row, F), get(row, N), row[COMPOSITE], get(row, COMPOSITE + 1)
        ux, uy, _ = get(row, U)
        x, y, _ = get(row, SPIN)
        linear, turning = force[0] * y - force[1] * x, moment[0] * y - moment[1] * x
        gravity = along(slide, m * row[A + 2], cross(h, get(row, A))[2])
        p[i] = along(slide, force[2], moment[2]) + joint.body[ARMATURE] * state.v[i]
        beta[i] = along(slide, linear, turning + force[0] * uy - force[1] * ux) - gravity
        hand_force(joint)
        up[COMPOSITE] += m
        add(up, COMPOSITE + 1, plus(times(row, R, h), scaled(m, get(row, P))))


@kernel
def tree_momenta(q: Mat, v: Mat, layout: Vec, weights: Vec, work: Vec, p: Mat, beta: Mat) -> None:
    """M(q) v and C(q, v)ᵀv − G(q) of many states.

    Args:
        q: positions [rad, m], (rows, n).
        v: velocities [rad/s, m/s].
        layout: of the tree, as `tree_layout.pack_tree` packs it.
        weights: of the tree.
        work: scratch space (`tree_layout.tree_workspace`).
        p: written [N·m·s, N·s].
        beta: written [N·m, N].
    """
    for k in range(len(q)):
        tree_momentum(State(q[k], v[k]), Packed(layout, weights), work, p[k], beta[k])


@kernel
def filtered(rate: Vec, gain: Vec, mean: Mat, torque: Mat) -> None:
    """r_k+1 = r_k + (1 − exp(−K h_k))(τ̄_k − r_k) down the rows of torque, whose first one is given.

    Args:
        rate: periods h_k [s], (rows − 1,).
        gain: K of every column [1/s].
        mean: τ̄, the mean external torque over each period [N·m, N], (rows − 1, columns).
        torque: written from the second row on [N·m, N], (rows, columns).
    """
    for k in range(len(rate)):
        for i in range(len(gain)):
            torque[k + 1, i] = torque[k, i] - np.expm1(-gain[i] * rate[k]) * (mean[k, i] - torque[k, i])


@kernel
def observe(
    q: Vec, v: Vec, tau: Vec, period: float, constants: Mat, layout: Vec, weights: Vec, work: Vec, before: Mat,
    after: Mat,
) -> bool:  # fmt: skip
    """One step of the observer of a rigid tree → after; False where a length is not n or a result is not finite.

    Args:
        q: position now [rad, m].
        v: velocity now [rad/s, m/s].
        tau: torque that has acted since the instant before [N·m, N].
        period: time since then [s].
        constants: (`CONSTANTS`, n) of the observer.
        layout: of the tree, as `tree_layout.pack_tree` packs it.
        weights: of the tree.
        work: scratch space (`tree_layout.tree_workspace`).
        before: (`MEMORY`, n) of the instant before.
        after: written, (`MEMORY`, n).
    """
    n = layout[TREE_SIZE]
    if not (len(q) == n and len(v) == n and len(tau) == n and before.shape[1] == n):
        return False
    tree_momentum(State(q, v), Packed(layout, weights), work, after[MOMENTUM], after[KNOWN])
    size = 0.0
    for i in range(n):
        after[KNOWN, i] -= constants[VISCOUS, i] * v[i] + constants[COULOMB, i] * np.tanh(
            v[i] / constants[TRANSITION, i]
        )
        known = tau[i] + 0.5 * (before[KNOWN, i] + after[KNOWN, i])
        mean, last = (after[MOMENTUM, i] - before[MOMENTUM, i]) / period - known, before[TORQUE, i]
        after[TORQUE, i] = last - np.expm1(-constants[GAIN, i] * period) * (mean - last)
        size += abs(after[TORQUE, i])
    return bool(np.isfinite(size))
