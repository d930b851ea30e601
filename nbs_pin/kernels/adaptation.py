"""The kernel of `controllers.adaptive_law.AdaptiveLaw`: a law on a rigid tree whose bodies, friction and rotors adapt.

A body that is not known has P = K X Kᵀ, 0 ≺ X ≺ 1, in place of a known one in the frame of a joint's body, and X the
dual Q = log X(1 − X)⁻¹. A number that is not known is lowest + width·x, 0 < x < 1, with the dual log x/(1 − x).

    unknown layout     bodies, numbers, `OutputCode`, then per body: joint, then per number: its `NumberCode`, joint
    unknown weights    σ, transition, ε or λ of the output (n), then per body: K (16), Q₀ (10), the known
                       m, h (3), E (6), γ, then per number: lowest, width, dual₀, the known value, γ
    memory             per body Q (10), then per number its dual
"""

import math

import numpy as np
from numba import boolean, float64, int64

from nbs_pin.kernels import layout as at
from nbs_pin.kernels.jit import compile_for, inlined, kernel
from nbs_pin.kernels.laws import difference, fit, is_finite, law_workspace, pack_tree_law, signals_of
from nbs_pin.kernels.layout import NumberCode, OutputCode, Packed
from nbs_pin.kernels.records import Motion, Signals, State, Target, Vec
from nbs_pin.kernels.symmetric4 import FARTHEST, TRIANGLE, congruent, logistic
from nbs_pin.kernels.tree_bodies import joint_of
from nbs_pin.kernels.tree_layout import ARMATURE, BASE, BODY, MASS
from nbs_pin.kernels.tree_parameters import COLUMNS, INERTIA, inertia_bars
from nbs_pin.kernels.trees import spread, tree_torque
from nbs_pin.kernels.views import row, take, take3, vector

BODIES, NUMBERS, OUTPUT, UNKNOWN = range(4)
"""Where the counts and the kind of the output lie in the layout, and where the list of unknowns begins."""
LEAK, TRANSITION, OUTPUT_RATE = range(3)
"""Where σ, the transition speed and the numbers of the output lie in the weights; bodies follow these n numbers."""
START, KNOWN, BODY_RATE, PER_BODY = 16, 26, 36, 37
"""Where Q₀, the known body and γ lie after K, and numbers of a body."""
LOWEST, WIDTH, DUAL, VALUE, RATE, PER_NUMBER = range(6)
_MATRICES = 16 * 4 + 36
_VEC = float64[::1]


def compile_adaptive_law() -> None:
    """Compile `adaptive_law` for float64, so that no first call waits for the compiler."""
    compile_for(adaptive_law, boolean(*[_VEC] * 7, float64, _VEC, int64[::1], *[_VEC] * 5))


def pack_adaptive(law: Packed, tree: Packed, unknown: Packed) -> Packed:
    """A law, its model and what it adapts, for `adaptive_law`: where the unknowns begin, then law and tree, then they.

    Args:
        law: the law, as `layout.pack_law` packs it.
        tree: the model, as `tree_layout.pack_tree` packs it.
        unknown: as the layout above has it.
    """
    both = pack_tree_law(law, tree)
    starts = [2 + len(both.layout), len(both.weights)]
    layout = np.concatenate([starts, both.layout, unknown.layout])
    return Packed(layout, np.concatenate([both.weights, unknown.weights]))


def adaptive_workspace(law: Packed, tree: Packed) -> int:
    """Size of the scratch space that `adaptive_law` needs."""
    return law_workspace(law, tree) + len(tree.weights) + _MATRICES + COLUMNS


@inlined
def bar_matrix(bar: Vec, out: Vec) -> None:
    """L with tr(L P) = m̄ m + h̄ᵀh + Σ Ē E from the derivatives by m, h and E."""
    for i in range(3):
        out[4 * i + 3] = out[12 + i] = 0.5 * bar[INERTIA + 1 + i]
    out[15], k = bar[INERTIA], INERTIA + 4
    for i in range(3):
        for j in range(i, 3):
            half = bar[k] if i == j else 0.5 * bar[k]
            out[4 * i + j] = half
            out[4 * j + i] = half
            k += 1


@inlined
def add_body(p: Vec, known: Vec, body: Vec) -> None:
    """Add P, and take off the known m, h and E, in the weights of a joint's body."""
    body[MASS] += p[15] - known[0]
    for i in range(3):
        body[MASS + 1 + i] += p[4 * i + 3] - known[1 + i]
    k = 4
    for i in range(3):
        for j in range(i, 3):
            body[MASS + k] += p[4 * i + j] - known[k]
            k += 1


