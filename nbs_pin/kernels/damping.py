"""The damping force of one velocity error: two tanh networks and the products with T."""

import math

from nbs_pin.kernels.jit import exact_kernel, inlined, kernel
from nbs_pin.kernels.layout import PADDING, DampingCode, Packed
from nbs_pin.kernels.records import Vec
from nbs_pin.kernels.views import damping_of, layer, row, take, take2

_I3, _I5, _I6, _I7, _I8, _I9 = 1 / 3, 1 / 5, 1 / 6, 1 / 7, 1 / 8, 1 / 9
_I10, _I11, _I12, _I13, _I14, _I15 = 1 / 10, 1 / 11, 1 / 12, 1 / 13, 1 / 14, 1 / 15


@exact_kernel
def tanh(x: Vec, y: Vec) -> None:
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
        for _ in range(6):
            e = e * (2.0 + e)
        y[i] = -e / (2.0 + e)


@kernel
def tanh_network(first: int, part: Packed, x: Vec, taped: bool, tape: Vec, out: Vec) -> int:
    """The linear output of a tanh network at x → out; `first`: its first layer in the layout.

    Taped, the inputs [h, 1, 0] of all its layers follow each other on the tape, and the number of them is returned;
    else they replace each other at its start.
    """
    size, at = len(x), 0
    for k in range(first, first + damping_of(part).depth):
        width, length, matrix = layer(part, k)
        h = tape[at : at + length]
        if k == first:
            h[:size] = x
        else:
            tanh(out[:size], h[:size])
        h[size], h[size + 1 :] = 1.0, 0.0
        for i in range(width):
            w = row(matrix, i, length)
            a = 0.0
            for j in range(length):
                a += w[j] * h[j]
            out[i] = a
        size = width
        if taped:
            at += length
    return at


@inlined
def diagonal_of(code: int, m: float, x: float) -> tuple[float, float]:
    """An entry of T's diagonal from what its network gives, and its derivative."""
    if code == DampingCode.BOUNDED:
        return x, 1.0
    if code == DampingCode.PAPER:
        return m if x < 0.0 else x + m, 1.0 if x > 0.0 else 0.0
    return math.nan, math.nan


@kernel
def damping_force(z: Vec, part: Packed, work: Vec, force: Vec) -> None:
    """D(z) z = D₀z + R TᵀT Rz [N·m] → force."""
    d = damping_of(part)
    n = d.n
    x, diagonal, work = take2(work, n)
    h, out = take(work, d.widest + PADDING)
    for i in range(n):
        x[i] = d.scale[i] * z[i]
    tanh_network(0, part, x, False, h, out)
    for i in range(n):
        diagonal[i], _ = diagonal_of(d.code, d.m[0], out[i])
    tanh_network(d.depth, part, x, False, h, out)
    force[:], at = 0.0, 0
    for i in range(n):  # Tᵀ(T x), with row i of T below the diagonal in out[at : at + i]
        tx = diagonal[i] * x[i]
        for j in range(i):
            tx += out[at + j] * x[j]
        force[i] += diagonal[i] * tx
        for j in range(i):
            force[j] += out[at + j] * tx
        at += i
    for i in range(n):
        total, floor = 0.0, row(d.floor, i, n)
        for j in range(n):
            total += floor[j] * z[j]
        force[i] = total + d.scale[i] * force[i]
