"""Disturbance torques τ_d(t, q, v) [N·m] for `simulate`; any callable of that signature will do.

Each record gives its torque to every start of a batch, except `TorqueNoise`, which draws one per start.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from nbs_pin.base.arrays import Vectors
from nbs_pin.base.checks import PerJoint, per_joint, positive
from nbs_pin.base.exceptions import ArgumentError

Disturbance: TypeAlias = Callable[[float, np.ndarray, np.ndarray], Any]
"""τ_d(t, q, v) [N·m], shape (..., n)."""


@dataclass(frozen=True, eq=False)
class ConstantTorque:
    """τ_d = torque [N·m]."""

    torque: PerJoint

    def __post_init__(self) -> None:
        per_joint(self, "torque")

    def __call__(self, t: float, q: Vectors, v: Vectors) -> Vectors:
        """Torque at time t [s] in the state (q, v) [N·m]."""
        return _on_joints(self.torque, q)


@dataclass(frozen=True, eq=False)
class SinusoidalTorque:
    """τ_d = amplitude·sin(frequency·t + phase): amplitude [N·m], frequency [rad/s], phase [rad]."""

    amplitude: PerJoint
    frequency: PerJoint
    phase: PerJoint = 0.0

    def __post_init__(self) -> None:
        per_joint(self, "amplitude", "frequency", "phase")

    def __call__(self, t: float, q: Vectors, v: Vectors) -> Vectors:
        """Torque at time t [s] in the state (q, v) [N·m]."""
        return _on_joints(self.amplitude * np.sin(self.frequency * t + self.phase), q)


@dataclass(frozen=True, eq=False)
class SquareWave:
    """Bang-bang: ±amplitude [N·m] with the sign of sin(frequency·t + phase), frequency [rad/s], + at zero."""

    amplitude: PerJoint
    frequency: PerJoint
    phase: PerJoint = 0.0

    def __post_init__(self) -> None:
        per_joint(self, "amplitude", "frequency", "phase")

    def __call__(self, t: float, q: Vectors, v: Vectors) -> Vectors:
        """Torque at time t [s] in the state (q, v) [N·m]."""
        return _on_joints(self.amplitude * np.where(np.sin(self.frequency * t + self.phase) >= 0.0, 1.0, -1.0), q)


@dataclass(frozen=True, eq=False)
class TorqueNoise:
    """White noise of standard deviation std [N·m], constant over each `period` [s].

    A pure function of time: the same seed gives the same torque at the same t, in whatever order it is asked.
    """

    std: PerJoint
    period: float
    seed: int = 0
    share: tuple[int, int, int] | None = None
    """(first, last + 1, all): the starts of a larger batch that q stands for; the noise is theirs in that batch."""

    def __post_init__(self) -> None:
        per_joint(self, "std")
        positive("period", self.period, "s")
        if self.seed < 0:
            raise ArgumentError(f"seed is {self.seed}, expected an integer ≥ 0; give another seed.")

    def __call__(self, t: float, q: Vectors, v: Vectors) -> Vectors:
        """Torque at time t [s] in the state (q, v) [N·m]."""
        interval = math.floor(t / self.period + 1e-9)  # t = k·period may round to just below its interval
        rng = np.random.default_rng((self.seed, interval))
        if self.share is None:
            return _on_joints(self.std, q) * rng.standard_normal(q.shape)
        first, end, count = self.share
        return _on_joints(self.std, q) * rng.standard_normal((count, *q.shape[1:]))[first:end]


def _on_joints(torque: Any, q: np.ndarray) -> np.ndarray:
    """The torque for every start and joint of q."""
    if np.size(torque) not in (1, q.shape[-1]):
        raise ArgumentError(
            f"the disturbance has {np.size(torque)} torques for {q.shape[-1]} joints; give one, or one for each."
        )
    return np.zeros(q.shape) + torque
