"""How often the monitor errs: honest arms with encoders, and twelve kinds of fault.

    python tools/monitor_campaign.py                    # 200 honest runs and 12 kinds of fault on four arms
    python tools/monitor_campaign.py --honest 20 --bits 18 --seed 3

Every run is a MuJoCo arm at 1 kHz whose law sees what a real one does: positions rounded to encoder steps, and their
differences as velocities. Honest runs start off the reference, at random, under random admissible disturbances; any
assumption that the monitor names there is a false alarm. A fault, large enough to leave the box of the disturbance,
begins at `BEGINS`; what is named, and after how long, is printed. With any false alarm, any fault that is not named in
`SOON`, or a certificate that is called wrong, the exit code is 1.
"""

import argparse
import collections
import sys
import time
import xml.etree.ElementTree as ET
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

import nbs_pin as nbs
from nbs_pin.certificates.assumptions import WRONG
from nbs_pin.certificates.attack import random_disturbances
from nbs_pin.certificates.claims import Assumption
from nbs_pin.certificates.online_monitor import Watched
from nbs_pin.identification.measurement import quantised

ARMS = ("two_link", "ur5", "panda", "kinova")
PERIOD, BEGINS, SOON = 0.001, 0.5, 0.2
"""Control period, begin of a fault, and the time in which it has to be named [s]."""
BOX, QUIET = {"two_link": 0.5, "ur5": 0.5, "panda": 0.5, "kinova": 0.1}, 0.2
"""Bound of the disturbance of every joint [N·m], below what 0.2 kg weighs on the arm, and the share of it that acts
beside a fault: a disturbance that fills its box can hide a fault of up to twice the bound."""


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
    limit: Callable[[float, np.ndarray], np.ndarray] = lambda t, limit: limit
    aim: Callable[[np.ndarray, nbs.Reference], nbs.Reference] = lambda t, aim: aim

    def run(self) -> nbs.Run:
        """The run as the arm's own log has it: measured states, and the torques that were asked for."""
        n, h, steps = self.arm.nv, PERIOD, round(self.duration / PERIOD)
        law, lead = self.law.compile(), 0.5 * PERIOD
        t = h * np.arange(steps + 1)
        aim, ahead = (self.aim(x, self.reference(x)) for x in (t, t + lead))
        q, v = self.q0, self.v0
        step = 2.0**-self.bits
        readings = [quantised(q - h * v, step, self.arm.prismatic)]
        rows, asked = [], []
        command = np.zeros(n)
        for k in range(steps + 1):
            reading = self.read(t[k], quantised(q, step, self.arm.prismatic), readings)
            speed = (reading - readings[-1]) / h
            readings.append(reading)
            dv = lead * aim.a[k]
            if np.isfinite(reading + speed).all():  # else the last torque is held
                command = law.torque(
                    reading + lead * (speed + 0.5 * dv), speed + dv, ahead.q[k], ahead.v[k], ahead.a[k]
                )
            limit = self.limit(t[k], self.arm.effort_limit)
            applied = np.clip(command, -limit, limit)
            asked.append(applied)
            rows.append((reading, speed, applied, command))
            plant = self.plant if self.late is None or t[k] < self.begins else self.late
            q, v = plant.step(q, v, self.act(t[k], applied, asked, v) + self.torque(t[k]), h)
        measured, speeds, tau, commands = (np.array(x) for x in zip(*rows, strict=True))
        return nbs.Run(
            t=t,
            q=measured,
            v=speeds,
            tau=tau,
            tau_command=commands,
            disturbance=0.0 * tau,
            q_ref=aim.q,
            v_ref=aim.v,
            a_ref=aim.a,
            effort_limit=self.arm.effort_limit,
            continuous=self.arm.continuous,
            joint_names=self.arm.joint_names,
            period=h,
            robot=self.arm.source,
            robot_sha256=self.arm.sha256,
        )


@cache
def arm(name: str) -> nbs.Robot:
    """The arm."""
    return nbs.load_robot(name)


@cache
def plant(name: str) -> nbs.Plant:
    """The arm in MuJoCo."""
    return nbs.MujocoPlant(arm(name))


