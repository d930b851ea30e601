"""Conditions that laws are judged under: what the arm has, and its law does not know."""

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pinocchio as pin

from nbs_pin.base.arrays import JointArray
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.robots.carrying import carrying
from nbs_pin.robots.joint_drive import Drive
from nbs_pin.robots.places import tool_frame
from nbs_pin.robots.robot import Robot, load_robot
from nbs_pin.robots.urdf_options import Payload
from nbs_pin.robots.urdf_writer import write_urdf
from nbs_pin.simulation.mujoco_plant import MujocoPlant


@dataclass(frozen=True)
class Condition:
    """How the true arm and its loop differ from what its description says; by default in nothing."""

    name: str
    said: str
    """In words."""
    friction: float = 0.0
    """Coulomb friction of each joint as a share of its effort limit; viscous friction is as much at its speed limit."""
    inertia: float = 0.0
    """p: mass, each coordinate of the centre of mass and the inertia about it are each 1 + p or 1 − p times those of
    the description, by a coin for each body."""
    load: float = 0.0
    """A point mass at the arm's end (`tool_frame`) [kg]."""
    delay: int = 0
    """Control periods between a reading and the torque that answers it."""
    bits: int | None = None
    """Encoders of so many bits per turn, velocities by differences of their readings; None for exact readings."""
    headroom: float | None = None
    """Effort limits are so many times what the reference takes at most on each joint; None for those of the arm."""

    def friction_of(self, robot: Robot) -> JointFriction | None:
        """The friction of the true arm, None for none."""
        if self.friction == 0.0:
            return None
        effort, speed = robot.effort_limit, robot.velocity_limit
        coulomb = np.where(np.isfinite(effort), self.friction * effort, 0.0)
        return JointFriction(np.where(np.isfinite(speed), coulomb / speed, 0.0), coulomb)

    def arm(self, robot: Robot, rng: np.random.Generator) -> Robot:
        """The true arm without its friction; the coins of `inertia` come from `rng`."""
        arm = carrying(robot, [(tool_frame(robot), Payload(self.load))]) if self.load else robot
        return with_other_bodies(arm, self.inertia, rng) if self.inertia else arm

    def plant(self, robot: Robot, rng: np.random.Generator) -> MujocoPlant:
        """The true arm in MuJoCo."""
        return MujocoPlant(self.arm(robot, rng), joint_friction=self.friction_of(robot) or "drop")

    def effort_limit(self, robot: Robot, needed: JointArray) -> JointArray:
        """The torques that the drives give [N·m], for a reference that takes `needed` at most; never above the arm's.

        A joint that hardly works keeps a tenth of its limit.
        """
        limit = robot.effort_limit
        if self.headroom is None:
            return limit
        return np.asarray(np.minimum(limit, np.maximum(self.headroom * needed, 0.1 * limit)))


CONDITIONS = {
    condition.name: condition
    for condition in (
        Condition("nominal", "the arm of the description"),
        Condition("friction", "Coulomb friction of 2 % of the effort limits, as much viscous at full speed", 0.02),
        Condition("inertia", "bodies 5 % heavier or lighter, and with centres and inertias 5 % off", inertia=0.05),
        Condition("load", "2 kg at the end of the arm", load=2.0),
        Condition("delay", "torques a control period late", delay=1),
        Condition("encoders", "positions of 14 bits per turn, velocities as their differences", bits=14),
        Condition("limits", "no more torque than 1.2 times what the motion takes", headroom=1.2),
    )
}
"""All conditions by name, one difference each."""


def with_other_bodies(robot: Robot, p: float, rng: np.random.Generator) -> Robot:
    """The arm whose moving bodies have mass, centre of mass and inertia about it 1 ± p times theirs."""
    model = robot.model.copy()
    for k in range(1, len(model.inertias)):
        body = model.inertias[k]
        mass, *centre, inertia = 1.0 + p * rng.choice([-1.0, 1.0], size=5)
        model.inertias[k] = pin.Inertia(mass * body.mass, np.array(centre) * body.lever, inertia * body.inertia)
    drives = {
        joint.name: Drive(joint.damping, joint.friction, armature)
        for joint, armature in zip(robot.joints, robot.armature.tolist(), strict=True)
    }
    return rewritten(robot, model, drives)


def rewritten(robot: Robot, model: pin.Model, drives: dict[str, Drive]) -> Robot:
    """The arm with the bodies of that model and these drives, by way of a description with them."""
    with tempfile.TemporaryDirectory() as folder:
        other = load_robot(write_urdf(robot, Path(folder) / "arm.urdf", model, drives), gravity=robot.gravity_vector)
    return replace(other.with_effort_limit(robot.effort_limit), name=robot.name)
