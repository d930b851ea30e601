"""`fit`: a model of an arm from measured motions, by the name of its kind."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, TypeAlias

import numpy as np

from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.dynamics.families import make_network
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.dynamics.identified import IdentifiedDynamics
from nbs_pin.dynamics.lagrangian import LagrangianDynamics
from nbs_pin.dynamics.lagrangian_network import LagrangianNetwork
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.dynamics.provider import DynamicsProvider
from nbs_pin.dynamics.residual import ResidualDynamics, ResidualNetwork
from nbs_pin.identification.chain_fit import fit_chain
from nbs_pin.identification.compatibility import arm_fault, other_data_fault
from nbs_pin.identification.datasets import Dataset
from nbs_pin.identification.fit_report import FitReport, torque_nmse
from nbs_pin.identification.identify import identify
from nbs_pin.identification.network_equations import deviation_of
from nbs_pin.identification.network_fit import NetworkFit, fit_network
from nbs_pin.identification.unidentifiable import unexcited
from nbs_pin.robots.robot import Robot

ModelName: TypeAlias = Literal["chain", "cholesky", "homogenised", "picnn", "unconstrained", "residual", "identified"]
"""What `fit` knows: rigid trees and networks, which need no description of the arm, a network that corrects the arm's
nominal model, and inertias that are put into its URDF's geometry."""
_USELESS = 0.9
"""Share of the torque's variance left unexplained beyond which a model says nothing."""
HELD_OUT = 0.2
"""Share of the trajectories that `fit` holds out by default."""
_WIDTHS = {"cholesky": (32, 32), "homogenised": (20, 20), "picnn": (16, 16, 16), "unconstrained": (32, 32)}
"""Hidden layers small enough for Levenberg–Marquardt, which more than makes up for their size."""
_RESIDUAL_WIDTHS = (24, 24)


@dataclass(frozen=True, eq=False)
class FitTask:
    """What every fitter is given."""

    model: str
    data: Dataset
    held_out: Dataset | None
    seed: int
    robot: Robot | None
    friction: bool
    progress: bool
    settings: Mapping[str, Any]
    """Further settings that were given, each of which some fitter knows."""

    def known(self, *names: str) -> dict[str, Any]:
        """The settings; raises ArgumentError for one that is not among the names."""
        for name, value in self.settings.items():
            if name not in names:
                known = f"takes {', '.join(names)}" if names else "takes none"
                raise ArgumentError(f"model '{self.model}' has no setting {name} = {value!r:.80}; it {known}.")
        return dict(self.settings)


@dataclass(frozen=True, eq=False)
class Fitted:
    """What every fitter returns."""

    assemble: Callable[[FitReport | None], DynamicsProvider]
    """The model with its report."""
    friction: JointFriction | None
    parameters: int
    history: tuple[float, ...] = ()
    held_out: tuple[float, ...] = ()
    evaluations: int = 0
    stopped: str = "converged"
    unexcited: tuple[str, ...] = ()
    details: Mapping[str, Any] = field(default_factory=dict)


def fit(
    data: Dataset,
    model: str = "chain",
    seed: int = 0,
    *,
    robot: Robot | None = None,
    held_out: Dataset | float | None = None,
    friction: bool = False,
    progress: bool = False,
    **settings: Any,
) -> DynamicsProvider:
    """A model of the arm that explains the data; its `report` is a `FitReport`, its `friction` what was learned of it.

    model: see `ModelName`. seed: of first parameters, batches, and what is held out. robot: the arm that the model is
    for; networks take limits and drawings from it, "residual" its nominal model and "identified" its geometry.
    held_out: trajectories that are not learned from, a dataset or a share of the data; None takes `HELD_OUT` where
    there are two trajectories at least, 0 nothing. They choose the iteration of a network. friction: learn viscous and
    Coulomb friction too, which is no part of M, C, G. progress: show a bar.
    settings: loss, optimiser and iterations of a network (`fit_network`) and its widths; what `identify` takes.
    Ctrl-C ends the fit of a network and keeps the best. Raises ArgumentError for an unknown model, settings that are
    none of its own, a missing robot or one that the data are not of (`same_arm.py`; its masses and lengths may be
    wrong), held_out of another arm, and data without torque unless the loss is that of the acceleration.
    """
    if model not in _FITTERS:
        raise ArgumentError(f"model '{model}' is unknown; choose one of {', '.join(_FITTERS)}.")
    fault = "" if robot is None else arm_fault(data, robot)
    if fault:
        raise ArgumentError(f"{fault}.")
    start = time.perf_counter()
    train, test = parted(data, held_out, seed)
    fitted = _FITTERS[model](FitTask(model, train, test, seed, robot, friction, progress, settings))
    bare = fitted.assemble(None)
    report = FitReport(
        model=model,
        seed=seed,
        samples=len(train),
        seconds=time.perf_counter() - start,
        evaluations=fitted.evaluations,
        parameters=fitted.parameters,
        history=fitted.history,
        held_out=fitted.held_out,
        train_nmse=torque_nmse(bare, train, fitted.friction),
        test_nmse=None if test is None else torque_nmse(bare, test, fitted.friction),
        stopped=fitted.stopped,
        unexcited=_useless(bare, train, fitted.friction) + fitted.unexcited,
        details=fitted.details,
    )
    return fitted.assemble(report)


def parted(data: Dataset, held_out: Dataset | float | None = None, seed: int = 0) -> tuple[Dataset, Dataset | None]:
    """What is learned from, and what is held out for `fit` with these arguments; raises as `fit` does."""
    if isinstance(held_out, Dataset):
        fault = other_data_fault(data, held_out, "held_out")
        if fault:
            raise ArgumentError(f"{fault}.")
        return data, held_out
    share = (HELD_OUT if data.trajectories > 1 else 0.0) if held_out is None else held_out
    return (data, None) if share == 0.0 else data.split(share, seed)


