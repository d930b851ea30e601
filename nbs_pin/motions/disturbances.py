"""Disturbance torques τ_d(t, q, v) [N·m] for `simulate`, which accepts any callable with this signature.

Each class applies the same torque to all states of a batch, except `TorqueNoise`, which draws one for each state.
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
    """Constant τ_d = torque [N·m], one number or one per joint.

    Example:
        >>> import nbs_pin as nbs
        >>> import numpy as np
        >>> nbs.ConstantTorque([1.0, -2.0])(t=0.0, q=np.zeros(2), v=np.zeros(2))
        array([ 1., -2.])
    """

    torque: PerJoint

    def __post_init__(self) -> None:
        per_joint(self, "torque")

    def __call__(self, t: float, q: Vectors, v: Vectors) -> Vectors:
        """τ_d [N·m] at time t [s] and state (q, v)."""
        return _on_joints(self.torque, q)


@dataclass(frozen=True, eq=False)
class SinusoidalTorque:
    """τ_d = amplitude·sin(frequency·t + phase), with amplitude [N·m], frequency [rad/s] and phase [rad]."""

    amplitude: PerJoint
    frequency: PerJoint
    phase: PerJoint = 0.0

    def __post_init__(self) -> None:
        per_joint(self, "amplitude", "frequency", "phase")

    def __call__(self, t: float, q: Vectors, v: Vectors) -> Vectors:
        """τ_d [N·m] at time t [s] and state (q, v)."""
        return _on_joints(self.amplitude * np.sin(self.frequency * t + self.phase), q)


@dataclass(frozen=True, eq=False)
class SquareWave:
    """τ_d = amplitude·sgn(sin(frequency·t + phase)), sgn 0 = 1: amplitude [N·m], frequency [rad/s], phase [rad]."""

    amplitude: PerJoint
    frequency: PerJoint
    phase: PerJoint = 0.0

    def __post_init__(self) -> None:
        per_joint(self, "amplitude", "frequency", "phase")

    def __call__(self, t: float, q: Vectors, v: Vectors) -> Vectors:
        """τ_d [N·m] at time t [s] and state (q, v)."""
        return _on_joints(self.amplitude * np.where(np.sin(self.frequency * t + self.phase) >= 0.0, 1.0, -1.0), q)


@dataclass(frozen=True, eq=False)
class TorqueNoise:
    """Gaussian noise of standard deviation `std` [N·m], held constant over each `period` [s].

    A pure function of time: the same seed gives the same torque at the same t, in any order of evaluation.
    """

    std: PerJoint
    period: float
    seed: int = 0
    share: tuple[int, int, int] | None = None
    """(first, last + 1, count): q holds these states of a batch of `count`, and gets their noise in that batch."""

    def __post_init__(self) -> None:
        per_joint(self, "std")
        positive("period", self.period, "s")
        if self.seed < 0:
            raise ArgumentError(f"seed is {self.seed}, expected an integer ≥ 0; give another seed.")

    def __call__(self, t: float, q: Vectors, v: Vectors) -> Vectors:
        """τ_d [N·m] at time t [s] and state (q, v)."""
        interval = math.floor(t / self.period + 1e-9)  # t = k·period may be rounded into the interval before
        rng = np.random.default_rng((self.seed, interval))
        if self.share is None:
            return _on_joints(self.std, q) * rng.standard_normal(q.shape)
        first, end, count = self.share
        return _on_joints(self.std, q) * rng.standard_normal((count, *q.shape[1:]))[first:end]


def _on_joints(torque: Any, q: np.ndarray) -> np.ndarray:
    """The torque, broadcast to the shape of q."""
    count, joints = np.size(torque), q.shape[-1]
    if count not in (1, joints):
        raise ArgumentError(f"the disturbance has {count} torques for {joints} joints; give one, or one per joint.")
    return np.zeros(q.shape) + torque
