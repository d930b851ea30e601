"""A closed loop as a monitor reads it: samples to torques and errors, and their means over a window of readings.

A sample is a matrix (7, n): q, v, q_d, v_d, a_d, the torque applied from then on, and the one commanded. From the
readings of three instants in a row follow the signals of the middle one, (8, n), in the order below, where v and v̇ are
the central differences of the readings:

    U      M(q)v̇ + C(q, v)v + G(q) − TAU, without friction [N·m]
    TAU    torque applied around this instant: the mean of those before and after it [N·m]
    LAG    distance of the command from the torques that the law asks for at the recorded state, or up to a period ahead
           of it, as `simulate` evaluates it [N·m]
    LAW    law at the recorded state [N·m]
    Z1, Z2, V, Q

The hat φ of half-width m has the weights (m − |j|)/m², which sum to 1 (docs/certificates.md §12).
"""

from numba import float64, int64, void

from nbs_pin.kernels import layout as at
from nbs_pin.kernels.convex import potential
from nbs_pin.kernels.jit import compile_for, inlined, kernel
from nbs_pin.kernels.laws import difference, law_workspace, torque_of
from nbs_pin.kernels.layout import Packed
from nbs_pin.kernels.records import Dual, Mat, Motion, State, Target, Vec
from nbs_pin.kernels.trees import place, tree_mass, tree_torque
from nbs_pin.kernels.views import potential_in, take, take3, take4, vector

Q, V, Q_REF, V_REF, A_REF, TAU, COMMAND, SAMPLE = range(8)
"""Rows of a sample, and their number."""
U, TORQUE, LAG, LAW, Z1, Z2, SPEED, READING, SIGNALS = range(9)
"""Rows of the signals of one instant, and their number."""
LAGS = 5
"""The longest delay that is tried as an explanation [periods]."""
VARIED, SPREAD, FROZEN, SPARE, OTHER, MORE = range(6)
"""Rows beside the means: change of V from one half of the window to the other, largest change of TORQUE in a period, 1
for joints whose readings are all equal, scratch space, and their number."""
PHI, PHI_SLACK, KINETIC, KINETIC_SLACK, CENTRE = range(5)
"""Numbers at the centre of a window: Φ(z̄1), its error, ½z̄2ᵀM z̄2, ½δᵀ|M|δ, and their number."""

_VEC, _MAT, _CUBE, _PACKED = float64[::1], float64[:, ::1], float64[:, :, ::1], (int64[::1], float64[::1])


def compile_watching() -> None:
    """Compile the entry points for float64, so that no first call waits for the compiler."""
    compile_for(observe, void(_CUBE, float64, *_PACKED, _VEC, _MAT))
    compile_for(average, void(_CUBE, int64, _MAT, _MAT))
    compile_for(centre, void(_MAT, _VEC, _VEC, float64, *_PACKED, _VEC, _VEC, _VEC))


def watch_workspace(law: Packed, tree: Packed) -> int:
    """Size of the scratch space that these kernels need for a law and its model."""
    n = int(law.layout[at.JOINTS])
    return law_workspace(law, tree) + 16 * n + n * n


@inlined
def parts(layout: Vec, weights: Vec) -> tuple[Packed, Packed]:
    """The law and the tree of `laws.pack_tree_law`."""
    return Packed(layout[2:], weights), Packed(layout[layout[0] :], weights[layout[1] :])


@kernel
def inertia(q: Vec, tree: Packed, work: Vec, mass: Mat) -> None:
    """M(q) → mass, both triangles."""
    place(q, tree, work)
    tree_mass(tree, work, mass)
    for i in range(len(mass)):
        for j in range(i):
            mass[j, i] = mass[i, j]


@kernel
def observe(samples: Mat, period: float, layout: Vec, weights: Vec, work: Vec, out: Mat) -> None:
    """The signals of the middle one of three samples.

    Args:
        samples: (3, 7, n), one period [s] apart.
        period: the time between them [s].
        layout: of law and tree, as `laws.pack_tree_law` packs them.
        weights: of law and tree.
        work: scratch space (`watch_workspace`).
        out: written, (8, n).
    """
    law, tree = parts(layout, weights)
    n = law.layout[at.JOINTS]
    now, wraps = samples[1], vector(law, at.WRAPS)
    before, after, a, half, work = take4(work, n)
    difference(now[Q], samples[0, Q], wraps, before)
    difference(samples[2, Q], now[Q], wraps, after)
    for i in range(n):
        out[SPEED, i] = 0.5 * (after[i] + before[i]) / period
        a[i] = (after[i] - before[i]) / (period * period)
        out[TORQUE, i] = 0.5 * (samples[0, TAU, i] + now[TAU, i])
    tree_torque(Motion(now[Q], out[SPEED], out[SPEED], a), tree, work, out[U])
    torque_of(State(now[Q], now[V]), Target(now[Q_REF], now[V_REF], now[A_REF]), law, tree, work, out[LAW])
    difference(now[Q], now[Q_REF], wraps, out[Z1])
    potential(Dual(out[Z1], a), potential_in(law), work, Dual(before, half))
    rate = vector(law, at.FIRST)
    for i in range(n):
        out[U, i] -= out[TORQUE, i]
        out[Z2, i] = out[SPEED, i] - now[V_REF, i] + rate[i] * before[i]
        out[READING, i] = now[Q, i]
    _ahead(now, samples[2, A_REF], period, law, tree, work, out)