def _useless(model: DynamicsProvider, data: Dataset, friction: JointFriction | None) -> tuple[str, ...]:
    """What to say of a fit that explains next to nothing: torque that is noise, or does not change."""
    nmse = torque_nmse(model, data, friction)
    if np.isnan(nmse) and data.tau.any():
        return ("everything: the torque never varies, so nothing was learned of how it does",)
    if nmse > _USELESS and data.tau.any():
        return (
            f"everything: {nmse:.0%} of the torque's variance is unexplained, as if it were noise or another arm's",
        )
    return ()


def _fit_family(task: FitTask) -> Fitted:
    """A network by name (`networks/families.py`), in the units that the data suggest."""
    settings = task.known("loss", "optimiser", "iterations", "transition", "widths", "epsilon")
    options = {name: settings.pop(name) for name in ("widths", "epsilon") if name in settings}
    torque, rate = (deviation_of(x) for x in (task.data.tau, task.data.a))
    scales = {"inertia": (torque / rate).tolist(), "energy": float(torque.mean())} if task.data.tau.any() else {}
    options = {"widths": _WIDTHS[task.model]} | scales | options
    found = fit_network(
        lambda seed: make_network(task.model, task.data.prismatic.tolist(), seed, **options),
        task.data,
        task.held_out,
        seed=task.seed,
        friction=task.friction,
        progress=task.progress,
        **settings,
    )
    return _of_network(
        task, found, lambda report: LagrangianDynamics(found.network, task.robot, found.friction, report)
    )


def _fit_chain(task: FitTask) -> Fitted:
    """A rigid tree, of which the data give only the order of the joints."""
    settings = task.known("rotor_inertia", "transition", "regularisation", "starts", "epsilon", "right_angles")
    names = () if task.robot is None else task.robot.joint_names
    found = fit_chain(task.data, task.seed, friction=task.friction, progress=task.progress, **settings)
    network, bodies = found.network, found.bodies
    return Fitted(
        assemble=lambda report: LagrangianDynamics(network, task.robot, found.friction, report),
        friction=found.friction,
        parameters=sum(x.numel() for x in network.parameters()) + (2 * task.data.nv if found.friction else 0),
        history=tuple(found.history.tolist()),
        evaluations=found.evaluations,
        stopped=found.stopped,
        unexcited=unexcited(network, task.data, friction=found.friction, names=names),
        details={
            "starts": len(found.costs),
            "nmse_of_starts": found.costs.tolist(),
            "noise_Nm": np.asarray(bodies.noise).tolist(),
            "condition": float(bodies.condition),
        },
    )


def _fit_residual(task: FitTask) -> Fitted:
    """What the arm's nominal model lacks."""
    settings = task.known("optimiser", "iterations", "transition", "widths", "share")
    options: dict[str, Any] = {"widths": _RESIDUAL_WIDTHS}
    options |= {name: settings.pop(name) for name in ("widths", "share") if name in settings}
    nominal, prismatic = PinocchioDynamics(_needed(task)), task.data.prismatic.tolist()

    def make(seed: int) -> LagrangianNetwork:
        return ResidualNetwork(nominal, prismatic, seed=seed, **options)

    found = fit_network(
        make,
        task.data,
        task.held_out,
        seed=task.seed,
        friction=task.friction,
        progress=task.progress,
        **settings,
    )

    def assemble(report: FitReport | None) -> DynamicsProvider:
        network = found.network
        assert isinstance(network, ResidualNetwork)
        return ResidualDynamics(network, found.friction, report)

    return _of_network(task, found, assemble)


def _of_network(task: FitTask, found: NetworkFit, assemble: Callable[[FitReport | None], DynamicsProvider]) -> Fitted:
    names = () if task.robot is None else task.robot.joint_names
    loss = task.settings.get("loss", "torque")
    return Fitted(
        assemble=assemble,
        friction=found.friction,
        parameters=found.parameters,
        history=tuple(found.history),
        held_out=tuple(found.held_out),
        evaluations=found.evaluations,
        stopped=found.stopped,
        unexcited=unexcited(found.network, task.data, friction=found.friction, loss=loss, names=names),
    )


def _fit_identified(task: FitTask) -> Fitted:
    """Inertial parameters of the arm's own geometry."""
    settings = task.known("rotor_inertia", "transition", "regularisation")
    found = identify(task.data, _needed(task), friction=task.friction, **settings)
    numbers, report = found.parameters.size, found.report

    def assemble(own: FitReport | None) -> DynamicsProvider:
        return IdentifiedDynamics(_needed(task), found.parameters, found.friction, found.rotor_inertia, own)

    return Fitted(
        assemble=assemble,
        friction=found.friction,
        parameters=numbers + (0 if found.friction is None else 2 * task.data.nv),
        evaluations=report.steps,
        unexcited=report.unexcited,
        details={"noise_Nm": np.asarray(report.noise).tolist(), "condition": float(report.condition)},
    )


def _needed(task: FitTask) -> Robot:
    if task.robot is None:
        raise ArgumentError(f"model '{task.model}' is built on the arm's URDF; give robot=nbs.load_robot(…).")
    return task.robot


_FITTERS: dict[str, Callable[[FitTask], Fitted]] = {
    "chain": _fit_chain,
    **dict.fromkeys(_WIDTHS, _fit_family),
    "residual": _fit_residual,
    "identified": _fit_identified,
}
MODELS = tuple(_FITTERS)
"""Names that `fit` knows."""
