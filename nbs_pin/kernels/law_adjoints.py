"""Adjoints of the laws of `laws.py`: vector–Jacobian products with respect to state and weights."""

import math

from nbs_pin.kernels import layout as at
from nbs_pin.kernels.convex_adjoint import pull_back, room_for_potential, taped
from nbs_pin.kernels.damping import damping_adjoint, room_for_damping
from nbs_pin.kernels.jit import exact_kernel, kernel
from nbs_pin.kernels.laws import errors, pid_terms
from nbs_pin.kernels.layout import LawCode, Packed
from nbs_pin.kernels.records import Dual, Memory, Signals, State, Target, Tracking, Vec
from nbs_pin.kernels.views import damping_in, numbers, pid_of, potential_in, take2, take4, vector


def adjoint_workspace(law: Packed) -> int:
    """Size of the scratch space that `law_adjoint` needs for this law."""
    networks = law.layout[at.LAW] == LawCode.BACKSTEPPING
    rooms = room_for_potential(potential_in(law)) + room_for_damping(damping_in(law)) if networks else 0
    return int(10 * law.layout[at.JOINTS] + rooms)


@kernel
def friction_adjoint(law: Packed, v: Vec, torque_bar: Vec, v_bar: Vec, law_bar: Packed) -> None:
    """Adjoint of `laws.friction`, added to v_bar and to the cotangents of its three constants."""
    viscous, coulomb, transition = vector(law, at.VISCOUS), vector(law, at.COULOMB), numbers(law)[at.TRANSITION]
    viscous_bar, coulomb_bar, numbers_bar = vector(law_bar, at.VISCOUS), vector(law_bar, at.COULOMB), numbers(law_bar)
    for i in range(len(v)):
        share = math.tanh(v[i] / transition)
        steepness = coulomb[i] * (1.0 - share * share) / transition
        v_bar[i] += (viscous[i] + steepness) * torque_bar[i]
        viscous_bar[i] += v[i] * torque_bar[i]
        coulomb_bar[i] += share * torque_bar[i]
        numbers_bar[at.TRANSITION] -= steepness * v[i] / transition * torque_bar[i]


@kernel
def backstepping_adjoint(
    now: Tracking, law: Packed, work: Vec, out_bar: Signals, state_bar: State, law_bar: Packed
) -> None:
    """Adjoint of `laws.backstepping` and of its friction, fed forward at v_r."""
    n, phi, rate, omega = len(now.v), potential_in(law), vector(law, at.FIRST), numbers(law)[at.OMEGA]
    error, feedback_bar, a_r_bar = Dual(now.z1, now.dz1), out_bar.feedback, out_bar.a_r
    rate_bar, numbers_bar = vector(law_bar, at.FIRST), numbers(law_bar)
    v_r, z2, r_bar, z2_bar, work = take4(work, n)
    gradient, product, gradient_bar, product_bar, work = take4(work, n)
    taped(error, phi, work, Dual(gradient, product))
    for i in range(n):
        v_r[i] = now.v_ref[i] - rate[i] * gradient[i]
        z2[i] = now.v[i] - v_r[i]
        r_bar[i], z2_bar[i], product_bar[i] = out_bar.v_r[i], -omega * a_r_bar[i], -feedback_bar[i]
        numbers_bar[at.OMEGA] -= z2[i] * a_r_bar[i]
    room = work[room_for_potential(phi) :]
    damping_adjoint(z2, product_bar, damping_in(law), room, z2_bar, damping_in(law_bar).weights)
    if law.layout[at.FRICTION]:
        friction_adjoint(law, v_r, feedback_bar, r_bar, law_bar)
    for i in range(n):
        state_bar.v[i] += z2_bar[i]
        r_bar[i] -= z2_bar[i]
        gradient_bar[i], product_bar[i] = -feedback_bar[i] - rate[i] * r_bar[i], -rate[i] * a_r_bar[i]
        rate_bar[i] -= gradient[i] * r_bar[i] + product[i] * a_r_bar[i]
    bars, error_bar = Dual(gradient_bar, product_bar), Dual(state_bar.q, state_bar.v)
    pull_back(error, bars, phi, work, error_bar, potential_in(law_bar).weights)


