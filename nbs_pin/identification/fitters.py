"""The fitters of each kind of model; `registry.py` names them."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeAlias

import numpy as np

from nbs_pin.base.doors import BLANK, names_of, option
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.dynamics.coupled import CoupledDynamics
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.dynamics.identified import IdentifiedDynamics
from nbs_pin.dynamics.lagrangian import LagrangianDynamics
from nbs_pin.dynamics.lagrangian_network import LagrangianNetwork
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.dynamics.registry import NETWORKS, make_network
from nbs_pin.dynamics.residual import ResidualDynamics, ResidualNetwork
from nbs_pin.identification.chain_fit import fit_chain
from nbs_pin.identification.coupling import Coupling, in_motors, matrix_of
from nbs_pin.identification.datasets import Dataset
from nbs_pin.identification.drive_choice import Wanted, terms_of_rest
from nbs_pin.identification.fit_report import FitReport, torque_nmse
from nbs_pin.identification.identify import identify
from nbs_pin.identification.network_equations import deviation_of
from nbs_pin.identification.network_fit import NetworkFit, fit_network
from nbs_pin.identification.unidentifiable import unidentifiable
from nbs_pin.robots.robot import Robot

_MOST, _LONG = 3_000, 100
"""Most samples of long trajectories that a network is fitted to, and how many make a trajectory long."""
LearnedDynamics: TypeAlias = LagrangianDynamics | IdentifiedDynamics
"""What `fit` makes: a model with its `friction` and its `report`."""


@dataclass(frozen=True, eq=False)
class FitTask:
    """Arguments of a fitter."""

    model: str
    data: Dataset
    held_out: Dataset | None
    seed: int
    robot: Robot | None
    coupled: Coupling | None
    """Motors that turn several joints; the data have the torques of the joints."""
    drives: tuple[bool | None, bool | None, bool | None]
    """Friction, offsets and rotor inertias wanted (`Wanted`)."""
    progress: bool
    settings: Mapping[str, Any]
    """Further keyword arguments of `fit`, not yet checked."""

    def of_network(self) -> "FitTask":
        """The same with fewer samples of long trajectories, of which neighbours say little new."""
        held_out = None if self.held_out is None else _few(self.held_out)
        return replace(self, data=_few(self.data), held_out=held_out)

    def wanted(self) -> dict[str, Any]:
        """The terms of the drives as keyword arguments."""
        return dict(zip(("friction", "offset", "rotor_inertia"), self.drives, strict=True))

    def beside(self, settings: dict[str, Any]) -> Wanted:
        """The terms beside a network; takes the transition out of the settings."""
        return Wanted(*self.drives, **{name: settings.pop(name) for name in ("transition",) if name in settings})

    def known(self, *names: str) -> dict[str, Any]:
        """The settings; raises ArgumentError if one is not among the names."""
        for name, value in self.settings.items():
            if name not in names:
                known = f"takes {', '.join(names_of(names)) or 'none'}"
                raise ArgumentError(f"model '{self.model}' takes no {option(name, value):.80}; it {known}.")
        return dict(self.settings)


@dataclass(frozen=True, eq=False)
class Fitted:
    """Result of a fitter."""

    assemble: Callable[[FitReport | None], LearnedDynamics]
    """Builds the model with its report."""
    friction: JointFriction | None
    parameters: int
    history: tuple[float, ...] = ()
    held_out: tuple[float, ...] = ()
    evaluations: int = 0
    stopped: str = "converged"
    unidentifiable: tuple[str, ...] = ()
    details: Mapping[str, Any] = field(default_factory=dict)

    def record(self, coupled: Coupling | None) -> dict[str, Any]:
        """What a `FitReport` takes as it is, with the coupling of the drives."""
        names = ("evaluations", "parameters", "history", "held_out")
        details = {**self.details, **({} if coupled is None else coupled.plain())}
        return {name: getattr(self, name) for name in names} | {"details": details}


def _few(data: Dataset) -> Dataset:
    """The data, thinned where its trajectories are long."""
    return data.thinned(_MOST) if len(data) > _LONG * data.trajectories else data


def fit_family(task: FitTask) -> Fitted:
    """Fit a network family (`dynamics/registry.py`), scaled to the magnitudes of the data."""
    task = task.of_network()
    settings = task.known("loss", "optimiser", "iterations", "transition", "widths", "epsilon")
    wanted = task.beside(settings)
    options: dict[str, Any] = {name: settings.pop(name) for name in ("widths", "epsilon") if name in settings}
    torque, rate = (deviation_of(x) for x in (task.data.tau, task.data.a))
    scales = {"inertia": (torque / rate).tolist(), "energy": float(torque.mean())} if task.data.tau.any() else {}
    family = NETWORKS[task.model].load()

    def fitted_with(widths: Sequence[int]) -> NetworkFit:
        return fit_network(
            lambda seed: make_network(
                task.model, task.data.prismatic.tolist(), seed, **({"widths": widths} | scales | options)
            ),
            task.data,
            task.held_out,
            seed=task.seed,
            wanted=wanted,
            coupled=task.coupled,
            progress=task.progress,
            **settings,
        )

    found = fitted_with(family.fit_widths)
    if "widths" not in options and family.few_widths and found.is_too_large:
        small = fitted_with(family.few_widths)
        found = min(found, small, key=lambda each: min(each.held_out))
        found = replace(found, stopped=small.stopped) if small.stopped == "interrupted" else found
    fitted = _of_network(
        task, found, lambda report: LagrangianDynamics(found.network, task.robot, found.friction, report)
    )
    beside = _left_by_urdf(task, wanted)
    return fitted if beside is None else replace(fitted, details={**fitted.details, "urdf_nmse": beside})


def _left_by_urdf(task: FitTask, wanted: Wanted) -> float | None:
    """Torque nMSE of the arm's own URDF with friction and rotors found in the data, which a network is to beat."""
    data, robot = task.data, task.robot
    if robot is None or not robot.has_bodies or not data.tau.any():
        return None
    nominal = _nominal(robot, data, wanted, task.coupled)
    left = replace(data, tau=data.tau - nominal.reference_torque(data.q, data.v, data.v, data.a))
    beside = replace(wanted, rotor_inertia=False)
    terms, numbers = terms_of_rest(beside, in_motors(data, task.coupled), in_motors(left, task.coupled).tau)
    judged = data if task.held_out is None else task.held_out
    return torque_nmse(nominal, judged, terms.friction(numbers, matrix_of(task.coupled)))


