"""Adjoint of ∇Φ and ∇²Φ ż: four sweeps through the network give a third derivative in every direction at once.

s = ḡᵀ∇f(x) + p̄ᵀ∇²f(x)ẋ is a derivative of f: with y₁ along ẋ, y₂ along p̄ and y₁₂ their mixed part, which enters as ḡ,

    a = W u, …, a₁₂ = W u₁₂;  y = σ(a), y₁ = σ'a₁, y₂ = σ'a₂, y₁₂ = σ'a₁₂ + σ''a₁a₂;  s = y₁₂ at the output.

Backwards, with δ for what s gains per a: δ₁₂ = σ'λ₁₂ and δ₂ = σ'λ₂ + σ''a₁λ₁₂ are the reverse sweep that gives ∇f and
∇²f ẋ themselves, and need no y₂, y₁₂. So the first half (`taped`) is `convex.potential` with a tape, and the second
half (`pull_back`) sends y₂, y₁₂ forward and δ₁ = σ'λ₁ + σ''a₂λ₁₂, δ = σ'λ + σ''(a₁λ₁ + a₂λ₂ + a₁₂λ₁₂) + σ'''a₁a₂λ₁₂
back; ds/dW = δuᵀ + δ₁u₁ᵀ + δ₂u₂ᵀ + δ₁₂u₁₂ᵀ. Each sweep carries two of the four.

Tape: u, u₁, u₂, u₁₂ of every layer, then per unit σ', σ''λ₁₂, σ'''a₁λ₁₂ + σ''λ₂, σ''a₁, δ₁₂, δ₂, δ₁ (a₂ before),
δ (a₁₂ before), then λ of one layer twice, then ∇f and ∇²f ẋ.
"""

import math

import numpy as np

from nbs_pin.kernels.jit import kernel
from nbs_pin.kernels.layout import PART_HEADER, SMOOTHED_RELU

_CHANNELS, _PER_UNIT = 4, 8


@kernel
def room_for_potential(layout: np.ndarray) -> int:
    """How many numbers of scratch space the kernels of this file need for the potential of that layout."""
    size, length = tape_sizes(layout)
    return 4 * layout[0] + 2 * layout[3] + _CHANNELS * length + _PER_UNIT * size


@kernel
def tape_sizes(layout: np.ndarray) -> tuple[int, int]:
    """Units of all layers; numbers in the inputs of all layers and of one behind them."""
    size, length = 0, layout[3]
    for layer in range(layout[1]):
        size += layout[PART_HEADER + 3 * layer]
        length += layout[PART_HEADER + 3 * layer + 1]
    return size, length


@kernel
def differentiate(
    code: int, parameter: float, a: np.ndarray, y: np.ndarray, slope: np.ndarray, bend: np.ndarray, third: np.ndarray
) -> None:
    """σ(a) → y and its first three derivatives → slope, bend, third."""
    if code == SMOOTHED_RELU:
        for i in range(len(a)):
            s = a[i] / parameter
            if s < 0.0:
                s = 0.0
            elif s > 1.0:
                s = 1.0
            y[i], slope[i], third[i] = s * (a[i] - 0.5 * parameter * s), s, 0.0
            bend[i] = 1.0 / parameter if 0.0 < a[i] < parameter else 0.0
    else:
        for i in range(len(a)):
            x = a[i]
            inverse = 1.0 / (x * x + parameter)
            root = math.sqrt(x * x + parameter)
            y[i], slope[i] = 0.5 * (x + root), 0.5 * (1.0 + x * root * inverse)
            bend[i] = 0.5 * parameter * root * inverse * inverse
            third[i] = -3.0 * x * inverse * bend[i]


@kernel
def times(matrix: np.ndarray, u: np.ndarray, du: np.ndarray, a: np.ndarray, da: np.ndarray) -> None:
    """W u → a and W u̇ → ȧ, W row by row in `matrix`."""
    length = len(u)
    for i in range(len(a)):
        row = matrix[i * length : (i + 1) * length]
        x, dx = 0.0, 0.0
        for j in range(length):
            x += row[j] * u[j]
            dx += row[j] * du[j]
        a[i], da[i] = x, dx


