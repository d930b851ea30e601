"""The Franka arm of `franka_server.py` as a fixture of tests and tools: its description, its process, its faults."""

import contextlib
import json
import subprocess
import sys
import warnings
from pathlib import Path

import franky_sim
import numpy as np

import nbs_pin as nbs

SERVER = Path(__file__).parent / "franka_server.py"
ROTORS = {f"joint{i + 1}": x for i, x in enumerate([0.195] * 4 + [0.074] * 3)}
ENDS = {  # what is sent over the wire in the motion, and how the loop must end
    "drop 10": {""},
    "late 10": {""},
    "deaf 10": {""},
    "slow 0.05": {""},
    "drop 30": {"TIME", "ARM"},
    "late 30": {"TIME", "ARM"},
    "deaf 40": {"ARM"},
    "reflex": {"ARM"},
    "close": {"ARM"},
}


def simulated_arm():
    """The arm that franky-sim simulates, less its joint friction."""
    file = Path(franky_sim.__file__).parent / "assets" / "fr3_clean.urdf"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        bare = nbs.load_robot(file, armature=ROTORS)
        return bare.with_payload("link8", 0.73, (-0.01, 0.0, 0.03), np.diag([0.001, 0.0025, 0.0017]))


class Wire:
    """The server's process."""

    def __init__(self, q):
        command = [sys.executable, str(SERVER), ",".join(map(str, q))]
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )
        self.host = self.process.stdout.readline().strip()

    def say(self, line):
        with contextlib.suppress(BrokenPipeError):
            self.process.stdin.write(f"{line}\n")
            self.process.stdin.flush()

    def story(self):
        """What came over the wire; ends the server."""
        self.say("quit")
        told = json.loads(self.process.stdout.readline())
        self.close()
        return told

    def close(self):
        self.process.kill()
        self.process.wait()
        for pipe in (self.process.stdin, self.process.stdout):
            with contextlib.suppress(BrokenPipeError):
                pipe.close()


def drive_with_fault(robot, law, motion, fault, *, at=100, duration=0.4):
    """One motion on a new server with one fault in it; returns what came of it and what came over the wire."""
    wire = Wire(motion(0.0).q)
    instants = []

    def watch(seen):
        instants.append(seen)
        if len(instants) == at:
            wire.say(fault)

    try:
        driven = nbs.drive(nbs.FrankaArm(wire.host), law, robot, motion, duration, watch=watch)
        return driven, wire.story()
    finally:
        wire.close()


def is_legal(story, robot):
    """Whether all that came over the wire was finite and within the limits."""
    largest, rate = np.array(story["largest"]), np.array(story["rate"])
    return story["finite"] and bool((largest <= robot.effort_limit).all() and (rate <= 1000.0).all())
