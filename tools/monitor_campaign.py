"""How often the monitor errs: honest arms with encoders, and ten kinds of fault.

    python tools/monitor_campaign.py                    # 200 honest runs and 10 kinds of fault on four arms
    python tools/monitor_campaign.py --honest 20 --bits 18 --seed 3

Every run is a MuJoCo arm at 1 kHz whose law sees what a real one does: positions rounded to encoder steps and velocities
as their differences. Honest runs start off the reference, at random, under random admissible disturbances; any
assumption that the monitor names there is a false alarm. A fault begins at `BEGINS`; what is named, and after how long,
is printed. With any false alarm, or any fault that is not named in `SOON`, the exit code is 1.
"""

import argparse
import sys
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

import nbs_pin as nbs
from nbs_pin.identification.measurement import quantised
from nbs_pin.robots.catalogue import find

ARMS = ("two_link", "ur5", "panda", "kinova")
PERIOD, BEGINS, SOON = 0.001, 0.5, 0.2
"""Control period, begin of a fault, and the time in which it has to be named [s]."""
TIPS = {"ur5": "tool0", "panda": "panda_link8", "kinova": "end_effector_link"}
LOAD = """<robot><link name="nbs_load"><inertial><mass value="{mass}"/><inertia ixx="1e-5" iyy="1e-5" izz="1e-5" ixy="0"
 ixz="0" iyz="0"/></inertial></link><joint name="nbs_load_joint" type="fixed"><parent link="{tip}"/>
 <child link="nbs_load"/><origin xyz="0 0 {out}"/></joint></robot>"""


@dataclass
class Loop:
    """What is true of one run; a fault changes it."""

    arm: nbs.Robot
    law: Any
    plant: nbs.Plant
    reference: Any
    q0: np.ndarray
    v0: np.ndarray
    torque: Callable[[float], np.ndarray]
    bits: int = 16
    duration: float = 1.0
    begins: float = BEGINS
    late: Any = None
    """The plant from `begins` on."""
    read: Callable[[float, np.ndarray, list[np.ndarray]], np.ndarray] = lambda t, q, before: q
    act: Callable[[float, np.ndarray, list[np.ndarray], np.ndarray], np.ndarray] = lambda t, tau, before, v: tau
    effort: np.ndarray = field(default_factory=lambda: np.array(np.inf))
    stops: bool = False

    def run(self) -> nbs.Run:
        """The run as the arm's own log has it: measured states, and the torques that were asked for."""
        n, h, steps = self.arm.nv, PERIOD, round(self.duration / PERIOD)
        law, lead = self.law.compile(), 0.5 * PERIOD
        t = h * np.arange(steps + 1)
        aim, ahead = self.reference(t), self.reference(t + lead)
        q, v = self.q0, self.v0
        step = 2.0**-self.bits
        readings = [quantised(q - h * v, step, self.arm.prismatic)]
        rows, asked = [], []
        command = np.zeros(n)
        limit = np.minimum(self.arm.effort_limit, self.effort)
        for k in range(steps + 1):
            reading = self.read(t[k], quantised(q, step, self.arm.prismatic), readings)
            speed = (reading - readings[-1]) / h
            readings.append(reading)
            dv = lead * aim.a[k]
            if np.isfinite(reading + speed).all():  # else the last torque is held
                command = law.torque(reading + lead * (speed + 0.5 * dv), speed + dv, ahead.q[k], ahead.v[k], ahead.a[k])
            applied = np.clip(command, -limit, limit)
            asked.append(applied)
            rows.append((reading, speed, applied, command))
            plant = self.plant if self.late is None or t[k] < self.begins else self.late
            q, v = plant.step(q, v, self.act(t[k], applied, asked, v) + self.torque(t[k]), h)
            if self.stops:
                hit = (q < self.arm.lower) | (q > self.arm.upper)
                q, v = np.clip(q, self.arm.lower, self.arm.upper), np.where(hit, 0.0, v)
        measured, speeds, tau, commands = (np.array(x) for x in zip(*rows, strict=True))
        return nbs.Run(
            t=t, q=measured, v=speeds, tau=tau, tau_command=commands, disturbance=0.0 * tau,
            q_ref=aim.q, v_ref=aim.v, a_ref=aim.a, effort_limit=limit, continuous=self.arm.continuous,
            joint_names=self.arm.joint_names, period=h, robot=self.arm.source, robot_sha256=self.arm.sha256,
        )
