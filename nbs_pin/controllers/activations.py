"""Convex, non-decreasing activations with their first two derivatives, for numpy and torch alike."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

from jaxtyping import Float

from nbs_pin.base.arrays import Array, array_namespace
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.kernels.layout import ActivationCode


class Activation(ABC):
    """σ: ℝ → ℝ, convex and non-decreasing, so that an input-convex network built from it is convex."""

    @abstractmethod
    def derivatives(
        self, x: Float[Array, "*shape"]
    ) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"], Float[Array, "*shape"]]:
        """σ(x), σ'(x) and σ''(x)."""

    @property
    def kernel(self) -> tuple[int, float] | None:
        """Code and parameter of its compiled form (`runtime/layout.py`), or None where there is none."""
        return None


@dataclass(frozen=True)
class SmoothedReLU(Activation):
    """The paper's choice: 0 (x ≤ 0), x²/2d (0 < x < d), x − d/2 (x ≥ d).

    σ'' jumps at 0 and at d, and with it the torque of a controller built on it (docs/theory.md §3).
    Raises ArgumentError unless d > 0. Source: Kolter and Manek 2019, as cited by the paper.
    """

    d: float = 0.01

    def __post_init__(self) -> None:
        if not self.d > 0.0:
            raise ArgumentError(f"the smoothing width d is {self.d}; give a positive number.")

    def derivatives(
        self, x: Float[Array, "*shape"]
    ) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"], Float[Array, "*shape"]]:
        """σ, σ', σ''; at the switches the one-sided value of the middle piece is not taken."""
        xp = array_namespace(x)
        slope = xp.clip(x / self.d, 0.0, 1.0)
        inside = (x > 0.0) & (x < self.d)
        return slope * (x - 0.5 * self.d * slope), slope, xp.astype(inside, x.dtype) / self.d

    @property
    def kernel(self) -> tuple[int, float]:
        """Code and parameter of the compiled form."""
        return ActivationCode.SMOOTHED_RELU, self.d


@dataclass(frozen=True)
class Squareplus(Activation):
    """σ(x) = ½(x + √(x² + b)): smooth everywhere, algebraic, and close to ReLU beyond |x| ≈ √b.

    Raises ArgumentError unless b > 0. Source: Barron 2021, "Squareplus: a softplus-like algebraic rectifier".
    """

    b: float = 1.0

    def __post_init__(self) -> None:
        if not self.b > 0.0:
            raise ArgumentError(f"the curvature b is {self.b}; give a positive number.")

    def derivatives(
        self, x: Float[Array, "*shape"]
    ) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"], Float[Array, "*shape"]]:
        """σ, σ', σ''."""
        root = array_namespace(x).sqrt(x * x + self.b)
        return 0.5 * (x + root), 0.5 * (1.0 + x / root), 0.5 * self.b / (root * root * root)

    @property
    def kernel(self) -> tuple[int, float]:
        """Code and parameter of the compiled form."""
        return ActivationCode.SQUAREPLUS, self.b