@kernel
def add_transposed(matrix: np.ndarray, d: np.ndarray, g: np.ndarray) -> None:
    """Add Wᵀδ to g, four rows of W at a time so that g is fetched and stored less often."""
    size, length = len(d), len(g)
    whole = size - size % 4
    for i in range(0, whole, 4):
        r0, r1 = matrix[i * length : (i + 1) * length], matrix[(i + 1) * length : (i + 2) * length]
        r2, r3 = matrix[(i + 2) * length : (i + 3) * length], matrix[(i + 3) * length : (i + 4) * length]
        d0, d1, d2, d3 = d[i], d[i + 1], d[i + 2], d[i + 3]
        for j in range(length):
            g[j] += d0 * r0[j] + d1 * r1[j] + d2 * r2[j] + d3 * r3[j]
    for i in range(whole, size):
        row, di = matrix[i * length : (i + 1) * length], d[i]
        for j in range(length):
            g[j] += di * row[j]


@kernel
def tape_of(layout: np.ndarray, work: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The tape's two parts, (4, inputs of all layers and of one behind them) and (8, units); λ twice, (2, widest)."""
    size, length = tape_sizes(layout)
    start = 4 * layout[0] + 2 * layout[3]
    middle = start + _CHANNELS * length
    inputs = work[start:middle].reshape(_CHANNELS, length)
    tape = work[middle : middle + _PER_UNIT * size].reshape(_PER_UNIT, size)
    return inputs, tape, work[4 * layout[0] : start].reshape(2, layout[3])


@kernel
def forward(layout: np.ndarray, weights: np.ndarray, inputs: np.ndarray, tape: np.ndarray) -> None:
    """u, u₁ of every layer from those of the first, and per unit σ', σ'', σ''' and a₁."""
    n, here, at = layout[0], 0, 0
    for layer in range(layout[1]):
        size, length, offset = layout[PART_HEADER + 3 * layer : PART_HEADER + 3 * layer + 3]
        there, end = here + length + n + 1, at + size
        a, a1 = tape[4, at:end], tape[3, at:end]
        y, y1 = inputs[0, there : there + size], inputs[1, there : there + size]
        u, u1 = inputs[0, here : here + length], inputs[1, here : here + length]
        slope, bend, third = tape[0, at:end], tape[1, at:end], tape[2, at:end]
        times(weights[offset : offset + size * length], u, u1, a, a1)
        differentiate(layout[2], weights[0], a, y, slope, bend, third)
        for i in range(size):
            y1[i] = slope[i] * a1[i]
        here, at = here + length, end


@kernel
def reverse(layout: np.ndarray, weights: np.ndarray, tape: np.ndarray, g: np.ndarray, g1: np.ndarray) -> None:
    """∇f(x) → g[:n] and ∇²f(x)ẋ → g₁[:n]; per unit δ₁₂, δ₂ and, in place of what `forward` left, what δ, δ₁ need."""
    n, depth, at = layout[0], layout[1], tape.shape[1]
    g[:], g1[:] = 0.0, 0.0
    for layer in range(depth - 1, -1, -1):
        size, length, offset = layout[PART_HEADER + 3 * layer : PART_HEADER + 3 * layer + 3]
        at, end = at - size, at
        slope, bend, third, a1 = tape[0, at:end], tape[1, at:end], tape[2, at:end], tape[3, at:end]
        delta12, delta2 = tape[4, at:end], tape[5, at:end]
        if layer == depth - 1:
            g[n + 1] = 1.0
        for i in range(size):
            lam12, lam2, bent = g[n + 1 + i], g1[n + 1 + i], bend[i] * a1[i]
            delta12[i], delta2[i] = slope[i] * lam12, slope[i] * lam2 + bent * lam12
            third[i] = third[i] * a1[i] * lam12 + bend[i] * lam2
            bend[i], a1[i] = bend[i] * lam12, bent
        g[n:], g1[n:] = 0.0, 0.0
        matrix = weights[offset : offset + size * length]
        add_transposed(matrix, delta12, g[:length])
        add_transposed(matrix, delta2, g1[:length])


@kernel
def forward_again(layout: np.ndarray, weights: np.ndarray, inputs: np.ndarray, tape: np.ndarray) -> None:
    """u₂, u₁₂ of every layer from those of the first, and a₂, a₁₂ per unit."""
    n, here, at = layout[0], 0, 0
    for layer in range(layout[1]):
        size, length, offset = layout[PART_HEADER + 3 * layer : PART_HEADER + 3 * layer + 3]
        there, end = here + length + n + 1, at + size
        a2, a12 = tape[6, at:end], tape[7, at:end]
        y2, y12 = inputs[2, there : there + size], inputs[3, there : there + size]
        u2, u12 = inputs[2, here : here + length], inputs[3, here : here + length]
        slope, bent = tape[0, at:end], tape[3, at:end]
        times(weights[offset : offset + size * length], u2, u12, a2, a12)
        for i in range(size):
            y2[i], y12[i] = slope[i] * a2[i], slope[i] * a12[i] + bent[i] * a2[i]
        here, at = here + length, end


@kernel
def reverse_again(
    layout: np.ndarray,
    weights: np.ndarray,
    inputs: np.ndarray,
    tape: np.ndarray,
    g: np.ndarray,
    g1: np.ndarray,
    weights_bar: np.ndarray,
) -> None:
    """What s gains per x → g[:n] and per ẋ → g₁[:n]; what it gains per weight of a layer is added to weights_bar."""
    n, depth, at, here = layout[0], layout[1], tape.shape[1], inputs.shape[1] - layout[3]
    g[:], g1[:] = 0.0, 0.0
    for layer in range(depth - 1, -1, -1):
        size, length, offset = layout[PART_HEADER + 3 * layer : PART_HEADER + 3 * layer + 3]
        at, end, here = at - size, at, here - length
        slope, bent2, bent, bent1 = tape[0, at:end], tape[1, at:end], tape[2, at:end], tape[3, at:end]
        delta1, delta = tape[6, at:end], tape[7, at:end]
        for i in range(size):
            lam, lam1, a2, a12 = g[n + 1 + i], g1[n + 1 + i], delta1[i], delta[i]
            delta1[i] = slope[i] * lam1 + bent2[i] * a2
            delta[i] = slope[i] * lam + bent1[i] * lam1 + bent[i] * a2 + bent2[i] * a12
        matrix = weights[offset : offset + size * length]
        add_outer(tape, at, inputs, here, weights_bar[offset : offset + size * length].reshape(size, length))
        g[n:], g1[n:] = 0.0, 0.0
        add_transposed(matrix, delta, g[:length])
        add_transposed(matrix, delta1, g1[:length])


@kernel
def add_outer(tape: np.ndarray, at: int, inputs: np.ndarray, here: int, matrix_bar: np.ndarray) -> None:
    """Add δ₁₂u₁₂ᵀ + δ₂u₂ᵀ + δ₁u₁ᵀ + δuᵀ to W̄ of the layer whose units start at `at` and whose inputs at `here`."""
    size, length = matrix_bar.shape
    end = here + length
    u, u1, u2, u12 = inputs[0, here:end], inputs[1, here:end], inputs[2, here:end], inputs[3, here:end]
    for i in range(size):
        row = matrix_bar[i]
        x12, x2, x1, x = tape[4, at + i], tape[5, at + i], tape[6, at + i], tape[7, at + i]
        for j in range(length):
            row[j] += x * u[j] + x1 * u1[j] + x2 * u2[j] + x12 * u12[j]


@kernel
def spread(layout: np.ndarray, inputs: np.ndarray, channel: int, scale: np.ndarray, z: np.ndarray) -> None:
    """Rz, the part of u that all layers share, into one channel of their inputs."""
    here = 0
    for layer in range(layout[1]):
        for i in range(layout[0]):
            inputs[channel, here + i] = scale[i] * z[i]
        here += layout[PART_HEADER + 3 * layer + 1]


@kernel
def taped(
    z: np.ndarray,
    dz: np.ndarray,
    layout: np.ndarray,
    weights: np.ndarray,
    work: np.ndarray,
    gradient: np.ndarray,
    product: np.ndarray,
) -> None:
    """∇Φ(z) → gradient and ∇²Φ(z) ż → product, (n,), as `convex.potential`; work keeps what `pull_back` needs."""
    n = layout[0]
    inputs, tape, lam = tape_of(layout, work)
    g, g1 = lam[0], lam[1]
    scale, tangent = weights[2 : 2 + n], weights[2 + n : 2 + 2 * n]
    stiffness = weights[2 + 2 * n : 2 + 2 * n + n * n].reshape(n, n)
    inputs[:] = 0.0
    here = n
    for layer in range(layout[1]):
        inputs[0, here] = 1.0
        here += layout[PART_HEADER + 3 * layer + 1]
    spread(layout, inputs, 0, scale, z)
    spread(layout, inputs, 1, scale, dz)
    forward(layout, weights, inputs, tape)
    reverse(layout, weights, tape, g, g1)
    for i in range(n):
        force, rate = 0.0, 0.0
        for j in range(n):
            force += stiffness[i, j] * z[j]
            rate += stiffness[i, j] * dz[j]
        work[i], work[n + i] = g[i] - tangent[i], g1[i]
        gradient[i], product[i] = scale[i] * work[i] + force, scale[i] * g1[i] + rate


@kernel
def pull_back(
    z: np.ndarray,
    dz: np.ndarray,
    gradient_bar: np.ndarray,
    product_bar: np.ndarray,
    layout: np.ndarray,
    weights: np.ndarray,
    work: np.ndarray,
    z_bar: np.ndarray,
    dz_bar: np.ndarray,
    weights_bar: np.ndarray,
) -> None:
    """`potential_adjoint`, once per call of `taped` at the same z, ż, whose tape it uses up."""
    n = layout[0]
    inputs, tape, lam = tape_of(layout, work)
    g, g1 = lam[0], lam[1]
    scale, tangent_bar = weights[2 : 2 + n], weights_bar[2 + n : 2 + 2 * n]
    spread(layout, inputs, 2, scale, product_bar)
    spread(layout, inputs, 3, scale, gradient_bar)
    forward_again(layout, weights, inputs, tape)
    reverse_again(layout, weights, inputs, tape, g, g1, weights_bar)
    for i in range(n):
        z_bar[i] += scale[i] * g[i]
        dz_bar[i] += scale[i] * g1[i]
        tangent_bar[i] -= scale[i] * gradient_bar[i]
        weights_bar[2 + i] += z[i] * g[i] + dz[i] * g1[i] + product_bar[i] * work[n + i] + gradient_bar[i] * work[i]
    stiffness = weights[2 + 2 * n : 2 + 2 * n + n * n].reshape(n, n)
    stiffness_bar = weights_bar[2 + 2 * n : 2 + 2 * n + n * n].reshape(n, n)
    for i in range(n):
        for j in range(n):
            z_bar[j] += stiffness[i, j] * gradient_bar[i]
            dz_bar[j] += stiffness[i, j] * product_bar[i]
            stiffness_bar[i, j] += gradient_bar[i] * z[j] + product_bar[i] * dz[j]


@kernel
def potential_adjoint(
    z: np.ndarray,
    dz: np.ndarray,
    gradient_bar: np.ndarray,
    product_bar: np.ndarray,
    layout: np.ndarray,
    weights: np.ndarray,
    work: np.ndarray,
    z_bar: np.ndarray,
    dz_bar: np.ndarray,
    weights_bar: np.ndarray,
) -> None:
    """Add the gradient of gradient_barᵀ∇Φ(z) + product_barᵀ∇²Φ(z) ż by z, ż and the weights of the potential.

    Vectors (n,), weights_bar as weights; f(0) and the activation's parameter get none. Where σ'' jumps it has the
    one-sided value that `convex.activate` has, and σ''' = 0.
    """
    n = layout[0]
    taped(z, dz, layout, weights, work, work[2 * n : 3 * n], work[3 * n : 4 * n])
    pull_back(z, dz, gradient_bar, product_bar, layout, weights, work, z_bar, dz_bar, weights_bar)