@kernel
def _ahead(now: Mat, a_next: Vec, period: float, law: Packed, tree: Packed, work: Vec, out: Mat) -> None:
    """LAG: the distance of the command from what the law asks for between now and a period ahead."""
    n, h = law.layout[at.JOINTS], period
    q, v, q_ref, v_ref, work = take4(work, n)
    for i in range(n):
        a = now[A_REF, i]
        q[i], v[i] = now[Q, i] + h * (now[V, i] + 0.5 * h * a), now[V, i] + h * a
        q_ref[i], v_ref[i] = now[Q_REF, i] + h * (now[V_REF, i] + 0.5 * h * a), now[V_REF, i] + h * a
    torque_of(State(q, v), Target(q_ref, v_ref, a_next), law, tree, work, out[LAG])
    for i in range(n):
        low, high = min(out[LAW, i], out[LAG, i]), max(out[LAW, i], out[LAG, i])
        out[LAG, i] = now[COMMAND, i] - min(max(now[COMMAND, i], low), high)


@kernel
def average(history: Mat, half: int, mean: Mat, more: Mat) -> None:
    """Means of the signals over the hat φ, which ends at the last row.

    Args:
        history: (2m − 1 + `LAGS`, 8, n), oldest first.
        half: m.
        mean: written, (8, n).
        more: written, (`MORE`, n).
    """
    n, rows = history.shape[2], 2 * half - 1
    flat, numbers = mean.reshape(SIGNALS * n), history.reshape(len(history), SIGNALS * n)
    flat[:] = 0.0
    for j in range(rows):
        weight = float(half - abs(j - half + 1)) / float(half * half)
        for i in range(SIGNALS * n):
            flat[i] += weight * numbers[LAGS + j, i]
    for i in range(n):
        varied, spread, frozen = 0.0, 0.0, 1.0
        for j in range(half - 1):
            varied += history[LAGS + half + j, SPEED, i] - history[LAGS + j, SPEED, i]
        for j in range(LAGS, LAGS + rows):
            spread = max(spread, abs(history[j, TORQUE, i] - history[j - 1, TORQUE, i]))
            if history[j, READING, i] != history[LAGS, READING, i]:
                frozen = 0.0
        more[VARIED, i], more[SPREAD, i], more[FROZEN, i] = varied / half, spread, frozen


@kernel
def earlier(history: Mat, half: int, lag: int, torque: Vec) -> None:
    """The mean of TORQUE over the window that ends `lag` periods earlier → torque."""
    torque[:] = 0.0
    for j in range(2 * half - 1):
        weight = float(half - abs(j - half + 1)) / float(half * half)
        for i in range(len(torque)):
            torque[i] += weight * history[LAGS + j - lag, TORQUE, i]


@kernel
def centre(
    mean: Mat, q: Vec, resolution: Vec, width: float, layout: Vec, weights: Vec, work: Vec, out: Vec, share: Vec
) -> None:
    """V at the means of a window, and what readings of that resolution leave uncertain.

    Args:
        mean: (8, n), from `average`.
        q: reading at the centre of the window [rad].
        resolution: encoder steps r [rad], (n,).
        width: half the length of the window, mh [s].
        layout: of law and tree, as `laws.pack_tree_law` packs them.
        weights: of law and tree.
        work: scratch space (`watch_workspace`).
        out: written, (4,), in [J].
        share: written, |M| r [kg·m²·rad], (n,).
    """
    law, tree = parts(layout, weights)
    n = law.layout[at.JOINTS]
    gradient, bend, radius, work = take3(work, n)
    flat, work = take(work, n * n)
    mass = flat.reshape(n, n)
    for i in range(n):
        radius[i] = 0.5 * resolution[i]
    out[PHI] = potential(Dual(mean[Z1], radius), potential_in(law), work, Dual(gradient, bend))
    inertia(q, tree, work, mass)
    rate = vector(law, at.FIRST)
    for i in range(n):
        radius[i] = resolution[i] / width + rate[i] * abs(bend[i])
    settle(mean[Z2], mass, gradient, radius, resolution, out, share)


@kernel
def settle(z2: Vec, mass: Mat, gradient: Vec, error: Vec, resolution: Vec, out: Vec, share: Vec) -> None:
    """The other numbers of `centre` from M, ∇Φ and the error δ of z̄2."""
    out[PHI_SLACK], out[KINETIC], out[KINETIC_SLACK] = 0.0, 0.0, 0.0
    for i in range(len(z2)):
        row, product, reach, share[i] = mass[i], 0.0, 0.0, 0.0
        for j in range(len(z2)):
            product += row[j] * z2[j]
            reach += abs(row[j]) * error[j]
            share[i] += abs(row[j]) * resolution[j]
        out[KINETIC] += 0.5 * z2[i] * product
        out[KINETIC_SLACK] += 0.5 * error[i] * reach
        out[PHI_SLACK] += 0.5 * abs(gradient[i]) * resolution[i]
    if out[KINETIC] < 0.0:  # by rounding
        out[KINETIC] = 0.0
