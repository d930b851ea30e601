"""A Universal Robots arm by the torque mode of ur_rtde, at 500 Hz.

Not tested on hardware: the tests run it against a double with the signatures of ur_rtde 1.6. The controller adds
gravity. The compensation of joint friction that it offers is switched off, so that a law that feeds friction forward is
not added to one that does too; without either, friction is an error of the law's (docs/runtime.md, F3).
"""

import importlib
from typing import Any

import numpy as np

from nbs_pin.base.arguments import checked, text
from nbs_pin.base.arrays import JointArray
from nbs_pin.base.exceptions import ArgumentError, MissingExtra
from nbs_pin.runtime.guarded import Sample

_JOINTS = 6
_FREQUENCY = 500.0
_FRICTION = [0.0] * _JOINTS  # the shares of viscous and Coulomb friction that the controller compensates


def clients() -> tuple[Any, Any]:
    """The modules rtde_control and rtde_receive; raises MissingExtra if they are not installed."""
    try:
        return importlib.import_module("rtde_control"), importlib.import_module("rtde_receive")
    except ImportError as error:
        raise MissingExtra(f"a UR arm needs ur_rtde ({error}); install nbs-pin[ur].") from error


class URArm:
    """The arm at an address, as `drive` takes it. Not tested on hardware.

    Args:
        host: Its address.

    Raises:
        MissingExtra: If ur_rtde is not installed.
        ArgumentError: If nothing answers at the address.
    """

    period = 1.0 / _FREQUENCY
    compensated = True
    torque_rate = None
    nv = _JOINTS

    @checked(host=text)
    def __init__(self, host: str) -> None:
        control, receive = clients()
        try:
            self._receive = receive.RTDEReceiveInterface(host, _FREQUENCY)
            self._control = control.RTDEControlInterface(host, _FREQUENCY)
        except Exception as error:  # the client raises RuntimeError and errors of its sockets
            raise ArgumentError(f"no UR arm answers at '{host}' ({error}); check address and mode.") from error
        self._last: Sample | None = None
        self._tick: Any = None
        self._fault = ""

    def look(self) -> Sample:
        """Where the arm is."""
        try:
            return self._sample()
        except Exception as error:  # as above
            raise ArgumentError(f"the arm tells no state ({error}); check the connection.") from error

    def start(self) -> Sample:
        """Begin the first period."""
        try:
            self._fault, self._tick = "", self._control.initPeriod()
            self._last = self._sample()
        except Exception as error:  # as above
            raise ArgumentError(f"the arm does not take control ({error}); set it to remote control.") from error
        return self._last

    def read(self) -> Sample:
        """The state at the next instant; not fresh where its time stamp is the last one's."""
        try:
            self._control.waitPeriod(self._tick)
            self._tick = self._control.initPeriod()
            sample = self._sample()
        except Exception as error:  # as above
            self._fault = str(error)
            assert self._last is not None
            return self._last._replace(fresh=False, fault=self._fault)
        if self._last is not None and sample.t == self._last.t:
            sample = sample._replace(fresh=False)
        self._last = sample
        return sample

    def write(self, tau: JointArray) -> None:
        """Send a torque without gravity [N·m]."""
        try:
            taken = self._control.directTorque(tau.tolist(), _FRICTION, _FRICTION)
        except Exception as error:  # as above; the next read tells
            self._fault = str(error)
            return
        if not taken:
            self._fault = "the controller did not take a torque"

    def stop(self) -> None:
        """End the program on the arm's controller, which then holds the arm."""
        try:
            self._control.stopScript()
        except Exception as error:  # the connection is lost
            self._fault = self._fault or str(error)

    def _sample(self) -> Sample:
        receive, fault = self._receive, self._fault
        if not receive.isConnected():
            fault = "the connection is lost"
        elif receive.isEmergencyStopped() or receive.isProtectiveStopped():
            fault = "emergency stop" if receive.isEmergencyStopped() else "protective stop"
        q, v = (np.array(x, dtype=float) for x in (receive.getActualQ(), receive.getActualQd()))
        return Sample(float(receive.getTimestamp()), q, v, True, None, fault)
