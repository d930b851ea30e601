"""Convex, non-decreasing activations with their first two derivatives, for numpy and torch."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from jaxtyping import Float

from nbs_pin.base.arguments import check_fields, number
from nbs_pin.base.arrays import Array, array_namespace
from nbs_pin.base.intervals import Interval
from nbs_pin.base.known_code import known_code
from nbs_pin.base.storable import storable
from nbs_pin.kernels.layout import ActivationCode

_Derivatives: TypeAlias = tuple[Float[Array, "*shape"], Float[Array, "*shape"], Float[Array, "*shape"]]


class Activation(ABC):
    """σ: ℝ → ℝ, convex and non-decreasing, so that an input-convex network built from it is convex."""

    @abstractmethod
    def derivatives(self, x: Float[Array, "*shape"]) -> _Derivatives:
        """σ(x), σ'(x) and σ''(x)."""

    @property
    def kernel(self) -> tuple[int, float] | None:
        """Code and parameter of the compiled form (`kernels/layout.py`), or None if there is none."""
        return None

    def curvature_range(self, a: Interval) -> Interval:
        """Bounds of σ'' over the intervals; [0, ∞) unless a subclass knows more."""
        return Interval(0.0 * a.low, np.inf + 0.0 * a.high)

    def largest_third_derivative(self, a: Interval) -> Float[np.ndarray, " units"]:
        """Bound of |σ'''| over the intervals; ∞ unless a subclass knows one."""
        return np.full(np.shape(a.low), np.inf)


@known_code
@storable(("d",))
@dataclass(frozen=True)
class SmoothedReLU(Activation):
    """The paper's activation: 0 (x ≤ 0), x²/2d (0 < x < d), x − d/2 (x ≥ d), with d > 0.

    σ'', hence the torque, jumps at 0 and d (docs/theory.md §3). Source: Kolter and Manek 2019, as cited by the paper.
    """

    d: float = 0.01

    def __post_init__(self) -> None:
        check_fields(self, d=number(above=0.0))

    def derivatives(self, x: Float[Array, "*shape"]) -> _Derivatives:
        """σ, σ', σ''; at 0 and d, where σ'' jumps, σ'' = 0."""
        xp = array_namespace(x)
        slope = xp.clip(x / self.d, 0.0, 1.0)
        inside = (x > 0.0) & (x < self.d)
        return slope * (x - 0.5 * self.d * slope), slope, xp.astype(inside, x.dtype) / self.d

    @property
    def kernel(self) -> tuple[int, float]:
        """Code and parameter of the compiled form."""
        return ActivationCode.SMOOTHED_RELU, self.d

    def curvature_range(self, a: Interval) -> Interval:
        """1/d between 0 and d, 0 outside."""
        inside, touching = (a.low > 0.0) & (a.high < self.d), (a.high >= 0.0) & (a.low <= self.d)
        return Interval(inside / self.d, touching / self.d)


@known_code
@storable(("b",))
@dataclass(frozen=True)
class Squareplus(Activation):
    """σ(x) = ½(x + √(x² + b)), b > 0: smooth ReLU (Barron 2021, "Squareplus: a softplus-like algebraic rectifier")."""

    b: float = 1.0

    def __post_init__(self) -> None:
        check_fields(self, b=number(above=0.0))

    def derivatives(self, x: Float[Array, "*shape"]) -> _Derivatives:
        """σ, σ', σ''."""
        root = array_namespace(x).sqrt(x * x + self.b)
        return 0.5 * (x + root), 0.5 * (1.0 + x / root), 0.5 * self.b / (root * root * root)

    @property
    def kernel(self) -> tuple[int, float]:
        """Code and parameter of the compiled form."""
        return ActivationCode.SQUAREPLUS, self.b

    def curvature_range(self, a: Interval) -> Interval:
        """σ'' is unimodal: its minimum is at an end, its maximum at an end or at 0."""
        low, high = (self.derivatives(end)[2] for end in (a.low, a.high))
        top = self.derivatives(np.zeros_like(low))[2]
        return Interval(np.minimum(low, high), np.where((a.low <= 0.0) & (a.high >= 0.0), top, np.maximum(low, high)))

    def largest_third_derivative(self, a: Interval) -> Float[np.ndarray, " units"]:
        """|σ'''| = 3b|x|/2(x² + b)^{5/2} grows up to |x| = ½√b and falls beyond."""
        nearest = np.where(a.low * a.high <= 0.0, 0.0, np.minimum(np.abs(a.low), np.abs(a.high)))
        x = np.clip(0.5 * np.sqrt(self.b), nearest, np.maximum(np.abs(a.low), np.abs(a.high)))
        return np.asarray(1.5 * self.b * x / (x * x + self.b) ** 2.5)
