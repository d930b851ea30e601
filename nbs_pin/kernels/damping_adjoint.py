"""Adjoint of the damping force: what s = f̄ᵀD(z)z gains per z and per weight.

With x = Rz and y = Rf̄:  s = f̄ᵀD₀z + (Ty)ᵀ(Tx), so T̄ = (Ty)xᵀ + (Tx)yᵀ on and below the diagonal, x̄ = Tᵀ(Ty) and
ȳ = Tᵀ(Tx) for T held still; T̄ then goes back through the two tanh networks.
"""

from nbs_pin.kernels.convex_adjoint import add_transposed
from nbs_pin.kernels.damping import diagonal_of, tanh_network
from nbs_pin.kernels.jit import kernel
from nbs_pin.kernels.layout import Packed
from nbs_pin.kernels.records import Vec
from nbs_pin.kernels.views import damping_of, layer, row, take, take4


@kernel
def room_for_damping(part: Packed) -> int:
    """How many numbers of scratch space `damping_adjoint` needs for the damping."""
    d, tapes = damping_of(part), 0
    for k in range(2 * d.depth):
        tapes += layer(part, k)[1]
    return 5 * d.n + tapes + 3 * d.widest + d.n * (d.n + 1) // 2


@kernel
def tanh_reverse(first: int, part: Packed, tape: Vec, out_bar: Vec, h_bar: Vec, part_bar: Packed) -> int:
    """What is gained per x → h_bar[:n] and, added to part_bar, per weight; returns where its tape began.

    tape: up to the last number that `damping.tanh_network` wrote. out_bar, as wide as a layer, is used up.
    """
    at = len(tape)
    for k in range(first + damping_of(part).depth - 1, first - 1, -1):
        size, length, matrix = layer(part, k)
        at -= length
        h, total, matrix_bar = tape[at : at + length], h_bar[:length], layer(part_bar, k)[2]
        total[:] = 0.0
        add_transposed(matrix, out_bar[:size], total)
        for i in range(size):
            row_bar, delta = row(matrix_bar, i, length), out_bar[i]
            for j in range(length):
                row_bar[j] += delta * h[j]
        if k > first:
            for j in range(layer(part, k - 1)[0]):
                out_bar[j] = total[j] * (1.0 - h[j] * h[j])
    return at


@kernel
def factor_adjoint(x: Vec, y: Vec, diagonal: Vec, lower: Vec, x_bar: Vec, y_bar: Vec) -> None:
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
def damping_adjoint(z: Vec, force_bar: Vec, part: Packed, work: Vec, z_bar: Vec, weights_bar: Vec) -> None:
    """Add the gradient of force_barᵀD(z)z by z and by the weights of the damping; m gets none."""
    part_bar = Packed(part.layout, weights_bar)
    d, d_bar = damping_of(part), damping_of(part_bar)
    n = d.n
    x, y, x_bar, y_bar, work = take4(work, n)
    diagonal, work = take(work, n)
    h_bar, work = take(work, d.widest)
    upper, work = take(work, d.widest + n)  # outputs of a network's layers, the last of which may be the widest
    lower, tapes = take(work, d.widest + n * (n - 1) // 2)
    for i in range(n):
        x[i], y[i] = d.scale[i] * z[i], d.scale[i] * force_bar[i]
    used = tanh_network(0, part, x, True, tapes, upper)
    used += tanh_network(d.depth, part, x, True, tapes[used:], lower)
    for i in range(n):
        diagonal[i], upper[i] = diagonal_of(d.code, d.m[0], upper[i])
    factor_adjoint(x, y, diagonal, lower, x_bar, y_bar)
    for i in range(n):
        upper[i] *= diagonal[i]
    used = tanh_reverse(d.depth, part, tapes[:used], lower, h_bar, part_bar)
    for i in range(n):
        x_bar[i] += h_bar[i]
    tanh_reverse(0, part, tapes[:used], upper, h_bar, part_bar)
    for i in range(n):
        x_bar[i] += h_bar[i]
        z_bar[i] += d.scale[i] * x_bar[i]
        d_bar.scale[i] += z[i] * x_bar[i] + force_bar[i] * y_bar[i]
    for i in range(n):
        floor, floor_bar = row(d.floor, i, n), row(d_bar.floor, i, n)
        for j in range(n):
            z_bar[j] += floor[j] * force_bar[i]
            floor_bar[j] += force_bar[i] * z[j]
