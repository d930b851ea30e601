"""A hundred faults on the wire of a Franka arm (franky-sim), and a minute of motion: how each ends, and what was sent.

python tools/franka_faults.py --rounds 12 --seconds 60
"""

import argparse
import sys
from pathlib import Path

import numpy as np
from franky_sim.mujoco_simulator import MujocoSimulator

import nbs_pin as nbs

sys.path.insert(0, str(Path(__file__).parent.parent))

from tests.franka_wire import ENDS, drive_with_fault, is_legal, simulated_arm


def rms_without_wire(robot: nbs.Robot, law: nbs.Controller, motion: nbs.Sinusoid, seconds: float) -> np.ndarray:
    """RMS error of each joint [rad] after a tenth of the motion, from franky-sim's simulation called step by step."""
    simulation = MujocoSimulator()
    arm = simulation.add_robot(initial_q=list(motion(0.0).q))
    simulation.init()
    simulation.start()
    errors = []
    for k in range(round(1e3 * seconds)):
        state = arm._get_state()
        q, v = np.array(state.q), np.array(state.dq)
        errors.append(q - motion(1e-3 * k).q)
        arm._torque_control(law.torque(q + 0.5e-3 * v, v, *motion(1e-3 * k + 0.5e-3)))
        simulation._step()
    return np.sqrt(np.mean(np.square(errors[len(errors) // 10 :]), axis=0))


def main() -> int:
    """Run it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=12, help="trials of each fault")
    parser.add_argument("--seconds", type=float, default=60.0, help="length of the motion without faults; 0 for none")
    options = parser.parse_args()
    robot = simulated_arm()
    law, motion = nbs.NeuralBackstepping.for_robot(robot), nbs.Sinusoid.for_robot(robot, amplitude=0.2)
    done = as_wanted = 0
    rng = np.random.default_rng(0)
    for _ in range(options.rounds):
        for fault, ends in ENDS.items():
            driven, story = drive_with_fault(robot, law, motion, fault, at=int(rng.integers(5, 150)), duration=0.25)
            code = "" if driven.report is None else driven.report.code.name
            good = code in ends and is_legal(story, robot)
            done, as_wanted = done + 1, as_wanted + good
            if not good:
                print(f"{fault}: {code or 'went on'}, {story}", flush=True)
    print(f"{as_wanted} of {done} faults ended as they must, with legal torques", flush=True)
    if options.seconds:
        driven, story = drive_with_fault(robot, law, motion, "", duration=options.seconds)
        rms = nbs.metrics.rms_error(driven.run, 0.1 * options.seconds)
        print(f"{options.seconds:g} s: {driven.report}, {driven.counters}, legal {is_legal(story, robot)}, RMS {rms}")
        apart = rms / rms_without_wire(robot, law, motion, options.seconds) - 1.0
        print(f"that is {100.0 * np.abs(apart).max():.2g} % at most from the same law in its MuJoCo without a wire")
    return 0 if as_wanted == done else 1


if __name__ == "__main__":
    sys.exit(main())
