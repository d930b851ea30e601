"""What the loop asks of an arm, and an arm in simulation that runs in real time."""

import time
from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import numpy as np

from nbs_pin.base.arguments import PERIOD, checked, flag, function, joints, maybe
from nbs_pin.base.arrays import JointArray
from nbs_pin.base.checks import PerJoint, vector_of
from nbs_pin.runtime.guarded import Sample
from nbs_pin.simulation.plant import PLANT, Plant

_SPIN = 2e-4  # the last stretch before an instant is waited for without sleep [s]

_PUSH = function(3, "a disturbance, a function of t, q and v that returns torques, or None")


@runtime_checkable
class ArmInterface(Protocol):
    """An arm that is read and driven once per period.

    `read` waits for the next instant, for at most about a second, and never raises for what can happen to an arm: it
    returns a sample that is not fresh, or one with a `fault`.

    Example:
        >>> import nbs_pin as nbs
        >>> arm = nbs.PlantArm(nbs.MujocoPlant(nbs.load_robot("two_link")), [0.0, 0.0])
        >>> isinstance(arm, nbs.ArmInterface), arm.period, arm.compensated
        (True, 0.001, False)
    """

    period: float
    """Time between two instants [s]."""
    compensated: bool
    """Whether the arm adds G(q) to the torques that it is sent."""
    torque_rate: PerJoint
    """Largest |Δτ|/period that it takes [N·m/s]; None where its maker states none."""
    nv: int
    """Number of joints."""

    def look(self) -> Sample:
        """Where the arm is, before control is taken; it does not move."""

    def start(self) -> Sample:
        """Take control and read the first state."""

    def read(self) -> Sample:
        """Wait for the next instant and read the state."""

    def write(self, tau: JointArray) -> None:
        """Send the torque that acts from now on [N·m]."""

    def stop(self) -> None:
        """Give up control; may be called more than once."""


class PlantArm:
    """A plant as an arm in real time: it moves on whether or not it was written to, with the last torque.

    Args:
        plant: The simulated arm.
        q: Where it starts [rad].
        v: How fast [rad/s]; None is at rest.
        period: Control period [s], one plant step.
        real_time: Whether `read` waits for the clock; without, every `read` is one period after the last.
        torque_rate: Largest |Δτ|/period that the simulated arm is said to take [N·m/s], such as
            `FrankaArm.torque_rate`; None for no such limit.
        disturbance: Torque τ_d(t, q, v) [N·m], or None.

    Example:
        >>> import nbs_pin as nbs
        >>> arm = nbs.PlantArm(nbs.MujocoPlant(nbs.load_robot("two_link")), [0.3, 0.2], real_time=False)
        >>> arm.start().t, arm.read().t
        (0.0, 0.001)
    """

    compensated = False

    @checked(
        plant=PLANT,
        period=PERIOD,
        real_time=flag,
        torque_rate=maybe(joints(above=0.0, unit="N·m/s")),
        disturbance=maybe(_PUSH),
    )
    def __init__(
        self,
        plant: Plant,
        q: Any,
        v: Any = None,
        *,
        period: float = 0.001,
        real_time: bool = True,
        torque_rate: PerJoint = None,
        disturbance: Callable[[float, np.ndarray, np.ndarray], Any] | None = None,
    ) -> None:
        self.plant, self.period, self.real_time, self.disturbance = plant, period, real_time, disturbance
        self.torque_rate, self.nv = torque_rate, plant.nv
        self._q, self._v = vector_of("q", q, self.nv, "rad"), np.zeros(self.nv)
        if v is not None:
            self._v = vector_of("v", v, self.nv, "rad/s")
        self._tau, self._steps, self._began = np.zeros(self.nv), 0, 0.0

    def look(self) -> Sample:
        """Where it starts."""
        return Sample(0.0, self._q, self._v)

    def start(self) -> Sample:
        """Start the clock."""
        self._began = time.perf_counter()
        return Sample(0.0, self._q, self._v)

    def read(self) -> Sample:
        """The state at the next instant, or a later one if that has passed."""
        due = self._steps + 1
        if self.real_time:
            due = max(due, int((time.perf_counter() - self._began) / self.period))
            self._wait(self._began + due * self.period)
        while self._steps < due:
            t = self._steps * self.period
            push = 0.0 if self.disturbance is None else self.disturbance(t, self._q, self._v)
            self._q, self._v = self.plant.at(t).step(self._q, self._v, self._tau + push, self.period)
            self._steps += 1
        return Sample(self._steps * self.period, self._q, self._v)

    def write(self, tau: JointArray) -> None:
        """Apply the torque from now on."""
        self._tau = np.array(tau, dtype=float)

    def stop(self) -> None:
        """No more torque."""
        self._tau = np.zeros(self.nv)

    @staticmethod
    def _wait(until: float) -> None:
        left = until - time.perf_counter()
        if left > _SPIN:
            time.sleep(left - _SPIN)
        while time.perf_counter() < until:
            pass
