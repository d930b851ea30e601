"""Adjoint of the damping force: what s = f̄ᵀD(z)z gains per z and per weight.

With x = Rz and y = Rf̄:  s = f̄ᵀD₀z + (Ty)ᵀ(Tx), so T̄ = (Ty)xᵀ + (Tx)yᵀ on and below the diagonal, x̄ = Tᵀ(Ty) and
ȳ = Tᵀ(Tx) for T held still; T̄ then goes back through the two tanh networks.
"""

import numpy as np

from nbs_pin.kernels.convex_adjoint import add_transposed
from nbs_pin.kernels.damping import tanh
from nbs_pin.kernels.jit import kernel
from nbs_pin.kernels.layout import PART_HEADER

_VECTORS = 5


@kernel
def room_for_damping(layout: np.ndarray) -> int:
    """How many numbers of scratch space `damping_adjoint` needs for the damping of that layout."""
    n, tapes = layout[0], 0
    for layer in range(2 * layout[2]):
        tapes += layout[PART_HEADER + 3 * layer + 1]
    return _VECTORS * n + tapes + 3 * layout[3] + n * (n + 1) // 2


@kernel
def tanh_forward(
    first: int, depth: int, layout: np.ndarray, weights: np.ndarray, x: np.ndarray, tape: np.ndarray, out: np.ndarray
) -> int:
    """`damping.tanh_network` → out with the inputs [h, 1, 0] of all layers on the tape; returns how many numbers."""
    size, at = len(x), 0
    h = tape
    for layer in range(first, first + depth):
        width, length, offset = layout[PART_HEADER + 3 * layer : PART_HEADER + 3 * layer + 3]
        h = tape[at : at + length]
        if layer == first:
            h[:size] = x
        else:
            tanh(out[:size], h[:size])
        h[size], h[size + 1 :] = 1.0, 0.0
        for i in range(width):
            row = weights[offset + i * length : offset + (i + 1) * length]
            a = 0.0
            for j in range(length):
                a += row[j] * h[j]
            out[i] = a
        size, at = width, at + length
    return at


@kernel
def tanh_reverse(
    first: int,
    depth: int,
    layout: np.ndarray,
    weights: np.ndarray,
    tape: np.ndarray,
    out_bar: np.ndarray,
    h_bar: np.ndarray,
    weights_bar: np.ndarray,
) -> int:
    """What is gained per x → h_bar[:n] and, added to weights_bar, per weight; returns where its tape began.

    tape: up to the last number that `tanh_forward` wrote. out_bar, as wide as a layer, is used up.
    """
    at = len(tape)
    for layer in range(first + depth - 1, first - 1, -1):
        size, length, offset = layout[PART_HEADER + 3 * layer : PART_HEADER + 3 * layer + 3]
        at -= length
        h, total = tape[at : at + length], h_bar[:length]
        total[:] = 0.0
        add_transposed(weights[offset : offset + size * length], out_bar[:size], total)
        for i in range(size):
            row_bar, delta = weights_bar[offset + i * length : offset + (i + 1) * length], out_bar[i]
            for j in range(length):
                row_bar[j] += delta * h[j]
        if layer > first:
            for j in range(layout[PART_HEADER + 3 * layer - 3]):
                out_bar[j] = total[j] * (1.0 - h[j] * h[j])
    return at


@kernel
def factor_adjoint(
    x: np.ndarray, y: np.ndarray, diagonal: np.ndarray, lower: np.ndarray, x_bar: np.ndarray, y_bar: np.ndarray
) -> None:
    """Tᵀ(Ty) → x_bar, Tᵀ(Tx) → y_bar, and T̄ in place of T: its diagonal, and its rows below it end to end."""
    n, at = len(x), 0
    x_bar[:], y_bar[:] = 0.0, 0.0
    for i in range(n):
        tx, ty = diagonal[i] * x[i], diagonal[i] * y[i]
        for j in range(i):
            tx += lower[at + j] * x[j]
            ty += lower[at + j] * y[j]
        x_bar[i] += diagonal[i] * ty
        y_bar[i] += diagonal[i] * tx
        diagonal[i] = ty * x[i] + tx * y[i]
        for j in range(i):
            x_bar[j] += lower[at + j] * ty
            y_bar[j] += lower[at + j] * tx
            lower[at + j] = ty * x[j] + tx * y[j]
        at += i


@kernel
def damping_adjoint(
    z: np.ndarray,
    force_bar: np.ndarray,
    layout: np.ndarray,
    weights: np.ndarray,
    work: np.ndarray,
    z_bar: np.ndarray,
    weights_bar: np.ndarray,
) -> None:
    """Add the gradient of force_barᵀD(z)z by z and the weights of the damping: (n,) and as weights; m gets none."""
    n, paper, depth, widest = layout[0], layout[1], layout[2], layout[3]
    m, scale, below = weights[0], weights[1 : 1 + n], n * (n - 1) // 2
    x, y, x_bar, y_bar = work[:n], work[n : 2 * n], work[2 * n : 3 * n], work[3 * n : 4 * n]
    diagonal = work[4 * n : 5 * n]
    room = work[_VECTORS * n :]
    h_bar, out = room[:widest], room[widest : 3 * widest + n + below]
    second, tapes, used = widest + n, room[3 * widest + n + below :], 0
    upper, lower = out[:second], out[second:]
    for i in range(n):
        x[i], y[i] = scale[i] * z[i], scale[i] * force_bar[i]
    for k in range(2):
        used += tanh_forward(k * depth, depth, layout, weights, x, tapes[used:], out[k * second :])
    for i in range(n):
        diagonal[i] = upper[i] if not paper else (m if upper[i] < 0.0 else upper[i] + m)
    factor_adjoint(x, y, diagonal, lower, x_bar, y_bar)
    for i in range(n):
        upper[i] = diagonal[i] if not paper or upper[i] > 0.0 else 0.0
    for k in range(1, -1, -1):
        used = tanh_reverse(k * depth, depth, layout, weights, tapes[:used], out[k * second :], h_bar, weights_bar)
        for i in range(n):
            x_bar[i] += h_bar[i]
    for i in range(n):
        z_bar[i] += scale[i] * x_bar[i]
        weights_bar[1 + i] += z[i] * x_bar[i] + force_bar[i] * y_bar[i]
    floor, floor_bar = weights[1 + n :], weights_bar[1 + n :]
    for i in range(n):
        for j in range(n):
            z_bar[j] += floor[i * n + j] * force_bar[i]
            floor_bar[i * n + j] += force_bar[i] * z[j]