@inlined
def factor_of(code: int, v_r: float, a_r: float, transition: float) -> float:
    """The factor of a number in the torque of its joint; of any other code NaN."""
    if code == NumberCode.VISCOUS:
        return v_r
    if code == NumberCode.COULOMB:
        return math.tanh(v_r / transition)
    if code == NumberCode.ROTOR:
        return a_r
    return 1.0 if code == NumberCode.OFFSET or code == NumberCode.ACCELERATION else math.nan


@inlined
def nearest(dual: float) -> float:
    """The dual within ±FARTHEST."""
    return math.copysign(FARTHEST, dual) if abs(dual) > FARTHEST else dual


@inlined
def value_of(dual: Vec, k: int, w: Vec) -> float:
    """The number of dual k, which is cut at ±FARTHEST in place."""
    dual[k] = nearest(dual[k])
    return w[LOWEST] + w[WIDTH] / (1.0 + math.exp(-dual[k]))


@inlined
def moved(now: float, start: float, rate: float, leak: float, period: float, slope: float) -> float:
    """The dual after a period of Q̇ = −γL − σ(Q − Q₀) with L held."""
    keep = math.exp(-leak * period)
    drive = rate * period if leak == 0.0 else -rate * math.expm1(-leak * period) / leak
    return start + keep * (now - start) - drive * slope


@kernel
def put_estimates(duals: Vec, unknown: Packed, own: Packed, signals: Signals, work: Vec) -> None:
    """The estimated bodies and rotors → the tree `own`, and friction and offsets → signals.feedback."""
    layout, weights = unknown.layout, unknown.weights
    x, p, other, work = take3(work, 16)
    count, first = layout[BODIES], OUTPUT_RATE + len(signals.v_r)
    for b in range(count):
        w, i = weights[first + PER_BODY * b :], layout[UNKNOWN + b]
        logistic(duals[TRIANGLE * b : TRIANGLE * (b + 1)], work, x)
        congruent(w[:16], 4, 1, x, other, p)
        start = BASE + BODY * i
        add_body(p, w[KNOWN:BODY_RATE], own.weights[start : start + BODY])
    for k in range(layout[NUMBERS]):
        code, i = layout[UNKNOWN + count + 2 * k], layout[UNKNOWN + count + 2 * k + 1]
        w = weights[first + PER_BODY * count + PER_NUMBER * k :]
        excess = value_of(duals, TRIANGLE * count + k, w) - w[VALUE]
        if code == NumberCode.ROTOR:
            own.weights[BASE + BODY * i + ARMATURE] += excess
        elif code == NumberCode.ACCELERATION:
            signals.a_r[i] += excess
        else:
            signals.feedback[i] += excess * factor_of(code, signals.v_r[i], 0.0, weights[TRANSITION])


@kernel
def move_duals(z2: Vec, period: float, unknown: Packed, own: Packed, signals: Signals, work: Vec, duals: Vec) -> None:
    """One step of all duals, after `tree_torque` has left the motion of every body in the end of work."""
    layout, weights = unknown.layout, unknown.weights
    bars, rest = take(work, COLUMNS)
    power, slope, other, rest = take3(rest, 16)
    tree_work = rest[_MATRICES - 48 :]
    spread(z2, own, tree_work)
    count, first, leak = layout[BODIES], OUTPUT_RATE + len(z2), weights[LEAK]
    for b in range(count):
        w, i = weights[first + PER_BODY * b :], layout[UNKNOWN + b]
        inertia_bars(joint_of(i, own, tree_work), signals.a_r[i], z2[i], bars)
        bar_matrix(bars, power)
        congruent(w[:16], 1, 4, power, other, slope)
        k = 0
        for r in range(4):
            for c in range(r, 4):
                d = TRIANGLE * b + k
                duals[d] = moved(duals[d], w[START + k], w[BODY_RATE], leak, period, slope[4 * r + c])
                k += 1
    for k in range(layout[NUMBERS]):
        code, i = layout[UNKNOWN + count + 2 * k], layout[UNKNOWN + count + 2 * k + 1]
        w, d = weights[first + PER_BODY * count + PER_NUMBER * k :], TRIANGLE * count + k
        felt = w[WIDTH] * z2[i] * factor_of(code, signals.v_r[i], signals.a_r[i], weights[TRANSITION])
        duals[d] = moved(duals[d], w[DUAL], w[RATE], leak, period, felt)


