"""When a sampled law reads the state, how exactly, and when its torque acts (docs/certificates.md §13).

The law reads the state at t_k − delay, is evaluated for `lead` after that, and acts from t_k to t_k + period. Encoders
give positions to half a step; the velocity is then the difference of two of them over a period.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from nbs_pin.base.arrays import JointArray


@dataclass(frozen=True)
class Timing:
    """Times of a sampled loop [s]; the age of a reading is counted from the beginning of the hold that it acts in."""

    period: float
    """h."""
    lead: float
    """Look-ahead."""
    delay: float
    """From the reading to the beginning of the hold."""
    differenced: bool
    """Whether the velocity is the mean of the period before the reading."""

    @property
    def blur(self) -> float:
        """By how much the velocity is older than the position."""
        return 0.5 * self.period if self.differenced else 0.0

    @property
    def age(self) -> float:
        """Mean age of the velocity, T."""
        return self.delay + self.blur

    @property
    def ahead(self) -> float:
        """From the beginning of the hold to the time for which the law is evaluated."""
        return self.lead - self.delay

    @property
    def span(self) -> float:
        """From the reading to the end of the hold."""
        return self.delay + self.period

    @property
    def oldest(self) -> float:
        """Largest age of anything read."""
        return self.delay + 2.0 * self.blur

    @property
    def holds(self) -> int:
        """Number of earlier holds that the readings reach into, m."""
        return math.ceil(self.oldest / self.period - 1e-12)

    @property
    def backlog(self) -> float:
        """Σ j T_j, where T_j of the mean age lies in the hold j before this one."""
        second = 0.5 * self.delay**2 / self.period if self.differenced else 0.0
        return self.age + second

    @property
    def jitter(self) -> float:
        """Σ j h times what the weights of the hold j before this one differ from their mean, root mean square."""
        share = self.delay / self.period
        if not self.differenced:
            return self.period * self.unevenness
        first = share + (1.0 - share**3) / 3.0 - (1.0 - 0.5 * (1.0 - share) ** 2) ** 2
        second = share**3 / 3.0 - share**4 / 4.0
        return self.period * (math.sqrt(max(first, 0.0)) + 2.0 * math.sqrt(second))

    @property
    def unevenness(self) -> float:
        """Root mean square over a hold of what the weight of ż2 in later readings differs from its mean."""
        share = self.delay / self.period
        return 1.0 / math.sqrt(12.0) if self.differenced else math.sqrt(max(share * (1.0 - share), 0.0))

    @property
    def half(self) -> float:
        """Longest time between an instant of the hold and that for which the law is evaluated."""
        return max(self.ahead, self.period - self.ahead)

    @property
    def mean(self) -> float:
        """Its mean over the hold."""
        h, a = self.period, self.ahead
        return (0.5 * h * h - h * a + a * a) / h if a >= 0.0 else 0.5 * h - a

    @property
    def bow(self) -> float:
        """How far an acceleration moves an instant of the hold from the prediction, at most [s²]."""
        return 0.5 * self.span**2 + self.lead * self.blur

    @property
    def mean_bow(self) -> float:
        """The same for the mean over the hold [s²]."""
        return (self.span**3 - self.delay**3) / (6.0 * self.period) + self.lead * self.blur


class Noise(NamedTuple):
    """What rounding to encoder steps does, in |·| and |·|_M."""

    reading: float
    """A reading, |ε|."""
    reading_m: float
    """|ε|_M."""
    rate: float
    """The difference of two over a period, |η|."""
    rate_m: float
    """|η|_M."""
    position: float
    """The predicted position, |ε + lead η|."""

    @classmethod
    def of(
        cls, timing: Timing, step: JointArray | None, floor: Float[np.ndarray, "n n"], diagonal: JointArray, isk: float
    ) -> "Noise":
        """For encoder steps [rad], D₀, max M_ii [kg·m²] and 1/√κ; nothing without encoders."""
        if step is None:
            return cls(0.0, 0.0, 0.0, 0.0, 0.0)
        half = 0.5 * step
        reading = math.sqrt(half @ np.abs(floor) @ half)
        reading_m = min(isk * reading, float(np.sqrt(diagonal) @ half))
        double, lead = 2.0 / timing.period, timing.lead
        return cls(reading, reading_m, double * reading, double * reading_m, (1.0 + double * lead) * reading)
