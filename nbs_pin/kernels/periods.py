"""The energy balance of V over one control period of exact states, and what it says.

`certificates/energy_balance.py` and `certificates/assumptions.py` define both; tests hold the two together.
"""

import math

from numba import float64, int64, void

from nbs_pin.kernels import layout as at
from nbs_pin.kernels.convex import potential
from nbs_pin.kernels.damping import damping_force
from nbs_pin.kernels.jit import compile_for, inlined, kernel
from nbs_pin.kernels.laws import difference, friction, torque_of
from nbs_pin.kernels.layout import Packed
from nbs_pin.kernels.records import Dual, Mat, Motion, State, Target, Vec
from nbs_pin.kernels.trees import tree_torque
from nbs_pin.kernels.verdicts import (
    BOX,
    CONSTANT,
    GAP_COULOMB,
    GAP_VISCOUS,
    OF_Q,
    OF_TORQUE,
    OF_V,
    RADIUS,
    outside,
    wrapped,
)
from nbs_pin.kernels.views import damping_in, numbers, potential_in, take, take3, take4, vector
from nbs_pin.kernels.watching import A_REF, COMMAND, Q_REF, TAU, V_REF, Q, V, inertia, parts

STORAGE, CHANGE, POTENTIAL, DAMPING, DISTURBANCE, HELD, SATURATION, SIZE_Q, SIZE_V, TERMS = range(10)
"""Numbers of a period: V at its end [J]; V̇, −∇ΦᵀΛ∇Φ, −z2ᵀ((ωM + D)z2 + …), z2ᵀ(unexplained, lag, cut) [W]; ‖q‖, ‖v‖ in
its middle; and how many."""
ERROR, UNEXPLAINED, BEHIND, CUT, VECTORS = range(5)
"""Vectors of a period: z2, and the torques unexplained, lag and cut."""
IS_UNEXPLAINED, IS_BEHIND, POWER, EXCESS, GREATEST_IS_LAG, FINDINGS = range(6)
"""What `judge_period` finds, and how many."""
_OF_BOUND = 1e-2

_VEC, _MAT, _PACKED = float64[::1], float64[:, ::1], (int64[::1], float64[::1])


def compile_periods() -> None:
    """Compile the entry points for float64, so that no first call waits for the compiler."""
    compile_for(period_terms, void(_MAT, _MAT, float64, float64, *_PACKED, _VEC, _VEC, _MAT))
    compile_for(storage, float64(_MAT, *_PACKED, _VEC))


def compile_judge() -> None:
    """Compile `judge_period`."""
    compile_for(judge_period, void(_VEC, _MAT, _MAT, _MAT, float64, _MAT, _VEC, _VEC))


@inlined
def _middle(x0: float, x1: float, rate0: float, rate1: float, h: float) -> float:
    return 0.5 * (x0 + x1) + 0.125 * h * (rate0 - rate1)


@inlined
def _near(x: float, other: float, wraps: float) -> float:
    """x less whole turns, next to another position, where `wraps` is 1 [rad]."""
    return other + wrapped(x - other, wraps) if wraps > 0.0 else x


@inlined
def _quadratic(mass: Mat, x: Vec) -> float:
    total = 0.0
    for i in range(len(x)):
        for j in range(len(x)):
            total += x[i] * mass[i, j] * x[j]
    return total


@kernel
def storage(sample: Mat, layout: Vec, weights: Vec, work: Vec) -> float:
    """V of a sample [J]; layout, weights and work as in `watching.observe`."""
    law, tree = parts(layout, weights)
    n = law.layout[at.JOINTS]
    z1, z2, gradient, bend, work = take4(work, n)
    flat, work = take(work, n * n)
    mass = flat.reshape(n, n)
    difference(sample[Q], sample[Q_REF], vector(law, at.WRAPS), z1)
    value, rate = potential(Dual(z1, z1), potential_in(law), work, Dual(gradient, bend)), vector(law, at.FIRST)
    for i in range(n):
        z2[i] = sample[V, i] - sample[V_REF, i] + rate[i] * gradient[i]
    inertia(sample[Q], tree, work, mass)
    value += 0.5 * _quadratic(mass, z2)
    return 0.0 if value < 0.0 else value  # V ≥ 0; Φ(z) − Φ(0) may round to less


