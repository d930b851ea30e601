"""A Franka arm that obeys its protocol, with faults on the wire: franky-sim, driven line by line over standard input.

Run as a program. It prints its address, takes one fault per line ("drop 10", "late 10", "deaf 30", "reflex", "close",
"slow 5", "quit") and prints what came over the wire when it ends, as JSON. Every state waits for its answer, so that a
slow machine loses no packet that is not meant to be lost.
"""

import itertools
import json
import queue
import struct
import sys
import threading
import time

import numpy as np
from franky_sim.franka_robot_protocol import BaseCommand, MoveStatus, RobotCommand, RobotMode
from franky_sim.franka_robot_server import ControlMode, FrankaRobotServer
from franky_sim.mujoco_simulator import MujocoSimulator
from franky_sim.simulation_server import LocalHostnames

ANSWER = 0.25  # longest wait for a command [s]
LOST = 20  # commands in a row without which the arm stops by itself


class Wire(FrankaRobotServer):
    def __init__(self, robot):
        super().__init__(robot, LocalHostnames())
        self.sent, self.heard, self.answered, self.silent, self.begun = [], False, True, 0, False
        self.drop = self.late = self.deaf = 0
        self.reflex = False
        self.waiting = []

    @property
    def is_moving(self):
        return self._FrankaRobotServer__control_mode is ControlMode.TORQUE

    def _handle_udp_command(self, data):
        self.heard = self.begun = True
        self.sent.append(struct.unpack("<7d", data[-57:-1]))
        if self.deaf > 0:
            self.deaf -= 1
            return
        self.silent = 0
        super()._handle_udp_command(data)

    def process_commands(self):
        moving, until = self.is_moving, time.monotonic() + ANSWER
        self.heard = False
        super().process_commands()
        while moving and self.answered and not self.heard and self.udp_connected and time.monotonic() < until:
            self._process_udp_commands()
            self._post_process_commands()
        self.begun = self.begun and moving  # a client that is slow to begin has lost nothing
        self.silent = self.silent + 1 if self.begun else 0
        if self.silent > LOST:
            self.stop_by_reflex()

    def stop_by_reflex(self):
        self.reflex = True
        if self.current_motion_id:
            BaseCommand.send_response(
                self._tcp_socket, RobotCommand.kMove, self.current_motion_id, MoveStatus.kReflexAborted
            )
            self.reset_current_motion_id()
        self.stop_motion(send_preemption_signal=False)

    @property
    def robot_state(self):
        state = super().robot_state
        return state.replace(robot_mode=RobotMode.kReflex) if self.reflex else state

    def send_state(self):
        self.answered = False
        if self.drop > 0:
            self.drop -= 1
            self._FrankaServer__message_id += 1
            return
        if self.udp_connected and (self.late > 0 or self.waiting):
            self.waiting.append(self._packet())
            if self.late > 0:
                self.late -= 1
                return
            for packet in self.waiting:
                self._FrankaServer__udp_socket.sendto(*packet)
            self.waiting, self.answered = [], True
            return
        super().send_state()
        self.answered = True

    def _packet(self):
        number = self._FrankaServer__message_id
        self._FrankaServer__message_id += 1
        to = (self._FrankaServer__client_address, self._FrankaServer__client_udp_port)
        return struct.pack("<Q", number) + self._get_state_bytes(), to

    def story(self):
        tau = np.array(self.sent) if self.sent else np.zeros((1, 7))
        return {
            "commands": len(self.sent),
            "finite": bool(np.isfinite(tau).all()),
            "largest": np.abs(tau).max(axis=0).tolist(),
            "rate": (1e3 * np.abs(np.diff(tau, axis=0)).max(axis=0, initial=0.0)).tolist(),
        }


def main():
    lines = queue.Queue()
    said = itertools.chain(sys.stdin, ["quit"])
    threading.Thread(target=lambda: [lines.put(line) for line in said], daemon=True).start()
    q = [float(x) for x in sys.argv[1].split(",")]
    with MujocoSimulator() as sim:
        wire = Wire(sim.add_robot(initial_q=q))
        wire.init()
        sim.start()
        print(wire.hostname, flush=True)
        pause = 0.0
        while True:
            while not lines.empty():
                what, _, number = lines.get().strip().partition(" ")
                if what in ("drop", "late", "deaf"):
                    setattr(wire, what, int(number))
                elif what == "slow":
                    time.sleep(float(number))
                elif what == "reflex":
                    wire.stop_by_reflex()
                elif what == "recover":
                    wire.reflex = False
                elif what == "close":
                    wire.reset_state()
                    wire.cleanup()
                    pause = 0.001
                elif what == "quit":
                    print(json.dumps(wire.story()), flush=True)
                    return
            if pause:
                time.sleep(pause)
                continue
            wire.process_commands()
            sim.step()
            wire.send_state()
            if not wire.is_moving:
                time.sleep(0.001)


main()
