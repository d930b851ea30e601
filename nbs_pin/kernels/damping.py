"""The damping force of one velocity error: two tanh networks and the products with T."""

import numpy as np

from nbs_pin.kernels.jit import exact_kernel, kernel
from nbs_pin.kernels.layout import PADDING, PART_HEADER

_I3, _I5, _I6, _I7, _I8, _I9 = 1 / 3, 1 / 5, 1 / 6, 1 / 7, 1 / 8, 1 / 9
_I10, _I11, _I12, _I13, _I14, _I15 = 1 / 10, 1 / 11, 1 / 12, 1 / 13, 1 / 14, 1 / 15


@exact_kernel
def tanh(x: np.ndarray, y: np.ndarray) -> None:
    """Hyperbolic tangent of x → y, to a few units in the last place, in operations that fill vector registers.

    −e/(2 + e) with e = expm1(−2x), from its series at −2x/64 and six doublings expm1(2w) = e(2 + e).
    """
    for i in range(len(x)):
        w = -2.0 * x[i]
        w = 40.0 if w > 40.0 else w
        w = -40.0 if w < -40.0 else w
        w = w * (1.0 / 64.0)
        e = 1.0 + w * _I13 * (1.0 + w * _I14 * (1.0 + w * _I15))
        e = 1.0 + w * _I9 * (1.0 + w * _I10 * (1.0 + w * _I11 * (1.0 + w * _I12 * e)))
        e = 1.0 + w * _I5 * (1.0 + w * _I6 * (1.0 + w * _I7 * (1.0 + w * _I8 * e)))
        e = w * (1.0 + w * 0.5 * (1.0 + w * _I3 * (1.0 + w * 0.25 * e)))
        e = e * (2.0 + e)
        e = e * (2.0 + e)
        e = e * (2.0 + e)
        e = e * (2.0 + e)
        e = e * (2.0 + e)
        e = e * (2.0 + e)
        y[i] = -e / (2.0 + e)


@kernel
def tanh_network(
    first: int, depth: int, layout: np.ndarray, weights: np.ndarray, x: np.ndarray, h: np.ndarray, out: np.ndarray
) -> None:
    """The linear output of a tanh network at x → out; h is scratch space. `first`: its first layer in the layout."""
    size = len(x)
    h[:size] = x
    for layer in range(first, first + depth):
        h[size], h[size + 1 :] = 1.0, 0.0
        size, length, offset = layout[PART_HEADER + 3 * layer : PART_HEADER + 3 * layer + 3]
        matrix = weights[offset : offset + size * length].reshape(size, length)
        for i in range(size):
            row = matrix[i]
            a = 0.0
            for j in range(length):
                a += row[j] * h[j]
            out[i] = a
        if layer < first + depth - 1:
            tanh(out[:size], h[:size])


@kernel
def damping_force(z: np.ndarray, layout: np.ndarray, weights: np.ndarray, work: np.ndarray, force: np.ndarray) -> None:
    """D(z) z = D₀z + R TᵀT Rz [N·m] → force, (n,)."""
    n, paper, depth, widest = layout[0], layout[1], layout[2], layout[3]
    m, scale, floor = weights[0], weights[1 : 1 + n], weights[1 + n : 1 + n + n * n].reshape(n, n)
    room = widest + PADDING
    x, tx, diagonal, h = work[:n], work[n : 2 * n], work[2 * n : 3 * n], work[3 * n : 3 * n + room]
    out = work[3 * n + room :]
    for i in range(n):
        x[i] = scale[i] * z[i]
    tanh_network(0, depth, layout, weights, x, h, out)
    for i in range(n):
        diagonal[i] = out[i] if not paper else (m if out[i] < 0.0 else out[i] + m)
    tanh_network(depth, depth, layout, weights, x, h, out)
    at = 0
    for i in range(n):  # T x, with row i of T below the diagonal in out[at : at + i]
        tx[i] = diagonal[i] * x[i]
        for j in range(i):
            tx[i] += out[at + j] * x[j]
        at += i
    for i in range(n):
        force[i] = diagonal[i] * tx[i]
    at = 0
    for i in range(n):
        for j in range(i):
            force[j] += out[at + j] * tx[i]
        at += i
    for i in range(n):
        total = 0.0
        for j in range(n):
            total += floor[i, j] * z[j]
        force[i] = total + scale[i] * force[i]
