"""Every law of one state: what it adds to the model, τ = M(q) a_r + C(q, v) v_r + G(q) + feedback."""

import math

import numpy as np
from numba import boolean, float64, int64, void

from nbs_pin.kernels.convex import potential
from nbs_pin.kernels.damping import damping_force
from nbs_pin.kernels.jit import compile_for, exact_kernel, kernel
from nbs_pin.kernels.layout import BACKSTEPPING, COMPUTED_TORQUE, PD_GRAVITY, SLOTINE_LI

_TURN = 2.0 * math.pi


_ROW, _ROWS = float64[::1], float64[:, ::1]
_PACKED = (int64[::1], float64[::1], float64[::1])
_SIGNALS = 3


def compile_laws() -> None:
    """Compile `law_row`, `law_rows` and `pid` for float64 arrays, so that no first call waits for the compiler."""
    compile_for(law_row, boolean(*[_ROW] * 5, *_PACKED, *[_ROW] * _SIGNALS))
    compile_for(law_rows, void(*[_ROWS] * 5, *_PACKED, *[_ROWS] * _SIGNALS))
    compile_for(pid, boolean(*[_ROW] * 6, float64, _ROWS, _ROWS))


@exact_kernel
def difference(q: np.ndarray, q_ref: np.ndarray, continuous: np.ndarray, z1: np.ndarray) -> None:
    """The error q ⊖ q_ref → z1 [rad] as `robot.configuration_difference` has it, wrapped where `continuous` is 1."""
    for i in range(len(q)):
        z1[i] = q[i] - q_ref[i]
        if continuous[i] > 0.0:
            z1[i] -= _TURN * np.ceil((z1[i] - math.pi) / _TURN)


@kernel
def friction(n: int, weights: np.ndarray, v: np.ndarray, torque: np.ndarray) -> None:
    """Add viscous·v + coulomb·tanh(v/transition) [N·m] to torque, with the constants of a law's weights."""
    viscous, coulomb, transition = weights[3 * n : 4 * n], weights[4 * n : 5 * n], weights[5 * n]
    for i in range(n):
        torque[i] += viscous[i] * v[i] + coulomb[i] * math.tanh(v[i] / transition)


@kernel
def backstepping(
    v: np.ndarray,
    v_ref: np.ndarray,
    a_ref: np.ndarray,
    layout: np.ndarray,
    weights: np.ndarray,
    work: np.ndarray,
    v_r: np.ndarray,
    a_r: np.ndarray,
    feedback: np.ndarray,
) -> None:
    """v_r = φ, a_r = φ̇ − ωz2, feedback = −∇Φ(z1) − D(z2)z2, with z1 in work[:n] (docs/theory.md §2)."""
    n, rate, omega = layout[1], weights[layout[1] : 2 * layout[1]], weights[5 * layout[1] + 1]
    z1, dz1, z2, force = work[:n], work[n : 2 * n], work[2 * n : 3 * n], work[3 * n : 4 * n]
    gradient, product, room = work[4 * n : 5 * n], work[5 * n : 6 * n], work[6 * n :]
    for i in range(n):
        dz1[i] = v[i] - v_ref[i]
    potential(z1, dz1, layout[layout[3] :], weights[layout[4] :], room, gradient, product)
    for i in range(n):
        v_r[i] = v_ref[i] - rate[i] * gradient[i]
        z2[i] = v[i] - v_r[i]
        a_r[i] = a_ref[i] - rate[i] * product[i] - omega * z2[i]
    damping_force(z2, layout[layout[5] :], weights[layout[6] :], room, force)
    for i in range(n):
        feedback[i] = -gradient[i] - force[i]