def fit_rigid_tree(task: FitTask) -> Fitted:
    """Fit a rigid tree of which only the joint tree of the data is known."""
    settings = task.known("transition", "regularisation", "starts", "epsilon", "right_angles")
    names = () if task.robot is None else task.robot.joint_names
    found = fit_chain(task.data, task.seed, progress=task.progress, coupled=task.coupled, **task.wanted(), **settings)
    network, bodies = found.network, found.bodies
    return Fitted(
        assemble=lambda report: LagrangianDynamics(network, task.robot, found.friction, report),
        friction=found.friction,
        parameters=sum(x.numel() for x in network.parameters()) + bodies.drive_numbers,
        history=tuple(found.history.tolist()),
        evaluations=found.evaluations,
        stopped=found.stopped,
        unidentifiable=unidentifiable(network, task.data, friction=found.friction, names=names),
        details={
            "starts": len(found.costs),
            "nmse_of_starts": found.costs.tolist(),
            "noise_Nm": np.asarray(bodies.noise).tolist(),
            "condition": float(bodies.condition),
            "outliers": bodies.outliers,
        },
    )


def fit_residual(task: FitTask) -> Fitted:
    """Fit a network that corrects the arm's nominal model."""
    task = task.of_network()
    settings = task.known("optimiser", "iterations", "transition", "widths", "share")
    options: dict[str, Any] = {"widths": ResidualNetwork.fit_widths}
    options |= {name: settings.pop(name) for name in ("widths", "share") if name in settings}
    if not _needed(task).has_bodies:
        raise ArgumentError(
            "model 'residual' corrects the masses of a URDF, and of this only the geometry was taken; fit 'identified'."
        )
    wanted, prismatic = task.beside(settings), task.data.prismatic.tolist()
    nominal = _nominal(_needed(task), task.data, wanted, task.coupled)

    def make(seed: int) -> LagrangianNetwork:
        return ResidualNetwork(nominal, prismatic, seed=seed, **options)

    found = fit_network(
        make,
        task.data,
        task.held_out,
        seed=task.seed,
        wanted=wanted,
        coupled=task.coupled,
        progress=task.progress,
        **settings,
    )

    def assemble(report: FitReport | None) -> LearnedDynamics:
        network = found.network
        assert isinstance(network, ResidualNetwork)
        return ResidualDynamics(network, found.friction, report)

    return _of_network(task, found, assemble)


