"""Motions of the loop as it runs, tried before a certificate is given: what one of them breaks is not PROVED."""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from nbs_pin.base.arrays import JointArray
from nbs_pin.base.claims import Label
from nbs_pin.base.exceptions import RobotError, SimulationDiverged
from nbs_pin.base.units import counted, units
from nbs_pin.certificates.admissible import Admissible
from nbs_pin.certificates.claims import Assumption, Condition, Role
from nbs_pin.certificates.margins import least_room
from nbs_pin.certificates.torque_waves import random_disturbances
from nbs_pin.controllers.lyapunov_law import LyapunovLaw
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.motions.references import DesiredMotion
from nbs_pin.robots.robot import Robot
from nbs_pin.simulation.dynamics_plant import DynamicsPlant
from nbs_pin.simulation.loop import LONGEST_PLANT_STEP, Loop
from nbs_pin.simulation.mujoco_plant import MujocoPlant
from nbs_pin.simulation.plant import Plant
from nbs_pin.simulation.plant_steps import stable_step
from nbs_pin.simulation.rollout import Batch, engine_for, motions
from nbs_pin.simulation.simulate import simulate

MOTIONS, PERIODS, PLANT_STEPS = 8, 2000, 8000
"""Motions tried, one of each kind of disturbance, and the most periods and plant steps of each."""


@dataclass(frozen=True)
class TriedMotions:
    """What motions of a loop reached from one start under admissible disturbances, with no torque cut off."""

    count: int
    """How many: one without a disturbance, as all are the same then."""
    duration: float
    """Length of each [s]."""
    errors: JointArray
    """Largest |z1_i| [rad]; inf if a motion diverged."""
    torque: JointArray
    """Largest |τ_i| that the law asked for [N·m]; inf if a motion diverged."""

    @classmethod
    def of(
        cls,
        law: LyapunovLaw,
        robot: Robot | None,
        friction: JointFriction,
        admissible: Admissible,
        reference: DesiredMotion,
        duration: float,
        period: float,
        start: tuple[JointArray, JointArray] | None,
        lookahead: float | None = None,
    ) -> "TriedMotions | None":
        """Motions of the arm along the reference, or None where it is shorter than a period.

        An arm with friction moves in MuJoCo, as friction can be too stiff for explicit steps; any other in Pinocchio.
        start: q and v; None takes the reference's. Readings are exact; lookahead None is half a period.
        """
        plant = _plant(law, robot, friction)
        step = None if robot is None else stable_step(plant, robot, period)
        finely = math.ceil(period / (LONGEST_PLANT_STEP if step is None else step) - 1e-9)
        steps = min(int(duration / period * (1.0 + 1e-9)), PERIODS, max(PLANT_STEPS // max(finely, 1), 1))
        if not steps:
            return None
        begin, count = reference(0.0), 1 if admissible.is_zero else MOTIONS
        q0, v0 = (np.tile(x, (count, 1)) for x in ((begin.q, begin.v) if start is None else start))
        waves = random_disturbances(admissible, steps, period, count, np.random.default_rng(0), nv=law.nv)
        loop = Loop.of(plant, law.nv, steps * period, period, plant_step=step, effort_limit=np.inf, lookahead=lookahead)
        far = np.full(law.nv, np.inf)
        try:
            with np.errstate(over="ignore", invalid="ignore"):
                q, wanted, torque = _moved(law, loop, reference, q0, v0, waves)
        except SimulationDiverged:
            return cls(count, steps * period, far, far)
        errors = law.dynamics.difference(q, wanted)
        return cls(count, steps * period, _largest(errors), _largest(torque))

    def conditions(self, robot: Robot | None, bounds: JointArray) -> tuple[Condition, ...]:
        """Whether the arm has the torques that were asked for, and whether |z1_i| kept within `bounds` [rad].

        Both are necessary: a motion that breaks one shows that the bounds do not hold, none that does shows nothing.
        """
        of = counted(self.count, "motion")
        because = f"{of} of {self.duration:.4g} s under disturbances of every kind, torques held, readings exact"
        share = np.zeros_like(bounds)
        np.divide(self.errors, np.maximum(bounds, np.finfo(float).tiny), out=share, where=np.isfinite(bounds))
        worst = int(np.argmax(share))
        joint = f"joint {worst + 1}" if robot is None else robot.joint_names[worst]
        unit = units("position", [False] * len(share) if robot is None else robot.prismatic)[worst]
        name, sides = (
            f"bound of |z1_i| of {joint} > largest in simulation",
            (float(bounds[worst]), float(self.errors[worst])),
        )
        found = Condition(name, *sides, unit, Label.PROVED, because, Role.NECESSARY, Assumption.TIME)
        if robot is None or not np.isfinite(robot.effort_limit).any():
            return (found,)
        cut = least_room(robot, "effort", self.torque, "largest torque in simulation", because)
        return found, cut


def _plant(law: LyapunovLaw, robot: Robot | None, friction: JointFriction) -> Plant:
    if robot is None:
        return DynamicsPlant(law.dynamics, friction=friction)
    if friction.viscous.any() or friction.coulomb.any():
        try:
            return MujocoPlant(robot, joint_friction=friction)
        except RobotError:  # such as an arm of point masses
            return DynamicsPlant(PinocchioDynamics(robot), friction=friction)
    return DynamicsPlant(PinocchioDynamics(robot))


def _moved(
    law: LyapunovLaw,
    loop: Loop,
    reference: DesiredMotion,
    q0: Float[np.ndarray, "count n"],
    v0: Float[np.ndarray, "count n"],
    waves: Float[np.ndarray, "count steps n"],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """q, q_d and the torques asked for, over all motions and instants; SimulationDiverged if one is not finite."""
    if isinstance(loop.plant, DynamicsPlant) and engine_for(law, loop) == "kernels":
        batch = replace(Batch.of(loop, reference, q0, v0), tau_d=np.ascontiguousarray(waves))
        with torch.no_grad():
            found = motions(law, batch, "kernels")
        return found.q.numpy(), batch.desired[:, :, 0], found.command.numpy()

    def held(t: float, q: Any, v: Any) -> np.ndarray:
        return np.asarray(waves[:, min(int(t / loop.period + 1e-6), loop.steps - 1)])

    duration = loop.steps * loop.period
    given: dict[str, Any] = {"plant_step": loop.step, "lookahead": loop.lead}
    given |= {"q0": q0, "v0": v0, "disturbance": held, "effort_limit": np.inf, "check": False}
    run = simulate(loop.plant, law, reference, duration, loop.period, **given)
    return run.q, run.q_ref, run.tau_command


def _largest(x: Float[np.ndarray, "*rows n"]) -> JointArray:
    size = np.where(np.isfinite(x), np.abs(x), np.inf)
    return np.asarray(size.reshape(-1, x.shape[-1]).max(axis=0))
