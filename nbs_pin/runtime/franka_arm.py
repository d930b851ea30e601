"""A Franka arm through Franka's own client, pylibfranka, by its torque interface at 1 kHz.

The arm adds gravity and takes at most 1000 N·m/s; it stops by itself, with a reflex, where a limit is passed or 20
packets in a row are lost. The client calls block for at most about a second when the connection is lost.
"""

import importlib
from typing import Any

import numpy as np

from nbs_pin.base.arguments import checked, flag, text
from nbs_pin.base.arrays import JointArray
from nbs_pin.base.exceptions import ArgumentError, MissingExtra
from nbs_pin.runtime.guarded import Sample

_JOINTS = 7


def client() -> Any:
    """The module pylibfranka; raises MissingExtra if it is not installed."""
    try:
        return importlib.import_module("pylibfranka")
    except ImportError as error:
        raise MissingExtra(f"a Franka arm needs pylibfranka ({error}); install nbs-pin[franka].") from error


class FrankaArm:
    """The arm at an address, as `drive` takes it.

    Args:
        host: Its address.
        real_time: Whether to refuse a kernel without real-time priorities, as libfranka does by default.
        recover: Whether to leave an earlier reflex when it starts.

    Raises:
        MissingExtra: If pylibfranka is not installed.
        ArgumentError: If nothing answers at the address.

    Example:
        >>> import nbs_pin as nbs
        >>> nbs.FrankaArm.period, nbs.FrankaArm.torque_rate  # s, N·m/s
        (0.001, 1000.0)
    """

    period = 0.001
    compensated = True
    torque_rate = 1000.0
    nv = _JOINTS

    @checked(host=text, real_time=flag, recover=flag)
    def __init__(self, host: str, *, real_time: bool = False, recover: bool = True) -> None:
        self._franka = client()
        config = self._franka.RealtimeConfig
        try:
            self._robot = self._franka.Robot(host, config.kEnforce if real_time else config.kIgnore)
        except Exception as error:  # the client's exceptions have no common base but Exception
            raise ArgumentError(f"no Franka arm answers at '{host}' ({error}); check address and FCI.") from error
        self._recover, self._fault = recover, ""
        self._control: Any = None
        self._last: Sample | None = None
        self._sent = self._franka.Torques([0.0] * _JOINTS)

    def look(self) -> Sample:
        """Where the arm is, after it has left a reflex if it was in one."""
        try:
            if self._recover and self._robot.read_once().robot_mode == self._franka.RobotMode.Reflex:
                self._robot.automatic_error_recovery()
            return self._sample(self._robot.read_once())
        except Exception as error:  # as above
            raise ArgumentError(f"the arm is not ready ({error}); unlock it and activate FCI.") from error

    def start(self) -> Sample:
        """Take control and read the first state."""
        try:
            self._control = self._robot.start_torque_control()
            state, _ = self._control.readOnce()
        except Exception as error:  # as above
            raise ArgumentError(f"the arm does not take control ({error}); unlock it and activate FCI.") from error
        self._fault, self._last = "", self._sample(state)
        return self._last

    def read(self) -> Sample:
        """The next state, one millisecond after the last unless packets were lost.

        A fault says what the client raised: the name of a reflex, or that the connection is lost. It stays.
        """
        if self._fault:
            return self._lost(self._fault)
        try:
            state, _ = self._control.readOnce()
        except Exception as error:  # as above
            return self._lost(str(error))
        self._last = self._sample(state)
        return self._last

    def write(self, tau: JointArray) -> None:
        """Send a torque without gravity [N·m]; after a fault nothing is sent."""
        if self._fault:
            return
        try:
            self._sent = self._franka.Torques(tau.tolist())
            self._control.writeOnce(self._sent)
        except Exception as error:  # as above; the next read tells
            self._fault = str(error)

    def stop(self) -> None:
        """End the motion; the arm then holds itself."""
        control, self._control = self._control, None
        if control is None:
            return
        try:
            if not self._fault:
                self._sent.motion_finished = True  # with the torque of the last period: a step would be a discontinuity
                control.readOnce()
                control.writeOnce(self._sent)
            self._robot.stop()
        except Exception as error:  # the connection is lost, or the arm has already stopped
            self._fault = self._fault or str(error)

    def _sample(self, state: Any) -> Sample:
        fault = "" if state.robot_mode != self._franka.RobotMode.Reflex else f"reflex: {state.current_errors}"
        external = np.array(state.tau_ext_hat_filtered, dtype=float)
        return Sample(
            state.time.to_sec(), np.array(state.q, dtype=float), np.array(state.dq, dtype=float), True, external, fault
        )

    def _lost(self, fault: str) -> Sample:
        self._fault = fault
        assert self._last is not None
        return self._last._replace(fresh=False, fault=fault)
