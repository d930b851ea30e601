"""Motions of joints that lead a frame along a path of the tool, and when."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from nbs_pin.base.arguments import DURATION, a, checked, flag, joints, maybe, text
from nbs_pin.base.arrays import JointArray
from nbs_pin.base.checks import PerJoint, vector_of
from nbs_pin.base.doors import BLANK, argument, option
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.records import Reference
from nbs_pin.base.shown import Shown
from nbs_pin.base.units import percent, units
from nbs_pin.motions.inverse_kinematics import InverseKinematics
from nbs_pin.motions.joint_paths import JointPath, joint_path
from nbs_pin.motions.limits import Margins
from nbs_pin.motions.reference_files import PLAUSIBLE_JUMP
from nbs_pin.motions.references import check_reference, instants
from nbs_pin.motions.timings import Even, Smooth, Timing
from nbs_pin.motions.tool_paths import ToolPath
from nbs_pin.motions.tool_postures import ORIENTATION, is_held, last_frame, tool_posture
from nbs_pin.robots.robot import ARM, Robot

DURATION_OF_PATH = 5.0
"""Time that a path takes that states none [s]."""
_INSTANTS = 2001


@dataclass(frozen=True, eq=False, repr=False)
class ToolMotion(Shown):
    """q(s(t)) of an arm whose frame follows a path; v = q'ṡ and a = q''ṡ² + q's̈ are its exact derivatives.

    It rests at the beginning before t = 0 and at the end after `duration`. Made by `tool_motion`.

    Example:
        >>> import nbs_pin as nbs
        >>> robot = nbs.load_robot("ur5")
        >>> posture = nbs.tool_posture(robot, "tool0")
        >>> line = nbs.ToolPath.line(robot.pose(posture, "tool0")[:3, 3], [0.0, 0.1, 0.0])
        >>> motion = nbs.tool_motion(robot, line, "tool0", posture=posture, duration=2.0)
        >>> motion.duration, motion(0.0).v.round(9).any(), motion.pose(1.0).shape
        (2.0, ..., (4, 4))
    """

    frame: str
    path: ToolPath
    joints: JointPath
    timing: Timing
    orientation: Float[np.ndarray, "3 3"]
    """Orientation where the path states none: that of the posture."""
    held: bool
    """Whether the orientation is that of the path, or of the beginning; otherwise it is free."""

    def _facts(self) -> Iterable[str]:
        return repr(self.frame), repr(self.path), f"{self.duration:.4g} s"

    @property
    def duration(self) -> float:
        """Time of the end of the path [s]."""
        return float(self.timing.duration)

    @property
    def rests(self) -> bool:
        """Whether it ends at rest; one with the times of its path may not."""
        return not isinstance(self.timing, Even)

    @property
    def largest_jerk(self) -> JointArray:
        """Bound of |ȧ_d| of each joint [rad/s³], inf where a jumps: |q'''||ṡ|³ + 3|q''||ṡ||s̈| + |q'||s⃛|."""
        speed, bend, jerk = self.timing.largest
        first, second, third = (self.joints.bound(order) for order in (1, 2, 3))
        return np.asarray(third * speed**3 + 3.0 * second * speed * bend + first * jerk)

    @property
    def notes(self) -> dict[str, Any]:
        """What a run of it keeps in `info`: the frame, whether its orientation counts, and the path by name."""
        return {"tool": {"frame": self.frame, "orientation": "hold" if self.held else "free", "path": self.path.name}}

    def pose(self, t: Any) -> Float[np.ndarray, "*batch 4 4"]:
        """Pose that the frame should have at t [s]; its orientation is the one of the beginning if it is free."""
        return self.path.poses(self.timing(instants(t)).s, self.orientation)

    def __call__(self, t: Any) -> Reference:
        """Desired motion at t [s]."""
        along = self.timing(instants(t))
        first, second = self.joints(along.s, 1), self.joints(along.s, 2)
        ds, dds = along.ds[..., None], along.dds[..., None]
        return Reference(self.joints(along.s), first * ds, second * ds**2 + first * dds)


@checked(
    robot=ARM,
    path=a(ToolPath, "a path, such as ToolPath.circle"),
    frame=maybe(text),
    orientation=maybe(ORIENTATION),
    duration=maybe(DURATION),
    fastest=flag,
    acceleration=maybe(joints(above=0.0, unit="rad/s²", infinite=True)),
    margins=maybe(a(Margins, "margins, as Margins makes them")),
)
def tool_motion(
    robot: Robot,
    path: ToolPath,
    frame: str | None = None,
    *,
    posture: Any = None,
    orientation: str | None = None,
    duration: float | None = None,
    fastest: bool = False,
    acceleration: PerJoint | None = None,
    margins: Margins | None = None,
) -> ToolMotion:
    """The motion of the joints that leads a frame along a path, within the limits of the arm.

    A redundant arm stays near the configuration in which it begins, away from its stops. Collisions are not looked at.

    Args:
        robot: The arm.
        path: The path, as `ToolPath.circle`, `line`, `through` or `load_tool_path` make it.
        frame: A link or joint (`Robot.frames`); None takes the link at the end of the arm.
        posture: Configuration (n,) [rad] near which the path begins and that a redundant arm keeps to; None takes
            `tool_posture`. Its orientation is held if the path states none.
        orientation: "hold" for the orientation of the path, or of the posture, throughout; "free" for positions alone.
            None holds it if six joints or more move the frame.
        duration: Time from rest to rest [s]. None takes the times of the path, or 5 s if it has none.
        fastest: Take the least time that the velocity and effort limits of the arm allow; without a duration.
        acceleration: Largest |a| of `fastest`, one number or one per joint [rad/s²]; None for no limit besides torque.
        margins: What to leave of position, velocity and effort limits.

    Raises:
        ArgumentError: At the first point of the path that is out of reach, singular, beyond a joint limit or not
            smooth; or if velocity or effort limits are exceeded, with joint and time.

    Example:
        >>> import nbs_pin as nbs
        >>> robot = nbs.load_robot("panda")
        >>> posture = nbs.tool_posture(robot, "panda_hand")
        >>> circle = nbs.ToolPath.circle(robot.pose(posture, "panda_hand")[:3, 3], radius=0.1)
        >>> motion = nbs.tool_motion(robot, circle, "panda_hand", posture=posture, duration=5.0)
        >>> bool(abs(robot.pose(motion(2.5).q, "panda_hand") - motion.pose(2.5)).max() < 1e-7)
        True
    """
    acceleration = _check_timing(robot, duration, fastest, acceleration)
    frame = last_frame(robot) if frame is None else frame
    held = is_held(robot, frame, orientation)
    if posture is None:
        posture = tool_posture(robot, frame, orientation="hold" if held else "free")
    posture = vector_of(argument("tool_motion", "posture"), posture, robot.nv, "rad")
    limited = robot if margins is None else margins.of(robot)
    along = joint_path(InverseKinematics(limited, frame, posture, held), path)
    if fastest:
        from nbs_pin.motions.least_time import least_time

        timing: Timing = least_time(limited, along, acceleration)
    elif duration is None and path.duration is not None:
        timing = Even(path.duration)
    else:
        timing = Smooth(DURATION_OF_PATH if duration is None else duration)
    motion = ToolMotion(frame, path, along, timing, robot.pose(posture, frame)[:3, :3], held)
    if not fastest:
        _check_speed(limited, motion)
        _check_ends(limited, motion)
        check_reference(motion, limited, motion.duration)
    return motion


def _check_timing(robot: Robot, duration: float | None, fastest: bool, acceleration: Any) -> np.ndarray | None:
    """The largest |a| of each joint, or None; raises ArgumentError if the settings of time contradict each other."""
    if fastest and duration is not None:
        given = option("duration", duration)
        raise ArgumentError(f"{option('fastest', True)} finds the duration of the path; omit {given}.")
    if acceleration is None:
        return None
    if not fastest:
        given, least = option("acceleration", acceleration.tolist()), option("fastest", True)
        raise ArgumentError(f"{given} is for the motion of least time; give {least} too, or omit it.")
    if acceleration.size not in (1, robot.nv):
        raise ArgumentError(
            f"acceleration has {acceleration.size} numbers for the {robot.nv} joints of {robot.name}; give one, or one "
            "each."
        )
    return np.full(robot.nv, acceleration)


def _check_speed(robot: Robot, motion: ToolMotion) -> None:
    """Raise ArgumentError if a joint is too fast, with the duration in which it is not."""
    t = np.linspace(0.0, motion.duration, _INSTANTS)
    v = np.abs(motion(t).v)
    share = v / robot.velocity_limit
    k, i = np.unravel_index(int(np.argmax(share)), share.shape)
    if share[k, i] <= 1.0:
        return
    unit = units("velocity", robot.prismatic)[i]
    peak = 1.0 if motion.rests else Smooth(1.0).largest[0]  # a duration makes it begin and end at rest
    slower = float(f"{1.01 * share[k, i] * motion.duration * peak:.3g}")
    raise ArgumentError(
        f"the {motion.path.name} needs the velocity {v[k, i]:.4g} {unit} of joint '{robot.joint_names[i]}' at t = "
        f"{t[k]:.4g} s, {percent(share[k, i] - 1.0)} above its limit {robot.velocity_limit[i]:.4g} {unit}; give at "
        f"least {option('duration', slower)} s."
    )


def _check_ends(robot: Robot, motion: ToolMotion) -> None:
    """Raise ArgumentError if a path with times begins or ends in motion, as the arm rests before and after."""
    for t, what in ((0.0, "begins"), (motion.duration, "ends")):
        v = np.abs(motion(t).v)
        i = int(np.argmax(v))
        if v[i] > PLAUSIBLE_JUMP:
            unit = units("velocity", robot.prismatic)[i]
            raise ArgumentError(
                f"the {motion.path.name} {what} with the velocity {v[i]:.3g} {unit} of joint '{robot.joint_names[i]}', "
                f"where the arm rests; add points at rest there, or give {option('duration', BLANK)}."
            )
