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
from typing import Any, NamedTuple

import numpy as np

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
    weights: np.ndarray
    """float64."""


def pack_potential(
    layers: Sequence[tuple[np.ndarray | None, np.ndarray, np.ndarray | None]],
    activation: tuple[int, float],
    scale: np.ndarray,
    stiffness: np.ndarray,
) -> Packed:
    """Φ(z) = zᵀSz + f(Rz) from the layers (Wy, Wx, b) of f, with f(0) = 0 and ∇f(0) = 0 noted.

    For the Bregman form see `convex.subtract_tangent`. activation: its code and parameter.
    """
    n = len(scale)
    code, parameter = activation
    matrices = [_padded(wx, _column(bias, len(wx)), wy) for wy, wx, bias in layers]
    head = [[parameter, 0.0], scale, np.zeros(n), (2.0 * stiffness).ravel()]
    return _assembled([n, len(layers), code], head, matrices, [len(wx) for _, wx, _ in layers])


def pack_damping(
    networks: tuple[Sequence[tuple[np.ndarray, np.ndarray]], Sequence[tuple[np.ndarray, np.ndarray]]],
    paper: bool,
    m: float,
    scale: np.ndarray,
    floor: np.ndarray,
) -> Packed:
    """D(z) = D₀ + R TᵀT R from the layers (W, b) of the networks of T's diagonal and of its rows below."""
    layers = [*networks[0], *networks[1]]
    matrices = [_padded(weight, _column(bias, len(weight))) for weight, bias in layers]
    head = [[m], scale, floor.ravel()]
    return _assembled([len(scale), int(paper), len(networks[0])], head, matrices, [len(w) for w, _ in layers])


def pack_law(
    law: int,
    gains: tuple[np.ndarray, np.ndarray],
    continuous: np.ndarray | None,
    friction: tuple[np.ndarray, np.ndarray, float] | None,
    inertial_rate: float = 0.0,
    potential: Packed | None = None,
    damping: Packed | None = None,
) -> Packed:
    """A whole law: its gains, the joints whose error wraps, its friction (viscous, coulomb, transition), its networks.

    gains: (Λ, –) of backstepping, (λ, K) of Slotine and Li, (k_p, k_d) of the others.
    """
    n = len(gains[0])
    wraps = np.zeros(n) if continuous is None else continuous
    viscous, coulomb, transition = (np.zeros(n), np.zeros(n), 1.0) if friction is None else friction
    constants = [wraps, *gains, viscous, coulomb, [transition, inertial_rate]]
    parts = [p for p in (potential, damping) if p is not None]
    layout_at = np.cumsum([LAW_HEADER, *(len(p.layout) for p in parts)])
    weights_at = np.cumsum([5 * n + 2, *(len(p.weights) for p in parts)])
    starts = [layout_at[0], weights_at[0], layout_at[len(parts) - 1], weights_at[len(parts) - 1]]
    head = [law, n, int(friction is not None), *starts, 8 * n + max((workspace(p) for p in parts), default=0)]
    return Packed(
        np.concatenate([head, *(p.layout for p in parts)]).astype(np.int64),
        np.concatenate([*constants, *(p.weights for p in parts)]).astype(float),
    )


def workspace(part: Packed) -> int:
    """How many numbers of scratch space the kernels of a potential or a damping need."""
    n, widest = int(part.layout[0]), int(part.layout[3])
    sizes = part.layout[PART_HEADER::3]
    return int(4 * (widest + PADDING) + 3 * n + 2 * sizes.sum())


def _column(bias: np.ndarray | None, size: int) -> np.ndarray:
    return np.zeros((size, 1)) if bias is None else bias[:, None]


def _padded(*blocks: np.ndarray | None) -> np.ndarray:
    row = np.hstack([block for block in blocks if block is not None])
    return np.pad(row, ((0, 0), (0, -row.shape[1] % PADDING)))


def _assembled(head: list[int], constants: list[Any], matrices: list[np.ndarray], sizes: list[int]) -> Packed:
    start = sum(len(c) for c in constants)
    offsets = start + np.cumsum([0, *(m.size for m in matrices)])
    rows = [m.shape[1] for m in matrices]
    table = np.column_stack([sizes, rows, offsets[:-1]]).ravel()
    layout = np.concatenate([[*head, max(rows)], table]).astype(np.int64)
    return Packed(layout, np.concatenate([*constants, *(m.ravel() for m in matrices)]).astype(float))
