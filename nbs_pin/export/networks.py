"""The potential and the damping of neural backstepping in C: their weights as constant arrays, and loops over them.

The loops do what `kernels/convex.py` and `kernels/damping.py` do. Every product is y = x W, whose inner loop adds rows
of W: compilers put that into vector registers without reordering a sum. So the layers are stored transposed for the way
forward, and as they are packed for the way back.
"""

import math

import numpy as np

from nbs_pin.export.reals import Real
from nbs_pin.export.templates import filled
from nbs_pin.export.tracing import as_python
from nbs_pin.kernels.layout import PADDING, ActivationCode, DampingCode, Packed
from nbs_pin.kernels.views import damping_of, layer, potential_of

_layer, _potential, _damping = (as_python(view, {}) for view in (layer, potential_of, damping_of))
_SQUAREPLUS = """
const real magnitude = @FABS@(a[i]), square = magnitude * magnitude + @PARAMETER@;
const real root = @SQRT@(square), inverse = 1 / square;
const real value = (real)0.5 * (a[i] + root), first = (real)0.5 * (1 + a[i] * root * inverse);
const real second = @HALF@ * root * inverse * inverse;
"""
_SMOOTHED_RELU = """
const real share = a[i] / @PARAMETER@, s = share < 0 ? 0 : (share > 1 ? 1 : share);
const real value = s * (a[i] - @HALF@ * s), first = s;
const real second = a[i] > 0 && a[i] < @PARAMETER@ ? 1 / @PARAMETER@ : 0;
"""
_ROWS = 4
"""Rows of a matrix that one turn of a loop takes."""
_ACTIVATIONS = {ActivationCode.SQUAREPLUS: _SQUAREPLUS, ActivationCode.SMOOTHED_RELU: _SMOOTHED_RELU}


def potential_c(part: Packed, real: Real) -> str:
    """The tables and functions of a potential (`layout.pack_potential`)."""
    phi = _potential(part)
    layers, n = [_layer(part, k) for k in range(phi.depth)], int(phi.n)
    size, length, last = layers[-1]
    if not np.delete(last.reshape(size, length), n, axis=1).any():  # but for its bias: f is constant
        return "\n".join([real.table("stiffness", phi.stiffness), filled("quadratic.c", {"N": n})])
    sizes = [int(size) for size, _, _ in layers]
    tables = [
        real.table("potential_scale", phi.scale),
        real.table("tangent", phi.tangent),
        real.table("stiffness", phi.stiffness),
    ]
    forward: list[str] = []
    back: list[str] = []
    for k, (size, length, matrix) in enumerate(layers):
        rows = n + 1 + (sizes[k - 1] if k else 0)
        way = matrix.reshape(size, length)
        tables += [_rows(f"potential_{k}", way[:, :rows].T, real), _rows(f"potential_back_{k}", way, real)]
        forward += [f"multiply_dual(potential_{k}, {_whole(rows, _ROWS)}, {_padded(size)}, u, du, a{k}, da{k});"]
        forward += [f"bend({size}, a{k}, da{k}, u + {n + 1}, du + {n + 1});"]
        back[:0] = [
            f"bend_back({size}, g + {n + 1}, dg + {n + 1}, a{k}, da{k});",
            f"multiply_dual(potential_back_{k}, {_whole(size, _ROWS)}, {length}, a{k}, da{k}, g, dg);",
            f"for (int i = 0; i < {n}; i++) {{ sum[i] += g[i]; rate[i] += dg[i]; }}",
        ]
    parameter = float(phi.parameter[0])
    activation = _ACTIVATIONS[ActivationCode(int(phi.code))]
    for name, text in (
        ("@PARAMETER@", real.literal(parameter)),
        ("@HALF@", real.literal(0.5 * parameter)),
        ("@SQRT@", real.function("sqrt")),
        ("@FABS@", real.function("fabs")),
    ):
        activation = activation.replace(name, text)
    words = {
        "N": n,
        "N1": n + 1,
        "INPUTS": _whole(n + 1, _ROWS) + _padded(max(sizes)),
        "WIDEST": max(n + 2, *(int(length) for _, length, _ in layers)),
        "ARRAYS": _lines([f"real a{k}[{_padded(size)}], da{k}[{_padded(size)}];" for k, size in enumerate(sizes)]),
        "ACTIVATION": _lines(activation.strip().splitlines(), 2),
        "FORWARD": _lines(forward),
        "BACK": _lines(back),
    }
    return "\n".join([*tables, filled("potential.c", words)])


def damping_c(part: Packed, real: Real) -> str:
    """The tables and functions of a damping (`layout.pack_damping`)."""
    d = _damping(part)
    n, depth = int(d.n), int(d.depth)
    layers = [_layer(part, k) for k in range(2 * depth)]
    last = (layers[depth - 1][2], layers[2 * depth - 1][2])
    if DampingCode(int(d.code)) is DampingCode.BOUNDED and not any(matrix.any() for matrix in last):
        return "\n".join([real.table("damping_floor", d.floor), filled("constant.c", {"N": n})])
    tables = [real.table("damping_scale", d.scale), real.table("damping_floor", d.floor)]
    calls: dict[str, list[str]] = {"diagonal": [], "lower": []}
    for name, first in (("diagonal", 0), ("lower", depth)):
        inputs, network = n, layers[first : first + depth]
        if network[-1][0] == 0:  # one joint: nothing lies below the diagonal
            calls[name] = ["lower[0] = 0;"]
            continue
        for k, (size, length, matrix) in enumerate(network):
            tables += [_rows(f"{name}_{k}", matrix.reshape(size, length)[:, : inputs + 1].T, real)]
            calls[name] += [f"for (int i = 0; i < {n}; i++) {{ h[i] = x[i]; }}"] if k == 0 else []
            calls[name] += [f"hyperbolic_tangents({_padded(inputs)}, {name}, h);"] if k else []
            calls[name] += [f"h[{inputs}] = 1;"]
            calls[name] += [f"multiply({name}_{k}, {_whole(inputs + 1, _ROWS)}, {_padded(size)}, h, {name});"]
            inputs = int(size)
    if DampingCode(int(d.code)) is DampingCode.PAPER:
        m = real.literal(d.m[0])
        free = f"diagonal[i] = diagonal[i] < 0 ? {m} : diagonal[i] + {m};"
        calls["diagonal"] += [f"for (int i = 0; i < {n}; i++) {{ {free} }}"]
    widest = max(_padded(size) for size, _, _ in layers)
    words = {
        "N": n,
        "FABS": real.function("fabs"),
        "INPUTS": max(n, widest) + _ROWS,
        "WIDEST": widest,
        "DIAGONAL": _lines(calls["diagonal"]),
        "LOWER": _lines(calls["lower"]),
        "INVERSE_CEILING": real.literal(d.inverse_ceiling[0]),
    }
    return "\n".join([*tables, filled("damping.c", words)])


def _rows(name: str, matrix: np.ndarray, real: Real) -> str:
    """The rows of a matrix, as many and as long as the loops take them."""
    rows, columns = matrix.shape
    return real.table(name, np.pad(matrix, ((0, _whole(rows, _ROWS) - rows), (0, _padded(columns) - columns))))


def _whole(size: int, block: int) -> int:
    return block * math.ceil(size / block)


def _padded(size: int) -> int:
    return _whole(size, PADDING)


def _lines(lines: list[str], depth: int = 1) -> str:
    return "\n".join(f"{'    ' * depth}{line}" for line in lines)
