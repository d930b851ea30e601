"""Rigid trees of revolute and prismatic joints (`tree_layout.py`): torques and accelerations, and the adjoint of each.

Because C(q, v) w is symmetric in v and w, M(q) a + C(q, v) w + G(q) with the Christoffel C (docs/theory.md §1) is one
Newton–Euler pass in which the products of velocities are polarised: outwards the motions, inwards the forces. Its
adjoint is one more pass outwards and inwards (`tree_bodies.py`).

`work` holds a row for the base, which is at rest but for a = −gravity, and one per joint, then two vectors (n,).
"""

import numpy as np

from nbs_pin.kernels import tree_bodies as bodies
from nbs_pin.kernels.jit import kernel
from nbs_pin.kernels.layout import Packed
from nbs_pin.kernels.records import Mat, Motion, State, Vec
from nbs_pin.kernels.spatial import cross, get, plus, put, times, transposed_times
from nbs_pin.kernels.tree_bodies import COMPOSITE, SPIN, V_BAR, A, F, N, P, R, U, V, along, joint_of
from nbs_pin.kernels.tree_layout import ARMATURE, MASS, PER_JOINT, PLACE, ROW, TREE_JOINTS, TREE_SIZE
from nbs_pin.kernels.views import take2


@kernel
def place(q: Vec, tree: Packed, work: Vec) -> None:
    """R and p of every joint → work."""
    for i in range(tree.layout[TREE_SIZE]):
        joint = joint_of(i, tree, work)
        body, row = joint.body, joint.row
        c, s, travel = 1.0, 0.0, joint.slide * q[i]
        if joint.slide == 0.0:
            c, s, travel = np.cos(q[i]), np.sin(q[i]), 0.0
        for k in range(3):
            x, y, z = get(body, 3 * k)
            put(row, 3 * k, (c * x + s * y, c * y - s * x, z))
            row[P + k] = body[PLACE + k] + travel * z


@kernel
def sweep(motion: Motion, tree: Packed, work: Vec) -> None:
    """Motion and force of every body alone, outwards, from R and p in work."""
    for k in range(V, ROW):  # loops: an assignment to a slice would first ask whether the two overlap
        work[k] = 0.0
    put(work, A, get(tree.weights, 0))
    for i in range(tree.layout[TREE_SIZE]):
        joint = joint_of(i, tree, work)
        bodies.move(joint, motion.v[i], motion.w[i], motion.a[i])
        bodies.load(joint)


@kernel
def gather(a: Vec, tree: Packed, work: Vec, tau: Vec) -> None:
    """The torque of every joint, inwards, after `sweep`; tau may be a."""
    for i in range(tree.layout[TREE_SIZE] - 1, -1, -1):
        joint = joint_of(i, tree, work)
        tau[i] = along(joint.slide, joint.row[F + 2], joint.row[N + 2]) + joint.body[ARMATURE] * a[i]
        bodies.hand_force(joint)


@kernel
def tree_torque(motion: Motion, tree: Packed, work: Vec, tau: Vec) -> None:
    """M(q) a + C(q, v) w + G(q) → tau [N·m], by one polarised Newton–Euler pass; C is the Christoffel one."""
    place(motion.q, tree, work)
    sweep(motion, tree, work)
    gather(motion.a, tree, work, tau)


@kernel
def spread(mu: Vec, tree: Packed, work: Vec) -> None:
    """The velocities u and o of every body at the joint velocity μ; its cotangents become 0."""
    for i in range(tree.layout[TREE_SIZE]):
        joint = joint_of(i, tree, work)
        row, up, slide = joint.row, joint.up, joint.slide
        ux, uy, uz = transposed_times(row, R, plus(get(up, U), cross(get(up, SPIN), get(row, P))))
        x, y, z = transposed_times(row, R, get(up, SPIN))
        put(row, U, (ux, uy, uz + slide * mu[i]))
        put(row, SPIN, (x, y, z + (1.0 - slide) * mu[i]))
        for k in range(V_BAR, ROW):
            row[k] = 0.0


@kernel
def tree_torque_adjoint(motion: Motion, mu: Vec, tree: Packed, work: Vec, motion_bar: Motion) -> None:
    """Add the derivatives of μᵀτ, τ of `tree_torque`, with respect to q, v, w and a to motion_bar."""
    place(motion.q, tree, work)
    sweep(motion, tree, work)
    spread(mu, tree, work)
    for i in range(tree.layout[TREE_SIZE] - 1, -1, -1):
        joint, v, w, a = joint_of(i, tree, work), motion.v[i], motion.w[i], motion.a[i]
        bodies.couple(joint)
        dv, dw, da = bodies.joint_bars(joint, v, w)
        motion_bar.v[i] += dv
        motion_bar.w[i] += dw
        motion_bar.a[i] += da + joint.body[ARMATURE] * mu[i]
        x, y, z = bodies.shift_bar(joint, bodies.hand_bars(joint))
        travel_bar = x * joint.row[R + 2] + y * joint.row[R + 5] + z * joint.row[R + 8]
        motion_bar.q[i] += along(joint.slide, travel_bar, bodies.turn_bar(joint, v, w, a, mu[i])[2])
        bodies.hand_force(joint)


