"""The report of a fit, common to all models."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.dynamics.provider import DynamicsProvider
from nbs_pin.identification.datasets import Dataset

NOTICED = 0.02
"""Unexplained share of the torque's variance that is worth a word."""
_WORSE = 5.0
"""Ratio of the unexplained share on held-out data to that on fitted ones from which on it is far worse."""
_VARIES = 1e-12


@dataclass(frozen=True)
class FitReport:
    """How a model was fitted: the `report` of a model returned by `fit`."""

    model: str
    seed: int
    samples: int
    """Training samples, without those held out."""
    seconds: float
    """Duration of the fit [s]."""
    evaluations: int
    """Passes over the data, derivatives included; steps of the optimiser for "chain" and "identified"."""
    parameters: int
    """Number of learned parameters."""
    history: tuple[float, ...]
    """Normalised mean squared residual, before training and after every iteration."""
    held_out: tuple[float, ...]
    """The same on the held-out data; empty if they did not select the iteration."""
    train_nmse: float
    """Mean over joints of mean squared torque error over torque variance (`torque_nmse`), on the training data."""
    test_nmse: float | None
    """The same on the held-out data, None without; optimistic for a network, whose iteration these selected."""
    stopped: str
    """Why it ended: "converged", "iterations", "held out" (no improvement there), "interrupted", or, for a chain,
    "starts": no other random tree found the best minimum, or no physical bodies reach it; give more data or starts.
    For a network, "no better than the start" if no iterate predicts the held-out data, or without these the training
    data, better than the untrained network with friction. However it ended, "no better than zero torque", or
    than "a constant torque", if that predicts the data as well."""
    unidentifiable: tuple[str, ...]
    """What the data do not determine, the worst first."""
    left: Mapping[str, Any] = field(default_factory=dict)
    """What it leaves of the torques of the held-out data, or without these of the training data: per joint mean, RMS,
    and the share of the residual that other effects would explain (`remainder`); empty without torque."""
    next_try: str = ""
    """The one thing to try next, empty if little is left."""
    details: Mapping[str, Any] = field(default_factory=dict)
    """Further results of this kind of model, JSON-serialisable."""


def is_far_worse(held_out: float, fitted: float) -> bool:
    """Whether so much more of the torque's variance is unexplained on held-out data that too much was learned."""
    return held_out > max(_WORSE * fitted, NOTICED)


def torque_errors(model: DynamicsProvider, data: Dataset, friction: JointFriction | None = None) -> np.ndarray:
    """Torque of the model, friction included, minus the measured torque, (samples, n) [N·m]."""
    torque = model.reference_torque(data.q, data.v, data.v, data.a)
    return torque - data.tau if friction is None else torque + friction.feedforward(data.v, torque) - data.tau


def zero_torque_nmse(data: Dataset) -> float:
    """`torque_nmse` of a model that predicts no torque at all."""
    return _nmse(data.tau, data)


def torque_nmse(model: DynamicsProvider, data: Dataset, friction: JointFriction | None = None) -> float:
    """Mean over joints of mean squared torque error over torque variance; joints whose torque is constant are left out.

    The model's torque includes the given friction. NaN if no torque varies.
    """
    return _nmse(torque_errors(model, data, friction), data)


def _nmse(errors: np.ndarray, data: Dataset) -> float:
    squares, variance = np.square(errors).mean(axis=0), data.tau.var(axis=0)
    varies = variance > _VARIES * max(variance.max(), np.square(data.tau).max())
    return float((squares[varies] / variance[varies]).mean()) if varies.any() else float("nan")
