"""The response of the linearised loop to errors of the bodies along a reference (docs/certificates.md §14)."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from nbs_pin.certificates.constants import Constants

_FIRST, _GROWTH, LONGEST = 2.5e-4, 0.02, 5e-3
"""Steps [s] of the first instants, their share of the time so far, and the longest."""


def instants(duration: float) -> Float[np.ndarray, " rows"]:
    """Instants from 0 to `duration` [s]: dense at first, where the response starts."""
    t = [0.0]
    while t[-1] < duration:
        t.append(t[-1] + min(LONGEST, max(_FIRST, _GROWTH * t[-1])))
    return np.array([*t[:-1], duration])


@dataclass(frozen=True, eq=False)
class Response:
    """f and η, piecewise linear in time, of every error g: ḟ ≈ H(η − Λf), M̂η̇ ≈ w − ζf − (ωM̂ + D₀ + Ĉ)η."""

    t: Float[np.ndarray, " rows"]
    """[s]"""
    f: Float[np.ndarray, "rows n g"]
    """[N·m]"""
    eta: Float[np.ndarray, "rows n g"]
    """[rad/s]"""
    df: Float[np.ndarray, "steps n g"]
    deta: Float[np.ndarray, "steps n g"]
    """Their rates in each step."""

    @classmethod
    def of(
        cls,
        t: Float[np.ndarray, " rows"],
        mass: Float[np.ndarray, "rows n n"],
        own: Float[np.ndarray, "rows n n"],
        torque: Float[np.ndarray, "rows n g"],
        hessian: Float[np.ndarray, "n n"],
        c: Constants,
    ) -> "Response":
        """By the trapezoidal rule from rest; own: ωM̂ + D₀ + Ĉ, torque: w."""
        n, rows = len(hessian), len(t)
        inverse = np.linalg.inv(mass)
        system = np.zeros((rows, 2 * n, 2 * n))
        system[:, :n, :n], system[:, :n, n:] = -hessian * c.rate, hessian
        system[:, n:, :n], system[:, n:, n:] = -c.coupling * inverse, -inverse @ own
        forcing = np.concatenate([np.zeros_like(torque), inverse @ torque], axis=1)
        x, eye = np.zeros_like(forcing), np.eye(2 * n)
        for k, h in enumerate(np.diff(t).tolist()):
            right = (eye + 0.5 * h * system[k]) @ x[k] + 0.5 * h * (forcing[k] + forcing[k + 1])
            x[k + 1] = np.linalg.solve(eye - 0.5 * h * system[k + 1], right)
        rates = np.diff(x, axis=0) / np.diff(t)[:, None, None]
        return cls(t, x[:, :n], x[:, n:], rates[:, :n], rates[:, n:])

    def beside(self, k: int) -> list[tuple[float, np.ndarray, np.ndarray]]:
        """Half the step [s], negative before instant k, and the rates before and after it."""
        sides = [(k - 1, -0.5), (k, 0.5)]
        inside = [(i, share) for i, share in sides if 0 <= i < len(self.df)]
        return [(share * float(self.t[i + 1] - self.t[i]), self.df[i], self.deta[i]) for i, share in inside]