@cache
def loaded(name: str, mass: float) -> nbs.Plant:
    """The arm with a mass [kg] at its last link that its model does not have."""
    tree, last = ET.fromstring(arm(name).urdf.xml), arm(name).joint_names[-1]
    tip = tree.find(f"joint[@name='{last}']/child").get("link")
    return nbs.MujocoPlant(arm(name).with_payload(tip, mass, (0.0, 0.0, 0.05), 1e-5))


@cache
def rough(name: str, coulomb: float) -> nbs.Plant:
    """The arm with dry friction [N·m] in every joint."""
    n = arm(name).nv
    return nbs.MujocoPlant(arm(name), joint_friction=nbs.JointFriction(np.zeros(n), np.full(n, coulomb)))


@cache
def tilted(name: str, degrees: float) -> nbs.Plant:
    """The arm on a floor that is not level."""
    robot = arm(name)
    g, c, s = robot.gravity_vector, np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ np.array(
        [[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]]
    )
    return nbs.MujocoPlant(nbs.load_robot(name, gravity=turn @ g))


def honest(
    name: str, seed: int, bits: int = 16, duration: float = 1.0, *, is_moving: bool = False
) -> tuple[nbs.Certificate, Loop]:
    """A random loop that keeps every assumption; `is_moving`: its reference does not rest."""
    rng, robot, n = np.random.default_rng(seed), arm(name), arm(name).nv
    law = nbs.NeuralBackstepping.for_robot(robot, bandwidth=float(rng.choice([4.0, 8.0, 12.0])))
    reference = nbs.Sinusoid.for_robot(robot, rng.uniform(0.5, 2.0), rng.uniform(0.1, 0.6))
    if rng.uniform() < 0.2 and not is_moving:
        reference = nbs.Hold(reference(np.zeros(1)).q[0])
    certificate = nbs.certify(law, np.full(n, BOX[name]), reference=reference, period=PERIOD)
    steps = round(duration / PERIOD) + 1
    torque = random_disturbances(certificate.admissible, steps, PERIOD, 8, rng)[seed % 8]
    begin, off = reference(np.zeros(1)), rng.uniform(0.0, 0.1)
    q0, v0 = begin.q[0] + off * rng.uniform(-1.0, 1.0, n), begin.v[0] + off * rng.normal(size=n)
    while (np.abs(law.torque(q0, v0, *(x[0] for x in begin))) > 0.4 * robot.effort_limit).any() and off > 1e-3:
        q0, v0, off = 0.5 * (q0 + begin.q[0]), 0.5 * (v0 + begin.v[0]), 0.5 * off
    return certificate, Loop(
        robot, law, plant(name), reference, q0, v0, lambda t: torque[min(round(t / PERIOD), steps - 1)], bits, duration
    )


def dash(robot: nbs.Robot) -> nbs.MinimumJerk:
    """A quick move of every joint at `BEGINS`, in 0.25 s, within 0.8 of the effort and velocity limits."""
    begin, model = nbs.Sinusoid.for_robot(robot)(np.zeros(1)).q[0], nbs.PinocchioDynamics(robot)
    times = np.linspace(BEGINS, BEGINS + 0.25, 51)
    for far in 0.5 * 0.8 ** np.arange(20):
        move = nbs.MinimumJerk([begin, begin + far], [BEGINS, BEGINS + 0.25])
        torque = nbs.inverse_dynamics(model, *move(times))
        if (np.abs(torque) < 0.8 * robot.effort_limit).all() and (
            np.abs(move(times).v) < 0.8 * robot.velocity_limit
        ).all():
            return move
    raise ValueError(f"{robot.name} is too weak to move quickly.")


def outstretched(name: str, seed: int) -> nbs.Hold:
    """Of some random postures, the one in which a load at the tip weighs most, with effort to spare."""
    robot, rng = arm(name), np.random.default_rng(seed)
    postures = rng.uniform(*(0.8 * x for x in robot.one_turn_range), (200, robot.nv))
    bare, still = nbs.bias(nbs.PinocchioDynamics(robot), postures, 0.0 * postures), np.zeros(robot.nv)
    weight = np.array([np.abs(loaded(name, 0.2).bias(q, still) - g).max() for q, g in zip(postures, bare, strict=True)])
    weight[(np.abs(bare) > 0.6 * robot.effort_limit).any(axis=-1)] = 0.0
    return nbs.Hold(postures[np.argmax(weight)])


