"""Adjoint of ∇Φ and ∇²Φ ż: four sweeps through the network give a third derivative in every direction at once.

s = ḡᵀ∇f(x) + p̄ᵀ∇²f(x)ẋ is a derivative of f: with y₁ along ẋ, y₂ along p̄ and y₁₂ their mixed part, which enters as ḡ,

    a = W u, …, a₁₂ = W u₁₂;  y = σ(a), y₁ = σ'a₁, y₂ = σ'a₂, y₁₂ = σ'a₁₂ + σ''a₁a₂;  s = y₁₂ at the output.

Backwards, with δ = ∂s/∂a and λ = ∂s/∂y,

    δ₁₂ = σ'λ₁₂,  δ₂ = σ'λ₂ + σ''a₁λ₁₂,  δ₁ = σ'λ₁ + σ''a₂λ₁₂,  δ = σ'λ + σ''(a₁λ₁ + a₂λ₂ + a₁₂λ₁₂) + σ'''a₁a₂λ₁₂.

δ₁₂ and δ₂ are the reverse sweep that gives ∇f and ∇²f ẋ themselves, and need no y₂, y₁₂. So the first half (`taped`)
is `convex.potential` with a tape, and the second half (`pull_back`) sends y₂, y₁₂ forward and δ₁, δ back. Each sweep
carries two of the four. In the end ds/dW = δuᵀ + δ₁u₁ᵀ + δ₂u₂ᵀ + δ₁₂u₁₂ᵀ.

The tape holds u, u₁, u₂, u₁₂ of every layer, and eight numbers per unit. Sweeps replace what is no longer needed:

    row         forward   reverse               forward_again   reverse_again
    SLOPE       σ'        σ'                    σ'              σ'
    BEND        σ''       σ''λ₁₂                σ''λ₁₂          σ''λ₁₂
    THIRD       σ'''      σ'''a₁λ₁₂ + σ''λ₂     the same        the same
    ALONG       a₁        σ''a₁                 σ''a₁           σ''a₁
    DELTA_12    a         δ₁₂                   δ₁₂             δ₁₂
    DELTA_2               δ₂                    δ₂              δ₂
    DELTA_1                                     a₂              δ₁
    DELTA                                       a₁₂             δ
"""

from collections import namedtuple

from nbs_pin.kernels.convex import activation
from nbs_pin.kernels.jit import inlined, kernel
from nbs_pin.kernels.layout import Packed
from nbs_pin.kernels.matrices import add_transposed, times_adjoint, times_dual
from nbs_pin.kernels.records import Dual, Vec
from nbs_pin.kernels.views import layer, potential_of, row, take, take2

U, U_1, U_2, U_12, CHANNELS = range(5)
"""Where the inputs of a layer lie on the tape, and how many they are."""
SLOPE, BEND, THIRD, ALONG, DELTA_12, DELTA_2, DELTA_1, DELTA, PER_UNIT = range(9)
"""Where the numbers of a unit lie on the tape, and how many they are."""

Tape = namedtuple("Tape", "psi lam inputs units")
"""∇f(x) − ∇f(0) and ∇²f(x)ẋ (n,); what the layers below a layer gain per input of it, in the two channels of a reverse
sweep (widest row,); u, u₁, u₂, u₁₂ of all layers (4, inputs); the numbers of all units (8, units)."""


@inlined
def tape_sizes(part: Packed) -> tuple[int, int]:
    """Units of all layers; numbers in the inputs of all layers and of one behind them."""
    phi = potential_of(part)
    units, inputs = 0, phi.widest
    for k in range(phi.depth):
        size, length, _ = layer(part, k)
        units, inputs = units + size, inputs + length
    return units, inputs


@kernel
def room_for_potential(part: Packed) -> int:
    """Size of the scratch space that `taped` and `pull_back` need for the potential."""
    phi, (units, inputs) = potential_of(part), tape_sizes(part)
    return 2 * (phi.n + phi.widest) + CHANNELS * inputs + PER_UNIT * units


@inlined
def tape_in(part: Packed, work: Vec) -> Tape:
    """The tape in scratch space."""
    phi, (units, inputs) = potential_of(part), tape_sizes(part)
    psi, psi_rate, work = take2(work, phi.n)
    lam, lam_rate, work = take2(work, phi.widest)
    channels, work = take(work, CHANNELS * inputs)
    numbers, work = take(work, PER_UNIT * units)
    tapes = channels.reshape(CHANNELS, inputs), numbers.reshape(PER_UNIT, units)
    return Tape(Dual(psi, psi_rate), Dual(lam, lam_rate), *tapes)


