"""Batches of motions of one closed loop under held disturbances, starting on the reference, with gradients."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int

from nbs_pin.base.checks import PerJoint
from nbs_pin.base.exceptions import ArgumentError, SimulationDiverged
from nbs_pin.base.progress import tracked
from nbs_pin.base.records import Run
from nbs_pin.controllers.adaptive_law import AdaptiveLaw
from nbs_pin.controllers.compiled_adaptive import CompiledAdaptiveLaw
from nbs_pin.controllers.controller import Controller
from nbs_pin.controllers.lyapunov_law import LyapunovLaw
from nbs_pin.controllers.model_law import ModelLaw
from nbs_pin.dynamics.provider import DynamicsProvider
from nbs_pin.motions.references import MOTION, DesiredMotion, Hold, Sinusoid, at_times
from nbs_pin.robots.robot import configuration_difference
from nbs_pin.simulation.dynamics_plant import DynamicsPlant
from nbs_pin.simulation.loop import Loop
from nbs_pin.simulation.rollout import Batch, Engine, engine_for, motions, recorded

POSTURES = 7
"""Number of postures at rest, besides the arm's own motion, if no reference is given."""
TIME_CONSTANTS, MOST_PERIODS = 7.0, 4000
"""Default duration: so many of the slowest time constants, at most so many periods."""
_BATCH = 128  # motions in memory at once


class Peaks(NamedTuple):
    """Largest errors of motions, one row per motion."""

    error: Float[np.ndarray, " count"]
    """max_t ‖z1(t)‖ [rad]."""
    joint_errors: Float[np.ndarray, "count n"]
    """max_t |z1_i(t)| [rad]."""


@dataclass(frozen=True, eq=False)
class LoopEnsemble:
    """A closed loop and the motions that it follows; built by `of`."""

    controller: ModelLaw
    scenes: Batch
    """One row per reference motion, undisturbed."""
    engine: Engine

    @classmethod
    def of(
        cls,
        controller: Controller,
        reference: DesiredMotion | Sequence[DesiredMotion] | None,
        plant_dynamics: DynamicsProvider | None,
        duration: float | None,
        period: float,
        effort_limit: PerJoint,
        seed: int,
    ) -> "LoopEnsemble":
        """The loop for the arguments of `attack`; raises ArgumentError if they do not fit."""
        law = law_of(controller)
        truth = law.dynamics if plant_dynamics is None else plant_dynamics
        followed = motions_of(law.dynamics, reference, seed)
        if duration is None:
            lasting = TIME_CONSTANTS / slowest_rate(law, followed[0])
            duration = period * min(max(math.ceil(lasting / period), 10), MOST_PERIODS)
        plant = DynamicsPlant(truth, friction=law.friction)
        loop = Loop.of(plant, law.nv, duration, period, plant_step=None, effort_limit=effort_limit, lookahead=None)
        scenes = Batch.joined([Batch.of(loop, motion) for motion in followed])
        return cls(law, scenes, engine_for(law, loop))

    @property
    def loop(self) -> Loop:
        """Period, steps and plant."""
        return self.scenes.loop

    def batch(self, motion: Int[np.ndarray, " count"], tau_d: Float[np.ndarray, "count steps n"]) -> Batch:
        """The motions of these indices under these torques [N·m]."""
        picked = {name: getattr(self.scenes, name)[motion] for name in ("aims", "desired", "q0", "v0")}
        return replace(self.scenes, **picked, tau_d=np.ascontiguousarray(tau_d))

    def peaks(
        self, motion: Int[np.ndarray, " count"], tau_d: Float[np.ndarray, "count steps n"], progress: bool = False
    ) -> Peaks:
        """Largest errors of the motions of these indices under these torques [N·m]."""
        parts = [slice(k, k + _BATCH) for k in range(0, len(motion), _BATCH)]
        found = []
        with torch.no_grad():
            for part in tracked(parts, "motions under disturbance", progress):
                z1 = np.abs(self._errors(self.batch(motion[part], tau_d[part])).numpy())
                found.append((np.linalg.norm(z1, axis=-1).max(axis=1), z1.max(axis=1)))
        return Peaks(*(np.concatenate(x) for x in zip(*found, strict=True)))

    def torque_gradient(
        self,
        motion: Int[np.ndarray, " count"],
        tau_d: Float[np.ndarray, "count steps n"],
        weights: Float[np.ndarray, "count n"],
        at_end: bool,
    ) -> Float[np.ndarray, "count steps n"]:
        """The gradient of Σ w_i z1_i² with respect to τ_d, at the final time or at its peak."""
        torque = torch.tensor(tau_d, requires_grad=True)
        z1 = self._errors(self.batch(motion, tau_d), torque)
        goal = (torch.as_tensor(weights)[:, None] * z1**2).sum(-1)
        row = torch.full((len(goal),), -1) if at_end else goal.argmax(dim=1)
        (gradient,) = torch.autograd.grad(goal[torch.arange(len(goal)), row].sum(), torque)
        return np.asarray(gradient.numpy())

    def run(self, motion: int, tau_d: Float[np.ndarray, "steps n"], **info: str) -> Run:
        """One motion under one torque, as a `Run`."""
        batch = self.batch(np.array([motion]), tau_d[None])
        with torch.no_grad():
            moved = motions(self.controller, batch, self.engine)
        many = recorded(moved, batch, type(self.controller).__name__)
        return replace(many, **{name: x[:, 0] for name, x in many.signals.items()}, info={**many.info, **info})

    def _errors(self, batch: Batch, tau_d: torch.Tensor | None = None) -> torch.Tensor:
        """z1 (count, rows, n); raises SimulationDiverged if it is not finite."""
        q = motions(self.controller, batch, self.engine, tau_d).q
        robot = batch.loop.plant.robot
        continuous = None if robot is None else robot.continuous
        z1 = configuration_difference(q, torch.as_tensor(batch.desired[:, :, 0]), continuous)
        if not bool(torch.isfinite(z1).all()):
            row = int((~torch.isfinite(z1).all(-1)).any(0).to(torch.uint8).argmax())
            raise SimulationDiverged(
                f"the closed loop diverged at t = {row * batch.loop.period:g} s under an admissible"
                f" disturbance; take a shorter control period than {batch.loop.period:g} s."
            )
        return z1