@kernel
def linear_law(
    v: np.ndarray,
    v_ref: np.ndarray,
    a_ref: np.ndarray,
    layout: np.ndarray,
    weights: np.ndarray,
    work: np.ndarray,
    v_r: np.ndarray,
    a_r: np.ndarray,
    feedback: np.ndarray,
) -> None:
    """Slotine–Li, computed torque and PD: the same signals without networks, with z1 in work[:n]."""
    law, n = layout[0], layout[1]
    z1, first, second = work[:n], weights[n : 2 * n], weights[2 * n : 3 * n]
    for i in range(n):
        dz1 = v[i] - v_ref[i]
        if law == SLOTINE_LI:
            v_r[i] = v_ref[i] - first[i] * z1[i]
            a_r[i] = a_ref[i] - first[i] * dz1
            feedback[i] = -second[i] * (v[i] - v_r[i])
        elif law == COMPUTED_TORQUE:
            v_r[i] = v[i]
            a_r[i] = a_ref[i] - second[i] * dz1 - first[i] * z1[i]
            feedback[i] = 0.0
        else:
            v_r[i], a_r[i] = (0.0, 0.0) if law == PD_GRAVITY else (v_ref[i], a_ref[i])
            feedback[i] = -first[i] * z1[i] - second[i] * dz1


@kernel
def law_row(
    q: np.ndarray,
    v: np.ndarray,
    q_ref: np.ndarray,
    v_ref: np.ndarray,
    a_ref: np.ndarray,
    layout: np.ndarray,
    weights: np.ndarray,
    work: np.ndarray,
    v_r: np.ndarray,
    a_r: np.ndarray,
    feedback: np.ndarray,
) -> bool:
    """τ = M a_r + C v_r + G + feedback: these three for one state; False, and nothing done, unless all are (n,)."""
    n = layout[1]
    if not (len(q) == n and len(v) == n and len(q_ref) == n and len(v_ref) == n and len(a_ref) == n):
        return False
    difference(q, q_ref, weights[:n], work[:n])
    if layout[0] == BACKSTEPPING:
        backstepping(v, v_ref, a_ref, layout, weights, work, v_r, a_r, feedback)
    else:
        linear_law(v, v_ref, a_ref, layout, weights, work, v_r, a_r, feedback)
    if layout[2]:
        friction(n, weights, v_r if layout[0] == BACKSTEPPING or layout[0] == SLOTINE_LI else v_ref, feedback)
    return True


@kernel
def law_rows(
    q: np.ndarray,
    v: np.ndarray,
    q_ref: np.ndarray,
    v_ref: np.ndarray,
    a_ref: np.ndarray,
    layout: np.ndarray,
    weights: np.ndarray,
    work: np.ndarray,
    v_r: np.ndarray,
    a_r: np.ndarray,
    feedback: np.ndarray,
) -> None:
    """`law_row` for every row of arrays (rows, n)."""
    for i in range(len(q)):
        law_row(q[i], v[i], q_ref[i], v_ref[i], a_ref[i], layout, weights, work, v_r[i], a_r[i], feedback[i])


@exact_kernel
def pid(
    integral: np.ndarray,
    derivative: np.ndarray,
    q: np.ndarray,
    v: np.ndarray,
    q_ref: np.ndarray,
    v_ref: np.ndarray,
    period: float,
    gains: np.ndarray,
    out: np.ndarray,
) -> bool:
    """One step of `controllers.pid.PID` for any number of states laid end to end; τ, integral, derivative → out rows.

    gains: rows k_p, k_i, k_d, effort limit, T_f, continuous, each (n,). False, and nothing done, unless all lengths are
    that of the rows of out, a multiple of n.
    """
    n, size = gains.shape[1], out.shape[1]
    for x in (integral, derivative, q, v, q_ref, v_ref):
        if len(x) != size or size % n != 0:
            return False
    for k in range(size):
        i = k % n
        z1 = q[k] - q_ref[k]
        if gains[5, i] > 0.0:
            z1 -= _TURN * np.ceil((z1 - math.pi) / _TURN)
        blend = period / (gains[4, i] + period)
        rate = derivative[k] + blend * (v[k] - v_ref[k] - derivative[k])
        tau = -gains[0, i] * z1 - integral[k] - gains[2, i] * rate
        winding = abs(tau) > gains[3, i] and tau * z1 < 0.0
        out[0, k], out[1, k], out[2, k] = tau, integral[k] + (0.0 if winding else gains[1, i] * period * z1), rate
    return True