@kernel
def tree_mass(tree: Packed, work: Vec, mass: Mat) -> None:
    """The lower triangle of M(q) from R and p in work, by composite bodies: column i is the load of a unit a_i."""
    n = tree.layout[TREE_SIZE]
    for i in range(n):
        joint = joint_of(i, tree, work)
        for k in range(ARMATURE - MASS):
            joint.row[COMPOSITE + k] = joint.body[MASS + k]
        for j in range(n):
            mass[i, j] = 0.0
    for i in range(n - 1, -1, -1):
        joint = joint_of(i, tree, work)
        (m, hx, hy), (exx, _, exz) = get(joint.row, COMPOSITE), get(joint.row, COMPOSITE + 4)
        eyy, eyz, _ = get(joint.row, COMPOSITE + 7)
        force, moment = (0.0, 0.0, m), (hy, -hx, 0.0)
        if joint.slide == 0.0:
            force, moment = (-hy, hx, 0.0), (-exz, -eyz, exx + eyy)
        mass[i, i] = along(joint.slide, force[2], moment[2]) + joint.body[ARMATURE]
        arm, j = joint, tree.layout[TREE_JOINTS + PER_JOINT * i]
        while j > 0:
            force, moment = times(arm.row, R, force), times(arm.row, R, moment)
            moment = plus(moment, cross(get(arm.row, P), force))
            arm = joint_of(j - 1, tree, work)
            mass[i, j - 1] = along(arm.slide, force[2], moment[2])
            j = tree.layout[TREE_JOINTS + PER_JOINT * (j - 1)]
        bodies.join(joint)


@kernel
def _factorise(matrix: Mat) -> None:
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
        row[i] = np.sqrt(rest)


@kernel
def _solve(factor: Mat, x: Vec) -> None:
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
def tree_acceleration(state: State, tau: Vec, tree: Packed, work: Vec, factor: Mat, a: Vec) -> None:
    """M(q)⁻¹(τ − C(q, v) v − G(q)) → a, and the Cholesky factor L of M = LLᵀ, zero above, → factor (n, n)."""
    place(state.q, tree, work)
    a[:] = 0.0
    sweep(Motion(state.q, state.v, state.v, a), tree, work)
    gather(a, tree, work, a)
    for i in range(len(a)):
        a[i] = tau[i] - a[i]
    tree_mass(tree, work, factor)
    _factorise(factor)
    _solve(factor, a)


@kernel
def tree_acceleration_adjoint(
    state: State, a: Vec, a_bar: Vec, tree: Packed, work: Vec, factor: Mat, state_bar: State, tau_bar: Vec
) -> None:
    """Add the derivatives of āᵀa, a of `tree_acceleration`, with respect to q, v and τ to state_bar and tau_bar.

    a and factor: as `tree_acceleration` left them at this q. With μ = M⁻¹ā, δ(āᵀa) = μᵀ(δτ − δ(M a + C v + G)).
    """
    n = len(a)
    mu, unused, _ = take2(work[ROW * (n + 1) :], n)
    mu[:] = a_bar
    _solve(factor, mu)
    for i in range(n):
        tau_bar[i] += mu[i]
        mu[i], unused[i] = -mu[i], 0.0
    motion, bars = Motion(state.q, state.v, state.v, a), Motion(state_bar.q, state_bar.v, state_bar.v, unused)
    tree_torque_adjoint(motion, mu, tree, work, bars)


# The entry points take single arrays: numba takes them apart sooner than tuples of them.


@kernel
def tree_torques(q: Mat, v: Mat, w: Mat, a: Mat, layout: Vec, weights: Vec, work: Vec, tau: Mat) -> None:
    """M(q) a + C(q, v) w + G(q) of many states, with the Christoffel C.

    Args:
        q: positions [rad, m], (rows, n).
        v: velocities [rad/s, m/s].
        w: velocities that C is multiplied by [rad/s, m/s].
        a: accelerations [rad/s², m/s²].
        layout: of the tree, as `tree_layout.pack_tree` packs it.
        weights: of the tree.
        work: scratch space (`tree_layout.tree_workspace`).
        tau: written [N·m, N].
    """
    for k in range(len(q)):
        tree_torque(Motion(q[k], v[k], w[k], a[k]), Packed(layout, weights), work, tau[k])


@kernel
def tree_accelerations(q: Mat, v: Mat, tau: Mat, layout: Vec, weights: Vec, work: Vec, factor: Mat, a: Mat) -> None:
    """M(q)⁻¹(τ − C(q, v) v − G(q)) of many states.

    Args:
        q: positions [rad, m], (rows, n).
        v: velocities [rad/s, m/s].
        tau: torques [N·m, N].
        layout: of the tree, as `tree_layout.pack_tree` packs it.
        weights: of the tree.
        work: scratch space (`tree_layout.tree_workspace`).
        factor: written, the Cholesky factor of the last row's M, (n, n).
        a: written [rad/s², m/s²]; NaN where M is not positive definite.
    """
    for k in range(len(q)):
        tree_acceleration(State(q[k], v[k]), tau[k], Packed(layout, weights), work, factor, a[k])
