"""Disturbance torques τ_d(t, q, v) [N·m] for `simulate`, which accepts any callable with this signature.

Each class applies the same torque to all states of a batch, except `TorqueNoise`, which draws one for each state.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Float

from nbs_pin.base.arguments import PERIOD, SEED, check_fields, number
from nbs_pin.base.arrays import Vectors
from nbs_pin.base.checks import PerJoint, floats, per_joint
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.shown import joints_told

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
        return _on_joints(self._at(_instant(t)), q)

    def _at(self, t: Any) -> Any:
        """τ_d [N·m] at a time t [s], or a row for each of t of shape (rows, 1)."""
        return self.torque


@dataclass(frozen=True, eq=False)
class SinusoidalTorque:
    """τ_d = amplitude·sin(frequency·t + phase), with amplitude [N·m], frequency [rad/s] and phase [rad].

    Example:
        >>> import numpy as np
        >>> import nbs_pin as nbs
        >>> nbs.SinusoidalTorque(5.0, frequency=np.pi)(0.5, q=np.zeros(2), v=np.zeros(2))
        array([5., 5.])
    """

    amplitude: PerJoint
    frequency: PerJoint
    phase: PerJoint = 0.0

    def __post_init__(self) -> None:
        per_joint(self, "amplitude", "frequency", "phase")

    def __call__(self, t: float, q: Vectors, v: Vectors) -> Vectors:
        """τ_d [N·m] at time t [s] and state (q, v)."""
        return _on_joints(self._at(_instant(t)), q)

    def _at(self, t: Any) -> Any:
        """τ_d [N·m] at a time t [s], or a row for each of t of shape (rows, 1)."""
        return self.amplitude * np.sin(self.frequency * t + self.phase)


@dataclass(frozen=True, eq=False)
class SquareWave:
    """τ_d = amplitude·sgn(sin(frequency·t + phase)), sgn 0 = 1: amplitude [N·m], frequency [rad/s], phase [rad].

    Example:
        >>> import numpy as np
        >>> import nbs_pin as nbs
        >>> nbs.SquareWave([5.0, 2.0], frequency=2.0 * np.pi)(0.75, q=np.zeros(2), v=np.zeros(2))
        array([-5., -2.])
    """

    amplitude: PerJoint
    frequency: PerJoint
    phase: PerJoint = 0.0

    def __post_init__(self) -> None:
        per_joint(self, "amplitude", "frequency", "phase")

    def __call__(self, t: float, q: Vectors, v: Vectors) -> Vectors:
        """τ_d [N·m] at time t [s] and state (q, v)."""
        return _on_joints(self._at(_instant(t)), q)

    def _at(self, t: Any) -> Any:
        """τ_d [N·m] at a time t [s], or a row for each of t of shape (rows, 1)."""
        return self.amplitude * np.where(np.sin(self.frequency * t + self.phase) >= 0.0, 1.0, -1.0)


@dataclass(frozen=True, eq=False)
class TorqueNoise:
    """Gaussian noise of standard deviation `std` [N·m], held constant over each `period` [s].

    A pure function of time: the same seed gives the same torque at the same t, in any order of evaluation.

    Example:
        >>> import numpy as np
        >>> import nbs_pin as nbs
        >>> noise = nbs.TorqueNoise(0.5, period=0.01, seed=1)
        >>> bool((noise(0.2, np.zeros(2), np.zeros(2)) == noise(0.2, np.zeros(2), np.zeros(2))).all())
        True
    """

    std: PerJoint
    period: float
    seed: int = 0
    share: tuple[int, int, int] | None = None
    """(first, last + 1, count): q holds these states of a batch of `count`, and gets their noise in that batch."""

    def __post_init__(self) -> None:
        per_joint(self, "std")
        check_fields(self, period=PERIOD, seed=SEED)

    def __call__(self, t: float, q: Vectors, v: Vectors) -> Vectors:
        """τ_d [N·m] at time t [s] and state (q, v)."""
        interval = math.floor(_instant(t) / self.period + 1e-9)  # t = k·period may be rounded into the interval before
        if interval < 0:
            raise ArgumentError(f"TorqueNoise: t is {t} s; noise begins at t = 0, give a time ≥ 0.")
        rng, std = np.random.default_rng((self.seed, interval)), _on_joints(self.std, q)
        if self.share is None:
            return std * rng.standard_normal(std.shape)
        first, end, count = self.share
        return std * rng.standard_normal((count, *std.shape[1:]))[first:end]


def torques_over(
    disturbance: Disturbance | None, times: Float[np.ndarray, " rows"], nv: int
) -> Float[np.ndarray, "rows n"] | None:
    """τ_d [N·m] at each of the times [s]; None for one of another class, which may depend on the state."""
    if disturbance is None:
        return np.zeros((len(times), nv))
    if type(disturbance) not in (ConstantTorque, SinusoidalTorque, SquareWave, TorqueNoise):
        return None  # a subclass may do something else
    if isinstance(disturbance, ConstantTorque | SinusoidalTorque | SquareWave):
        first, rows = _on_joints(disturbance._at(float(times[0])), np.zeros(nv)), disturbance._at(times[:, None])
        return np.zeros((len(times), len(first))) + rows
    if isinstance(disturbance, TorqueNoise):
        rest = np.zeros(nv)
        return np.array([disturbance(t, rest, rest) for t in times.tolist()])
    return None


def _on_joints(torque: Any, q: Any) -> np.ndarray:
    """The torque, broadcast to the shape of q."""
    shape = floats("the disturbance: q", q).shape
    count, joints = np.size(torque), shape[-1] if shape else 0
    if joints == 0 or count not in (1, joints):
        raise ArgumentError(
            f"the disturbance has {count} torques for {joints_told(joints)}; give one, or one per joint."
        )
    return np.zeros(shape) + torque


_instant = partial(number(unit="s"), "the disturbance: t")
