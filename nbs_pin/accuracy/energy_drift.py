"""Energy drift of free motions of a model and of the truth from the same initial states."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from nbs_pin.dynamics.equations import energy, kinetic_energy
from nbs_pin.dynamics.provider import DynamicsProvider
from nbs_pin.simulation.integrators import rk4


class FreeMotion(NamedTuple):
    """|E − E(0)| along torque-free motions, relative to the largest true kinetic energy of each start.

    The arrays have shape (times, starts), with NaN once a motion is no longer finite.
    """

    t: Float[np.ndarray, " times"]
    """Time [s]."""
    drift: Float[np.ndarray, "times starts"]
    """True energy along the model's motion: whether the model gains or loses energy."""
    own: Float[np.ndarray, "times starts"]
    """The model's energy ½vᵀM̂v + V̂ along its motion: only integration error if Ĉ and Ĝ are consistent with M̂ and V̂."""
    floor: Float[np.ndarray, "times starts"]
    """True energy along the true motion: only integration error."""

    @property
    def worst(self) -> float:
        """Largest drift over all starts and times; inf if a motion does not stay finite."""
        return float(self.drift.max()) if np.isfinite(self.drift).all() else np.inf


_FAR = 1e50
"""Numbers beyond this count as not finite."""


def free_motion(
    model: DynamicsProvider,
    truth: DynamicsProvider,
    q: Float[np.ndarray, "starts n"],
    v: Float[np.ndarray, "starts n"],
    *,
    duration: float = 1.0,
    step: float = 0.004,
) -> FreeMotion:
    """Motions from these initial states over `duration` [s] by RK4 with this step [s], without joint limits."""
    steps = round(duration / step)
    with np.errstate(all="ignore"):  # motions may diverge
        moved, true = (_motion(dynamics, q, v, steps, step) for dynamics in (model, truth))
        scale = kinetic_energy(truth, *true).max(axis=0)
        drift, own, floor = (
            np.abs(e - e[0]) / scale for e in (energy(truth, *moved), energy(model, *moved), energy(truth, *true))
        )
    return FreeMotion(step * np.arange(steps + 1), drift, own, floor)


def _motion(
    dynamics: DynamicsProvider, q: np.ndarray, v: np.ndarray, steps: int, step: float
) -> tuple[np.ndarray, np.ndarray]:
    """(q, v) over time, (steps + 1, starts, n) each, NaN once numbers exceed `_FAR`."""
    nothing = np.zeros_like(q)

    def near(q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        gone = ~((np.abs(q) <= _FAR) & (np.abs(v) <= _FAR)).all(axis=-1, keepdims=True)
        return np.where(gone, np.nan, q), np.where(gone, np.nan, v)

    states = [(q, v)]
    for _ in range(steps):
        q, v = near(*rk4(lambda q, v: dynamics.forward_dynamics(*near(q, v), nothing), q, v, step))
        states.append((q, v))
    positions, velocities = zip(*states, strict=True)
    return np.array(positions), np.array(velocities)
