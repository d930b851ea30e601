"""Arms as they are beside their descriptions: rotors, friction, other bodies, loads and encoders; trials on them."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from jaxtyping import Float

from nbs_pin.base.arrays import JointArray, Vectors
from nbs_pin.base.exceptions import SimulationDiverged
from nbs_pin.base.records import Reference, Run
from nbs_pin.benchmarks.conditions import rewritten
from nbs_pin.controllers.controller import Controller
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.motions.references import Sinusoid
from nbs_pin.robots.joint_drive import Drive
from nbs_pin.robots.places import tool_frame
from nbs_pin.robots.robot import Robot, load_robot
from nbs_pin.simulation import metrics
from nbs_pin.simulation.dynamics_plant import DynamicsPlant
from nbs_pin.simulation.mujoco_plant import MujocoPlant
from nbs_pin.simulation.simulate import simulate
from nbs_pin.simulation.tool_errors import tool_errors

PERIOD = 0.001
"""Control period, and plant step [s]."""
ENCODER = 2.0**-18
"""Step of the encoders as a share of a turn."""
BODIES, WARMTH = 0.05, 0.3
"""Bodies are up to this share heavier or lighter than described; friction is up to that share more or less."""
AWAY, OFF_CENTRE = 0.2, 0.05
"""Starts are at rest, each joint within this of the motion [rad]; loads are within this of the tool [m], per axis."""
LOADS = {"panda": 2.0, "ur5": 3.0, "fr3": 2.0}
"""Largest load of every arm [kg]."""
_ROTOR, _FRICTION = 0.1, 0.02  # [kg·m²], as in MuJoCo's models of both; Coulomb and, at full speed, viscous friction


@dataclass(frozen=True, eq=False)
class RealArm:
    """An arm, and what its laws are told of it.

    The rotors and friction of fr3 are those of its description; panda and ur5 have rotors of 0.1 kg·m² at every joint,
    Coulomb friction of 2 % of the effort limit, and as much viscous friction at full speed.
    """

    name: str
    told: Robot
    """The description without rotors and friction, which is all that laws know."""
    rotors: JointArray
    """[kg·m²], (n,)."""
    friction: JointFriction
    bodies: JointArray
    """Mass of every body over that of the description, (n,)."""

    @classmethod
    def of(cls, name: str, seed: int) -> "RealArm":
        """The arm of that name; its bodies are drawn from the seed."""
        robot = load_robot(name)
        rotors, friction = robot.armature, JointFriction.of(robot)
        if not rotors.any():
            coulomb = _FRICTION * robot.effort_limit
            rotors, friction = np.full(robot.nv, _ROTOR), JointFriction(coulomb / robot.velocity_limit, coulomb)
        bodies = np.random.default_rng((seed, 0)).uniform(1.0 - BODIES, 1.0 + BODIES, robot.nv)
        return cls(name, robot.with_armature(0.0).with_friction(0.0, 0.0), rotors, friction, bodies)

    def true(self, load: float = 0.0, centre: Float[np.ndarray, "3"] | None = None) -> Robot:
        """The arm with its rotors and bodies, and a load [kg] with this centre in the frame of the tool [m]."""
        robot = self.told
        if load:
            robot = robot.with_payload(tool_frame(robot), load, np.zeros(3) if centre is None else centre)
        model = robot.model.copy()
        for k, factor in enumerate(self.bodies, start=1):
            bare, own = (x.inertias[k].toDynamicParameters() for x in (self.told.model, model))
            model.inertias[k] = pin.Inertia.FromDynamicParameters(own + (factor - 1.0) * bare)
        drives = {joint.name: Drive(0.0, 0.0, x) for joint, x in zip(robot.joints, self.rotors.tolist(), strict=True)}
        return rewritten(robot, model, drives)

    def trials(self, count: int, seed: int, stream: int) -> list["Trial"]:
        """Trials with loads, friction, motions and starts of their own; streams have no draw in common."""
        draws = [np.random.default_rng((seed, stream, k)) for k in range(count)]
        return [Trial.of(self, draw) for draw in draws]


@dataclass(frozen=True, eq=False)
class Trial:
    """One load, friction of the day, motion and start."""

    arm: RealArm
    true: Robot
    friction: JointFriction
    motion: Sinusoid
    start: JointArray

    @classmethod
    def of(cls, arm: RealArm, draw: np.random.Generator) -> "Trial":
        """A trial drawn at random."""
        told, n = arm.told, arm.told.nv
        load, centre = draw.uniform(0.0, LOADS[arm.name]), draw.uniform(-OFF_CENTRE, OFF_CENTRE, 3)
        day = draw.uniform(1.0 - WARMTH, 1.0 + WARMTH)
        friction = JointFriction(day * arm.friction.viscous, day * arm.friction.coulomb)
        motion = Sinusoid.for_robot(told, amplitude=draw.uniform(0.2, 0.5), frequency=draw.uniform(0.5, 2.5))
        return cls(arm, arm.true(load, centre), friction, motion, motion(0.0).q + draw.uniform(-AWAY, AWAY, n))

    @cached_property
    def plant(self) -> MujocoPlant:
        """The arm in MuJoCo, where dry friction is a constraint."""
        return MujocoPlant(self.true, joint_friction=self.friction)

    @property
    def differentiable(self) -> DynamicsPlant:
        """The same arm for training, with a tanh as dry friction."""
        return DynamicsPlant(PinocchioDynamics(self.true), friction=self.friction)


class Figures(NamedTuple):
    """Figures of a run over its second half."""

    error: float
    """RMS error of the worst joint [rad]; inf, as all below, for a run that diverged."""
    peak: float
    """Largest error of a joint [rad]."""
    tool: float
    """RMS error of the tool's position [m]."""
    roughness: float
    """RMS change of a torque from one millisecond to the next as a share of the effort limit, of the worst joint."""
    saturated: float
    """Share of the instants at which some torque is cut off."""


