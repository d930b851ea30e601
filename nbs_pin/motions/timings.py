"""When a path is where: s(t) from 0 at t = 0 to 1 at the end, with ṡ and s̈; before and after, s rests at 0 and 1."""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float


class Along(NamedTuple):
    """Where a path is, and how that changes."""

    s: Float[np.ndarray, "*batch"]
    ds: Float[np.ndarray, "*batch"]
    """ṡ [1/s]."""
    dds: Float[np.ndarray, "*batch"]
    """s̈ [1/s²]."""


@dataclass(frozen=True)
class Smooth:
    """From rest to rest with least jerk: s = 10u³ − 15u⁴ + 6u⁵ for u = t / duration."""

    duration: float

    @property
    def largest(self) -> tuple[float, float, float]:
        """Bounds of |ṡ|, |s̈| and |s⃛|: 15/8, 10/√3 and 60 over powers of the duration."""
        T = self.duration
        return 1.875 / T, 10.0 / np.sqrt(3.0) / T**2, 60.0 / T**3

    def __call__(self, t: Float[np.ndarray, "*batch"]) -> Along:
        """Where the path is at t [s]."""
        u, T = np.clip(t / self.duration, 0.0, 1.0), self.duration
        return Along(
            u**3 * (10.0 - 15.0 * u + 6.0 * u**2),
            30.0 * (u * (1.0 - u)) ** 2 / T,
            60.0 * u * (1.0 - u) * (1.0 - 2.0 * u) / T**2,
        )


@dataclass(frozen=True)
class Even:
    """s = t / duration: a path whose own curve knows the time, at rest before and after."""

    duration: float

    @property
    def largest(self) -> tuple[float, float, float]:
        """Bounds of |ṡ|, |s̈| and |s⃛|."""
        return 1.0 / self.duration, 0.0, 0.0

    def __call__(self, t: Float[np.ndarray, "*batch"]) -> Along:
        """Where the path is at t [s]."""
        inside = (t >= 0.0) & (t <= self.duration)
        s = np.clip(t / self.duration, 0.0, 1.0)
        return Along(s, np.where(inside, 1.0 / self.duration, 0.0), np.zeros_like(s))


@dataclass(frozen=True, eq=False)
class Stepped:
    """s̈ constant between the nodes of a grid: s(t) piecewise quadratic, with v continuous and a in steps."""

    grid: Float[np.ndarray, " nodes"]
    """s at the nodes, from 0 to 1."""
    speed: Float[np.ndarray, " nodes"]
    """ṡ at the nodes [1/s], never 0 at two in a row."""

    @cached_property
    def times(self) -> Float[np.ndarray, " nodes"]:
        """Times of the nodes [s]."""
        steps = 2.0 * np.diff(self.grid) / (self.speed[1:] + self.speed[:-1])
        return np.concatenate([[0.0], np.cumsum(steps)])

    @property
    def duration(self) -> float:
        """Time of the last node [s]."""
        return float(self.times[-1])

    @cached_property
    def acceleration(self) -> Float[np.ndarray, " intervals"]:
        """s̈ between the nodes [1/s²]."""
        return np.asarray(0.5 * np.diff(self.speed**2) / np.diff(self.grid))

    @property
    def largest(self) -> tuple[float, float, float]:
        """Bounds of |ṡ|, |s̈| and |s⃛|; the last is inf, as s̈ jumps."""
        return float(self.speed.max()), float(np.abs(self.acceleration).max()), np.inf

    def __call__(self, t: Float[np.ndarray, "*batch"]) -> Along:
        """Where the path is at t [s]; at a node, the acceleration is that of the interval after it."""
        inside = (t >= 0.0) & (t < self.duration)
        t = np.clip(t, 0.0, self.duration)
        k = np.clip(np.searchsorted(self.times, t, side="right") - 1, 0, len(self.grid) - 2)
        late, start, bend = t - self.times[k], self.speed[k], self.acceleration[k]
        s = np.clip(self.grid[k] + late * (start + 0.5 * bend * late), self.grid[k], self.grid[k + 1])
        ds = np.maximum(start + bend * late, 0.0)
        return Along(np.where(t >= self.duration, 1.0, s), np.where(inside, ds, 0.0), np.where(inside, bend, 0.0))


Timing: TypeAlias = Smooth | Even | Stepped
"""s(t) of a path, with its duration [s] and bounds of |ṡ|, |s̈| and |s⃛| (`largest`)."""
