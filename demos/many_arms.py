"""Every arm that is known by name, with default gains: from two joints to seven, from 1 kg to 50 kg.

What to see: nothing is tuned per arm, and each follows its motion. Arms with light wrists need more of their torque.
"""

import numpy as np

import nbs_pin as nbs


def main(arms: tuple[str, ...] = nbs.ROBOT_NAMES, duration: float = 4.0) -> dict[str, float]:
    """Prints a line per arm and returns its steady RMS error, of the worst joint [rad]."""
    errors = {}
    for name in arms:
        robot = nbs.load_robot(name)
        law, reference = nbs.NeuralBackstepping.for_robot(robot), nbs.Sinusoid.for_robot(robot)
        start = reference(0.0).q + 0.2 * (-1.0) ** np.arange(robot.nv)
        run = nbs.simulate(nbs.MujocoPlant(robot), law, reference, duration, 0.001, q0=start, check=False)
        errors[name] = float(nbs.metrics.rms_error(run, after=0.7 * duration).max())
        share = float((nbs.metrics.joint_peak_torque(run) / robot.effort_limit).max())
        print(f"{name:16} {robot.nv} joints  error {errors[name]:.1e} rad  peak {share:.0%} of a torque limit")
    return errors


if __name__ == "__main__":
    main()