@kernel
def period_terms(
    before: Mat, after: Mat, h: float, last: float, layout: Vec, weights: Vec, work: Vec, out: Vec, found: Mat
) -> None:
    """The energy balance between two samples (7, n).

    Args:
        before: the first.
        after: the second.
        h: time between them [s].
        last: V of the first [J].
        layout: of law and tree, as `laws.pack_tree_law` packs them.
        weights: of law and tree.
        work: scratch space (`watching.watch_workspace`).
        out: written, (`TERMS`,).
        found: written, (`VECTORS`, n).
    """
    law, tree = parts(layout, weights)
    n = law.layout[at.JOINTS]
    out[STORAGE] = storage(after, layout, weights, work)
    q, v, a, asked, work = take4(work, n)
    q_ref, v_ref, a_ref, work = take3(work, n)
    size_q, size_v, wraps = 0.0, 0.0, vector(law, at.WRAPS)
    for i in range(n):
        near = _near(after[Q, i], before[Q, i], wraps[i])
        q[i] = _middle(before[Q, i], near, before[V, i], after[V, i], h)
        v[i], a[i] = 0.5 * (before[V, i] + after[V, i]), (after[V, i] - before[V, i]) / h
        near = _near(after[Q_REF, i], before[Q_REF, i], wraps[i])
        q_ref[i] = _middle(before[Q_REF, i], near, before[V_REF, i], after[V_REF, i], h)
        v_ref[i] = _middle(before[V_REF, i], after[V_REF, i], before[A_REF, i], after[A_REF, i], h)
        a_ref[i] = 0.5 * (before[A_REF, i] + after[A_REF, i])
        size_q, size_v = size_q + q[i] * q[i], size_v + v[i] * v[i]
    out[SIZE_Q], out[SIZE_V], out[CHANGE] = math.sqrt(size_q), math.sqrt(size_v), (out[STORAGE] - last) / h
    torque_of(State(q, v), Target(q_ref, v_ref, a_ref), law, tree, work, asked)
    tree_torque(Motion(q, v, v, a), tree, work, found[UNEXPLAINED])
    z1, z2 = a, found[ERROR]
    difference(q, q_ref, wraps, z1)
    _losses(Motion(q, v, v_ref, z1), law, tree, work, z2, out, found)
    out[DISTURBANCE], out[HELD], out[SATURATION] = 0.0, 0.0, 0.0
    for i in range(n):
        found[UNEXPLAINED, i] -= before[TAU, i]
        found[BEHIND, i], found[CUT, i] = before[COMMAND, i] - asked[i], before[TAU, i] - before[COMMAND, i]
        out[DISTURBANCE] += z2[i] * found[UNEXPLAINED, i]
        out[HELD] += z2[i] * found[BEHIND, i]
        out[SATURATION] += z2[i] * found[CUT, i]


@kernel
def _losses(at_middle: Motion, law: Packed, tree: Packed, work: Vec, z2: Vec, out: Vec, found: Mat) -> None:
    """z2 and the two losses of V, for q, v, v_d and z1 in `at_middle`; adds the friction that is fed forward."""
    n, omega, rate = len(z2), numbers(law)[at.OMEGA], vector(law, at.FIRST)
    gradient, bend, force, rubbing, work = take4(work, n)
    reference, work = take(work, n)
    flat, work = take(work, n * n)
    mass = flat.reshape(n, n)
    z1 = at_middle.a
    potential(Dual(z1, z1), potential_in(law), work, Dual(gradient, bend))
    out[POTENTIAL], out[DAMPING] = 0.0, 0.0
    for i in range(n):
        reference[i] = at_middle.w[i] - rate[i] * gradient[i]
        z2[i] = at_middle.v[i] - reference[i]
        out[POTENTIAL] -= rate[i] * gradient[i] * gradient[i]
        rubbing[i], bend[i] = 0.0, 0.0
    damping_force(z2, damping_in(law), work, force)
    inertia(at_middle.q, tree, work, mass)
    out[DAMPING] = -omega * _quadratic(mass, z2)
    if law.layout[at.FRICTION]:
        friction(law, at_middle.v, rubbing)
        friction(law, reference, bend)
    for i in range(n):
        found[UNEXPLAINED, i] += rubbing[i]
        out[DAMPING] -= z2[i] * (force[i] + rubbing[i] - bend[i])