def law_of(controller: Any) -> ModelLaw:
    """The controller, if it is a law with a model; raises ArgumentError otherwise."""
    if isinstance(controller, (AdaptiveLaw, CompiledAdaptiveLaw)):
        raise ArgumentError(
            f"attack does not follow the estimates of a {type(controller).__name__}; call transient_attack with its "
            "transient_bound, or give the law that it is about."
        )
    if not isinstance(controller, ModelLaw):
        raise ArgumentError(
            f"a {type(controller).__name__} is not a law with a model, which gradients of a motion need; give a "
            "NeuralBackstepping, ComputedTorque or SlotineLi, or the controller that a compiled law was made from."
        )
    return controller


def motions_of(
    dynamics: DynamicsProvider, reference: DesiredMotion | Sequence[DesiredMotion] | None, seed: int
) -> list[DesiredMotion]:
    """The given motions, or `Sinusoid.for_robot` and postures at rest; raises ArgumentError if one is not a motion."""
    if reference is not None:
        followed = list(reference) if isinstance(reference, Sequence) else [reference]
        if not followed:
            raise ArgumentError("reference is an empty list, expected at least one motion; omit it for the arm's own.")
        for motion in followed:
            MOTION("reference", motion)
            at_times(motion, np.zeros(1), dynamics.nv)
        return followed
    rng, robot, n = np.random.default_rng(seed), dynamics.robot, dynamics.nv
    low, high = (np.full(n, -np.pi), np.full(n, np.pi)) if robot is None else robot.sampling_range
    own: list[DesiredMotion] = [Hold(np.zeros(n)) if robot is None else Sinusoid.for_robot(robot, 1.0)]
    return own + [Hold(rng.uniform(low, high)) for _ in range(POSTURES)]


def slowest_rate(controller: ModelLaw, reference: DesiredMotion) -> float:
    """The least |Re λ| [1/s] of the undisturbed loop, linearised at rest at the start of the reference.

    In z1, z2 it is ż1 = z2 − Λ∇²Φ(0)z1, M ż2 = −∇²Φ(0)z1 − (ωM + D(0))z2. A law without a storage function gets 1.
    """
    if not isinstance(controller, LyapunovLaw):
        return 1.0
    n, zero = controller.nv, np.zeros(controller.nv)
    eye = np.eye(n)
    hessian = controller.potential_terms(np.zeros((n, n)), eye)[2]
    mass = controller.dynamics.mass_matrix(at_times(reference, np.zeros(1), n).q[0])
    damping = controller.inertial_rate * eye + np.linalg.solve(mass, controller.damping_matrix(zero))
    above = np.hstack([-controller.rate_like(zero)[:, None] * hessian, eye])
    loop = np.vstack([above, np.hstack([-controller.coupling * np.linalg.solve(mass, hessian), -damping])])
    return float(max(np.abs(np.linalg.eigvals(loop).real).min(), 1e-6))
