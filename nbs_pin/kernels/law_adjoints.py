"""Adjoints of the laws of `laws.py`: what a number that depends on their signals gains per state and per weight."""

import math

import numpy as np

from nbs_pin.kernels.convex_adjoint import pull_back, room_for_potential, taped
from nbs_pin.kernels.damping_adjoint import damping_adjoint, room_for_damping
from nbs_pin.kernels.jit import exact_kernel, kernel
from nbs_pin.kernels.laws import difference
from nbs_pin.kernels.layout import BACKSTEPPING, COMPUTED_TORQUE, SLOTINE_LI, Packed

_TURN = 2.0 * math.pi
_VECTORS = 10


def adjoint_workspace(law: Packed) -> int:
    """How many numbers of scratch space `law_adjoint` needs for this law."""
    layout, n = law.layout, int(law.layout[1])
    if layout[0] != BACKSTEPPING:
        return _VECTORS * n
    return _VECTORS * n + int(room_for_potential(layout[layout[3] :]) + room_for_damping(layout[layout[5] :]))


@kernel
def friction_adjoint(
    n: int, weights: np.ndarray, v: np.ndarray, torque_bar: np.ndarray, v_bar: np.ndarray, weights_bar: np.ndarray
) -> None:
    """Adjoint of `laws.friction`, added to v_bar and to the bars of its three constants."""
    viscous, coulomb, transition = weights[3 * n : 4 * n], weights[4 * n : 5 * n], weights[5 * n]
    for i in range(n):
        share = math.tanh(v[i] / transition)
        steepness = coulomb[i] * (1.0 - share * share) / transition
        v_bar[i] += (viscous[i] + steepness) * torque_bar[i]
        weights_bar[3 * n + i] += v[i] * torque_bar[i]
        weights_bar[4 * n + i] += share * torque_bar[i]
        weights_bar[5 * n] -= steepness * v[i] / transition * torque_bar[i]


@kernel
def backstepping_adjoint(
    v: np.ndarray,
    v_ref: np.ndarray,
    layout: np.ndarray,
    weights: np.ndarray,
    work: np.ndarray,
    v_r_bar: np.ndarray,
    a_r_bar: np.ndarray,
    feedback_bar: np.ndarray,
    q_bar: np.ndarray,
    v_bar: np.ndarray,
    weights_bar: np.ndarray,
) -> None:
    """Adjoint of `laws.backstepping` and of its friction, fed forward at v_r, with z1 in work[:n]."""
    n, rate, omega = layout[1], weights[layout[1] : 2 * layout[1]], weights[5 * layout[1] + 1]
    vectors = work[: _VECTORS * n].reshape(_VECTORS, n)
    z1, dz1, v_r, z2, r_bar, z2_bar = vectors[0], vectors[1], vectors[2], vectors[3], vectors[4], vectors[5]
    gradient, product, gradient_bar, product_bar = vectors[6], vectors[7], vectors[8], vectors[9]
    phi, phi_weights, phi_bar = layout[layout[3] :], weights[layout[4] :], weights_bar[layout[4] :]
    d, d_weights, d_bar = layout[layout[5] :], weights[layout[6] :], weights_bar[layout[6] :]
    room, d_room = work[_VECTORS * n :], work[_VECTORS * n + room_for_potential(phi) :]
    for i in range(n):
        dz1[i] = v[i] - v_ref[i]
    taped(z1, dz1, phi, phi_weights, room, gradient, product)
    for i in range(n):
        v_r[i] = v_ref[i] - rate[i] * gradient[i]
        z2[i] = v[i] - v_r[i]
        r_bar[i], z2_bar[i], product_bar[i] = v_r_bar[i], -omega * a_r_bar[i], -feedback_bar[i]
        weights_bar[5 * n + 1] -= z2[i] * a_r_bar[i]
    damping_adjoint(z2, product_bar, d, d_weights, d_room, z2_bar, d_bar)
    if layout[2]:
        friction_adjoint(n, weights, v_r, feedback_bar, r_bar, weights_bar)
    for i in range(n):
        v_bar[i] += z2_bar[i]
        r_bar[i] -= z2_bar[i]
        gradient_bar[i], product_bar[i] = -feedback_bar[i] - rate[i] * r_bar[i], -rate[i] * a_r_bar[i]
        weights_bar[n + i] -= gradient[i] * r_bar[i] + product[i] * a_r_bar[i]
    pull_back(z1, dz1, gradient_bar, product_bar, phi, phi_weights, room, q_bar, v_bar, phi_bar)


