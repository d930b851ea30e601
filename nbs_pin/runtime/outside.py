"""The torque from outside, for arms that do not tell it: a momentum observer of the samples that the guard takes."""

from typing import NamedTuple

import numpy as np

from nbs_pin.base.arrays import JointArray
from nbs_pin.dynamics.momentum_observer import MomentumObserver, ObserverMemory
from nbs_pin.runtime.guard import Guard

_SHORTEST = 0.1  # of a period: readings that are closer tell little of a momentum's rate
_LARGEST = 1e30  # sizes of readings beyond which their products are no numbers


class _Known(NamedTuple):
    """What is known at a sample."""

    t: float
    q: JointArray
    torque: JointArray
    memory: ObserverMemory


class Outside:
    """What a momentum observer makes of an arm's samples and of the torques sent between them.

    The guard judges a sample together with the torque from outside, so a sample is `seen` first and counts from `keep`
    on: a single wrong reading, which the guard refuses, leaves no trace in the estimate. Periods without a sample are
    one long period, as the torque is held over them.
    """

    def __init__(self, observer: MomentumObserver, guard: Guard) -> None:
        self.observer, self._compensated = observer, guard.compensated
        self._least, self._most = _SHORTEST * guard.period, (guard.patience + 0.5) * guard.period
        self.begin()

    def begin(self) -> None:
        """Forget everything."""
        self._kept: _Known | None = None
        self._new: _Known | None = None

    def seen(self, t: float, q: JointArray, v: JointArray, tau: JointArray) -> JointArray:
        """The estimate at a sample [N·m]; tau has been sent since the last one that was kept.

        Where the sample tells no momentum it is the last estimate, and at first 0.
        """
        last = self._kept
        self._new = self._known(t, q, v, tau) if np.abs([q, v]).max() <= _LARGEST else None  # NaN is not ≤
        known = last if self._new is None else self._new
        return np.zeros(self.observer.nv) if known is None else known.torque

    def keep(self) -> None:
        """The guard has taken the sample."""
        if self._new is not None:
            self._kept = self._new

    def _known(self, t: float, q: JointArray, v: JointArray, tau: JointArray) -> _Known | None:
        last = self._kept
        if last is None:
            return _Known(t, q, np.zeros_like(q), self.observer.initial(q, v))
        if not self._least <= t - last.t <= self._most:
            return None
        if self._compensated:  # by the arm, at every instant
            gravity = self.observer.dynamics.gravity
            tau = tau + 0.5 * (gravity(last.q) + gravity(q))
        seen, memory = self.observer.step(last.memory, q, v, tau, t - last.t)
        return _Known(t, q, seen.torque, memory)
