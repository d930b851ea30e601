"""How weights are packed: one int64 array says where things lie, one float64 array holds them.

A part (`Packed`) is a pair (layout, weights); offsets in a layout count from the start of the part's own weights, so a
part works alone or as a slice of a larger one. Every layer is one row-major matrix whose rows are padded with zeros to
a multiple of 8 numbers:

    input-convex layer   a = [Wx | b | Wy | 0] · [x, 1, y, 0]
    tanh layer           a = [W | b | 0] · [h, 1, 0]

    potential layout     n, depth, activation, widest row or column, then per layer: size, row length, offset
    potential weights    activation parameter, f(0), R (n), ∇f(0) (n), 2S (n, n), layers
    damping layout       n, depth, form, widest row or column, then per layer of the diagonal network and then of the
                         lower one: size, row length, offset
    damping weights      m, 1/ceiling, R (n), D₀ (n, n), layers
    law layout           law, n, 1 with friction, start of the potential in the layout and in the weights, the same of
                         the damping, numbers of scratch space
    law weights          continuous (n), first gain (n), second gain (n), viscous (n), coulomb (n), transition, ω,
                         potential, damping
    PID layout           law, n
    PID weights          k_p (n), k_i (n), k_d (n), effort limit (n), filter time (n), continuous (n)

Kernels read them through `views.py`.
"""

from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple, TypeAlias, TypeVar

import numpy as np

from nbs_pin.base.arrays import Array, array_namespace, constant_like
from nbs_pin.base.exceptions import ArgumentError

LawCode = IntEnum("LawCode", "BACKSTEPPING SLOTINE_LI COMPUTED_TORQUE PD_REFERENCE PD_GRAVITY PID", start=0)
"""Every law that has a kernel and an adjoint (`laws.py`, `law_adjoints.py`)."""
ActivationCode = IntEnum("ActivationCode", "SMOOTHED_RELU SQUAREPLUS", start=0)
"""Every activation of a potential that has a kernel (`convex.activation`)."""
DampingCode = IntEnum("DampingCode", "BOUNDED PAPER", start=0)
"""Every form of a damping that has a kernel (`damping.diagonal_of`)."""
IntegratorCode = IntEnum("IntegratorCode", "EULER SEMI_IMPLICIT_EULER RK4", start=0)
"""Every integrator that rollouts have, by the equations of `simulation/integrators.py`."""
JointCode = IntEnum("JointCode", "REVOLUTE PRISMATIC", start=0)
"""Every joint that a rigid tree may have."""
NumberCode = IntEnum("NumberCode", "VISCOUS COULOMB ROTOR OFFSET ACCELERATION", start=0)
"""Every number of a joint that a law may adapt, by its factor in the torque (`adaptation.factor_of`)."""
OutputCode = IntEnum("OutputCode", "VELOCITY FILTERED", start=0)
"""Every output that drives adaptation: v − v_r, or ż1 + εz1."""

Code = TypeVar("Code", bound=IntEnum)
Layers: TypeAlias = Sequence[tuple[Array, Array]]
"""(W, b), input to output."""

PADDING = 8
"""Row lengths are multiples of this many float64: one cache line, and whole vector registers."""
LAW, JOINTS, FRICTION, POTENTIAL_LAYOUT, POTENTIAL_WEIGHTS, DAMPING_LAYOUT, DAMPING_WEIGHTS, SCRATCH, HEAD = range(9)
"""Where the numbers of a law's layout lie, and where its parts begin."""
WRAPS, FIRST, SECOND, VISCOUS, COULOMB, VECTORS = range(6)
TRANSITION, OMEGA = range(2)
"""Vectors (n,) that a law's weights begin with, and numbers that follow them."""
SIZE, DEPTH, CODE, WIDEST, LAYERS = range(5)
"""Where n, depth, code and widest row or column of a network's layout lie, and where its layers begin."""
PER_LAYER = 3
"""Numbers in the layout for each layer."""


