"""How kernels read packed weights and scratch space, so that offsets have their names in one place."""

from nbs_pin.kernels import layout as at
from nbs_pin.kernels.jit import inlined
from nbs_pin.kernels.layout import Packed
from nbs_pin.kernels.records import PID, Damping, Potential, Vec


@inlined
def row(x: Vec, k: int, n: int) -> Vec:
    """Vector k of vectors of n numbers laid end to end, such as the rows of a matrix."""
    return x[k * n : (k + 1) * n]


@inlined
def take(work: Vec, n: int) -> tuple[Vec, Vec]:
    """The first n numbers of scratch space, and the rest of it."""
    return work[:n], work[n:]


@inlined
def take2(work: Vec, n: int) -> tuple[Vec, Vec, Vec]:
    """Two vectors of n numbers from scratch space, and the rest of it."""
    return work[:n], work[n : 2 * n], work[2 * n :]


@inlined
def take3(work: Vec, n: int) -> tuple[Vec, Vec, Vec, Vec]:
    """Three vectors of n numbers from scratch space, and the rest of it."""
    return work[:n], work[n : 2 * n], work[2 * n : 3 * n], work[3 * n :]


@inlined
def take4(work: Vec, n: int) -> tuple[Vec, Vec, Vec, Vec, Vec]:
    """Four vectors of n numbers from scratch space, and the rest of it."""
    return work[:n], work[n : 2 * n], work[2 * n : 3 * n], work[3 * n : 4 * n], work[4 * n :]


@inlined
def layer(network: Packed, k: int) -> tuple[int, int, Vec]:
    """How many rows a layer has, how long they are, and the rows end to end."""
    start = at.LAYERS + at.PER_LAYER * k
    size, length, offset = network.layout[start], network.layout[start + 1], network.layout[start + 2]
    return size, length, network.weights[offset : offset + size * length]


@inlined
def vector(law: Packed, which: int) -> Vec:
    """One of the vectors that a law's weights begin with."""
    return row(law.weights, which, law.layout[at.JOINTS])


@inlined
def numbers(law: Packed) -> Vec:
    """The numbers that follow these vectors."""
    return law.weights[at.VECTORS * law.layout[at.JOINTS] :]


@inlined
def potential_in(law: Packed) -> Packed:
    """The potential of a law."""
    return Packed(law.layout[law.layout[at.POTENTIAL_LAYOUT] :], law.weights[law.layout[at.POTENTIAL_WEIGHTS] :])


@inlined
def damping_in(law: Packed) -> Packed:
    """The damping of a law."""
    return Packed(law.layout[law.layout[at.DAMPING_LAYOUT] :], law.weights[law.layout[at.DAMPING_WEIGHTS] :])


@inlined
def potential_of(packed: Packed) -> Potential:
    """The potential, or with cotangents for weights those of its weights."""
    layout, w, n = packed.layout, packed.weights, packed.layout[at.SIZE]
    scale, tangent, rest = take2(w[2:], n)
    head = n, layout[at.DEPTH], layout[at.CODE], layout[at.WIDEST]
    return Potential(*head, w[:1], w[1:2], scale, tangent, rest[: n * n])


@inlined
def damping_of(packed: Packed) -> Damping:
    """The damping, or with cotangents for weights those of its weights."""
    layout, w, n = packed.layout, packed.weights, packed.layout[at.SIZE]
    head = n, layout[at.DEPTH], layout[at.CODE], layout[at.WIDEST]
    scale, rest = take(w[2:], n)
    return Damping(*head, w[:1], w[1:2], scale, rest[: n * n])


@inlined
def pid_of(weights: Vec) -> PID:
    """The weights of a PID, or their cotangents."""
    w, n = weights, len(weights) // 6
    return PID(row(w, 0, n), row(w, 1, n), row(w, 2, n), row(w, 3, n), row(w, 4, n), row(w, 5, n))
