"""How well arms that nobody tuned track: random ones with rotors, known friction and any mount, in MuJoCo at 1 kHz."""

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np
from rich.progress import track

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
from random_arms import random_arm

import nbs_pin as nbs

TRANSITION = 0.002
"""Speed at which the law feeds most of the Coulomb friction forward [rad/s, m/s]; MuJoCo's turns over at once."""


def error(seed: int, folder: Path) -> tuple[int, float]:
    """Number of joints, and the largest RMS error of a joint over the second half of 4 s [rad, m]."""
    robot = random_arm(seed, folder)
    friction = nbs.JointFriction.of(robot, TRANSITION)
    law = nbs.NeuralBackstepping.for_robot(robot, friction=friction)
    run = nbs.simulate(nbs.MujocoPlant(robot, joint_friction="keep"), law, nbs.Sinusoid.for_robot(robot), 4.0, 0.001)
    return robot.nv, float(nbs.metrics.rms_error(run, 2.0).max())


def main() -> int:
    """Print the errors; returns 1 if one is above the limit."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--arms", type=int, default=50)
    parser.add_argument("--limit", type=float, default=1e-4, help="largest RMS error [rad, m]")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        found = [error(seed, Path(folder)) for seed in track(range(options.arms), "tracking")]
    for seed, (joints, value) in enumerate(found):
        print(f"arm {seed:3d}: {joints:2d} joints, RMS error {value:.2e}")
    errors = np.array([value for _, value in found])
    print(f"{int((errors <= options.limit).sum())} of {len(found)} below {options.limit:g}; worst {errors.max():.2e}")
    return int((errors > options.limit).any())


if __name__ == "__main__":
    sys.exit(main())