def attempt(law: Controller, trial: Trial, duration: float) -> Figures:
    """The figures of a law that reads encoders in a trial."""
    robot = trial.arm.told
    seen = Encoded(law.compile(), robot.prismatic)
    try:
        run = simulate(trial.plant, seen, trial.motion, duration, PERIOD, q0=trial.start, lookahead=0.0, check=False)
    except SimulationDiverged:
        return Figures(*[np.inf] * 5)
    return _figures(run, robot)


def _figures(run: Run, robot: Robot) -> Figures:
    half = 0.5 * float(run.t[-1])
    late = run.t >= half
    change = np.diff(run.tau_command[late][:-1], axis=0) / run.effort_limit
    return Figures(
        error=float(metrics.rms_error(run, half).max()),
        peak=float(np.abs(metrics.error(run)[late]).max()),
        tool=float(np.sqrt(np.mean(tool_errors(run, robot, tool_frame(robot)).position[late] ** 2))),
        roughness=float(np.sqrt(np.mean(change**2, axis=0)).max()),
        saturated=float(np.any(np.abs(run.tau_command[late]) > run.effort_limit, axis=-1).mean()),
    )


class Encoded(Controller):
    """A law that is given positions as encoders read them, and the differences of neighbouring readings as velocities.

    Its memory is the last reading and the memory of the law; before the first the arm is taken to stand still.
    """

    def __init__(self, law: Controller, prismatic: np.ndarray, encoder: float = ENCODER) -> None:
        self.law, self._step = law, encoder * np.where(prismatic, 1.0, 2.0 * np.pi)

    @property
    def nv(self) -> int:
        """Number of joints."""
        return self.law.nv

    def initial_memory(self, q: Vectors) -> tuple[Any, Any]:
        """The reading at q, and the law's memory."""
        return self._read(q), self.law.initial_memory(q)

    def step(
        self, memory: tuple[Any, Any], q: Vectors, v: Vectors, reference: Reference, period: float
    ) -> tuple[Vectors, tuple[Any, Any]]:
        """The law's torque for the readings [N·m]; v is not looked at."""
        last, inner = memory
        seen = self._read(q)
        tau, inner = self.law.step(inner, seen, (seen - last) / period, reference, period)
        return tau, (seen, inner)

    def _read(self, q: Vectors) -> np.ndarray:
        return np.asarray(self._step * np.round(q / self._step))