@kernel
def linear_adjoint(now: Tracking, law: Packed, work: Vec, out_bar: Signals, state_bar: State, law_bar: Packed) -> None:
    """Adjoint of `laws.linear_law` and of its friction; of any other law NaN."""
    n, code, first, second = len(now.v), law.layout[at.LAW], vector(law, at.FIRST), vector(law, at.SECOND)
    first_bar, second_bar = vector(law_bar, at.FIRST), vector(law_bar, at.SECOND)
    r_bar, v_r, work = take2(work, n)
    for i in range(n):
        r_bar[i] = out_bar.v_r[i]
        v_r[i] = now.v_ref[i] - (first[i] * now.z1[i] if code == LawCode.SLOTINE_LI else 0.0)
    if law.layout[at.FRICTION]:
        friction_adjoint(law, v_r, out_bar.feedback, r_bar, law_bar)
    for i in range(n):
        z1, dz1, a_bar, f_bar, pd_bar = now.z1[i], now.dz1[i], out_bar.a_r[i], out_bar.feedback[i], math.nan
        if code == LawCode.SLOTINE_LI:
            r_bar[i] += second[i] * f_bar
            state_bar.q[i] -= first[i] * r_bar[i]
            state_bar.v[i] -= first[i] * a_bar + second[i] * f_bar
            first_bar[i] -= z1 * r_bar[i] + dz1 * a_bar
            second_bar[i] -= (now.v[i] - v_r[i]) * f_bar
            continue
        if code == LawCode.COMPUTED_TORQUE:  # the same PD as that of the others, asked for as an acceleration
            pd_bar = a_bar
            state_bar.v[i] += out_bar.v_r[i]
        elif code == LawCode.PD_REFERENCE or code == LawCode.PD_GRAVITY:
            pd_bar = f_bar
        state_bar.q[i] -= first[i] * pd_bar
        state_bar.v[i] -= second[i] * pd_bar
        first_bar[i] -= z1 * pd_bar
        second_bar[i] -= dz1 * pd_bar


@kernel
def law_adjoint(
    state: State, target: Target, law: Packed, work: Vec, out_bar: Signals, state_bar: State, law_bar: Packed
) -> None:
    """Add the gradient of v_r_barᵀv_r + a_r_barᵀa_r + feedback_barᵀfeedback by q, v and the weights of the law.

    For the signals of `laws.signals_of` at the same state; law_bar has cotangents for weights. What says which joints
    wrap gets none, nor does the reference, which training does not change.
    """
    z1, dz1, work = take2(work, len(state.q))
    now = errors(state, target, law, z1, dz1)
    if law.layout[at.LAW] == LawCode.BACKSTEPPING:
        backstepping_adjoint(now, law, work, out_bar, state_bar, law_bar)
    else:
        linear_adjoint(now, law, work, out_bar, state_bar, law_bar)


@exact_kernel
def pid_adjoint(
    memory: Memory,
    state: State,
    target: State,
    period: float,
    weights: Vec,
    tau_bar: Vec,
    after_bar: Memory,
    memory_bar: Memory,
    state_bar: State,
    weights_bar: Vec,
) -> None:
    """Add the gradient of tau_barᵀτ + after_barᵀafter by memory, state and weights, for `laws.pid_step`.

    The effort limit only decides whether the integral rests, and gets none, nor does what says which joints wrap.
    """
    gains, bars = pid_of(weights), pid_of(weights_bar)
    for k in range(len(tau_bar)):
        i = k % len(gains.kp)
        z1, blend, change, rate, _, rests = pid_terms(k, memory, state, target, period, gains)
        rate_bar = after_bar.derivative[k] - gains.kd[i] * tau_bar[k]
        gained_bar = 0.0 if rests else period * after_bar.integral[k]
        state_bar.q[k] += gains.ki[i] * gained_bar - gains.kp[i] * tau_bar[k]
        state_bar.v[k] += blend * rate_bar
        memory_bar.integral[k] += after_bar.integral[k] - tau_bar[k]
        memory_bar.derivative[k] += (1.0 - blend) * rate_bar
        bars.kp[i] -= z1 * tau_bar[k]
        bars.ki[i] += z1 * gained_bar
        bars.kd[i] -= rate * tau_bar[k]
        bars.filter_time[i] -= change * rate_bar * blend / (gains.filter_time[i] + period)
