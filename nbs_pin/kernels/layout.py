"""How weights are packed: one int64 array says where things lie, one float64 array holds them.

A part (`Packed`) is a pair (layout, weights); offsets in a layout count from the start of the part's own weights, so a
part works alone or as a slice of a larger one. Every layer is one row-major matrix whose rows are padded with zeros to
a multiple of 8 numbers:

    input-convex layer   a = [Wx | b | Wy | 0] · [x, 1, y, 0]
    tanh layer           a = [W | b | 0] · [h, 1, 0]

    potential layout     n, depth, activation, widest row, then per layer: size, row length, offset
    potential weights    activation parameter, f(0), R (n), ∇f(0) (n), 2S (n, n), layers
    damping layout       n, 1 for the paper's diagonal, depth, widest row, then per layer of the diagonal network and
                         then of the lower one: size, row length, offset
    damping weights      m, R (n), D₀ (n, n), layers
    law layout           law, n, 1 with friction, start of the potential in the layout and in the weights, the same of
                         the damping, numbers of scratch space
    law weights          continuous (n), first gain (n), second gain (n), viscous (n), coulomb (n), transition, ω,
                         potential, damping
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from nbs_pin.base.arrays import Array, array_namespace

PADDING = 8
"""Row lengths are multiples of this many float64: one cache line, and whole vector registers."""
SMOOTHED_RELU, SQUAREPLUS = 0, 1
"""Activations of a potential."""
BACKSTEPPING, SLOTINE_LI, COMPUTED_TORQUE, PD_REFERENCE, PD_GRAVITY, PID = 0, 1, 2, 3, 4, 5
"""Laws."""
PART_HEADER, LAW_HEADER = 4, 8
"""Numbers in a layout before its layers, and in a law's before its parts."""


class Packed(NamedTuple):
    """Weights in one flat array, and where they lie."""

    layout: np.ndarray
    """int64."""
    weights: Array
    """float64: a numpy array, or a torch tensor of the same numbers, differentiable in what was packed."""


def pack_potential(
    layers: Sequence[tuple[Array | None, Array, Array | None]],
    activation: tuple[int, float],
    scale: Array,
    stiffness: Array,
    tangent: tuple[Array, Array] | None = None,
) -> Packed:
    """Φ(z) = zᵀSz + f(Rz) − f(0) − ∇f(0)ᵀRz from the layers (Wy, Wx, b) of f, all in the kind of R.

    activation: its code and parameter. tangent: f(0), a scalar array, and ∇f(0); None notes zeros, which
    `convex.subtract_tangent` replaces.
    """
    n = len(scale)
    code, parameter = activation
    matrices = [_padded(wx, bias, wy) for wy, wx, bias in layers]
    value, gradient = (0.0 * scale[0], 0.0 * scale) if tangent is None else tangent
    head = [_vector(scale, parameter), value[None], scale, gradient, 2.0 * stiffness.ravel()]
    return _assembled([n, len(layers), code], head, matrices, [len(wx) for _, wx, _ in layers])


def pack_damping(
    networks: tuple[Sequence[tuple[Array, Array]], Sequence[tuple[Array, Array]]],
    paper: bool,
    m: float,
    scale: Array,
    floor: Array,
) -> Packed:
    """D(z) = D₀ + R TᵀT R from the layers (W, b) of T's diagonal and of its rows below, all in the kind of R."""
    layers = [*networks[0], *networks[1]]
    matrices = [_padded(weight, bias) for weight, bias in layers]
    head = [_vector(scale, m), scale, floor.ravel()]
    return _assembled([len(scale), int(paper), len(networks[0])], head, matrices, [len(w) for w, _ in layers])


def pack_law(
    law: int,
    gains: tuple[Array, Array],
    continuous: np.ndarray | None,
    friction: tuple[np.ndarray, np.ndarray, float] | None,
    inertial_rate: float = 0.0,
    potential: Packed | None = None,
    damping: Packed | None = None,
) -> Packed:
    """A whole law: its gains, the joints whose error wraps, its friction (viscous, coulomb, transition), its networks.

    gains: (Λ, –) of backstepping, (λ, K) of Slotine and Li, (k_p, k_d) of the others; the networks are of their kind.
    """
    n = len(gains[0])
    wraps = np.zeros(n) if continuous is None else continuous
    viscous, coulomb, transition = (np.zeros(n), np.zeros(n), 1.0) if friction is None else friction
    constants = [_vector(gains[0], wraps), *gains, _vector(gains[0], viscous, coulomb, transition, inertial_rate)]
    parts = [p for p in (potential, damping) if p is not None]
    layout_at = np.cumsum([LAW_HEADER, *(len(p.layout) for p in parts)])
    weights_at = np.cumsum([5 * n + 2, *(len(p.weights) for p in parts)])
    starts = [layout_at[0], weights_at[0], layout_at[len(parts) - 1], weights_at[len(parts) - 1]]
    head = [law, n, int(friction is not None), *starts, 8 * n + max((workspace(p) for p in parts), default=0)]
    return Packed(
        np.concatenate([head, *(p.layout for p in parts)]).astype(np.int64),
        _joined([*constants, *(p.weights for p in parts)]),
    )


def workspace(part: Packed) -> int:
    """How many numbers of scratch space the kernels of a potential or a damping need."""
    n, widest = int(part.layout[0]), int(part.layout[3])
    sizes = part.layout[PART_HEADER::3]
    return int(4 * (widest + PADDING) + 3 * n + 2 * sizes.sum())


def _vector(like: Array, *constants: np.ndarray | float) -> Array:
    return array_namespace(like).asarray(np.hstack(constants).astype(float))


def _joined(vectors: list[Array]) -> Array:
    xp = array_namespace(*vectors)
    return xp.astype(xp.concat(vectors), xp.float64, copy=False)


def _padded(inputs: Array, bias: Array | None, others: Array | None = None) -> Array:
    """[Wx | b | Wy | 0], row after row; a network without biases has zeros for them."""
    xp = array_namespace(inputs)
    size, width = inputs.shape[0], inputs.shape[1] + 1 + (0 if others is None else others.shape[1])
    column = xp.zeros((size, 1), dtype=inputs.dtype) if bias is None else bias[:, None]
    padding = xp.zeros((size, -width % PADDING), dtype=inputs.dtype)
    return xp.concat([x for x in (inputs, column, others, padding) if x is not None], axis=1)


def _assembled(head: list[int], constants: list[Array], matrices: list[Array], sizes: list[int]) -> Packed:
    start = sum(len(c) for c in constants)
    offsets = start + np.cumsum([0, *(size * m.shape[1] for size, m in zip(sizes, matrices, strict=True))])
    rows = [m.shape[1] for m in matrices]
    table = np.column_stack([sizes, rows, offsets[:-1]]).ravel()
    layout = np.concatenate([[*head, max(rows)], table]).astype(np.int64)
    return Packed(layout, _joined([*constants, *(m.ravel() for m in matrices)]))
