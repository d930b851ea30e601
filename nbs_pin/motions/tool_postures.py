"""Where a tool path begins if nobody says so: a configuration from which the frame can move in every direction."""

import numpy as np
import pinocchio as pin
from jaxtyping import Float

from nbs_pin.base.arguments import checked, choice, maybe, text
from nbs_pin.base.arrays import JointArray
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.motions.inverse_kinematics import InverseKinematics
from nbs_pin.robots.robot import ARM, Robot

_SAMPLES = 3000
_INNER = 0.35
"""Share of each joint's range, on either side of its middle, in which configurations are tried."""
_UPRIGHT = 0.999
_TURNED = 8
"""Best configurations whose frame is turned downwards exactly."""
ORIENTATIONS = ("hold", "free")
ORIENTATION = choice(*ORIENTATIONS)


def is_held(robot: Robot, frame: str, orientation: str | None) -> bool:
    """Whether the orientation of the frame is to be held: as said, else if six joints or more move it."""
    return int(robot.supporting(frame).sum()) >= 6 if orientation is None else orientation == "hold"


def last_frame(robot: Robot) -> str:
    """The link at the end of the arm: the farthest one behind the last joint of the longest chain."""
    frames = [frame for frame in robot.model.frames if frame.type == pin.FrameType.BODY]
    depth = [len(robot.model.supports[frame.parentJoint]) for frame in frames]
    last = [frame for frame, joints in zip(frames, depth, strict=True) if joints == max(depth)]
    return str(max(last, key=lambda frame: round(float(np.linalg.norm(frame.placement.translation)), 9)).name)


@checked(robot=ARM, frame=maybe(text), orientation=maybe(ORIENTATION))
def tool_posture(robot: Robot, frame: str | None = None, *, orientation: str | None = None) -> JointArray:
    """A configuration for a tool path to begin in [rad]: away from joint limits and singular configurations.

    It is the best of samples within the middle of the joint ranges: by the smallest singular value of the frame's
    Jacobian, the distance from the stops, at most half of the effort limits for its weight, and a frame in the middle
    of the workspace. Where six joints or more move the frame, it points downwards: the axis of its last joint, away
    from the arm, is opposite to the base's z, or to what is nearest within reach.

    Args:
        robot: The arm.
        frame: A link or joint (`Robot.frames`); None takes the link at the end of the arm.
        orientation: "hold" or "free", as for `tool_motion`.

    Raises:
        ArgumentError: If there is no such frame, or it cannot follow paths.

    Example:
        >>> import nbs_pin as nbs
        >>> robot = nbs.load_robot("panda")
        >>> bool(robot.pose(nbs.tool_posture(robot, "panda_hand"), "panda_hand")[2, 2] < -0.999)
        True
    """
    frame = last_frame(robot) if frame is None else frame
    hold = is_held(robot, frame, orientation)
    lower, upper = robot.one_turn_range
    middle, span = 0.5 * (lower + upper), upper - lower
    tries = middle + np.random.default_rng(0).uniform(-_INNER, _INNER, (_SAMPLES, robot.nv)) * span
    moving = robot.supporting(frame)
    tries[:, ~moving] = middle[~moving]
    if abs(robot.jacobian(middle, frame)[5, 0]) > _UPRIGHT:  # it only turns the arm about the vertical
        tries[:, 0] = middle[0]
    inverse = InverseKinematics(robot, frame, middle, hold)
    downwards = hold and len(inverse.directions) == 6
    score = _scores(inverse, tries, downwards)
    best = tries[np.argsort(-score)[:_TURNED]]
    if downwards:
        turned = [_turned_down(robot, frame, q) for q in best]
        best = np.array([q for q in turned if _scores(inverse, q[None], True)[0] > 0.0] or best)
    found = best[np.argmax(_scores(inverse, best, downwards))]
    if not inverse.steadiness(found) > 0.0:
        raise ArgumentError(f"'{frame}' of {robot.name} cannot move in every direction; give another frame.")
    return np.asarray(found)


def _scores(inverse: InverseKinematics, tries: Float[np.ndarray, "tries n"], downwards: bool) -> np.ndarray:
    """How good configurations are to begin in: a product of factors from 0 to 1."""
    robot, frame = inverse.robot, inverse.frame
    poses, data = robot.pose(tries, frame), robot.model.createData()
    steady = inverse.steadiness(tries)
    lower, upper = robot.one_turn_range
    room = np.clip(2.0 * np.minimum(tries - lower, upper - tries) / (upper - lower), 0.0, 0.25).min(axis=-1)
    load = np.array([np.abs(pin.computeGeneralizedGravity(robot.model, data, q)) for q in tries]) / robot.effort_limit
    light = np.clip(2.0 - 2.0 * load.max(axis=-1), 0.0, 1.0)
    away = np.linalg.norm(poses[:, :2, 3], axis=-1) / inverse.reach
    middling = np.clip(1.0 - np.abs(away - 0.55) / 0.5, 0.05, 1.0)
    central = np.exp(-np.mean((2.0 * (tries - lower) / (upper - lower) - 1.0) ** 2, axis=-1))
    score = steady * (0.1 + room) * light * middling * central**2
    if downwards:
        height = np.minimum(_lowest_joint(robot, frame, tries), poses[:, 2, 3]) / inverse.reach
        score *= (0.5 - 0.5 * _pointing(robot, frame, tries)[:, 2]) ** 4 * np.clip(height / 0.2, 0.05, 1.0)
    return np.asarray(score)


def _lowest_joint(robot: Robot, frame: str, q: Float[np.ndarray, "tries n"]) -> Float[np.ndarray, " tries"]:
    """Height of the lowest joint of the outer half of those that move the frame [m]."""
    moving = np.flatnonzero(robot.supporting(frame))
    outer = [robot.joint_names[joint] for joint in moving[len(moving) // 2 - 1 :]]
    return np.asarray(np.min([robot.pose(q, joint)[:, 2, 3] for joint in outer], axis=0))


def _pointing(robot: Robot, frame: str, q: Float[np.ndarray, "*batch n"]) -> Float[np.ndarray, "*batch 3"]:
    """Where the frame points: the axis of the last joint that moves it, away from the joint before."""
    last = np.flatnonzero(robot.supporting(frame))[-1]
    axis = robot.jacobian(q, frame)[..., 3:, last]
    axis = np.where(robot.prismatic[last], robot.jacobian(q, frame)[..., :3, last], axis)
    before = robot.pose(q, robot.joint_names[max(last - 1, 0)])[..., :3, 3]
    away = np.einsum("...k,...k->...", axis, robot.pose(q, frame)[..., :3, 3] - before)
    return np.asarray(axis * np.where(away < 0.0, -1.0, 1.0)[..., None])


def _turned_down(robot: Robot, frame: str, q: JointArray) -> JointArray:
    """The configuration near q whose frame is where it was and points downwards; q if there is none."""
    pose, axis = robot.pose(q, frame), _pointing(robot, frame, q)
    turn = pin.Quaternion.FromTwoVectors(axis, np.array([0.0, 0.0, -1.0])).toRotationMatrix()
    pose[:3, :3] = turn @ pose[:3, :3]
    found = InverseKinematics(robot, frame, q, True).solve(q, pose)
    inside = ((found.q >= robot.lower) & (found.q <= robot.upper)).all()
    return found.q if found.exact and inside else q
