"""Kernels of all laws: v_r, a_r and feedback of τ = M(q)a_r + C(q, v)v_r + G(q) + feedback, and τ on a rigid tree."""

import math

import numpy as np
from numba import boolean, float64, int64

from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.kernels import layout as at
from nbs_pin.kernels.convex import potential
from nbs_pin.kernels.damping import damping_force
from nbs_pin.kernels.jit import compile_for, exact_kernel, inlined, kernel
from nbs_pin.kernels.layout import LawCode, Packed, known
from nbs_pin.kernels.records import PID, Dual, Mat, Memory, Motion, Signals, State, Target, Tracking, Vec
from nbs_pin.kernels.tree_layout import tree_workspace
from nbs_pin.kernels.trees import tree_torque
from nbs_pin.kernels.views import damping_in, numbers, pid_of, potential_in, row, take2, take3, take4, vector

_TURN = 2.0 * math.pi
_VEC, _MAT, _PACKED = float64[::1], float64[:, ::1], (int64[::1], float64[::1])


def compile_laws() -> None:
    """Compile `law_signals` and `pid` for float64, so that no first call waits for the compiler."""
    compile_for(law_signals, boolean(*[_VEC] * 5, *_PACKED, _VEC, _MAT))
    compile_for(pid, boolean(*[_VEC] * 6, float64, _VEC, _MAT))


def compile_tree_law() -> None:
    """Compile `tree_law` for float64, so that no first call waits for the compiler."""
    compile_for(tree_law, boolean(*[_VEC] * 5, *_PACKED, _VEC, _VEC))


def law_workspace(law: Packed, tree: Packed | None = None) -> int:
    """Size of the scratch space that `law_signals` or `tree_law` needs.

    Args:
        law: a law with a model of the arm, as `layout.pack_law` packs it.
        tree: that model for `tree_law`.

    Raises:
        ArgumentError: for a law that no kernel knows, and for a PID, which has no model.
    """
    if known(int(law.layout[at.LAW]), LawCode, "law") is LawCode.PID:
        raise ArgumentError("a PID was given as a law with a model of the arm; compile the PID itself.")
    signals = int(law.layout[at.SCRATCH])
    return signals if tree is None else 3 * int(law.layout[at.JOINTS]) + max(signals, tree_workspace(tree))


def pack_tree_law(law: Packed, tree: Packed) -> Packed:
    """A law and its model for `tree_law`: where the tree begins in layout and weights, the law, the tree.

    Args:
        law: the law, as `layout.pack_law` packs it.
        tree: the model, as `tree_layout.pack_tree` packs it.
    """
    starts = [2 + len(law.layout), len(law.weights)]
    return Packed(np.concatenate([starts, law.layout, tree.layout]), np.concatenate([law.weights, tree.weights]))


@exact_kernel
def difference(q: Vec, q_ref: Vec, wraps: Vec, z1: Vec) -> None:
    """The error q ⊖ q_ref → z1 [rad] as `robot.configuration_difference` has it, wrapped where `wraps` is 1."""
    for i in range(len(q)):
        z1[i] = q[i] - q_ref[i]
        if wraps[i] > 0.0:
            z1[i] -= _TURN * np.ceil((z1[i] - math.pi) / _TURN)


@inlined
def errors(state: State, target: Target, law: Packed, z1: Vec, dz1: Vec) -> Tracking:
    """z1 = q ⊖ q_ref and ż1 = v − v_ref, with what else a law reads of the two."""
    difference(state.q, target.q, vector(law, at.WRAPS), z1)
    for i in range(len(dz1)):
        dz1[i] = state.v[i] - target.v[i]
    return Tracking(z1, dz1, state.v, target.v, target.a)


@inlined
def friction(law: Packed, v: Vec, torque: Vec) -> None:
    """Add viscous·v + coulomb·tanh(v/transition) [N·m] to torque."""
    viscous, coulomb, transition = vector(law, at.VISCOUS), vector(law, at.COULOMB), numbers(law)[at.TRANSITION]
    for i in range(len(v)):
        torque[i] += viscous[i] * v[i] + coulomb[i] * math.tanh(v[i] / transition)


