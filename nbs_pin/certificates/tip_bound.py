"""How far a tip can be from where the reference has it, given bounds of the joints' errors."""

import numpy as np
from jaxtyping import Float

from nbs_pin.robots.robot import Robot
from nbs_pin.robots.visuals import tips


def tip_bound(robot: Robot, joint_errors: Float[np.ndarray, " n"], error: float) -> float:
    """Greatest distance of any tip from its place at the reference [m], in every pose; inf if nothing bounds it.

    A joint that turns by e moves the tip along an arc of at most r|e|, where r is the greatest length of the chain
    behind the joint, and one that slides by |e|. From the reference to the arm one joint after the other moves, so
    that the distance is at most Σ r_i|e_i|, and if all of them turn at most ‖r‖‖e‖.

    Args:
        robot: The arm.
        joint_errors: Bound of |z1| of every joint [rad, m].
        error: Bound of ‖z1‖ [rad, m].
    """
    model, worst = robot.model, 0.0
    for tip in tips(robot):
        behind, joint, levers, slides = float(np.linalg.norm(tip.point)), tip.joint, np.zeros(robot.nv), False
        while joint > 0:
            i = model.joints[joint].idx_v
            if robot.prismatic[i]:
                levers[i], slides = 1.0, True
                behind += max(abs(robot.lower[i]), abs(robot.upper[i])) + joint_errors[i]
            else:
                levers[i] = behind
            behind += float(np.linalg.norm(model.jointPlacements[joint].translation))
            joint = model.parents[joint]
        together = np.inf if slides else float(np.linalg.norm(levers)) * error
        found = min(float(levers @ joint_errors), together)
        worst = np.inf if np.isnan(found) else max(worst, found)
    return worst