class Packed(NamedTuple):
    """Weights in one flat array, and where they lie."""

    layout: np.ndarray
    """int64."""
    weights: Array
    """float64: a numpy array, or a torch tensor of the same numbers, differentiable in what was packed."""


def known(code: int | str, codes: type[Code], what: str) -> Code:
    """One of the codes that the kernels know.

    Args:
        code: the code, or its name in small letters.
        codes: the list it must be in.
        what: what it stands for, as the message says it.

    Raises:
        ArgumentError: for what no kernel knows.
    """
    for one in codes:
        if code in (one, one.name.lower()):
            return one
    names = ", ".join(f"{one.name.lower()} = {one}" for one in codes)
    raise ArgumentError(f"no kernel knows the {what} '{code}'; give one of {names}.")


def pack_potential(
    layers: Sequence[tuple[Array | None, Array, Array | None]],
    activation: tuple[int, float],
    scale: Array,
    stiffness: Array,
    tangent: tuple[Array, Array] | None = None,
) -> Packed:
    """Φ(z) = zᵀSz + f(Rz) − f(0) − ∇f(0)ᵀRz, all in the kind of R.

    Args:
        layers: (Wy, Wx, b) of f, input to output; no Wy for the first, None for no biases.
        activation: its code and parameter.
        scale: the diagonal R, (n,).
        stiffness: S, (n, n) [J/rad²].
        tangent: f(0), a scalar array, and ∇f(0), (n,); None packs zeros, which `convex.subtract_tangent` replaces.

    Raises:
        ArgumentError: for an activation that no kernel knows.
    """
    code, parameter = known(activation[0], ActivationCode, "activation"), activation[1]
    matrices = [padded(wx, bias, wy) for wy, wx, bias in layers]
    value, gradient = (0.0 * scale[0], 0.0 * scale) if tangent is None else tangent
    head = [_vector(scale, parameter), value[None], scale, gradient, 2.0 * stiffness.ravel()]
    return assembled([len(scale), len(layers), code], head, matrices)


def pack_damping(
    networks: tuple[Layers, Layers], form: int | str, m: float, scale: Array, floor: Array, ceiling: float | None = None
) -> Packed:
    """D(z) = D₀ + R TᵀT R / (1 + ‖T‖_F²/ceiling), all in the kind of R.

    Args:
        networks: layers (W, b) of T's diagonal and of its rows below the diagonal, input to output; as many in both.
        form: code or name of the damping's form.
        m: smallest diagonal entry of T in the paper's form.
        scale: the diagonal R, (n,).
        floor: D₀, (n, n) [N·m·s/rad].
        ceiling: what TᵀT / (1 + ‖T‖_F²/ceiling) stays below, positive; None divides by 1.

    Raises:
        ArgumentError: for a form that no kernel knows.
    """
    code = known(form, DampingCode, "form of a damping")
    matrices = [padded(weight, bias) for network in networks for weight, bias in network]
    head = [_vector(scale, m, 0.0 if ceiling is None else 1.0 / ceiling), scale, floor.ravel()]
    return assembled([len(scale), len(networks[0]), code], head, matrices)


