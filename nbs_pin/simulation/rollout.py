"""The closed loop as a differentiable function from parameters and starts to motions."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple, TypeAlias, cast

import numpy as np
import torch
from jaxtyping import Float
from torch import nn
from torch.autograd.function import once_differentiable

from nbs_pin.base.arguments import called
from nbs_pin.base.checks import floats, told
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.records import Reference, Run
from nbs_pin.controllers.controller import Controller
from nbs_pin.controllers.model_law import ModelLaw
from nbs_pin.dynamics.friction import has_viscous_and_coulomb_only
from nbs_pin.kernels.layout import IntegratorCode, Packed, known
from nbs_pin.kernels.rollouts import Course, Rollout, Scene, rollout, rollout_adjoint, rollout_workspace
from nbs_pin.kernels.threads import over_cores
from nbs_pin.motions.references import DesiredMotion
from nbs_pin.robots.robot import configuration_difference
from nbs_pin.simulation.costs import StageCost
from nbs_pin.simulation.dynamics_plant import DynamicsPlant
from nbs_pin.simulation.loop import Loop

Engine: TypeAlias = Literal["kernels", "torch"]
"""Compiled kernels with hand-written adjoints, or the law and the plant in torch."""


_BATCH = 256  # starts with gradients stored apart: threads do not wait, and the order of summation is fixed


class Motions(NamedTuple):
    """Closed-loop motions from B starts over T periods, all differentiable."""

    q: Float[torch.Tensor, "B T+1 n"]
    """Configurations at the control instants [rad]."""
    v: Float[torch.Tensor, "B T+1 n"]
    """Velocities [rad/s]."""
    command: Float[torch.Tensor, "B T n"]
    """Commanded torques [N·m], before the effort limits."""


@dataclass(frozen=True, eq=False)
class Batch:
    """Starts, references and disturbances of B closed-loop motions; made by `of`."""

    loop: Loop
    leads: Float[np.ndarray, " T"]
    """How far ahead of each instant the law is evaluated [s]."""
    aims: Float[np.ndarray, "B T 4 n"]
    """a_d at the instant, and q_d, v_d, a_d at the instant plus its lead."""
    desired: Float[np.ndarray, "B T+1 3 n"]
    """q_d, v_d, a_d at the control instants."""
    q0: Float[np.ndarray, "B n"]
    """Starts [rad]."""
    v0: Float[np.ndarray, "B n"]
    """Velocities at the start [rad/s]."""
    tau_d: Float[np.ndarray, "B T n"]
    """Disturbance held over each period [N·m]."""

    @classmethod
    def of(cls, loop: Loop, reference: DesiredMotion, q0: Any = None, v0: Any = None, tau_d: Any = None) -> "Batch":
        """Motions along one reference from q0, v0 (B, n): at rest without v0, on the reference without both.

        tau_d is a constant torque, a number or (n,). Raises ArgumentError if starts or torque do not match the loop.
        """
        q, v = (np.array(x).reshape(-1, loop.plant.nv) for x in loop.start(reference, q0, v0))
        loop.check_size(len(q))
        _, leads, desired, target = loop.schedule(reference)
        aim = np.stack([desired.a, target.q, target.v, target.a], axis=1)[:-1]
        aims, wanted = (np.tile(x, (len(q), 1, 1, 1)) for x in (aim, np.stack(desired, axis=1)))
        torque = np.zeros((len(q), loop.steps, loop.plant.nv)) + _constant_torque(tau_d, loop.plant.nv)
        return cls(loop, leads[:-1], aims, wanted, q, v, torque)

    @classmethod
    def joined(cls, batches: Sequence["Batch"]) -> "Batch":
        """The motions of all batches of one loop, concatenated."""
        named = ("aims", "desired", "q0", "v0", "tau_d")
        joined: dict[str, Any] = {name: np.concatenate([getattr(b, name) for b in batches]) for name in named}
        return replace(batches[0], **joined)

    def misread(self, encoder: float, draw: np.random.Generator) -> "Batch":
        """The motions with encoders of that step [shares of a turn, of 1 m] and differences of readings as velocities.

        An error of the reading acts on the law as its negative does in the reference, up to products with the error in
        the model's terms. Errors of rounding are independent, uniform and drawn once; the start is read exactly before.
        """
        robot, h = self.loop.plant.robot, self.loop.period
        step = encoder * (2.0 * np.pi if robot is None else np.where(robot.prismatic, 1.0, 2.0 * np.pi))
        error = step * draw.uniform(-0.5, 0.5, self.aims[:, :, 1].shape)
        aims = self.aims.copy()
        aims[:, :, 1] -= error
        aims[:, :, 2] -= np.diff(error, axis=1, prepend=0.0) / h
        return replace(self, aims=aims)

    def beginning(self) -> "Batch":
        """The first period of the first motion."""
        one = {name: getattr(self, name)[:1] for name in ("q0", "v0")}
        rows = {name: getattr(self, name)[:1, :k] for name, k in (("aims", 1), ("desired", 2), ("tau_d", 1))}
        first: dict[str, Any] = {name: np.ascontiguousarray(x) for name, x in (one | rows).items()}
        return replace(self, leads=self.leads[:1], **first)

    def __len__(self) -> int:
        return len(self.q0)


def engine_for(controller: Controller, loop: Loop) -> Engine:
    """The fastest engine for this loop: "kernels" if law, model and plant have them, else "torch"."""
    return "torch" if scene_of(controller, loop) is None or not _on_cpu(controller) else "kernels"


def motions(
    controller: Controller,
    batch: Batch,
    engine: Engine | None = None,
    tau_d: Float[torch.Tensor, "B T n"] | None = None,
) -> Motions:
    """The motions of the batch under the controller, differentiable in its parameters and in the disturbance.

    Args:
        controller: The control law.
        batch: Starts, references and disturbances.
        engine: None takes `engine_for`; both engines agree to 1e-9, in values and in gradients.
        tau_d: Replaces the disturbance of the batch [N·m].

    Raises:
        ArgumentError: If the loop has no kernels for engine "kernels", or its plant is not differentiable.
    """
    check_plant(batch.loop)
    engine = engine_for(controller, batch.loop) if engine is None else engine
    torque = torch.as_tensor(batch.tau_d) if tau_d is None else tau_d
    if torque.shape != batch.tau_d.shape or torque.dtype != torch.float64:
        raise ArgumentError(
            f"tau_d is {torque.dtype} of shape {tuple(torque.shape)}, expected float64 of shape {batch.tau_d.shape};"
            " give one torque per motion, period and joint."
        )
    if engine == "torch":
        return _by_torch(controller, batch, torque)
    scene = scene_of(controller, batch.loop)
    if scene is None or not _on_cpu(controller):
        raise ArgumentError(
            f"{type(controller).__name__} on {batch.loop.plant!r} has no kernels; take engine='torch', it runs any law."
        )
    law = controller.packed_law(numpy=False)
    return Motions(*_ByKernels.apply(law.weights, torque, law.layout, batch, scene))  # type: ignore[no-untyped-call]


def running_cost(motion: Motions, batch: Batch, cost: StageCost) -> Float[torch.Tensor, " B"]:
    """∫ l(z1, v − v_d, τ) dt of each motion, from the state after each period and the torque commanded during it."""
    robot = batch.loop.plant.robot
    q_ref, v_ref = (torch.as_tensor(batch.desired[:, 1:, k]).to(motion.q) for k in (0, 1))
    z1 = configuration_difference(motion.q[:, 1:], q_ref, None if robot is None else robot.continuous)
    price = called("the cost", cost, z1, motion.v[:, 1:] - v_ref, motion.command)
    if not isinstance(price, torch.Tensor) or price.shape != z1.shape[:-1]:
        raise ArgumentError(
            f"the cost of errors of shape {tuple(z1.shape)} is {told(price)}, expected a tensor of one number per"
            f" instant, shape {tuple(z1.shape[:-1])}; sum over the joints alone."
        )
    return batch.loop.period * price.sum(-1)


def recorded(motion: Motions, batch: Batch, controller: str) -> Run:
    """The motions as a run with a batch axis for the starts; its last row repeats the last torque."""
    loop = batch.loop
    q, v, command = (x.detach().cpu().numpy().swapaxes(0, 1) for x in motion)
    desired = Reference(*np.moveaxis(batch.desired, 2, 0).swapaxes(1, 2))
    run = loop.blank_run(loop.period * np.arange(loop.steps + 1.0), desired, batch.q0, batch.v0, controller)
    run.q[:], run.v[:] = q, v
    run.tau_command[:] = np.concatenate([command, command[-1:]])
    run.tau[:] = np.clip(run.tau_command, -loop.limit, loop.limit)
    run.disturbance[:-1] = batch.tau_d.swapaxes(0, 1)
    return run


def check_plant(loop: Loop) -> None:
    """Raises ArgumentError unless the plant is differentiable."""
    if not isinstance(loop.plant, DynamicsPlant):
        raise ArgumentError(
            f"{loop.plant!r} has no derivatives; train on DynamicsPlant(PinocchioDynamics(robot)), which agrees with"
            " MuJoCo to 1e-10, and test the result on this plant."
        )


def _on_cpu(controller: Any) -> bool:
    return all(p.device.type == "cpu" for p in controller.parameters())


def _constant_torque(tau_d: Any, nv: int) -> np.ndarray:
    """The torque as an array; raises ArgumentError unless it is one finite number or one per joint."""
    torque = floats("disturbance", 0.0 if tau_d is None else tau_d)
    if torque.shape not in ((), (nv,)) or not np.isfinite(torque).all():
        raise ArgumentError(
            f"disturbance is {told(tau_d)}, expected one finite torque or {nv}, one per joint [N·m, N where it slides]."
        )
    return torque


def scene_of(controller: Controller, loop: Loop) -> Scene | None:
    """Constants of the loop for the kernels, or None if one of its parts has no kernel."""
    plant = loop.plant
    if type(plant) is not DynamicsPlant or not controller.packable:
        return None
    if not has_viscous_and_coulomb_only(plant.friction):
        return None
    truth = plant.dynamics.packed_tree()
    belief = controller.dynamics.packed_tree() if isinstance(controller, ModelLaw) else truth
    if truth is None or belief is None:
        return None
    n, friction = plant.nv, plant.friction
    viscous, coulomb = np.zeros((2, n)) if friction is None else np.array([friction.viscous, friction.coulomb])
    return Scene(
        period=float(loop.period),
        step=float(loop.step),
        substeps=int(loop.substeps),
        integrator=int(known(plant.integrator, IntegratorCode, "integrator")),
        limit=loop.limit,
        viscous=viscous,
        coulomb=coulomb,
        transition=1.0 if friction is None else float(friction.transition),
        belief=belief,
        truth=truth,
    )


class _ByKernels(torch.autograd.Function):
    """One rollout per start, in parallel; the gradients of the starts are stored apart and then summed."""

    @staticmethod
    def forward(
        ctx: Any, weights: torch.Tensor, torque: torch.Tensor, layout: np.ndarray, batch: Batch, scene: Scene
    ) -> tuple[torch.Tensor, ...]:
        tau_d = np.ascontiguousarray(torque.detach().numpy())
        count, steps, n = tau_d.shape
        law = Packed(layout, np.ascontiguousarray(weights.detach().numpy()))
        q, v = np.empty((2, count, steps + 1, n))
        command, memory = np.empty((count, steps, n)), np.empty((count, steps + 1, 2, n))
        q[:, 0], v[:, 0] = batch.q0, batch.v0
        size = rollout_workspace(law, scene)

        def run(part: slice) -> None:
            work = np.zeros(size)
            for k in range(count)[part]:
                motion = Rollout(q[k], v[k], command[k], memory[k])
                rollout(Course(batch.aims[k], batch.leads, tau_d[k]), scene, law, work, motion)

        over_cores(run, count, fewest=1)
        ctx.saved = law, batch, tau_d, scene, q, v, command, memory
        return torch.from_numpy(q), torch.from_numpy(v), torch.from_numpy(command)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *cotangents: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        law, batch, tau_d, scene, q, v, command, memory = ctx.saved
        q_bar, v_bar, command_bar = (np.array(x.numpy(), order="C") for x in cotangents)
        tau_d_bar, memory_bar, total = np.empty(command.shape), np.zeros(memory.shape), np.zeros(len(law.weights))
        weights_bar = np.empty((min(len(batch), _BATCH), len(law.weights)))
        size = rollout_workspace(law, scene)

        def run(part: slice) -> None:
            work = np.zeros(size)
            for k in range(first, len(batch))[part]:
                course = Course(batch.aims[k], batch.leads, tau_d[k])
                motion = Rollout(q[k], v[k], command[k], memory[k])
                bars = Rollout(q_bar[k], v_bar[k], command_bar[k], memory_bar[k])
                law_bar = Packed(law.layout, weights_bar[k - first])
                rollout_adjoint(course, scene, law, work, motion, bars, tau_d_bar[k], law_bar)

        for first in range(0, len(batch), _BATCH):
            together = min(_BATCH, len(batch) - first)
            weights_bar[:] = 0.0
            over_cores(run, together, fewest=1)
            total += weights_bar[:together].sum(axis=0)
        return torch.from_numpy(total), torch.from_numpy(tau_d_bar), None, None, None


def _by_torch(controller: Controller, batch: Batch, tau_d: torch.Tensor) -> Motions:
    """The same loop in torch operations."""
    loop, plant = batch.loop, cast(DynamicsPlant, batch.loop.plant)
    parameters: list[Any] = list(controller.parameters()) if isinstance(controller, nn.Module) else []
    device = parameters[0].device if parameters else torch.device("cpu")
    given = (batch.aims, batch.q0, batch.v0, loop.limit, tau_d)
    aims, q, v, limit, tau_d = (torch.as_tensor(x, device=device) for x in given)
    memory = controller.initial_memory(q)
    states, commands = [(q, v)], []
    for k, lead in enumerate(batch.leads.tolist()):
        a, *aim = aims[:, k].unbind(1)
        seen = q + lead * (v + 0.5 * lead * a), v + lead * a
        command, memory = controller.step(memory, *seen, Reference(*aim), loop.period)
        tau = torch.clamp(command, -limit, limit) + tau_d[:, k]
        for _ in range(loop.substeps):
            q, v = plant.step(q, v, tau, loop.step)
        states.append((q, v))
        commands.append(command)
    return Motions(*(torch.stack(list(x), dim=1) for x in (*zip(*states, strict=True), commands)))