@kernel
def forward(part: Packed, tape: Tape) -> None:
    """u, u₁ of every layer from those of the first, and per unit σ', σ'', σ''' and a₁."""
    phi, here, at = potential_of(part), 0, 0
    code, parameter = phi.code, phi.parameter[0]
    for k in range(phi.depth):
        size, length, matrix = layer(part, k)
        end, there = at + size, here + length
        tape.inputs[U, here + phi.n] = 1.0
        y, y1 = tape.inputs[U, there + phi.n + 1 :], tape.inputs[U_1, there + phi.n + 1 :]
        slope, bend, third = tape.units[SLOPE, at:end], tape.units[BEND, at:end], tape.units[THIRD, at:end]
        a, a1 = tape.units[DELTA_12, at:end], tape.units[ALONG, at:end]
        times_dual(matrix, tape.inputs[U, here:there], tape.inputs[U_1, here:there], a, a1)
        for i in range(size):
            y[i], slope[i], bend[i], third[i] = activation(code, parameter, a[i])
            y1[i] = slope[i] * a1[i]
        here, at = there, end


@kernel
def reverse(part: Packed, tape: Tape) -> None:
    """∇f(x) → λ[:n] and ∇²f(x)ẋ → λ̇[:n]; per unit δ₁₂, δ₂, and in place of the derivatives what δ, δ₁ need of them."""
    phi, lam12, lam2, units = potential_of(part), tape.lam.value, tape.lam.rate, tape.units
    n, end = phi.n, units.shape[1]
    lam12[:], lam2[:] = 0.0, 0.0
    lam12[n + 1] = 1.0
    for k in range(phi.depth - 1, -1, -1):
        size, length, matrix = layer(part, k)
        at = end - size
        slope, bend, third = units[SLOPE, at:end], units[BEND, at:end], units[THIRD, at:end]
        a1, delta12, delta2 = units[ALONG, at:end], units[DELTA_12, at:end], units[DELTA_2, at:end]
        bend_lam12, mixed, bend_a1 = bend, third, a1  # the same memory, as it is named from here on
        for i in range(size):
            by_y12, by_y2, bent = lam12[n + 1 + i], lam2[n + 1 + i], bend[i] * a1[i]
            delta12[i], delta2[i] = slope[i] * by_y12, slope[i] * by_y2 + bent * by_y12
            mixed[i] = third[i] * a1[i] * by_y12 + bend[i] * by_y2
            bend_lam12[i], bend_a1[i] = bend[i] * by_y12, bent
        lam12[n:], lam2[n:] = 0.0, 0.0
        add_transposed(matrix, delta12, lam12[:length])
        add_transposed(matrix, delta2, lam2[:length])
        end = at


@kernel
def forward_again(part: Packed, tape: Tape) -> None:
    """u₂, u₁₂ of every layer from those of the first, and a₂, a₁₂ per unit."""
    phi, here, at = potential_of(part), 0, 0
    for k in range(phi.depth):
        size, length, matrix = layer(part, k)
        end, there = at + size, here + length
        y2, y12 = tape.inputs[U_2, there + phi.n + 1 :], tape.inputs[U_12, there + phi.n + 1 :]
        slope, bend_a1 = tape.units[SLOPE, at:end], tape.units[ALONG, at:end]
        a2, a12 = tape.units[DELTA_1, at:end], tape.units[DELTA, at:end]
        times_dual(matrix, tape.inputs[U_2, here:there], tape.inputs[U_12, here:there], a2, a12)
        for i in range(size):
            y2[i], y12[i] = slope[i] * a2[i], slope[i] * a12[i] + bend_a1[i] * a2[i]
        here, at = there, end


@kernel
def reverse_again(part: Packed, tape: Tape, part_bar: Packed) -> None:
    """∂s/∂x → λ[:n] and ∂s/∂ẋ → λ̇[:n]; the gradient by the weights of a layer is added to part_bar."""
    phi, lam, lam1, units = potential_of(part), tape.lam.value, tape.lam.rate, tape.units
    n, end, there = phi.n, units.shape[1], tape.inputs.shape[1] - phi.widest
    lam[:], lam1[:] = 0.0, 0.0
    for k in range(phi.depth - 1, -1, -1):
        size, length, matrix = layer(part, k)
        at, here = end - size, there - length
        slope, bend_lam12, mixed = units[SLOPE, at:end], units[BEND, at:end], units[THIRD, at:end]
        bend_a1, delta1, delta = units[ALONG, at:end], units[DELTA_1, at:end], units[DELTA, at:end]
        for i in range(size):
            by_y, by_y1, a2, a12 = lam[n + 1 + i], lam1[n + 1 + i], delta1[i], delta[i]
            delta1[i] = slope[i] * by_y1 + bend_lam12[i] * a2
            delta[i] = slope[i] * by_y + bend_a1[i] * by_y1 + mixed[i] * a2 + bend_lam12[i] * a12
        add_outer(tape, at, here, size, length, layer(part_bar, k)[2])
        lam[n:], lam1[n:] = 0.0, 0.0
        add_transposed(matrix, delta, lam[:length])
        add_transposed(matrix, delta1, lam1[:length])
        end, there = at, here


