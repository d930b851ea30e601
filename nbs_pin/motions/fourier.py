"""Motions that are finite Fourier series over one period, at rest where the period begins and ends."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from nbs_pin.base.arrays import JointArray
from nbs_pin.base.records import Reference
from nbs_pin.motions.references import instants


@dataclass(frozen=True, eq=False)
class Fourier:
    """q = offset + Σ_k sine_k sin(kωt) + cosine_k cos(kωt) with ω = 2π / duration, held before t = 0 and after it.

    v and a are its exact derivatives. They vanish at both ends if Σ_k k sine_k = 0 and Σ_k k² cosine_k = 0, as for the
    coefficients that `at_rest` gives.
    """

    offset: JointArray
    """Mean configuration [rad, m]."""
    sine: Float[np.ndarray, "harmonics n"]
    """[rad, m]."""
    cosine: Float[np.ndarray, "harmonics n"]
    """[rad, m]."""
    duration: float
    """The period [s]."""

    @property
    def largest_jerk(self) -> JointArray:
        """Bound of |ȧ_d| of each joint, Σ_k (kω)³ √(sine_k² + cosine_k²) [rad/s³]."""
        return np.asarray(self._frequencies**3 @ np.hypot(self.sine, self.cosine))

    def __call__(self, t: Any) -> Reference:
        """Desired motion at t [s]."""
        t = instants(t)
        inside = np.clip(t, 0.0, self.duration)
        q, v, a = (wave @ np.concatenate([self.sine, self.cosine]) for wave in waves(inside, self._frequencies))
        moving = (inside == t)[..., None]
        return Reference(self.offset + q, np.where(moving, v, 0.0), np.where(moving, a, 0.0))

    @property
    def _frequencies(self) -> Float[np.ndarray, " harmonics"]:
        return 2.0 * np.pi / self.duration * np.arange(1, len(self.sine) + 1)


def waves(t: np.ndarray, w: Float[np.ndarray, " harmonics"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(sin wt, cos wt) of every frequency and their first and second derivatives (..., 2 harmonics) at times t [s]."""
    sine, cosine = np.sin(t[..., None] * w), np.cos(t[..., None] * w)
    q, v = np.concatenate([sine, cosine], axis=-1), np.concatenate([w * cosine, -w * sine], axis=-1)
    return q, v, -(np.concatenate([w, w]) ** 2) * q


def at_rest(harmonics: int) -> Float[np.ndarray, "twice free"]:
    """A basis (2 harmonics, 2 harmonics − 2) of the coefficients (sine, cosine) with v = a = 0 where the period begins.

    Its columns are orthonormal in units of 1/k, which is what a bound of the velocity leaves the harmonic k.
    """
    k = np.arange(1.0, harmonics + 1.0)
    scale = np.concatenate([1.0 / k, 1.0 / k])
    conditions = np.zeros((2, 2 * harmonics))
    conditions[0, :harmonics], conditions[1, harmonics:] = 1.0, k  # k sine_k and k² cosine_k, in these units
    _, _, directions = np.linalg.svd(conditions)
    return np.asarray(scale[:, None] * directions[2:].T)
