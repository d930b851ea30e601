"""What one instant of a watched loop shows."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from nbs_pin.certificates.certificate import Certificate
from nbs_pin.certificates.claims import Assumption
from nbs_pin.certificates.energy_balance import Balance
from nbs_pin.kernels import verdicts

BITS = {
    verdicts.EFFORT: Assumption.EFFORT,
    verdicts.WRAP: Assumption.WRAP,
    verdicts.REFERENCE: Assumption.REFERENCE,
    verdicts.STOPS: Assumption.STOPS,
}
"""The assumptions that `verdicts.instant` checks."""


class Glance(NamedTuple):
    """What one instant shows."""

    storage: float
    """V [J], of the means over the window where there is one, NaN before the first is full."""
    promise: float
    """Bound of V [J], where the window begins."""
    errors: Float[np.ndarray, " errors"]
    """‖z1‖ and each |z1_i| [rad]."""
    bounds: Float[np.ndarray, " errors"]
    """Their bounds [rad]."""
    excesses: tuple[str, ...]
    """The bounds exceeded."""
    is_wrong: bool
    """Whether one is exceeded by more than inadmissible torques can have done."""
    cause: tuple[Assumption, ...] = ()
    """What is named if a bound is exceeded and no assumption failed noticeably."""
    failed: tuple[Assumption, ...] = ()
    """The assumptions that failed now."""
    suspects: tuple[str, ...] = ()
    """Simple faults that would explain the torque."""
    balance: Balance | None = None


def labels(certificate: Certificate) -> tuple[str, ...]:
    """Names of V, ‖z1‖ and each |z1_i|."""
    return ("V", "‖z1‖", *(f"|z1| of {name}" for name in certificate.joint_names))


def bound(certificate: Certificate, initial: float, held: float, t: float) -> float:
    """`Certificate.storage_bound` at one time; held: `Certificate.held_storage` from `initial` [J]."""
    if held < math.inf:
        return held
    level = certificate.level
    return min(initial * math.exp(-level.c * max(t, 0.0)) + level.storage, max(initial, level.storage))
