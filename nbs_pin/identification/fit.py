"""`fit`: a model of an arm from measured motions, by the name of its kind."""

import time
from typing import Any

import numpy as np

from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.registry import entry
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.dynamics.provider import DynamicsProvider
from nbs_pin.identification.compatibility import arm_fault, other_data_fault
from nbs_pin.identification.datasets import Dataset
from nbs_pin.identification.fit_report import FitReport, torque_nmse
from nbs_pin.identification.fitters import FitTask
from nbs_pin.identification.registry import MODELS
from nbs_pin.robots.robot import Robot

_USELESS = 0.9
"""Share of the torque's variance left unexplained beyond which a model says nothing."""
HELD_OUT = 0.2
"""Share of the trajectories that `fit` holds out by default."""


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

    model: one of `identification.registry.MODELS`. seed: of first parameters, batches, and what is held out. robot: the arm that the model is
    for; networks take limits and drawings from it, "residual" its nominal model and "identified" its geometry.
    held_out: trajectories that are not learned from, a dataset or a share of the data; None takes `HELD_OUT` where
    there are two trajectories at least, 0 nothing. They choose the iteration of a network. friction: learn viscous and
    Coulomb friction too, which is no part of M, C, G. progress: show a bar.
    settings: loss, optimiser and iterations of a network (`fit_network`) and its widths; what `identify` takes.
    Ctrl-C ends the fit of a network and keeps the best. Raises ArgumentError for an unknown model, settings that are
    none of its own, a missing robot or one that the data are not of (`compatibility.py`; its masses and lengths may be
    wrong), held_out of another arm, and data without torque unless the loss is that of the acceleration.
    """
    fitter = entry("model", model, MODELS).load()
    fault = "" if robot is None else arm_fault(data, robot)
    if fault:
        raise ArgumentError(f"{fault}.")
    start = time.perf_counter()
    train, test = split_data(data, held_out, seed)
    fitted = fitter(FitTask(model, train, test, seed, robot, friction, progress, settings))
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
        unidentifiable=_useless(bare, train, fitted.friction) + fitted.unidentifiable,
        details=fitted.details,
    )
    return fitted.assemble(report)


def split_data(data: Dataset, held_out: Dataset | float | None = None, seed: int = 0) -> tuple[Dataset, Dataset | None]:
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