def follow(certificate: nbs.Certificate, loop: Loop, reference: Any) -> nbs.Certificate:
    """Let the loop follow another reference from its begin; the certificate of that."""
    start = reference(np.zeros(1))
    loop.reference, loop.q0, loop.v0 = reference, start.q[0], start.v[0]
    return nbs.certify(loop.law, certificate.admissible, reference=reference, period=PERIOD, duration=loop.duration)


def alone(joint: int, n: int) -> np.ndarray:
    """1 for that joint, 0 for the others."""
    return np.eye(n)[joint % n]


def faulty(fault: str, name: str, seed: int, bits: int = 16) -> tuple[nbs.Certificate, Loop]:
    """The loop of `honest`, to which a fault happens at `BEGINS`."""
    certificate, loop = honest(name, seed, bits, is_moving=True)
    n, joint, torque = loop.arm.nv, seed % 2, loop.torque
    loop.torque = lambda t: QUIET * torque(t)

    def since(t: float) -> bool:
        return t >= BEGINS - 1e-9

    if fault == "wrong sign":
        loop.act = lambda t, tau, before, v: tau * (1.0 - 2.0 * alone(joint, n)) if since(t) else tau
    elif fault == "0.2 kg of payload":
        certificate = follow(certificate, loop, outstretched(name, seed))
        loop.late = loaded(name, 0.2)
    elif fault == "delay of 3 samples":
        certificate = follow(certificate, loop, dash(loop.arm))
        loop.act = lambda t, tau, before, v: before[-4] if since(t) else tau
    elif fault == "saturation":
        loop.limit = lambda t, limit: 0.02 * limit if since(t) else limit
    elif fault == "friction":
        loop.late = rough(name, 3.0)
    elif fault == "reading that is no number":
        loop.read = lambda t, q, before: np.where(alone(joint, n), np.nan, q) if abs(t - BEGINS) < 1e-9 else q
    elif fault == "frozen encoder":
        loop.read = lambda t, q, before: np.where(alone(joint, n), before[round(BEGINS / PERIOD)], q) if since(t) else q
    elif fault == "tilted base":
        loop.late = tilted(name, 20.0)
    elif fault == "reference that jumps":
        loop.aim = lambda t, aim: aim._replace(q=aim.q + 0.1 * since(t)[:, None])
    elif fault == "encoder that slips":
        loop.read = lambda t, q, before: q + 0.05 * alone(joint, n) if since(t) else q
    elif fault == "exchanged encoders":
        loop.read = lambda t, q, before: q[[1, 0, *range(2, n)]] if since(t) else q
    elif fault == "motor that stops":
        loop.act = lambda t, tau, before, v: tau * (1.0 - alone(joint, n)) if since(t) else tau
    else:
        raise ValueError(fault)
    return certificate, loop


FAULTS: dict[str, Assumption | None] = {
    "wrong sign": Assumption.MODEL,
    "0.2 kg of payload": Assumption.MODEL,
    "delay of 3 samples": Assumption.TIME,
    "saturation": Assumption.EFFORT,
    "friction": Assumption.FRICTION,
    "reading that is no number": None,
    "frozen encoder": Assumption.MEASUREMENT,
    "tilted base": Assumption.MODEL,
    "reference that jumps": Assumption.REFERENCE,
    "encoder that slips": Assumption.MEASUREMENT,
    "exchanged encoders": Assumption.MEASUREMENT,
    "motor that stops": Assumption.MODEL,
}
"""The assumption that each fault breaks; None for a number that is not finite."""


def watched(certificate: nbs.Certificate, run: nbs.Run, bits: int) -> list[Watched]:
    """What a `Watch` says at every instant of the run."""
    watch, memory, said = nbs.Watch(certificate, nbs.Encoders.of_bits(bits)), None, []
    for k in range(len(run.t)):
        aim = nbs.Reference(run.q_ref[k], run.v_ref[k], run.a_ref[k])
        now, memory = watch.step(memory, float(run.t[k]), run.q[k], run.v[k], aim, run.tau[k], run.tau_command[k])
        said.append(now)
    return said