@kernel
def add_outer(tape: Tape, at: int, here: int, size: int, length: int, matrix_bar: Vec) -> None:
    """Add δ₁₂u₁₂ᵀ + δ₂u₂ᵀ + δ₁u₁ᵀ + δuᵀ to W̄ of the layer whose units start at `at` and whose inputs at `here`."""
    there, units = here + length, tape.units
    u, u1 = tape.inputs[U, here:there], tape.inputs[U_1, here:there]
    u2, u12 = tape.inputs[U_2, here:there], tape.inputs[U_12, here:there]
    for i in range(size):
        w_bar = row(matrix_bar, i, length)
        d12, d2 = units[DELTA_12, at + i], units[DELTA_2, at + i]
        d1, d = units[DELTA_1, at + i], units[DELTA, at + i]
        for j in range(length):
            w_bar[j] += d * u[j] + d1 * u1[j] + d2 * u2[j] + d12 * u12[j]


@kernel
def spread(part: Packed, tape: Tape, channel: int, z: Vec, dz: Vec) -> None:
    """Rz and Rż, the part of u that all layers share, into two channels of their inputs."""
    phi, here = potential_of(part), 0
    for k in range(phi.depth):
        for i in range(phi.n):
            tape.inputs[channel, here + i] = phi.scale[i] * z[i]
            tape.inputs[channel + 1, here + i] = phi.scale[i] * dz[i]
        here += layer(part, k)[1]


@kernel
def taped(error: Dual, part: Packed, work: Vec, out: Dual) -> None:
    """∇Φ(z) and ∇²Φ(z) ż → out as `convex.potential`; work keeps what `pull_back` needs."""
    phi, tape = potential_of(part), tape_in(part, work)
    tape.inputs[:] = 0.0
    spread(part, tape, U, error.value, error.rate)
    forward(part, tape)
    reverse(part, tape)
    times_dual(phi.stiffness, error.value, error.rate, out.value, out.rate)
    for i in range(phi.n):
        tape.psi.value[i], tape.psi.rate[i] = tape.lam.value[i] - phi.tangent[i], tape.lam.rate[i]
        out.value[i] += phi.scale[i] * tape.psi.value[i]
        out.rate[i] += phi.scale[i] * tape.psi.rate[i]


@kernel
def pull_back(error: Dual, out_bar: Dual, part: Packed, work: Vec, error_bar: Dual, weights_bar: Vec) -> None:
    """Add the gradient of out_barᵀ(∇Φ(z), ∇²Φ(z) ż) by z and ż and by the weights of the potential.

    Once per call of `taped` at the same error, whose tape in work it uses up. f(0) and the activation's parameter get
    none. Where σ'' jumps it has the one-sided value that `convex.activation` has, and σ''' = 0.
    """
    part_bar = Packed(part.layout, weights_bar)
    phi, phi_bar, tape = potential_of(part), potential_of(part_bar), tape_in(part, work)
    n, psi, force_bar, rate_bar = phi.n, tape.psi, out_bar.value, out_bar.rate
    spread(part, tape, U_2, rate_bar, force_bar)
    forward_again(part, tape)
    reverse_again(part, tape, part_bar)
    x_bar, dx_bar = tape.lam.value, tape.lam.rate
    for i in range(n):
        error_bar.value[i] += phi.scale[i] * x_bar[i]
        error_bar.rate[i] += phi.scale[i] * dx_bar[i]
        phi_bar.tangent[i] -= phi.scale[i] * force_bar[i]
        phi_bar.scale[i] += error.value[i] * x_bar[i] + error.rate[i] * dx_bar[i]
        phi_bar.scale[i] += rate_bar[i] * psi.rate[i] + force_bar[i] * psi.value[i]
    times_adjoint(phi.stiffness, error.value, force_bar, error_bar.value, phi_bar.stiffness)
    times_adjoint(phi.stiffness, error.rate, rate_bar, error_bar.rate, phi_bar.stiffness)
