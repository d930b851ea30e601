"""How far the tool was from its path in a run: position and orientation of the frame against those of the reference."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from nbs_pin.base.arguments import checked, maybe, text
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.records import RUN, Run
from nbs_pin.motions.inverse_kinematics import pose_error
from nbs_pin.robots.robot import ARM, Robot


class ToolErrors(NamedTuple):
    """Errors of a frame at the control instants.

    Example:
        >>> import nbs_pin as nbs
        >>> robot = nbs.load_robot("two_link")
        >>> law, plant = nbs.NeuralBackstepping.for_robot(robot), nbs.DynamicsPlant.for_robot(robot)
        >>> run = nbs.simulate(plant, law, nbs.Hold([0.3, 0.2]), 0.1, 0.001, q0=[0.4, 0.2])
        >>> nbs.tool_errors(run, robot, robot.frames[-1]).position.shape  # m, one row per control instant
        (101,)
    """

    position: Float[np.ndarray, "rows *batch"]
    """Distance of its origin from where the reference puts it [m]."""
    orientation: Float[np.ndarray, "rows *batch"]
    """Angle from the orientation that the reference gives it [rad]."""

    def figures(self) -> dict[str, float]:
        """RMS and peak of both over the whole run."""
        rms = {name: float(np.sqrt(np.mean(x**2))) for name, x in self._asdict().items()}
        return {
            "rms_position_error_m": rms["position"],
            "peak_position_error_m": float(self.position.max()),
            "rms_orientation_error_rad": rms["orientation"],
            "peak_orientation_error_rad": float(self.orientation.max()),
        }


def tool_of(run: Run) -> dict[str, Any] | None:
    """What the run notes of its path of the tool: "frame", "orientation" and "path"; None if it had none."""
    noted = run.info.get("tool")
    return noted if isinstance(noted, dict) and isinstance(noted.get("frame"), str) else None


@checked(run=RUN, robot=ARM, frame=maybe(text))
def tool_errors(run: Run, robot: Robot, frame: str | None = None) -> ToolErrors:
    """Errors of a frame in the run, by the forward kinematics of q against those of q_ref.

    The reference of a `ToolMotion` is within 1e-6 m and rad of its path, so these are the errors from the path.

    Args:
        run: The run.
        robot: The arm that ran.
        frame: A link or joint (`Robot.frames`); None takes that of the path which the run followed.

    Raises:
        ArgumentError: If the arm has other joints or no such frame, or None is given and the run followed no path.

    Example:
        >>> import nbs_pin as nbs
        >>> robot = nbs.load_robot("two_link")
        >>> law, reference = nbs.NeuralBackstepping.for_robot(robot), nbs.Sinusoid.for_robot(robot)
        >>> run = nbs.simulate(nbs.MujocoPlant(robot), law, reference, 0.1, 0.001)
        >>> bool(nbs.tool_errors(run, robot, "tip").position.max() < 1e-5)
        True
    """
    noted = tool_of(run)
    if frame is None and noted is None:
        raise ArgumentError("the run followed no path of a tool; say of which frame the errors are: frame='…'.")
    if robot.joint_names != run.joint_names:
        raise ArgumentError(
            f"the run moves joints {', '.join(run.joint_names)} but {robot.name} has {', '.join(robot.joint_names)}: "
            "give the robot that ran."
        )
    frame = noted["frame"] if frame is None and noted is not None else str(frame)
    error = pose_error(robot.pose(run.q, frame), robot.pose(run.q_ref, frame))
    return ToolErrors(np.linalg.norm(error[..., :3], axis=-1), np.linalg.norm(error[..., 3:], axis=-1))