@inlined
def backstepping(now: Tracking, law: Packed, work: Vec, out: Signals) -> None:
    """v_r = φ, a_r = φ̇ − ωz2, feedback = −∇Φ(z1) − D(z2)z2 (docs/theory.md §2)."""
    n, rate, omega = len(now.v), vector(law, at.FIRST), numbers(law)[at.OMEGA]
    gradient, product, z2, force, work = take4(work, n)
    potential(Dual(now.z1, now.dz1), potential_in(law), work, Dual(gradient, product))
    for i in range(n):
        out.v_r[i] = now.v_ref[i] - rate[i] * gradient[i]
        z2[i] = now.v[i] - out.v_r[i]
        out.a_r[i] = now.a_ref[i] - rate[i] * product[i] - omega * z2[i]
    damping_force(z2, damping_in(law), work, force)
    for i in range(n):
        out.feedback[i] = -gradient[i] - force[i]


@inlined
def linear_law(now: Tracking, law: Packed, out: Signals) -> None:
    """Slotine–Li, computed torque and PD: the same signals without networks; of any other law NaN."""
    code, first, second = law.layout[at.LAW], vector(law, at.FIRST), vector(law, at.SECOND)
    for i in range(len(now.v)):
        v_r, a_r, feedback = math.nan, math.nan, math.nan
        pd = -first[i] * now.z1[i] - second[i] * now.dz1[i]
        if code == LawCode.SLOTINE_LI:
            v_r, a_r = now.v_ref[i] - first[i] * now.z1[i], now.a_ref[i] - first[i] * now.dz1[i]
            feedback = -second[i] * (now.v[i] - v_r)
        elif code == LawCode.COMPUTED_TORQUE:
            v_r, a_r, feedback = now.v[i], now.a_ref[i] + pd, 0.0
        elif code == LawCode.PD_REFERENCE:
            v_r, a_r, feedback = now.v_ref[i], now.a_ref[i], pd
        elif code == LawCode.PD_GRAVITY:
            v_r, a_r, feedback = 0.0, 0.0, pd
        out.v_r[i], out.a_r[i], out.feedback[i] = v_r, a_r, feedback


@inlined
def signals_of(state: State, target: Target, law: Packed, work: Vec, out: Signals) -> None:
    """v_r, a_r and feedback of one state."""
    z1, dz1, work = take2(work, len(state.q))
    now, code = errors(state, target, law, z1, dz1), law.layout[at.LAW]
    if code == LawCode.BACKSTEPPING:
        backstepping(now, law, work, out)
    else:
        linear_law(now, law, out)
    if law.layout[at.FRICTION]:
        at_v_r = code == LawCode.BACKSTEPPING or code == LawCode.SLOTINE_LI
        friction(law, out.v_r if at_v_r else now.v_ref, out.feedback)


@kernel
def torque_of(state: State, target: Target, law: Packed, tree: Packed, work: Vec, tau: Vec) -> None:
    """M a_r + C v_r + G + feedback [N·m] of one state → tau."""
    n = len(tau)
    v_r, a_r, feedback, work = take3(work, n)
    signals_of(state, target, law, work, Signals(v_r, a_r, feedback))
    # Gravity alone does not depend on v: a v that is no number must not spoil it.
    v = v_r if law.layout[at.LAW] == LawCode.PD_GRAVITY else state.v
    tree_torque(Motion(state.q, v, v_r, a_r), tree, work, tau)
    for i in range(n):
        tau[i] += feedback[i]


@inlined
def fit(n: int, size: int, vectors: tuple[Vec, ...]) -> bool:
    """Whether all are `size` long, and that a multiple of n."""
    for x in vectors:
        if len(x) != size:
            return False
    return size % n == 0


@inlined
def is_finite(x: Vec) -> bool:
    """Whether all numbers are finite."""
    nothing = 0.0
    for y in x:
        nothing += 0.0 * y  # NaN if y is not finite
    return nothing == 0.0


# The entry points at control rate take single arrays: numba takes them apart sooner than tuples of them.


