"""Where a tool or a load sits on an arm."""

import numpy as np
import pinocchio as pin
from jaxtyping import Float

from nbs_pin.base.checks import floats
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.robots.robot import Robot


def tool_frame(robot: Robot) -> str:
    """The link fixed to the last joint that is farthest from it, where a tool or payload usually is."""
    frames = [f for f in robot.model.frames if f.type == pin.FrameType.BODY and f.parentJoint == robot.nv]
    return str(max(frames, key=lambda f: float(np.linalg.norm(f.placement.translation))).name)


def place_of(robot: Robot, frame: str | None, position: Float[np.ndarray, "3"] | None = None) -> tuple[int, np.ndarray]:
    """The joint that carries a point of a link, its origin by default, and the point in that joint's frame [m].

    Raises:
        ArgumentError: If the link does not exist or moves with no joint, or the position is not three numbers.
    """
    name = tool_frame(robot) if frame is None else frame
    bodies = {f.name: f for f in robot.model.frames if f.type == pin.FrameType.BODY and f.parentJoint > 0}
    if name not in bodies:
        raise ArgumentError(f"{robot.name} has no moving link '{name}'; give one of {', '.join(bodies)}.")
    at = np.zeros(3) if position is None else floats("position", position)
    if at.shape != (3,) or not np.isfinite(at).all():
        raise ArgumentError(f"position is {position}, expected three finite numbers [m]; correct it.")
    return int(bodies[name].parentJoint), np.array(bodies[name].placement.act(at))
