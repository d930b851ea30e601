"""Interval arithmetic on arrays: the range of an expression whose operands are known only by their ranges."""

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

Numbers: TypeAlias = np.ndarray | np.float64
"""An array or one number."""
OUTWARD = 1.0 + 1e-9
"""Factor that widens a bound by more than the rounding errors of the operations that led to it."""


@dataclass(frozen=True, eq=False)
class Interval:
    """The closed intervals [low, high], elementwise."""

    low: Numbers
    high: Numbers

    @classmethod
    def of(cls, value: Numbers) -> "Interval":
        """The intervals [value, value]."""
        return cls(value, value)

    @classmethod
    def cells(cls, radius: float, count: int) -> "Interval":
        """[−radius, radius] split into `count` equal cells, shape (1, count)."""
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
        """Elementwise sums."""
        if isinstance(other, Interval):
            return Interval(self.low + other.low, self.high + other.high)
        return Interval(self.low + other, self.high + other)

    def __mul__(self, other: "Interval") -> "Interval":
        """Elementwise products: the extremes of the products of the end points."""
        products = np.stack([a * b for a in (self.low, self.high) for b in (other.low, other.high)])
        return Interval(products.min(axis=0), products.max(axis=0))

    def squared(self) -> "Interval":
        """Elementwise squares; the lower end is 0 where the interval contains 0."""
        ends = np.stack([self.low**2, self.high**2])
        contains_zero = (self.low <= 0.0) & (self.high >= 0.0)
        return Interval(np.where(contains_zero, 0.0, ends.min(axis=0)), ends.max(axis=0))

    def through(self, weight: np.ndarray) -> "Interval":
        """The matrix product weight @ self."""
        up, down = np.maximum(weight, 0.0), np.minimum(weight, 0.0)
        return Interval(up @ self.low + down @ self.high, up @ self.high + down @ self.low)

    def times(self, factor: float) -> "Interval":
        """The product with a factor ≥ 0."""
        return Interval(self.low * factor, self.high * factor)

    def hull(self) -> "Interval":
        """The smallest interval that contains all elements."""
        return Interval(self.low.min(), self.high.max())

    def widened(self, factor: float) -> "Interval":
        """Widened at each end by (factor − 1)·max(|low|, |high|), to cover rounding errors."""
        allowance = (factor - 1.0) * np.maximum(np.abs(self.low), np.abs(self.high))
        return Interval(self.low - allowance, self.high + allowance)
