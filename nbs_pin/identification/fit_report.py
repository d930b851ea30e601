"""What is said of a fit, whatever was fitted."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.dynamics.provider import DynamicsProvider
from nbs_pin.identification.datasets import Dataset

_VARIES = 1e-12


@dataclass(frozen=True)
class FitReport:
    """How a model was fitted; `report` of what `fit` returns."""

    model: str
    seed: int
    samples: int
    """Learned from, without those held out."""
    seconds: float
    """What it took [s]."""
    evaluations: int
    """Passes over the data, derivatives included; 0 where none are counted."""
    parameters: int
    """Numbers that were learned."""
    history: tuple[float, ...]
    """Normalised mean squared residual: untrained, and after every iteration."""
    held_out: tuple[float, ...]
    """The same on what was held out; empty where it chose nothing."""
    train_nmse: float
    """Mean over joints of mean squared torque error over torque variance (`torque_nmse`)."""
    test_nmse: float | None
    """The same on what was held out, None where nothing was; optimistic for a network, whose iteration it chose."""
    stopped: str
    """Why it ended: "converged", "iterations", "held out" (no better there any more), "interrupted", or, of a chain,
    "starts": no other random tree met the best minimum, or no physical bodies reach it; give more data or starts."""
    unidentifiable: tuple[str, ...]
    """What the data leave open, the worst first."""
    details: Mapping[str, Any] = field(default_factory=dict)
    """What only this kind of model has to say, as JSON can store it."""


def torque_errors(model: DynamicsProvider, data: Dataset, friction: JointFriction | None = None) -> np.ndarray:
    """Torque of the model, friction included, less the torque measured, (samples, n) [N·m]."""
    torque = model.reference_torque(data.q, data.v, data.v, data.a)
    return torque - data.tau if friction is None else torque + friction.torque(data.v) - data.tau


def torque_nmse(model: DynamicsProvider, data: Dataset, friction: JointFriction | None = None) -> float:
    """Mean over joints of mean squared torque error over torque variance; joints whose torque is constant are left out.

    friction: learned beside the model. NaN where no torque varies.
    """
    squares, variance = np.square(torque_errors(model, data, friction)).mean(axis=0), data.tau.var(axis=0)
    varies = variance > _VARIES * max(variance.max(), np.square(data.tau).max())
    return float((squares[varies] / variance[varies]).mean()) if varies.any() else float("nan")
