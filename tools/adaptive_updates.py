"""Random updates of an adaptive law's kernel, of any size, and whether every estimate stays within its set."""

from typing import Any, NamedTuple

import numpy as np
from numba import njit

import nbs_pin as nbs
from nbs_pin.kernels.adaptation import (
    BODIES,
    LOWEST,
    NUMBERS,
    OUTPUT_RATE,
    PER_BODY,
    PER_NUMBER,
    WIDTH,
    adaptive_law,
    adaptive_workspace,
    pack_adaptive,
    value_of,
)  # fmt: skip
from nbs_pin.kernels.symmetric4 import TRIANGLE, congruent, eigen, logistic

SIZES = np.array([0.0, 1e-9, 1e-3, 0.1, 1.0, 10.0, 1e3, 1e5, 1e8])
"""Sizes of positions' errors, velocities, accelerations and z2, in SI units."""
PERIODS = np.array([1e-6, 1e-3, 1e-3, 1e-3, 0.1, 10.0, 1e6])
"""Lengths of a step [s]: those far beyond 1 ms make updates far beyond what γ is made for."""
_ROUNDING = 1e-13
"""An eigenvalue below zero by this share of the trace of the largest body is rounding."""
_ANEW = 1000
"""Updates after which the estimates begin anew, from duals at random."""


class Updates(NamedTuple):
    """What happened."""

    count: int
    outside: int
    """Bodies with P̂ or P̄ − P̂ not positive semidefinite."""
    beyond: int
    """Numbers beyond their bounds."""
    not_finite: int
    depth: float
    """Largest −λ_min/tr of all P̂ and P̄ − P̂ with an eigenvalue below zero."""


@njit(nogil=True)
def below_zero(matrix: Any, total: float, work: Any) -> float:
    """−λ_min of a symmetric matrix, as a share of `total`, or 0."""
    work[:16] = matrix
    eigen(work[:16], work[16:32])
    return max(0.0, -min(work[0], work[5], work[10], work[15]) / total)


@njit(nogil=True)
def check(duals: Any, first: int, unknown_layout: Any, unknown: Any, found: Any) -> None:
    """Add what is wrong with the estimates of these duals to found; first: where bodies begin in `unknown`."""
    x, p, other, work = np.empty(16), np.empty(16), np.empty(16), np.empty(52)
    largest, one, count = np.empty(16), np.zeros(16), unknown_layout[BODIES]
    for k in range(4):
        one[5 * k] = 1.0
    for b in range(count):
        factor = unknown[first + PER_BODY * b : first + PER_BODY * b + 16]
        logistic(duals[TRIANGLE * b : TRIANGLE * (b + 1)], work, x)
        congruent(factor, 4, 1, x, other, p)
        congruent(factor, 4, 1, one, other, largest)
        total = largest[0] + largest[5] + largest[10] + largest[15]
        depth = max(below_zero(p, total, work), below_zero(largest - p, total, work))
        found[3] = max(found[3], depth)
        if not (depth <= _ROUNDING and np.isfinite(p).all()):
            found[0] += 1
    for k in range(unknown_layout[NUMBERS]):
        w = unknown[first + PER_BODY * count + PER_NUMBER * k :]
        value = value_of(duals, TRIANGLE * count + k, w)
        if not w[LOWEST] <= value <= w[LOWEST] + w[WIDTH]:
            found[1] += 1


@njit(nogil=True)
def campaign(
    rng: Any, start: Any, count: int, n: int, packed: Any, unknown_layout: Any, unknown: Any, work: Any, sizes: Any,
    periods: Any, found: Any,
) -> None:  # fmt: skip
    """`count` updates; found: bodies outside, numbers beyond, updates that are not finite, depth."""
    duals, after, tau, z2, limit = start.copy(), start.copy(), np.empty(n), np.empty(n), np.full(n, np.inf)
    x = np.empty((6, n))
    for k in range(count):
        if k % _ANEW == 0:
            spread = 10.0 ** rng.uniform(-2.0, 3.0)
            for i in range(len(duals)):
                duals[i] = start[i] + spread * rng.normal()
        for i in range(6):
            size = sizes[rng.integers(0, len(sizes))]
            for j in range(n):
                x[i, j] = size * rng.normal()
        period = periods[rng.integers(0, len(periods))]
        fits = adaptive_law(
            duals, x[0], x[1], x[2], x[3], x[4], x[5], period, limit, packed[0], packed[1], work, tau, after, z2
        )
        if not fits:
            found[2] += 1
            continue
        duals[:] = after
        check(after, OUTPUT_RATE + n, unknown_layout, unknown, found)


def updates(law: nbs.AdaptiveLaw, count: int, seed: int = 0) -> Updates:
    """`count` updates of the law's kernel at random states, with steps from 1 µs to 10⁶ s and no effort limit."""
    tree, inner, unknown = law._believed, law.law.packed_law(), law.unknowns.packed(law.rates, law.leak, law.output)
    packed, work = tuple(pack_adaptive(inner, tree, unknown)), np.empty(adaptive_workspace(inner, tree))
    found = np.zeros(4)
    rng = np.random.default_rng(seed)
    campaign(rng, law.unknowns.start, count, law.nv, packed, *unknown, work, SIZES, PERIODS, found)
    return Updates(count, *(int(x) for x in found[:3]), float(found[3]))