@kernel
def law_signals(
    q: Vec, v: Vec, q_ref: Vec, v_ref: Vec, a_ref: Vec, layout: Vec, weights: Vec, work: Vec, out: Mat
) -> bool:
    """The signals of a law in τ = M(q) a_r + C(q, v) v_r + G(q) + feedback.

    Args:
        q: position [rad] of any number of states laid end to end, n numbers each.
        v: velocity [rad/s].
        q_ref: desired position [rad].
        v_ref: desired velocity [rad/s].
        a_ref: desired acceleration [rad/s²].
        layout: of the law, as `layout.pack_law` packs it.
        weights: of the law.
        work: scratch space (`law_workspace`).
        out: written, rows v_r [rad/s], a_r [rad/s²] and feedback [N·m], each as long as q.

    Returns:
        Whether all are as long as the rows of out, a multiple of n; nothing is done otherwise.
    """
    law, size = Packed(layout, weights), out.shape[1]
    n = law.layout[at.JOINTS]
    if not fit(n, size, (q, v, q_ref, v_ref, a_ref)):
        return False
    for k in range(size // n):
        target = Target(row(q_ref, k, n), row(v_ref, k, n), row(a_ref, k, n))
        signals = Signals(row(out[0], k, n), row(out[1], k, n), row(out[2], k, n))
        signals_of(State(row(q, k, n), row(v, k, n)), target, law, work, signals)
    return True


@kernel
def tree_law(
    q: Vec, v: Vec, q_ref: Vec, v_ref: Vec, a_ref: Vec, layout: Vec, weights: Vec, work: Vec, tau: Vec
) -> bool:
    """The torque of a law whose model of the arm is a rigid tree.

    Args:
        q: position [rad] of any number of states laid end to end, n numbers each.
        v: velocity [rad/s].
        q_ref: desired position [rad].
        v_ref: desired velocity [rad/s].
        a_ref: desired acceleration [rad/s²].
        layout: of law and tree, as `pack_tree_law` packs them.
        weights: of law and tree.
        work: scratch space (`law_workspace`).
        tau: written [N·m].

    Returns:
        Whether all are as long as tau, a multiple of n, nothing being done otherwise, and tau is finite.
    """
    law, tree, size = Packed(layout[2:], weights), Packed(layout[layout[0] :], weights[layout[1] :]), len(tau)
    n = law.layout[at.JOINTS]
    if not fit(n, size, (q, v, q_ref, v_ref, a_ref)):
        return False
    for k in range(size // n):
        target = Target(row(q_ref, k, n), row(v_ref, k, n), row(a_ref, k, n))
        torque_of(State(row(q, k, n), row(v, k, n)), target, law, tree, work, row(tau, k, n))
    return is_finite(tau)


@exact_kernel
def pid_terms(
    k: int, memory: Memory, state: State, target: State, period: float, gains: PID
) -> tuple[float, float, float, float, float, bool]:
    """z1, blend, what the filter's input exceeds its output by, its next output, τ, whether the integral rests."""
    i = k % len(gains.kp)
    z1 = state.q[k] - target.q[k]
    if gains.wraps[i] > 0.0:
        z1 -= _TURN * np.ceil((z1 - math.pi) / _TURN)
    blend = period / (gains.filter_time[i] + period)
    change = state.v[k] - target.v[k] - memory.derivative[k]
    rate = memory.derivative[k] + blend * change
    tau = -gains.kp[i] * z1 - memory.integral[k] - gains.kd[i] * rate
    return z1, blend, change, rate, tau, abs(tau) > gains.limit[i] and tau * z1 < 0.0


@exact_kernel
def pid_step(memory: Memory, state: State, target: State, period: float, gains: PID, tau: Vec, after: Memory) -> None:
    """One step of `controllers.pid.PID` for any number of states laid end to end; the torque → tau."""
    for k in range(len(tau)):
        z1, _, _, rate, tau[k], rests = pid_terms(k, memory, state, target, period, gains)
        after.integral[k] = memory.integral[k] + (0.0 if rests else gains.ki[k % len(gains.ki)] * period * z1)
        after.derivative[k] = rate


@exact_kernel
def pid(
    integral: Vec, derivative: Vec, q: Vec, v: Vec, q_ref: Vec, v_ref: Vec, period: float, weights: Vec, out: Mat
) -> bool:
    """One step of `controllers.pid.PID`.

    Args:
        integral: integral torque [N·m] of any number of states laid end to end, n numbers each.
        derivative: filtered ż1 [rad/s].
        q: position [rad].
        v: velocity [rad/s].
        q_ref: desired position [rad].
        v_ref: desired velocity [rad/s].
        period: control period [s].
        weights: of the PID, as `layout.pack_pid` packs it, (6n,).
        out: written, rows τ [N·m], integral [N·m], derivative [rad/s], each as long as q.

    Returns:
        Whether all are as long as the rows of out, a multiple of n, nothing being done otherwise, and τ is finite.
    """
    gains = pid_of(weights)
    if not fit(len(gains.kp), out.shape[1], (integral, derivative, q, v, q_ref, v_ref)):
        return False
    after = Memory(out[1], out[2])
    pid_step(Memory(integral, derivative), State(q, v), State(q_ref, v_ref), period, gains, out[0], after)
    return is_finite(out[0])
