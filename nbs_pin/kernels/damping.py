"""The damping force of one velocity error: two tanh networks and the products with T; and its adjoint.

What s = f̄ᵀD(z)z gains, with x = Rz, y = Rf̄, and c = 1/(1 + ‖T‖_F²/b) for a ceiling b, 1 without:
s = f̄ᵀD₀z + c(Ty)ᵀ(Tx), so x̄ = cTᵀ(Ty) and ȳ = cTᵀ(Tx) for T held still, and T̄ = c((Ty)xᵀ + (Tx)yᵀ) − 2(c²/b)(Ty)ᵀ(Tx)T
on and below the diagonal; T̄ then goes back through the two tanh networks.
"""

import math

from nbs_pin.kernels.jit import exact_kernel, inlined, kernel
from nbs_pin.kernels.layout import PADDING, DampingCode, Packed
from nbs_pin.kernels.matrices import times, times_adjoint
from nbs_pin.kernels.records import Vec
from nbs_pin.kernels.views import damping_of, layer, take, take2, take3, take4

_N1, _N2, _N3 = 5 / 39, 2 / 715, 1 / 135135
_D1, _D2, _D3 = 6 / 13, 10 / 429, 4 / 19305
"""tanh w = w(1 + N1 w² + …)/(1 + D1 w² + …), its continued fraction broken off at w²/13."""


@exact_kernel
def tanh(x: Vec, y: Vec) -> None:
    """Hyperbolic tangent of x → y, to a few units in the last place, in operations that fill vector registers.

    n/d of its continued fraction at w = x/8, and three doublings tanh 2w = 2nd/(d² + n²). What is left out, w¹⁵/3e11,
    weighs less the larger x is: dtanh(x) = dx/cosh² x.
    """
    for i in range(len(x)):
        w = 0.125 * x[i]
        w = 2.5 if w > 2.5 else w
        w = -2.5 if w < -2.5 else w
        square = w * w
        n = w * (1.0 + square * (_N1 + square * (_N2 + square * _N3)))
        d = 1.0 + square * (_D1 + square * (_D2 + square * _D3))
        for _ in range(3):
            n, d = 2.0 * n * d, d * d + n * n
        value = n / d
        value = 1.0 if value > 1.0 else value  # by rounding
        y[i] = -1.0 if value < -1.0 else value


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
        times(matrix, h, out[:width])
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
    """D(z) z = D₀z + cR TᵀT Rz [N·m] → force."""
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
    force[:], at, square = 0.0, 0, 0.0
    for i in range(n):  # Tᵀ(T x), with row i of T below the diagonal in out[at : at + i]
        tx = diagonal[i] * x[i]
        square += diagonal[i] * diagonal[i]
        for j in range(i):
            tx += out[at + j] * x[j]
            square += out[at + j] * out[at + j]
        force[i] += diagonal[i] * tx
        for j in range(i):
            force[j] += out[at + j] * tx
        at += i
    share = 1.0 / (1.0 + square * d.inverse_ceiling[0])
    times(d.floor, z, x)
    for i in range(n):
        force[i] = x[i] + d.scale[i] * (share * force[i])


@kernel
def room_for_damping(part: Packed) -> int:
    """Size of the scratch space that `damping_adjoint` needs for the damping."""
    d, tapes = damping_of(part), 0
    for k in range(2 * d.depth):
        tapes += layer(part, k)[1]
    return 5 * d.n + 3 * d.widest + tapes


@kernel
def tanh_reverse(first: int, part: Packed, tape: Vec, out_bar: Vec, h_bar: Vec, part_bar: Packed) -> int:
    """What is gained per x → h_bar[:n] and, added to part_bar, per weight; returns where its tape began.

    tape: up to the last number that `tanh_network` wrote. out_bar, as wide as a layer, is used up.
    """
    at = len(tape)
    for k in range(first + damping_of(part).depth - 1, first - 1, -1):
        size, length, matrix = layer(part, k)
        at -= length
        h, total = tape[at : at + length], h_bar[:length]
        total[:] = 0.0
        times_adjoint(matrix, h, out_bar[:size], total, layer(part_bar, k)[2])
        if k > first:
            for j in range(layer(part, k - 1)[0]):
                out_bar[j] = total[j] * (1.0 - h[j] * h[j])
    return at


@kernel
def limit_of(x: Vec, y: Vec, diagonal: Vec, lower: Vec, inverse_ceiling: float) -> tuple[float, float]:
    """c = 1/(1 + ‖T‖_F²/b), and 2(c²/b)(Ty)ᵀ(Tx); T is its diagonal, and its rows below it end to end."""
    at, square, product = 0, 0.0, 0.0
    for i in range(len(x)):
        tx, ty = diagonal[i] * x[i], diagonal[i] * y[i]
        square += diagonal[i] * diagonal[i]
        for j in range(i):
            tx += lower[at + j] * x[j]
            ty += lower[at + j] * y[j]
            square += lower[at + j] * lower[at + j]
        product += tx * ty
        at += i
    share = 1.0 / (1.0 + square * inverse_ceiling)
    return share, 2.0 * share * share * inverse_ceiling * product


@kernel
def factor_adjoint(x: Vec, y: Vec, diagonal: Vec, lower: Vec, inverse_ceiling: float, x_bar: Vec, y_bar: Vec) -> None:
    """cTᵀ(Ty) → x_bar, cTᵀ(Tx) → y_bar, and T̄ in place of T: its diagonal, and its rows below it end to end."""
    n, at = len(x), 0
    share, drag = limit_of(x, y, diagonal, lower, inverse_ceiling)
    x_bar[:], y_bar[:] = 0.0, 0.0
    for i in range(n):
        tx, ty = diagonal[i] * x[i], diagonal[i] * y[i]
        for j in range(i):
            tx += lower[at + j] * x[j]
            ty += lower[at + j] * y[j]
        tx, ty = share * tx, share * ty
        x_bar[i] += diagonal[i] * ty
        y_bar[i] += diagonal[i] * tx
        diagonal[i] = ty * x[i] + tx * y[i] - drag * diagonal[i]
        for j in range(i):
            x_bar[j] += lower[at + j] * ty
            y_bar[j] += lower[at + j] * tx
            lower[at + j] = ty * x[j] + tx * y[j] - drag * lower[at + j]
        at += i


@kernel
def damping_adjoint(z: Vec, force_bar: Vec, part: Packed, work: Vec, z_bar: Vec, weights_bar: Vec) -> None:
    """Add the gradient of force_barᵀD(z)z by z and by the weights of the damping; m and the ceiling get none."""
    part_bar = Packed(part.layout, weights_bar)
    d, d_bar = damping_of(part), damping_of(part_bar)
    n = d.n
    x, y, x_bar, y_bar, work = take4(work, n)
    diagonal, work = take(work, n)
    h_bar, upper, lower, tapes = take3(work, d.widest)
    for i in range(n):
        x[i], y[i] = d.scale[i] * z[i], d.scale[i] * force_bar[i]
    used = tanh_network(0, part, x, True, tapes, upper)
    used += tanh_network(d.depth, part, x, True, tapes[used:], lower)
    for i in range(n):
        diagonal[i], upper[i] = diagonal_of(d.code, d.m[0], upper[i])
    factor_adjoint(x, y, diagonal, lower, d.inverse_ceiling[0], x_bar, y_bar)
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
    times_adjoint(d.floor, z, force_bar, z_bar, d_bar.floor)
