"""M̂ a + Ĉ w + Ĝ of a network with M̂ = R LLᵀ R + εI: one pass forward with two tangents, one pass back.

layout     n, depth, joints that turn, largest layer, then the joints in the order of the features, then per layer:
           size, row length, offset
weights    R (n), ε, scale of V̂, layers [W | b | 0] padded as in `layout.py`
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nbs_pin.kernels.damping import tanh
from nbs_pin.kernels.jit import kernel
from nbs_pin.kernels.layout import PADDING, PART_HEADER, Packed
from nbs_pin.kernels.threads import over_cores


@dataclass(frozen=True, eq=False)
class CholeskyTorque:
    """Rows (m, n) of q, v, w, a, contiguous float64, to rows of M̂ a + Ĉ(q, v) w + Ĝ; many rows run over all cores."""

    packed: Packed

    def __call__(self, q: np.ndarray, v: np.ndarray, w: np.ndarray, a: np.ndarray) -> np.ndarray:
        """The torque of every row [N·m]."""
        tau, room = np.empty_like(q), cholesky_workspace(self.packed)

        def evaluate(part: slice) -> None:
            cholesky_torques(q[part], v[part], w[part], a[part], *self.packed, np.empty(room), tau[part])

        over_cores(evaluate, len(q))
        return tau


def pack_cholesky(
    layers: Sequence[tuple[np.ndarray, np.ndarray]],
    joints: np.ndarray,
    turning: int,
    root: np.ndarray,
    epsilon: float,
    energy: float,
) -> Packed:
    """The layers (W, b) of the network, input to output, the order of the joints in its features, and its scales."""
    matrices = [np.column_stack([w, b, np.zeros((len(b), -(w.shape[1] + 1) % PADDING))]) for w, b in layers]
    offsets = len(root) + 2 + np.cumsum([0, *(m.size for m in matrices)])
    table = [(*m.shape, offset) for m, offset in zip(matrices, offsets[:-1], strict=True)]
    head = [len(root), len(layers), turning, max(max(m.shape) for m in matrices), *joints]
    weights = np.concatenate([root, [epsilon, energy], *(m.ravel() for m in matrices)])
    return Packed(np.concatenate([head, np.ravel(table)]).astype(np.int64), weights.astype(float))


def cholesky_workspace(part: Packed) -> int:
    """How many numbers of scratch space the kernel needs."""
    n, depth, widest = (int(x) for x in part.layout[[0, 1, 3]])
    return (6 + depth) * (widest + PADDING) + 8 * n


@kernel
def _layer(matrix: np.ndarray, u: np.ndarray, du: np.ndarray, out: np.ndarray) -> None:
    """The matrix times u, du[0] and du[1] → the rows of out; padding and bias are set in the inputs."""
    size, length = matrix.shape
    for i in range(size):
        row = matrix[i]
        a, da, db = 0.0, 0.0, 0.0
        for j in range(length):
            a += row[j] * u[j]
            da += row[j] * du[0, j]
            db += row[j] * du[1, j]
        out[0, i], out[1, i], out[2, i] = a, da, db


@kernel
def _features(
    q: np.ndarray, v: np.ndarray, w: np.ndarray, joints: np.ndarray, turning: int, u: np.ndarray, du: np.ndarray
) -> None:
    """Sines, cosines and positions → u, their rates along v and w → du."""
    for k in range(len(joints)):
        i = joints[k]
        if k < turning:
            s, c = math.sin(q[i]), math.cos(q[i])
            u[k], du[0, k], du[1, k] = s, c * v[i], c * w[i]
            u[turning + k], du[0, turning + k], du[1, turning + k] = c, -s * v[i], -s * w[i]
        else:
            u[turning + k], du[0, turning + k], du[1, turning + k] = q[i], v[i], w[i]


@kernel
def _inertial(
    v: np.ndarray, w: np.ndarray, a: np.ndarray, weights: np.ndarray, out: np.ndarray, p: np.ndarray, tau: np.ndarray
) -> None:
    """M̂ a + ½(∂_v M̂ w + ∂_w M̂ v) → tau, from L and its rates in out, which becomes −½ ∂(vᵀM̂w)/∂L in its first row.

    p (6, n): Rv, Rw, Ra, LᵀRv, LᵀRw and LᵀRa + ½(L̇_vᵀRw + L̇_wᵀRv).
    """
    n = len(tau)
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
        tau[i] = weights[i] * total + weights[n] * a[i]
    out[0, k] = weights[n + 1]


@kernel
def cholesky_torque(
    q: np.ndarray,
    v: np.ndarray,
    w: np.ndarray,
    a: np.ndarray,
    layout: np.ndarray,
    weights: np.ndarray,
    work: np.ndarray,
    tau: np.ndarray,
) -> None:
    """M̂ a + Ĉ(q, v) w + Ĝ [N·m] → tau, (n,)."""
    n, depth, turning, room = layout[0], layout[1], layout[2], layout[3] + PADDING
    joints, table = layout[PART_HEADER : PART_HEADER + n], layout[PART_HEADER + n :]
    u, du, out = work[:room], work[room : 3 * room].reshape(2, room), work[3 * room : 6 * room].reshape(3, room)
    slopes = work[6 * room : (6 + depth) * room].reshape(depth, room)
    waves, p = work[(6 + depth) * room :][: 2 * n], work[(6 + depth) * room + 2 * n :][: 6 * n].reshape(6, n)
    size = n + turning
    _features(q, v, w, joints, turning, u, du)
    waves[:size] = u[:size]
    for layer in range(depth):
        u[size], u[size + 1 :], du[:, size:] = 1.0, 0.0, 0.0
        size, length, offset = table[3 * layer : 3 * layer + 3]
        _layer(weights[offset : offset + size * length].reshape(size, length), u, du, out)
        if layer < depth - 1:
            tanh(out[0, :size], u[:size])
            for i in range(size):
                slope = 1.0 - u[i] * u[i]
                slopes[layer, i], du[0, i], du[1, i] = slope, slope * out[1, i], slope * out[2, i]
    _inertial(v, w, a, weights, out, p, tau)
    g = out[0]
    for layer in range(depth - 1, -1, -1):
        size, length, offset = table[3 * layer : 3 * layer + 3]
        matrix = weights[offset : offset + size * length].reshape(size, length)
        u[:length] = 0.0
        for i in range(size):
            row, gain = matrix[i], g[i]
            for j in range(length):
                u[j] += gain * row[j]
        if layer > 0:
            for i in range(table[3 * layer - 3]):
                g[i] = slopes[layer - 1, i] * u[i]
    for k in range(n):
        if k < turning:
            tau[joints[k]] += waves[turning + k] * u[k] - waves[k] * u[turning + k]
        else:
            tau[joints[k]] += u[turning + k]


@kernel
def cholesky_torques(
    q: np.ndarray,
    v: np.ndarray,
    w: np.ndarray,
    a: np.ndarray,
    layout: np.ndarray,
    weights: np.ndarray,
    work: np.ndarray,
    tau: np.ndarray,
) -> None:
    """`cholesky_torque` for every row of arrays (rows, n)."""
    for i in range(len(q)):
        cholesky_torque(q[i], v[i], w[i], a[i], layout, weights, work, tau[i])
