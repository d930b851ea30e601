"""`fit`: a model of an arm from measured motions, chosen by name."""

import time
import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from nbs_pin.base.arguments import SEED, checked, either, flag, maybe, number, text
from nbs_pin.base.checks import positive
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.registry import entry
from nbs_pin.base.units import percent
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.dynamics.provider import DynamicsProvider
from nbs_pin.identification.compatibility import arm_fault, other_data_fault
from nbs_pin.identification.coupling import Given, possible
from nbs_pin.identification.datasets import DATA, Dataset
from nbs_pin.identification.doubts import doubts, doubts_of_report
from nbs_pin.identification.drive_choice import Wanted
from nbs_pin.identification.fit_report import FitReport, torque_errors, torque_nmse, zero_torque_nmse
from nbs_pin.identification.fitters import FitTask, Fitted, LearnedDynamics
from nbs_pin.identification.identify import rotors_wanted, sign_fault
from nbs_pin.identification.registry import MODELS
from nbs_pin.identification.remainder import next_try, remainder
from nbs_pin.robots.robot import ARM, Robot

_USELESS = 0.9
"""Torque nMSE above which a model is reported as useless."""
HELD_OUT = 0.2
"""Share of the trajectories that `fit` holds out by default."""


@checked(
    data=DATA,
    model=text,
    seed=SEED,
    robot=maybe(ARM),
    held_out=maybe(either(DATA, number(least=0.0, below=1.0))),
    friction=maybe(flag),
    offset=maybe(flag),
    rotor_inertia=maybe(flag),
    progress=flag,
)
def fit(
    data: Dataset,
    model: str = "chain",
    seed: int = 0,
    *,
    robot: Robot | None = None,
    held_out: Dataset | float | None = None,
    friction: bool | None = None,
    offset: bool | None = None,
    rotor_inertia: bool | None = None,
    coupling: Given = None,
    progress: bool = False,
    **settings: Any,
) -> LearnedDynamics:
    """Fit a model of the arm to the data; its `report` is a `FitReport`, its `friction` the learned friction.

    Args:
        data: Samples with torque, or without it for a network with loss "acceleration".
        model: One of `identification.registry.MODELS`.
        seed: Seed of initial parameters, batches and the choice of held-out trajectories.
        robot: The arm; its masses and lengths may be inaccurate. "residual" needs its nominal model, "identified" its
            geometry; the other models take limits and drawings from it.
        held_out: Trajectories not trained on, as a dataset or a share of the data, 0 for none. They select the iterate
            of a network. None takes `HELD_OUT` if there are at least two trajectories or one long recording.
        friction: None learns the friction that the data show, up to that of `DriveFriction`; True viscous and Coulomb
            friction of every joint, False none. It is not part of M, C, G.
        offset: Learn constant torques, of sensors or a pull; None those that the data show.
        rotor_inertia: Learn rotor inertias; None those that the robot states or the data show. Networks without a
            nominal model have them in M.
        coupling: Motors that turn several joints, as in `identify`: friction, offsets and rotors are then theirs. None
            looks for some only where there is a robot, whose geometry counts even if the model does not take it. A
            matrix without a robot is fitted with the torques of the data as those of the joints and of the motors, and
            the better fit counts; `report.details` tells which.
        progress: Show a progress bar. Ctrl-C ends the fit of a network and keeps the best iterate.
        **settings: Options of the model, see `fit_network`, `fit_chain` and `identify`; widths of a network.

    Raises:
        ArgumentError: If the model or a setting is unknown, the robot is missing, data, robot and held_out are not of
            one arm (`compatibility.py`), the torque of a joint has the wrong sign for the robot (`sign_fault`), or the
            data have no torque and the loss is not "acceleration".

    Example:
        >>> import nbs_pin as nbs
        >>> robot = nbs.load_robot("two_link")
        >>> data = nbs.collect(robot, "uniform", samples=100)
        >>> nbs.fit(data, "identified", robot=robot).report.test_nmse < 1e-9
        True
    """
    fitter = entry("model", model, MODELS).load()
    _check(data, robot)
    start = time.perf_counter()
    train, test = split_data(data, held_out, seed)
    rotors = rotors_wanted(rotor_inertia, robot)
    transition = settings.get("transition", 0.01)
    positive("transition", transition, "rad/s")
    wanted = Wanted(friction, offset, rotors, transition)
    task = FitTask(model, train, test, seed, robot, None, (friction, offset, rotors), progress, settings)
    task, fitted = _fitted(fitter, task, coupling, wanted)
    report = _reported(task, fitted, time.perf_counter() - start)
    for doubt in doubts_of_report(report):
        warnings.warn(f"{doubt}.", stacklevel=3)
    return fitted.assemble(report)


