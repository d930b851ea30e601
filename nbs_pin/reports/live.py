"""The arm in the browser while it moves: meshcat's viewer at an address that only this machine reaches."""

import subprocess
import sys
from types import TracebackType
from typing import Any

import numpy as np
import pinocchio as pin
import umsgpack  # type: ignore[import-untyped]
import zmq
from meshcat.commands import SetTransform
from meshcat.path import Path as ScenePath

from nbs_pin.base.arguments import checked
from nbs_pin.base.arrays import JointArray
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.reports.scene import body_node, body_poses, scene_commands
from nbs_pin.robots.robot import ARM, Robot
from nbs_pin.robots.visuals import link_visuals

_PATIENCE = 2000  # for an answer of the viewer's server [ms]


class LiveView:
    """The viewer of an arm, in a process of its own; ends with the `with` statement.

    Raises:
        ArgumentError: If its server does not start.
    """

    @checked(robot=ARM)
    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        # standard error stays open: the server would be stopped by a pipe that nobody reads
        self._server = subprocess.Popen(
            [sys.executable, "-u", "-m", "nbs_pin.reports.live_server"], stdout=subprocess.PIPE, text=True
        )
        said = dict.fromkeys(("zmq_url", "web_url"), "")
        assert self._server.stdout is not None
        for line in self._server.stdout:
            name, _, value = line.strip().partition("=")
            said[name] = value
            if said["zmq_url"] and said["web_url"]:
                break
        else:
            raise ArgumentError("the server of the live view did not start; go on without it.")
        self.url = said["web_url"]
        """Address of the page."""
        self._socket: Any = zmq.Context.instance().socket(zmq.REQ)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.RCVTIMEO, _PATIENCE)
        self._socket.connect(said["zmq_url"])
        for command in scene_commands(robot, link_visuals(robot)):
            self._send(command)

    def __enter__(self) -> "LiveView":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def show(self, q: JointArray) -> None:
        """Put the arm where it is [rad]."""
        for body, pose in enumerate(body_poses(self._robot, np.asarray(q)[None])[0]):
            self._send(SetTransform(pin.XYZQUATToSE3(pose).homogeneous, ScenePath(body_node(body))).lower())

    def close(self) -> None:
        """End the server."""
        self._socket.close()
        self._server.kill()
        self._server.wait()
        if self._server.stdout is not None:
            self._server.stdout.close()

    def _send(self, command: dict[str, Any]) -> None:
        self._socket.send_multipart([command["type"].encode(), command["path"].encode(), umsgpack.packb(command)])
        self._socket.recv()