def alarm(said: list[Watched]) -> int | None:
    """The row of the first alarm."""
    return next((k for k, one in enumerate(said) if one.excesses or one.broken), None)


def naming(fault: str, said: list[Watched]) -> int | None:
    """The first row that names what the fault breaks."""
    broken = FAULTS[fault]
    if broken is None:
        return next((k for k, one in enumerate(said) if any("not finite" in name for name in one.excesses)), None)
    return next((k for k, one in enumerate(said) if broken in one.broken), None)


def blames_certificate(said: list[Watched]) -> bool:
    """Whether it was ever called wrong."""
    return any(WRONG in one.verdict for one in said)


def check_honest(count: int, bits: int, seed: int) -> int:
    """The number of honest runs with an alarm, each of which is printed."""
    false, closest = 0, collections.defaultdict(float)
    for k in range(count):
        name = ARMS[k % len(ARMS)]
        certificate, loop = honest(name, seed + k, bits)
        said = watched(certificate, loop.run(), bits)
        closest[name] = max(closest[name], *(one.error / one.error_bound for one in said))
        row = alarm(said)
        if row is not None:
            false += 1
            print(f"  false alarm: {name}, seed {seed + k}, t = {row * PERIOD:.3f} s: {said[row].verdict}")
    print(f"{count} honest runs, {bits} bits: {false} false alarms; ", end="")
    print("largest ‖z1‖ ÷ bound: " + ", ".join(f"{name} {x:.2f}" for name, x in closest.items()))
    return false


def check_faults(seeds: int, bits: int, seed: int) -> int:
    """The number of faults that are not named in `SOON`, or for which the certificate is blamed."""
    missed = 0
    for fault in FAULTS:
        times, words = [], ""
        for k in range(seeds * len(ARMS)):
            certificate, loop = faulty(fault, ARMS[k % len(ARMS)], seed + k // len(ARMS), bits)
            said = watched(certificate, loop.run(), bits)
            row, early = naming(fault, said), alarm(said)
            after = np.inf if row is None else row * PERIOD - loop.begins
            is_early = early is not None and early * PERIOD < loop.begins - 1.5 * PERIOD
            if after > SOON or is_early or blames_certificate(said):
                missed += 1
                print(f"  missed: {fault}, {ARMS[k % len(ARMS)]}, seed {seed + k // len(ARMS)}: {said[-1].verdict}")
            times.append(max(after, 0.0))
            if row is not None:
                words = str(FAULTS[fault] or said[row].excesses[0])
                words += f"; this looks like {said[-1].suspects[0]}" if said[-1].suspects else ""
        span = f"{np.median(times):.3f} s, {max(times):.3f} s at worst"
        print(f"{fault:26} named after {span}, in {len(times)} runs: {words}")
    return missed


def cost(bits: int) -> dict[str, float]:
    """Median time of a step on each arm [µs], over 10,000 of them."""
    times = {}
    for name in ARMS:
        certificate, loop = honest(name, 1, bits, duration=2.0, is_moving=True)
        run, watch, spent = loop.run(), nbs.Watch(certificate, nbs.Encoders.of_bits(bits)), []
        for _ in range(5):
            memory = None
            for k in range(len(run.t)):
                aim = nbs.Reference(run.q_ref[k], run.v_ref[k], run.a_ref[k])
                row = (float(run.t[k]), run.q[k], run.v[k], aim, run.tau[k], run.tau_command[k])
                begin = time.perf_counter()
                _, memory = watch.step(memory, *row)
                spent.append(time.perf_counter() - begin)
        times[name] = 1e6 * float(np.median(spent))
    return times


def main() -> int:
    """Prints the figures; 1 if any is not as it should be."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--honest", type=int, default=200, help="honest runs")
    parser.add_argument("--seeds", type=int, default=3, help="runs of each fault on each arm")
    parser.add_argument("--bits", type=int, default=16, help="of the encoders")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    false = check_honest(options.honest, options.bits, options.seed)
    print("Watch, per step: " + ", ".join(f"{name} {x:.0f} µs" for name, x in cost(options.bits).items()))
    missed = check_faults(options.seeds, options.bits, options.seed)
    return int(false + missed > 0)


if __name__ == "__main__":
    sys.exit(main())
