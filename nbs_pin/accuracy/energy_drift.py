"""Free motions of a model and of the truth from the same starts, judged by energy."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from nbs_pin.dynamics.equations import energy, kinetic_energy
from nbs_pin.dynamics.provider import DynamicsProvider
from nbs_pin.simulation.integrators import rk4


class FreeMotion(NamedTuple):
    """|E − E(0)| over time of motions under no torque, per start a share of its own largest true kinetic energy.

    (times, starts) each; NaN from where a motion leaves the finite numbers.
    """

    t: Float[np.ndarray, " times"]
    """Time [s]."""
    drift: Float[np.ndarray, "times starts"]
    """The true energy along the model's motion: does the model make or lose energy?"""
    own: Float[np.ndarray, "times starts"]
    """The model's own energy ½vᵀM̂v + V̂ along it, constant but for the integrator when Ĉ and Ĝ belong to M̂ and V̂."""
    floor: Float[np.ndarray, "times starts"]
    """The true energy along the true motion: what the integrator alone does."""

    @property
    def worst(self) -> float:
        """Largest drift of any start at any time; inf when a motion leaves the finite numbers."""
        return float(self.drift.max()) if np.isfinite(self.drift).all() else np.inf


def free_motion(
    model: DynamicsProvider,
    truth: DynamicsProvider,
    q: Float[np.ndarray, "starts n"],
    v: Float[np.ndarray, "starts n"],
    *,
    duration: float = 1.0,
    step: float = 0.004,
) -> FreeMotion:
    """The motions from these starts for `duration` [s] by RK4 with this step [s], joint stops aside."""
    steps = round(duration / step)
    with np.errstate(all="ignore"):  # of motions that diverge
        moved, true = (_motion(dynamics, q, v, steps, step) for dynamics in (model, truth))
        scale = kinetic_energy(truth, *true).max(axis=0)
        drift, own, floor = (
            np.abs(e - e[0]) / scale for e in (energy(truth, *moved), energy(model, *moved), energy(truth, *true))
        )
    return FreeMotion(step * np.arange(steps + 1), drift, own, floor)


def _motion(
    dynamics: DynamicsProvider, q: np.ndarray, v: np.ndarray, steps: int, step: float
) -> tuple[np.ndarray, np.ndarray]:
    """(q, v) over time, (steps + 1, starts, n) each."""
    nothing = np.zeros_like(q)
    states = [(q, v)]
    for _ in range(steps):
        q, v = rk4(lambda q, v: dynamics.forward_dynamics(q, v, nothing), q, v, step)
        gone = ~(np.isfinite(q).all(axis=-1) & np.isfinite(v).all(axis=-1))
        q[gone] = v[gone] = np.nan
        states.append((q, v))
    positions, velocities = zip(*states, strict=True)
    return np.array(positions), np.array(velocities)
