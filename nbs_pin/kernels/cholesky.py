"""M̂ a + Ĉ w + Ĝ of a network with M̂ = R LLᵀ R + εI: one pass forward with two tangents, one pass back.

layout     n, depth, joints that turn, widest row or column, then per layer: size, row length, offset, then the joints
           in the order of the features
weights    R (n), ε, scale of V̂, layers [W | b | 0] padded as in `layout.py`
"""

from dataclasses import dataclass

import numpy as np

from nbs_pin.kernels.damping import tanh
from nbs_pin.kernels.jit import kernel
from nbs_pin.kernels.layout import (
    CODE,
    DEPTH,
    LAYERS,
    PADDING,
    PER_LAYER,
    SIZE,
    WIDEST,
    Layers,
    Packed,
    assembled,
    padded,
)
from nbs_pin.kernels.matrices import add_transposed, times, times_dual
from nbs_pin.kernels.records import Mat, Vec
from nbs_pin.kernels.threads import over_cores
from nbs_pin.kernels.views import layer, row, take


@dataclass(frozen=True, eq=False)
class CholeskyTorque:
    """Rows (m, n) of q, v, w, a, contiguous float64, to rows of M̂ a + Ĉ(q, v) w + Ĝ; many rows run over all cores."""

    packed: Packed

    def __call__(self, q: np.ndarray, v: np.ndarray, w: np.ndarray, a: np.ndarray) -> np.ndarray:
        """The torque of every row [N·m]."""
        tau, size = np.empty_like(q), cholesky_workspace(self.packed)

        def evaluate(part: slice) -> None:
            cholesky_torques(q[part], v[part], w[part], a[part], *self.packed, np.empty(size), tau[part])

        over_cores(evaluate, len(q))
        return tau


def pack_cholesky(
    layers: Layers, joints: np.ndarray, turning: int, root: np.ndarray, epsilon: float, energy: float
) -> Packed:
    """A Cholesky network.

    Args:
        layers: (W, b), input to output.
        joints: the joints in the order of its features, those that turn first.
        turning: how many turn.
        root: R, (n,) [√(kg·m²)].
        epsilon: ε [kg·m²].
        energy: scale of V̂ [J].
    """
    matrices, scales = [padded(w, b) for w, b in layers], np.array([epsilon, energy])
    layout, weights = assembled([len(root), len(layers), turning], [root, scales], matrices)
    return Packed(np.concatenate([layout, joints]).astype(np.int64), weights)


def cholesky_workspace(part: Packed) -> int:
    """Size of the scratch space that the kernels need."""
    n, depth, widest = (int(x) for x in part.layout[[SIZE, DEPTH, WIDEST]])
    return (6 + depth) * (widest + PADDING) + 8 * n


@kernel
def _features(q: Vec, v: Vec, w: Vec, joints: Vec, turning: int, u: Vec, du: Mat) -> None:
    """Sines, cosines and positions → u, their rates along v and w → du."""
    for k in range(len(joints)):
        i = joints[k]
        if k < turning:
            s, c = np.sin(q[i]), np.cos(q[i])
            u[k], du[0, k], du[1, k] = s, c * v[i], c * w[i]
            u[turning + k], du[0, turning + k], du[1, turning + k] = c, -s * v[i], -s * w[i]
        else:
            u[turning + k], du[0, turning + k], du[1, turning + k] = q[i], v[i], w[i]


@kernel
def _inertial(v: Vec, w: Vec, a: Vec, weights: Vec, out: Mat, p: Mat, tau: Vec) -> None:
    """M̂ a + ½(∂_v M̂ w + ∂_w M̂ v) → tau, from L and its rates in out, which becomes −½ ∂(vᵀM̂w)/∂L in its first row.

    p (6, n): Rv, Rw, Ra, LᵀRv, LᵀRw and LᵀRa + ½(L̇_vᵀRw + L̇_wᵀRv).
    """
    n = len(tau)
    epsilon, energy = weights[n], weights[n + 1]
    for i in range(n):
        root = weights[i]
        p[0, i], p[1, i], p[2, i] = root * v[i], root * w[i], root * a[i]
        p[3, i], p[4, i], p[5, i] = 0.0, 0.0, 0.0
    k = 0
    for i in range(n):
        for j in range(i + 1):
            p[3, j] += out[0, k] * p[0, i]
            p[4, j] += out[0, k] * p[1, i]
            p[5, j] += out[0, k] * p[2, i] + 0.5 * (out[1, k] * p[1, i] + out[2, k] * p[0, i])
            k += 1
    k = 0
    for i in range(n):
        total = 0.0
        for j in range(i + 1):
            total += out[0, k] * p[5, j] + 0.5 * (out[1, k] * p[4, j] + out[2, k] * p[3, j])
            out[0, k] = -0.5 * (p[0, i] * p[4, j] + p[1, i] * p[3, j])
            k += 1
        tau[i] = weights[i] * total + epsilon * a[i]
    out[0, k] = energy


@kernel
def cholesky_torque(q: Vec, v: Vec, w: Vec, a: Vec, part: Packed, work: Vec, tau: Vec) -> None:
    """M̂ a + Ĉ(q, v) w + Ĝ [N·m] → tau, (n,)."""
    n, depth, turning, widest = part.layout[SIZE], part.layout[DEPTH], part.layout[CODE], part.layout[WIDEST]
    joints, width = part.layout[LAYERS + PER_LAYER * depth :], widest + PADDING
    u, work = take(work, width)
    rates, work = take(work, 2 * width)
    outputs, work = take(work, 3 * width)
    slopes, work = take(work, depth * width)
    waves, work = take(work, 2 * n)
    du, out, p = rates.reshape(2, width), outputs.reshape(3, width), work[: 6 * n].reshape(6, n)
    size = n + turning
    _features(q, v, w, joints, turning, u, du)
    waves[:size] = u[:size]
    for k in range(depth):
        u[size], u[size + 1 :], du[:, size:] = 1.0, 0.0, 0.0
        size, length, matrix = layer(part, k)
        times(matrix, u[:length], out[0, :size])
        times_dual(matrix, du[0, :length], du[1, :length], out[1, :size], out[2, :size])
        if k < depth - 1:
            tanh(out[0, :size], u[:size])
            slope = row(slopes, k, width)
            for i in range(size):
                slope[i] = 1.0 - u[i] * u[i]
                du[0, i], du[1, i] = slope[i] * out[1, i], slope[i] * out[2, i]
    _inertial(v, w, a, part.weights, out, p, tau)
    g = out[0]
    for k in range(depth - 1, -1, -1):
        size, length, matrix = layer(part, k)
        u[:length] = 0.0
        add_transposed(matrix, g[:size], u[:length])
        if k > 0:
            slope = row(slopes, k - 1, width)
            for i in range(layer(part, k - 1)[0]):
                g[i] = slope[i] * u[i]
    for k in range(n):
        if k < turning:
            tau[joints[k]] += waves[turning + k] * u[k] - waves[k] * u[turning + k]
        else:
            tau[joints[k]] += u[turning + k]


@kernel
def cholesky_torques(q: Mat, v: Mat, w: Mat, a: Mat, layout: Vec, weights: Vec, work: Vec, tau: Mat) -> None:
    """`cholesky_torque` for every row of arrays (rows, n)."""
    for i in range(len(q)):
        cholesky_torque(q[i], v[i], w[i], a[i], Packed(layout, weights), work, tau[i])
