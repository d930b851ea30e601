"""Any arm in ten lines: load, track, replay.

What to see: give the path of your own URDF, xacro or MJCF file, or no argument for panda. Nothing is tuned, and the
steady error is below a millionth of a radian.
"""

import sys

import nbs_pin as nbs


def main(arm: str = "panda", duration: float = 5.0) -> float:
    """Returns the steady RMS error of the worst joint [rad, m]."""
    robot = nbs.load_robot(arm)
    law = nbs.NeuralBackstepping.for_robot(robot)
    run = nbs.simulate(nbs.MujocoPlant(robot), law, nbs.Sinusoid.for_robot(robot), duration, 0.001)
    error = float(nbs.metrics.rms_error(run, after=0.7 * duration).max())
    print(robot, f"follows its motion to {error:.1e}; open", nbs.replay(run, f"out/demo/{robot.name}.html"))
    return error


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "panda")
