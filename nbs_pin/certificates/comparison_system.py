"""Bounds V∞ of V = Φ + W and Φ∞ of Φ under every admissible disturbance, with W = ½z2ᵀM z2.

Along every motion (docs/certificates.md §2), with y² = z2ᵀD₀z2 and some x, s, σ

    Φ̇ = −x² + s,     x² ≥ 2ρΦ,   |s| ≤ xy/√δ,
    Ẇ ≤ −ζs − (1 − β)y² + αxy − 2ωW + σ,     2κW ≤ y² ≤ 2νW,   σ ≤ t y + P.

A set that no choice of x, y, s, σ can leave is invariant: the set below a level of V, and a polygon inside it.
"""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

_SHARES = np.linspace(0.0, 1.0, 401)[1:-1]
_STEEPNESS = np.concatenate([np.linspace(1.0, 4.0, 91)[:-1], np.geomspace(4.0, 1e4, 160)])
_ROWS = 240
_HALVINGS = 14
_LEAST_A = 1e-12
"""Added to a to avoid a division by 0; this can only enlarge the maximum."""
_OUTWARD = 1.0 + 1e-9
"""Each bound is enlarged by this factor, far more than the rounding of the few thousand operations behind it."""


@dataclass(frozen=True)
class ComparisonSystem:
    """The constants of the two inequalities, each rounded to the safe side."""

    rho: float
    """ρ = λ_min(2Λ^½SΛ^½) [1/s]."""
    delta: float
    """δ = λ_min(Λ^½D₀Λ^½)."""
    kappa: float
    """κ = 1/max λ(D₀^-½MD₀^-½) [1/s], 0 if no bound is known."""
    nu: float
    """ν = 1/min λ(D₀^-½MD₀^-½) [1/s], inf if no bound is known."""
    omega: float
    """ω [1/s]."""
    t: float
    """√Δ with Δ = sup τ_dᵀD₀⁻¹τ_d [W], plus the constant part of a model error."""
    alpha: float = 0.0
    """α, from a model error in proportion to ‖q‖ and ‖v‖."""
    beta: float = 0.0
    """β, from a model error in proportion to ‖v‖."""
    coupling: float = 1.0
    """ζ: the share of s, the power that z2 supplies to Φ, that the law takes from W."""

    power: float = 0.0
    """P [W], from Coulomb friction that is fed forward smoothly."""

    @property
    def cross(self) -> float:
        """α + (1 − ζ)/√δ: the coefficient of xy in V̇."""
        return self.alpha + (1.0 - self.coupling) / math.sqrt(self.delta)

    @property
    def is_dissipative(self) -> bool:
        """Whether x² − (α + (1 − ζ)/√δ)xy + (1 − β)y² is positive definite: the condition of Theorem 4 for ζ = 1."""
        return self.beta < 1.0 and self.cross**2 < 4.0 * (1.0 - self.beta)


class Level(NamedTuple):
    """V̇ ≤ −cV + cV∞, so that V(t) ≤ e^{−ct}V(0) + V∞, and V ≤ V∞ is never left."""

    c: float
    """[1/s]."""
    storage: float
    """V∞ [J], inf where c is 0."""


class Polygon(NamedTuple):
    """Accepted edges from (Φ, 0) up to the line Φ + W = V∞ or above it; `heights` rise from edge to edge."""

    start: float
    """Φ at W = 0 [J]."""
    steepness: tuple[float, ...]
    """m = −dW/dΦ of each edge."""
    heights: tuple[float, ...]
    """W at the upper end of each edge [J]."""


def decay(comparison: ComparisonSystem, share: float = 0.0) -> float:
    """The largest c found with x² − axy + (1 − β − share)y² + 2ωW ≥ c(Φ + W) [1/s], 0 if there is none.

    Here a = α + (1 − ζ)/√δ. The two parts are ηx² ≥ 2ηρΦ and r y² + 2ωW ≥ 2(rκ + ω)W, where r ≥ 0 and
    (1 − η)(1 − β − share − r) ≥ a²/4.
    """
    k = comparison
    rest = 1.0 - k.beta - share
    if k.cross == 0.0:
        return max(0.0, min(2.0 * k.rho, 2.0 * (rest * k.kappa + k.omega))) if rest >= 0.0 else 0.0
    eta = _SHARES
    r = rest - 0.25 * k.cross**2 / (1.0 - eta)
    c = np.where(r >= 0.0, np.minimum(2.0 * eta * k.rho, 2.0 * (r * k.kappa + k.omega)), 0.0)
    return float(c.max(initial=0.0))


