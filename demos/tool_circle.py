"""The hand of a Panda draws a circle of 10 cm: inverse kinematics, limits and timing are the package's work.

What to see: the joints of the circle have exact velocities and accelerations, so the hand stays within some tens of
nanometres of it. Then the same circle in the least time that the limits of the joints allow, and one that is too large,
which is refused at the first point that is out of reach.
"""

import numpy as np

import nbs_pin as nbs

FRAME = "panda_hand"


def main(duration: float = 5.0) -> dict[str, float | str]:
    """Returns the RMS error of the hand [m], the least time [s] and what is said of the circle that is too large."""
    robot = nbs.load_robot("panda")
    law = nbs.NeuralBackstepping.for_robot(robot)
    begin = robot.pose(nbs.Sinusoid.for_robot(robot).offset, FRAME)[:3, 3]
    circle = nbs.ToolPath.circle(begin, 0.1)
    motion = nbs.tool_motion(robot, circle, FRAME, duration=duration)
    run = nbs.simulate(nbs.MujocoPlant(robot), law, motion, duration, 0.001)
    error = float(np.sqrt(np.mean(nbs.tool_errors(run, robot).position ** 2)))
    print(f"{circle} in {duration:g} s: RMS error of the hand {1e9 * error:.0f} nm")

    fastest = nbs.tool_motion(robot, circle, FRAME, fastest=True).duration
    print(f"in the least time: {fastest:.2f} s")

    try:
        nbs.tool_motion(robot, nbs.ToolPath.circle(begin, 0.6), FRAME)
        refusal = ""
    except nbs.NbsPinError as error_of_path:
        refusal = str(error_of_path)
        print(f"refused: {refusal}")
    return {"error": error, "fastest": fastest, "refusal": refusal}


if __name__ == "__main__":
    main()
