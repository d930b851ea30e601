"""The tasks of the challenge: arms, motions and conditions, each motion within the limits of its arm."""

import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import pinocchio as pin
from jaxtyping import Float

from nbs_pin.base.arrays import JointArray
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.benchmarks.conditions import CONDITIONS, Condition
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.motions.fourier import Fourier, at_rest
from nbs_pin.motions.references import DesiredMotion, MinimumJerk, Sinusoid, at_times, resting_posture
from nbs_pin.motions.tool_motions import tool_motion
from nbs_pin.motions.tool_paths import ToolPath
from nbs_pin.motions.tool_postures import tool_posture
from nbs_pin.robots.places import tool_frame
from nbs_pin.robots.robot import Robot, load_robot
from nbs_pin.simulation.mujoco_plant import MujocoPlant

ARMS = ("panda", "ur5e", "xarm7", "iiwa14", "gen3")
"""With six joints and seven, with rotors in the description and without, limited and continuous."""
PERIOD = 0.001
"""Control period and plant step [s]."""
DURATION = 5.0
"""Length of every motion [s]."""
SETTLED = 1.0
"""Errors count from here on [s], as every motion begins off its reference."""
START_ERROR = 0.02
"""Every joint begins within this of the reference [rad], with its velocity."""
_SPEED, _TORQUE = 0.6, 0.85
"""Shares of the velocity and, with the heaviest load of the conditions, effort limits that a motion uses at most."""
_SHRUNK = tuple(0.9**k for k in range(30))
_INSTANTS = np.linspace(0.0, DURATION, 2001)
_REACH = 0.5  # [rad]
_HARMONICS = 5


@dataclass(frozen=True, eq=False)
class Task:
    """What an entrant that promises something is told of a task; its law is told nothing of the condition."""

    robot: Robot
    """The arm as described, which the law may believe in."""
    motion: str
    """Name of the reference, one of `MOTIONS`."""
    reference: DesiredMotion
    """The motion, for `duration` [s]."""
    condition: Condition
    """What is different from the description."""
    friction: JointFriction | None
    """The friction of the true arm, None for none."""
    effort_limit: JointArray
    """What the drives give at most [N·m]."""
    period: float = PERIOD
    """Control period [s]."""
    duration: float = DURATION
    """[s]."""
    settled: float = SETTLED
    """A promise holds from here on [s]."""
    start_error: float = START_ERROR
    """Each joint begins within this of the reference [rad], with its velocity."""


@dataclass(frozen=True, eq=False)
class Course:
    """One arm with its motions, and its start and true bodies for a seed."""

    robot: Robot
    seed: int

    def task(self, motion: str, condition: str) -> Task:
        """The task of a motion under a condition."""
        reference, one = motion_of(self.robot, motion), CONDITIONS[condition]
        limit = one.effort_limit(self.robot, np.abs(_torques(self.robot, reference)).max(axis=0))
        return Task(self.robot, motion, reference, one, one.friction_of(self.robot), limit)

    def plant(self, condition: str) -> MujocoPlant:
        """The true arm: its bodies are the same in all motions."""
        return CONDITIONS[condition].plant(self.robot, self._drawn("bodies"))

    def start(self, motion: str) -> tuple[JointArray, JointArray]:
        """Where every run of a motion begins, the same under all conditions."""
        begin = motion_of(self.robot, motion)(0.0)
        return begin.q + self._drawn(motion).uniform(-START_ERROR, START_ERROR, self.robot.nv), begin.v

    def _drawn(self, what: str) -> np.random.Generator:
        return np.random.default_rng([self.seed, zlib.crc32(f"{self.robot.name} {what}".encode())])


@lru_cache(maxsize=8)
def course_of(arm: str, seed: int) -> Course:
    """The course of an arm by name."""
    return Course(load_robot(arm), seed)


@lru_cache(maxsize=64)
def motion_of(robot: Robot, name: str) -> DesiredMotion:
    """The motion of that name, as large as it fits into the limits of the arm; the same in every challenge."""
    loaded = max(CONDITIONS.values(), key=lambda condition: condition.load).arm(robot, np.random.default_rng(0))
    for share in _SHRUNK:
        motion = MOTIONS[name](robot, share)
        q, v, _ = at_times(motion, _INSTANTS, robot.nv)
        inside = ((q >= robot.lower) & (q <= robot.upper)).all() and (np.abs(v) <= _SPEED * robot.velocity_limit).all()
        if inside and all(
            (np.abs(_torques(arm, motion)) <= _TORQUE * robot.effort_limit).all() for arm in (robot, loaded)
        ):
            return motion
    raise ArgumentError(f"no motion '{name}' of {robot.name} fits into its limits with a load; take another arm.")


def _torques(robot: Robot, motion: DesiredMotion) -> Float[np.ndarray, "rows n"]:
    """What the motion takes of the arm [N·m]."""
    data, desired = robot.model.createData(), at_times(motion, _INSTANTS, robot.nv)
    return np.array([pin.rnea(robot.model, data, *row) for row in zip(*desired, strict=True)])


def _sinusoid(robot: Robot, share: float) -> DesiredMotion:
    return Sinusoid.for_robot(robot, 2.0, share * _REACH)


def _moves(robot: Robot, share: float) -> DesiredMotion:
    """To two postures and back, at rest for 0.4 s in each."""
    home, reach = resting_posture(robot), share * _reach(robot)
    there, beyond = home + reach * np.random.default_rng(1).uniform(-1.0, 1.0, (2, robot.nv))
    return MinimumJerk([home, there, there, beyond, beyond, home], [0.0, 1.4, 1.8, 3.2, 3.6, DURATION])


def _circle(robot: Robot, share: float) -> DesiredMotion:
    frame, posture = tool_frame(robot), _posture(robot)
    path = ToolPath.circle(robot.pose(posture, frame)[:3, 3], 0.1 * share)
    return tool_motion(robot, path, frame, posture=posture, duration=DURATION)


@lru_cache(maxsize=8)
def _posture(robot: Robot) -> JointArray:
    return tool_posture(robot, tool_frame(robot))


def _excitation(robot: Robot, share: float) -> DesiredMotion:
    """Five harmonics of random amplitudes and phases, from rest to rest."""
    free = np.random.default_rng(2).normal(size=(2 * _HARMONICS - 2, robot.nv))
    waves = at_rest(_HARMONICS) @ free
    sine, cosine = waves[:_HARMONICS], waves[_HARMONICS:]
    q, v, _ = Fourier(np.zeros(robot.nv), sine, cosine, DURATION)(_INSTANTS)
    most, fastest = np.abs(q).max(axis=0), np.abs(v).max(axis=0)
    scale = share * np.minimum(_reach(robot) / most, _SPEED * robot.velocity_limit / fastest)
    return Fourier(resting_posture(robot), scale * sine, scale * cosine, DURATION)


def _reach(robot: Robot) -> JointArray:
    """How far the motions go from the resting posture [rad]."""
    return np.minimum(_REACH, 0.25 * np.minimum(robot.upper - robot.lower, 2.0 * np.pi))


MOTIONS: dict[str, Callable[[Robot, float], DesiredMotion]] = {
    "sinusoid": _sinusoid,
    "moves": _moves,
    "circle": _circle,
    "excitation": _excitation,
}
"""Makers of every motion, for an arm and a share of its usual size."""
SAID = {
    "sinusoid": "every joint a sine of 2 rad/s",
    "moves": "moves of least jerk to two postures and back, with rests",
    "circle": "a circle of the tool, turned as it is",
    "excitation": "five harmonics of random amplitudes on every joint",
}
"""Every motion in words."""