@kernel
def linear_adjoint(
    v: np.ndarray,
    v_ref: np.ndarray,
    layout: np.ndarray,
    weights: np.ndarray,
    work: np.ndarray,
    v_r_bar: np.ndarray,
    a_r_bar: np.ndarray,
    feedback_bar: np.ndarray,
    q_bar: np.ndarray,
    v_bar: np.ndarray,
    weights_bar: np.ndarray,
) -> None:
    """Adjoint of `laws.linear_law` and of its friction, with z1 in work[:n]."""
    law, n = layout[0], layout[1]
    first, second, first_bar, second_bar = weights[n:], weights[2 * n :], weights_bar[n:], weights_bar[2 * n :]
    z1, r_bar, v_r = work[:n], work[n : 2 * n], work[2 * n : 3 * n]
    for i in range(n):
        r_bar[i], v_r[i] = v_r_bar[i], v_ref[i] - (first[i] * z1[i] if law == SLOTINE_LI else 0.0)
    if layout[2]:
        friction_adjoint(n, weights, v_r, feedback_bar, r_bar, weights_bar)
    for i in range(n):
        dz1, a_bar, f_bar = v[i] - v_ref[i], a_r_bar[i], feedback_bar[i]
        if law == SLOTINE_LI:
            r_bar[i] += second[i] * f_bar
            q_bar[i] -= first[i] * r_bar[i]
            v_bar[i] -= first[i] * a_bar + second[i] * f_bar
            first_bar[i] -= z1[i] * r_bar[i] + dz1 * a_bar
            second_bar[i] -= (v[i] - v_r[i]) * f_bar
        else:  # the same PD, asked for as an acceleration or as a torque
            pd_bar = a_bar if law == COMPUTED_TORQUE else f_bar
            q_bar[i] -= first[i] * pd_bar
            v_bar[i] -= second[i] * pd_bar - (v_r_bar[i] if law == COMPUTED_TORQUE else 0.0)
            first_bar[i] -= z1[i] * pd_bar
            second_bar[i] -= dz1 * pd_bar


@kernel
def law_adjoint(
    q: np.ndarray,
    v: np.ndarray,
    q_ref: np.ndarray,
    v_ref: np.ndarray,
    a_ref: np.ndarray,
    layout: np.ndarray,
    weights: np.ndarray,
    work: np.ndarray,
    v_r_bar: np.ndarray,
    a_r_bar: np.ndarray,
    feedback_bar: np.ndarray,
    q_bar: np.ndarray,
    v_bar: np.ndarray,
    weights_bar: np.ndarray,
) -> None:
    """Add the gradient of v_r_barᵀv_r + a_r_barᵀa_r + feedback_barᵀfeedback by q, v and the weights of the law.

    For the signals of `laws.law_row` at the same state; (n,) each, weights_bar as weights. What says which joints wrap
    gets none, nor does the reference, which training does not change.
    """
    difference(q, q_ref, weights[: layout[1]], work[: layout[1]])
    bars = (v_r_bar, a_r_bar, feedback_bar, q_bar, v_bar, weights_bar)
    if layout[0] == BACKSTEPPING:
        backstepping_adjoint(v, v_ref, layout, weights, work, *bars)
    else:
        linear_adjoint(v, v_ref, layout, weights, work, *bars)


@exact_kernel
def pid_adjoint(
    integral: np.ndarray,
    derivative: np.ndarray,
    q: np.ndarray,
    v: np.ndarray,
    q_ref: np.ndarray,
    v_ref: np.ndarray,
    period: float,
    gains: np.ndarray,
    out_bar: np.ndarray,
    integral_bar: np.ndarray,
    derivative_bar: np.ndarray,
    q_bar: np.ndarray,
    v_bar: np.ndarray,
    gains_bar: np.ndarray,
) -> None:
    """Add the gradient of the sum of out_bar·out by memory, state and gains, out as `laws.pid` gives it.

    out_bar: rows τ, integral, derivative; gains_bar: k_p, k_i, k_d, –, T_f, – as gains. The effort limit only decides
    whether the integral rests, and gets none.
    """
    n = gains.shape[1]
    for k in range(out_bar.shape[1]):
        i = k % n
        z1 = q[k] - q_ref[k]
        if gains[5, i] > 0.0:
            z1 -= _TURN * np.ceil((z1 - math.pi) / _TURN)
        blend, change = period / (gains[4, i] + period), v[k] - v_ref[k] - derivative[k]
        rate = derivative[k] + blend * change
        tau = -gains[0, i] * z1 - integral[k] - gains[2, i] * rate
        winding = abs(tau) > gains[3, i] and tau * z1 < 0.0
        tau_bar, rate_bar = out_bar[0, k], out_bar[2, k] - gains[2, i] * out_bar[0, k]
        gained_bar = 0.0 if winding else period * out_bar[1, k]
        q_bar[k] += gains[1, i] * gained_bar - gains[0, i] * tau_bar
        v_bar[k] += blend * rate_bar
        integral_bar[k] += out_bar[1, k] - tau_bar
        derivative_bar[k] += (1.0 - blend) * rate_bar
        gains_bar[0, i] -= z1 * tau_bar
        gains_bar[1, i] += z1 * gained_bar
        gains_bar[2, i] -= rate * tau_bar
        gains_bar[4, i] -= change * rate_bar * blend / (gains[4, i] + period)