def pack_law(
    law: int,
    gains: tuple[Array, Array],
    continuous: np.ndarray | None,
    friction: tuple[np.ndarray, np.ndarray, float] | None,
    inertial_rate: float = 0.0,
    potential: Packed | None = None,
    damping: Packed | None = None,
) -> Packed:
    """A whole law with a model of the arm; its networks are in the kind of its gains.

    Args:
        law: its code.
        gains: (Λ, –) of backstepping, (λ, K) of Slotine and Li, (k_p, k_d) of the others, (n,) each.
        continuous: 1 for joints whose error wraps, (n,), or None for none.
        friction: viscous [N·m·s/rad] and Coulomb friction [N·m], (n,), and transition speed [rad/s], or None.
        inertial_rate: ω of backstepping [1/s].
        potential: Φ of backstepping.
        damping: D of backstepping.

    Raises:
        ArgumentError: for a law that no kernel knows, PID, or backstepping without its networks.
    """
    code, n = known(law, LawCode, "law"), len(gains[0])
    parts = [p for p in (potential, damping) if p is not None]
    if code is LawCode.PID or len(parts) != (2 if code is LawCode.BACKSTEPPING else 0):
        raise ArgumentError(
            f"{code.name} was packed with {len(parts)} networks; give backstepping its potential and its damping, other"
            " laws none, and PID to pack_pid."
        )
    wraps = np.zeros(n) if continuous is None else continuous
    viscous, coulomb, transition = (np.zeros(n), np.zeros(n), 1.0) if friction is None else friction
    constants = [_vector(gains[0], wraps), *gains, _vector(gains[0], viscous, coulomb, transition, inertial_rate)]
    layout_at = np.cumsum([HEAD, *(len(p.layout) for p in parts)])
    weights_at = np.cumsum([sum(len(c) for c in constants), *(len(p.weights) for p in parts)])
    starts = [layout_at[0], weights_at[0], layout_at[len(parts) - 1], weights_at[len(parts) - 1]]
    head = [code, n, int(friction is not None), *starts, 8 * n + max((workspace(p) for p in parts), default=0)]
    return Packed(
        np.concatenate([head, *(p.layout for p in parts)]).astype(np.int64),
        _joined([*constants, *(p.weights for p in parts)]),
    )


def pack_pid(
    gains: tuple[Array, Array, Array], effort_limit: np.ndarray, filter_time: float, continuous: np.ndarray
) -> Packed:
    """A PID, in the kind of its gains.

    Args:
        gains: k_p [N·m/rad], k_i [N·m/(rad·s)], k_d [N·m·s/rad], (n,) each.
        effort_limit: where saturation begins [N·m], (n,).
        filter_time: of the derivative [s].
        continuous: which joints' error wraps, (n,).
    """
    n = len(gains[0])
    constants = _vector(gains[0], effort_limit, np.full(n, filter_time), continuous)
    return Packed(np.array([LawCode.PID, n]), _joined([*gains, constants]))


def workspace(part: Packed) -> int:
    """Size of the scratch space that the kernels of a potential or a damping need."""
    sizes = part.layout[LAYERS::PER_LAYER]
    return int(4 * (part.layout[WIDEST] + PADDING) + 3 * part.layout[SIZE] + 2 * sizes.sum())


def _vector(like: Array, *constants: np.ndarray | float) -> Array:
    return constant_like(like, np.hstack(constants).astype(float))


def _joined(vectors: list[Array]) -> Array:
    xp = array_namespace(*vectors)
    return xp.astype(xp.concat(vectors), xp.float64, copy=False)


def padded(inputs: Array, bias: Array | None, others: Array | None = None) -> Array:
    """[Wx | b | Wy | 0], row after row; a network without biases has zeros for them."""
    xp = array_namespace(inputs)
    size, width = inputs.shape[0], inputs.shape[1] + 1 + (0 if others is None else others.shape[1])
    column = xp.zeros((size, 1), dtype=inputs.dtype) if bias is None else bias[:, None]
    padding = xp.zeros((size, -width % PADDING), dtype=inputs.dtype)
    return xp.concat([x for x in (inputs, column, others, padding) if x is not None], axis=1)


def assembled(head: list[int], constants: list[Array], matrices: list[Array]) -> Packed:
    """A network of those layers, with n, depth and code in head."""
    start = sum(len(c) for c in constants)
    offsets = start + np.cumsum([0, *(m.shape[0] * m.shape[1] for m in matrices)])
    table = [(*m.shape, offset) for m, offset in zip(matrices, offsets[:-1], strict=True)]
    widest = max(max(m.shape) for m in matrices)
    layout = np.concatenate([[*head, widest], np.ravel(table)]).astype(np.int64)
    return Packed(layout, _joined([*constants, *(m.ravel() for m in matrices)]))