@inlined
def _beyond(torque: Vec, limits: Mat, radius: float, rest: Vec) -> float:
    return outside(torque, limits[0], limits, radius, rest)


@kernel
def judge_period(
    terms: Vec, vectors: Mat, before: Mat, after: Mat, h: float, limits: Mat, numbers: Vec, out: Vec
) -> None:
    """What one period says of the assumptions.

    Args:
        terms: (`TERMS`,) of `period_terms`.
        vectors: (`VECTORS`, n) of it.
        before: sample (7, n) at its begin.
        after: sample at its end.
        h: its length [s].
        limits: (`verdicts.LIMITS`, n) of the certificate, of exact states.
        numbers: (`verdicts.NUMBERS`,) of the certificate.
        out: written, (`FINDINGS`,).
    """
    n, radius = vectors.shape[1], numbers[RADIUS]
    size, torque, speed0, speed1, u, gap, lag = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(n):
        size += limits[BOX, i] ** 2 if radius == math.inf else 0.0
        torque, u = torque + before[TAU, i] ** 2, u + vectors[UNEXPLAINED, i] ** 2
        speed0, speed1, lag = speed0 + before[V, i] ** 2, speed1 + after[V, i] ** 2, lag + vectors[BEHIND, i] ** 2
        unknown = limits[GAP_VISCOUS, i] * abs(0.5 * (before[V, i] + after[V, i])) + limits[GAP_COULOMB, i]
        gap += unknown * unknown
    size = math.sqrt(size) if radius == math.inf else radius
    granted = math.sqrt(gap) + numbers[OF_Q] * terms[SIZE_Q] + numbers[OF_V] * terms[SIZE_V] + numbers[CONSTANT]
    fastest = math.sqrt(max(speed0, speed1))
    told = _OF_BOUND * size + (OF_TORQUE + (h * fastest) ** 2) * (math.sqrt(torque) + math.sqrt(u))
    _weigh(vectors, granted, told, limits, numbers, math.sqrt(lag), out)
    terms_sum = terms[POTENTIAL] + terms[DAMPING] + terms[DISTURBANCE] + terms[HELD] + terms[SATURATION]
    out[POWER] += max(terms[CHANGE] - terms_sum, 0.0)


@kernel
def _weigh(vectors: Mat, granted: float, told: float, limits: Mat, numbers: Vec, lag: float, out: Vec) -> None:
    """The findings from torques, what is granted, and what differences can tell."""
    n, radius = vectors.shape[1], numbers[RADIUS]
    # After use: CUT and BEHIND of the caller's copy are scratch.
    u, other, total, z = vectors[UNEXPLAINED], vectors[BEHIND], vectors[CUT], 0.0
    norm = 0.0
    for i in range(n):
        total[i] += u[i] + other[i]
        norm, z = norm + total[i] * total[i], z + vectors[ERROR, i] ** 2
    norm = math.sqrt(norm)
    stretch = 1.0 + told / (norm if norm > 0.0 else 1.0)
    rest = vectors[ERROR]
    far = _beyond(u, limits, radius, rest)
    out[GREATEST_IS_LAG] = 1.0 if lag >= far else 0.0
    out[IS_UNEXPLAINED] = 1.0 if max(far - granted, 0.0) > told else 0.0
    kept = max(1.0 - granted / far, 0.0) if far > 0.0 else 1.0
    for i in range(n):
        other[i] += u[i] - rest[i] * kept
        total[i] *= stretch
    out[IS_BEHIND] = 1.0 if max(_beyond(other, limits, radius, rest) - granted, 0.0) > told else 0.0
    far = _beyond(total, limits, radius, rest)
    out[POWER] = math.sqrt(z) * max(far - granted, 0.0)
    kept, ratio, norm = max(1.0 - granted / far, 0.0) if far > 0.0 else 1.0, 1.0, 0.0
    for i in range(n):
        reached = total[i] - rest[i] + rest[i] * kept
        norm += reached * reached
        if radius == math.inf and reached != 0.0:
            ratio = max(ratio, abs(reached) / limits[BOX, i])
    if radius < math.inf and norm > 0.0:
        ratio = max(ratio, math.sqrt(norm) / radius)
    out[EXCESS] = ratio