def _reported(task: FitTask, fitted: Fitted, seconds: float) -> FitReport:
    """The report of a fit; warns of what its data make doubtful."""
    train, test, robot, asked = task.data, task.held_out, task.robot, task.wanted()
    bare, judged = fitted.assemble(None), train if test is None else test
    left = remainder(bare, judged, fitted.friction) if train.tau.any() else None
    joints = tuple(f"joint {i + 1}" for i in range(train.nv)) if robot is None else robot.joint_names
    for doubt in doubts(train, robot, left, asked, joints):
        warnings.warn(f"{doubt}.", stacklevel=4)
    return FitReport(
        model=task.model,
        seed=task.seed,
        samples=len(train),
        seconds=seconds,
        stopped=_ended(fitted.stopped, bare, judged, fitted.friction),
        train_nmse=torque_nmse(bare, train, fitted.friction),
        test_nmse=None if test is None else torque_nmse(bare, test, fitted.friction),
        unidentifiable=_useless(bare, train, fitted.friction) + fitted.unidentifiable,
        left={} if left is None else left.plain(),
        next_try="" if left is None else next_try(left, joints, asked),
        **fitted.record(task.coupled),
    )


def _check(data: Dataset, robot: Robot | None) -> None:
    """Raise ArgumentError for data of another arm, or with torques of the wrong sign."""
    fault = "" if robot is None else arm_fault(data, robot) or (sign_fault(data, robot) if data.tau.any() else "")
    if fault:
        raise ArgumentError(f"{fault}.")


def _fitted(fitter: Callable[[FitTask], Fitted], task: FitTask, given: Given, wanted: Wanted) -> tuple[FitTask, Fitted]:
    """The task with the torques of the joints and the coupling of the drives, and its result.

    A matrix without the geometry that tells whether the torques are those of joints or motors is fitted both ways.
    """
    done = []
    for data, held_out, coupled in possible(task.data, task.held_out, task.robot, given, wanted, stacklevel=5):
        own = replace(task, data=data, held_out=held_out, coupled=coupled)
        done.append((own, fitter(own)))
        if done[-1][1].stopped == "interrupted":
            break
    chosen, fitted = done[0] if len(done) == 1 else min(done, key=lambda pair: _misfit(*pair))
    last = done[-1][1].stopped
    return chosen, replace(fitted, stopped=last) if last == "interrupted" else fitted


def _misfit(task: FitTask, fitted: Fitted) -> float:
    """Minus the logarithm of the likelihood per sample of the torques that were recorded, but for a constant."""
    assert task.coupled is not None
    data = task.data if task.held_out is None else task.held_out
    left = torque_errors(fitted.assemble(None), data, fitted.friction)
    return task.coupled.misfit(np.sqrt(np.square(task.coupled.torques_of_motors(left)).mean(axis=0)))


def split_data(data: Dataset, held_out: Dataset | float | None = None, seed: int = 0) -> tuple[Dataset, Dataset | None]:
    """The training data and the held-out data of `fit` with these arguments; raises as `fit` does."""
    if isinstance(held_out, Dataset):
        fault = other_data_fault(data, held_out, "held_out")
        if fault:
            raise ArgumentError(f"{fault}.")
        return data, held_out
    share = (HELD_OUT if data.can_be_split else 0.0) if held_out is None else held_out
    return (data, None) if share == 0.0 else data.split(share, seed)


def _ended(stopped: str, model: DynamicsProvider, data: Dataset, friction: JointFriction | None) -> str:
    """Why the fit ended, unless no torque at all predicts the data as well."""
    if stopped == "interrupted" or not data.tau.any():
        return stopped
    left = torque_nmse(model, data, friction)
    if left >= zero_torque_nmse(data):
        return "no better than zero torque"
    return "no better than a constant torque" if left >= 1.0 else stopped


def _useless(model: DynamicsProvider, data: Dataset, friction: JointFriction | None) -> tuple[str, ...]:
    """A remark on a fit that explains hardly anything, as the torque is noise or constant."""
    nmse = torque_nmse(model, data, friction)
    if np.isnan(nmse) and data.tau.any():
        return ("everything: the torque is constant, so its dependence on the motion is unknown",)
    if nmse > _USELESS and data.tau.any():
        return (
            f"everything: {percent(nmse)} of the torque's variance is unexplained; it may be noise or of another arm",
        )
    return ()