@inlined
def output_of(state: State, target: Target, v_r: Vec, law: Packed, unknown: Packed, s: Vec) -> None:
    """The output that drives adaptation → s."""
    code, rate = unknown.layout[OUTPUT], unknown.weights[OUTPUT_RATE:]
    difference(state.q, target.q, vector(law, at.WRAPS), s)
    for i in range(len(s)):
        if code == OutputCode.VELOCITY:
            s[i] = state.v[i] - v_r[i]
        elif code == OutputCode.FILTERED:
            s[i] = state.v[i] - target.v[i] + rate[i] * s[i]
        else:
            s[i] = math.nan


@inlined
def within(tau: Vec, limit: Vec) -> bool:
    """Whether every torque is within its limit."""
    inside = True
    for i in range(len(tau)):
        inside = inside and abs(tau[i]) <= limit[i]
    return inside


@kernel
def adaptive_step(
    before: Vec, state: State, target: Target, period: float, limit: Vec,
    law: Packed, tree: Packed, unknown: Packed, work: Vec, tau: Vec, duals: Vec, output: Vec,
) -> None:  # fmt: skip
    """Torque, output and duals of one state; `duals` are those before and become those after."""
    n = len(tau)
    v_r, a_r, feedback, work = take3(work, n)
    weights, work = take(work, len(tree.weights))
    tree_work = work[COLUMNS + _MATRICES :]
    signals = Signals(v_r, a_r, feedback)
    signals_of(state, target, law, tree_work, signals)
    for k in range(len(weights)):
        weights[k] = tree.weights[k]
    own = Packed(tree.layout, weights)
    put_estimates(duals, unknown, own, signals, work)
    tree_torque(Motion(state.q, state.v, v_r, a_r), own, tree_work, tau)
    for i in range(n):
        tau[i] += feedback[i]
    # A torque that is cut off does not do what the estimates expect: they wait.
    if within(tau, limit) and is_finite(before):
        move_duals(before, period, unknown, own, signals, work, duals)
    output_of(state, target, v_r, law, unknown, output)


@kernel
def adaptive_law(
    memory: Vec, before: Vec, q: Vec, v: Vec, q_ref: Vec, v_ref: Vec, a_ref: Vec, period: float, limit: Vec,
    layout: Vec, weights: Vec, work: Vec, tau: Vec, memory_out: Vec, output: Vec,
) -> bool:  # fmt: skip
    """One step of an `AdaptiveLaw`.

    Args:
        memory: duals of any number of states laid end to end.
        before: the output of two instants ago, n numbers per state.
        q: position [rad].
        v: velocity [rad/s].
        q_ref: desired position [rad].
        v_ref: desired velocity [rad/s].
        a_ref: desired acceleration [rad/s²].
        period: control period [s].
        limit: torque beyond which the estimates wait [N·m], (n,).
        layout: of law, tree and unknowns, as `pack_adaptive` packs them.
        weights: of these.
        work: scratch space (`adaptive_workspace`).
        tau: written [N·m].
        memory_out: written, the duals after it.
        output: written, of this instant.

    Returns:
        Whether all lengths fit, nothing being done otherwise, and what was written is finite.
    """
    unknown, both = Packed(layout[layout[0] :], weights[layout[1] :]), layout[2 : layout[0]]
    law, tree = Packed(both[2:], weights), Packed(both[both[0] :], weights[both[1] : layout[1]])
    n, size = law.layout[at.JOINTS], len(tau)
    duals = TRIANGLE * unknown.layout[BODIES] + unknown.layout[NUMBERS]
    if not fit(n, size, (before, q, v, q_ref, v_ref, a_ref, output)) or len(limit) != n:
        return False
    if len(memory) != size // n * duals or len(memory_out) != len(memory):
        return False
    memory_out[:] = memory
    for k in range(size // n):
        state, target = State(row(q, k, n), row(v, k, n)), Target(row(q_ref, k, n), row(v_ref, k, n), row(a_ref, k, n))
        adaptive_step(
            row(before, k, n), state, target, period, limit, law, tree, unknown, work,
            row(tau, k, n), row(memory_out, k, duals), row(output, k, n),
        )  # fmt: skip
    return is_finite(tau) and is_finite(memory_out)