def level(comparison: ComparisonSystem) -> Level:
    """The least V∞ over the shares θ of y² that compensate the disturbance: ty ≤ θy² + t²/4θ, cV∞ = t²/4θ + P."""
    power = comparison.power * _OUTWARD
    if comparison.t == 0.0:
        c = decay(comparison) / _OUTWARD
        return Level(c, power / c if c > 0.0 else np.inf)
    found = Level(0.0, np.inf)
    for share in (*_SHARES.tolist(), 1.0):
        c = decay(comparison, share) / _OUTWARD
        storage = (comparison.t**2 / (4.0 * share) * _OUTWARD + power) / c if c > 0.0 else np.inf
        if storage < found.storage:
            found = Level(c, storage)
    return found


def reach(comparison: ComparisonSystem, storage: float) -> float:
    """Φ∞ [J]: the least one found such that {V ≤ V∞}, cut off by a polygon from (Φ∞, 0) upwards, is invariant.

    storage: V∞ of `level`.
    """
    found = polygon(comparison, storage)
    return storage if found is None else min(storage, found.start * _OUTWARD)


def polygon(comparison: ComparisonSystem, storage: float) -> Polygon | None:
    """The polygon behind `reach`; None if there is none below the level.

    An edge of steepness m = −dW/dΦ is accepted only if Ẇ + mΦ̇ ≤ 0 on all of it, for every choice of x, y, s, σ.
    """
    if not 0.0 < storage < np.inf:
        return None
    k = replace(comparison, t=comparison.t * _OUTWARD, power=comparison.power * _OUTWARD)
    low, high, best = 0.0, storage, None
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        found = _closed(k, middle, storage)
        if found is None:
            low = middle
        else:
            high, best = middle, found
    return best


def _closed(k: ComparisonSystem, potential: float, storage: float) -> Polygon | None:
    """Accepted edges from (Φ, 0) up to the line Φ + W = V∞; None if they do not reach it."""
    rows = storage * np.linspace(0.0, 1.0, _ROWS + 1) ** 2
    phi, edges = potential, []
    for low, high in zip(rows[:-1].tolist(), rows[1:].tolist(), strict=True):
        end = phi - (high - low) / _STEEPNESS
        steep = np.flatnonzero((end >= 0.0) & (_growth(k, end, low, high) <= 0.0))
        if not len(steep):
            return None
        phi = float(end[steep[-1]])
        edges.append((float(_STEEPNESS[steep[-1]]), high))
        if phi + high >= storage:
            steepness, heights = zip(*edges, strict=True)
            return Polygon(potential, steepness, heights)
    return None


def _growth(k: ComparisonSystem, end: np.ndarray, low: float, high: float) -> np.ndarray:
    """Upper bound of Ẇ + mΦ̇ over Φ ≥ end and W from low to high, for every m of `_STEEPNESS`, m ≥ 1.

    With a = (m − ζ)/√δ + α it is max axy − m x² − (1 − β)y² + ty − 2ωW over x ≥ x₀ and y₀ ≤ y ≤ y₁: for given y the
    best x is max(x₀, ay/2m), which leaves a quadratic in y on either side of y = 2mx₀/a, largest at a border or where
    its slope is 0.
    """
    m, g = _STEEPNESS, 1.0 - k.beta
    a = (m - k.coupling) / np.sqrt(k.delta) + k.alpha + _LEAST_A
    x0 = np.sqrt(2.0 * k.rho * np.maximum(end, 0.0))
    y0, y1 = np.sqrt(2.0 * k.kappa * low), np.sqrt(2.0 * k.nu * high)
    bend = g - a * a / (4.0 * m)
    switch = 2.0 * m * x0 / a
    free = k.t / (2.0 * np.where(bend > 0.0, bend, np.inf))
    ends = [np.full_like(m, y0), np.full_like(m, y1 if np.isfinite(y1) else y0)]
    candidates = np.clip(np.stack([*ends, switch, (a * x0 + k.t) / (2.0 * g), free]), y0, y1)
    x = np.maximum(x0, a * candidates / (2.0 * m))
    values = a * x * candidates - m * x * x - g * candidates**2 + k.t * candidates
    sizes = a * x * candidates + m * x * x + g * candidates**2 + k.t * candidates
    worst = values.max(axis=0) - 2.0 * k.omega * low + k.power
    rounding = 1e-14 * (sizes.max(axis=0) + 2.0 * k.omega * low) + 1e-12 * k.t**2
    return np.where((bend > 0.0) | np.isfinite(y1), worst + rounding, np.inf)
