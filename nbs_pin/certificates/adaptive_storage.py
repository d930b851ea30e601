"""Bounds of V and Φ of an adaptive law, from V_a(0) and what is supplied to V_a (docs/certificates.md §16)."""

import math
from dataclasses import dataclass

import numpy as np

from nbs_pin.base.rounding import up
from nbs_pin.certificates.certificate import Start
from nbs_pin.certificates.comparison_system import ComparisonSystem, decay, level
from nbs_pin.certificates.uncertainty import Payload
from nbs_pin.controllers.adaptive_law import AdaptiveLaw
from nbs_pin.controllers.lyapunov_law import LyapunovLaw
from nbs_pin.kernels.symmetric4 import FARTHEST

_MOST = FARTHEST + math.log1p(math.exp(-FARTHEST))  # d of one eigenvalue, for estimates that are cut
_SHARES = np.linspace(0.0, 1.0, 41)[1:-1].tolist()


def loaded_start(law: AdaptiveLaw, frame: str, payload: Payload, start: Start) -> float:
    """V(0) at most, with every load of the box [J].

    A load adds ½Σ m_k‖u + w × x_k‖² ≤ ½m̄(‖u‖ + r‖w‖)², with u and w the velocities of its frame at z2.
    """
    assert isinstance(law.law, LyapunovLaw)  # as no other law adapts a load
    e = law.law.errors(start.q, start.v, start.begin.q, start.begin.v, start.begin.a)
    u, w = np.split(law.robot.jacobian(start.q, frame) @ e.z2, 2)
    speed = float(np.linalg.norm(u)) + payload.radius * float(np.linalg.norm(w))
    return up(up(start.storage) + 0.5 * payload.mass * up(speed) ** 2)


@dataclass(frozen=True)
class Beginning:
    """V_a from its beginning on: V̇_a ≤ −x² + axy − y² + ty + P + σ(Σ d(X‖X₀)/γ − Σ d(X‖X̂)/γ) − 2ωW."""

    law: AdaptiveLaw
    k: ComparisonSystem
    """Of the law that `law` is about, without bounds of M, which the load changes."""
    start: float
    """V(0) [J]."""
    divergence: float
    """Σ d(X‖X₀)/γ [J]."""
    length: float
    """The time that is bounded [s]."""

    def within(self) -> float:
        """Bound of V for the length of time [J]."""
        return min(self.always(), self._supplied(1.0 - 0.25 * self.k.cross**2))

    def always(self) -> float:
        """Bound of V at all times [J], as V̇_a ≤ c(V∞ − V) + σ(Σ d(X‖X₀)/γ − Σ d(X‖X̂)/γ) and d(X‖X̂) ≤ d̄."""
        leak, k, storage, supplied = self.law.leak, self.k, self.start + self.divergence, 0.0
        c = decay(k) / (1.0 + 1e-9)
        if k.t > 0.0 or k.power > 0.0:
            c, supplied = level(k)
        if supplied == 0.0 and leak <= c:
            return storage
        if c <= 0.0:
            return math.inf
        rates = np.asarray(self.law.rates)
        sizes = np.array([4.0] * len(self.law.unknowns.bodies) + [1.0] * len(self.law.unknowns.numbers))
        most = float((sizes[rates > 0.0] / rates[rates > 0.0]).sum()) * _MOST
        found = supplied + leak / c * self.divergence + most
        if leak > 0.0:
            found = min(found, (c * supplied + leak * self.divergence) / min(c, leak))
        return max(storage, up(found))

    def potential(self) -> float:
        """Bound of Φ for the length of time [J].

        Φ + mV_a changes by what is supplied if (1 + m)x² − (1/√δ + ma)xy + m(1 − θ)y² ≥ 0 for all x and y, so that
        Φ ≤ (Φ(0) + m(V_a(0) + supplied))/(1 + m) for every share θ of the damping that pays for the disturbance.
        """
        k, best = self.k, math.inf
        a_, b = k.cross, 1.0 / math.sqrt(k.delta)
        for share in (0.0,) if k.t == 0.0 else _SHARES:
            # The larger root of 4m(1 + m)(1 − θ) − (b + ma)² = pm² + qm − b².
            p, q = 4.0 * (1.0 - share) - a_**2, 4.0 * (1.0 - share) - 2.0 * a_ * b
            if p > 0.0:
                m = up((math.sqrt(q * q + 4.0 * p * b * b) - q) / (2.0 * p))
                best = min(best, up((self.start + m * self._supplied(share)) / (1.0 + m)))
        return best

    def _supplied(self, share: float) -> float:
        """V_a(0) and what is supplied to V_a, where ty ≤ θy² + t²/4θ [J]."""
        k = self.k
        power = k.power + self.law.leak * self.divergence
        if k.t > 0.0:
            power += k.t**2 / (4.0 * share) if share > 0.0 else math.inf
        return self.start + self.divergence + (up(power * self.length) if power > 0.0 else 0.0)