def _nominal(robot: Robot, data: Dataset, wanted: Wanted, coupled: Coupling | None) -> PinocchioDynamics:
    """The arm's model, with rotor inertias that its URDF leaves out if they are wanted or the torques show them."""
    rotors = robot.armature
    if wanted.rotor_inertia is not False and not rotors.any():
        left = data.tau - PinocchioDynamics(robot).reference_torque(data.q, data.v, data.v, data.a)
        moved = in_motors(replace(data, tau=left), coupled)
        terms, numbers = terms_of_rest(wanted, in_motors(data, coupled), moved.tau)
        found = terms.rotors(numbers)
        rotors = rotors if found is None else found
    if not rotors.any() or (rotors is robot.armature and coupled is None):
        return PinocchioDynamics(robot)
    if coupled is None:
        return PinocchioDynamics(robot.with_armature(rotors))
    bodies = np.stack([body.toDynamicParameters() for body in list(robot.model.inertias)[1:]])
    return CoupledDynamics(robot, bodies, coupled.matrix, motor_inertia=rotors)


def _of_network(task: FitTask, found: NetworkFit, assemble: Callable[[FitReport | None], LearnedDynamics]) -> Fitted:
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
        unidentifiable=unidentifiable(found.network, task.data, friction=found.friction, loss=loss, names=names),
        details={"fitted_samples": len(task.data)},
    )


def fit_identified(task: FitTask) -> Fitted:
    """Identify inertial parameters for the arm's geometry."""
    settings = task.known("transition", "regularisation")
    found = identify(task.data, _needed(task), coupling=task.coupled or False, **task.wanted(), **settings)
    numbers, report = found.parameters.size, found.report

    def assemble(own: FitReport | None) -> LearnedDynamics:
        if isinstance(found, CoupledDynamics):
            numbers = (found.coupling, found.friction, found.motor_inertia)
            return CoupledDynamics(_needed(task), found.parameters, *numbers, own)
        return IdentifiedDynamics(_needed(task), found.parameters, found.friction, found.rotor_inertia, own)

    return Fitted(
        assemble=assemble,
        friction=found.friction,
        parameters=numbers + report.drive_numbers,
        evaluations=report.steps,
        stopped="converged" if report.converged else "iterations",
        unidentifiable=report.unidentifiable,
        details={
            "noise_Nm": np.asarray(report.noise).tolist(),
            "condition": float(report.condition),
            "outliers": report.outliers,
            "parameter_deviations": np.asarray(report.parameter_deviations).tolist(),
            "drive_deviations": {name: x.tolist() for name, x in report.drive_deviations.items()},
            "mass_kg": float(found.parameters[:, 0].sum()),
            "mass_deviation_kg": report.mass_deviation,
            "stated_mass_kg": _stated_mass(_needed(task)),
        },
    )


def _needed(task: FitTask) -> Robot:
    if task.robot is None:
        raise ArgumentError(f"model '{task.model}' needs the arm's URDF; give {option('robot', BLANK)}.")
    return task.robot


def _stated_mass(robot: Robot) -> float | None:
    """The mass of the URDF [kg], None where only its geometry was taken."""
    return float(sum(body.mass for body in list(robot.model.inertias)[1:])) if robot.has_bodies else None
