"""Interval arithmetic on arrays: what a value can be when all that is known of its parts is where they lie."""

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

Numbers: TypeAlias = np.ndarray | np.float64
"""An array, or one number."""
OUTWARD = 1.0 + 1e-9
"""Factor that widens a bound by more than the rounding of the operations behind it."""


@dataclass(frozen=True, eq=False)
class Interval:
    """All numbers from `low` to `high`, element by element."""

    low: Numbers
    high: Numbers

    @classmethod
    def of(cls, value: Numbers) -> "Interval":
        """The numbers themselves."""
        return cls(value, value)

    @classmethod
    def cells(cls, radius: float, count: int) -> "Interval":
        """[−radius, radius] in so many cells, (1, count)."""
        edges = np.linspace(-radius, radius, count + 1)[None]
        return cls(edges[:, :-1], edges[:, 1:])

    @property
    def middle(self) -> Numbers:
        """½(low + high)."""
        return 0.5 * (self.low + self.high)

    @property
    def half_width(self) -> Numbers:
        """½(high − low)."""
        return 0.5 * (self.high - self.low)

    def __add__(self, other: "Interval | Numbers") -> "Interval":
        """Sums."""
        if isinstance(other, Interval):
            return Interval(self.low + other.low, self.high + other.high)
        return Interval(self.low + other, self.high + other)

    def __mul__(self, other: "Interval") -> "Interval":
        """Products: least and greatest of those of the ends."""
        products = np.stack([a * b for a in (self.low, self.high) for b in (other.low, other.high)])
        return Interval(products.min(axis=0), products.max(axis=0))

    def squared(self) -> "Interval":
        """Squares, 0 among them where the interval holds 0."""
        ends = np.stack([self.low**2, self.high**2])
        holds_zero = (self.low <= 0.0) & (self.high >= 0.0)
        return Interval(np.where(holds_zero, 0.0, ends.min(axis=0)), ends.max(axis=0))

    def through(self, weight: np.ndarray) -> "Interval":
        """Weight @ interval."""
        up, down = np.maximum(weight, 0.0), np.minimum(weight, 0.0)
        return Interval(up @ self.low + down @ self.high, up @ self.high + down @ self.low)

    def times(self, factor: float) -> "Interval":
        """Multiples by a factor ≥ 0."""
        return Interval(self.low * factor, self.high * factor)

    def hull(self) -> "Interval":
        """The one interval around all."""
        return Interval(self.low.min(), self.high.max())

    def widened(self, factor: float) -> "Interval":
        """Wider by the factor, for rounding."""
        allowance = (factor - 1.0) * np.maximum(np.abs(self.low), np.abs(self.high))
        return Interval(self.low - allowance, self.high + allowance)
