"""What certificates assume, and the conditions that their theorems ask for."""

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from nbs_pin.base.claims import Label


class Assumption(StrEnum):
    """What bounds assume, in the words that a certificate prints and a monitor names."""

    MODEL = "the arm is its model"
    FRICTION = "joint friction is what is fed forward, or counted as disturbance"
    DISTURBANCE = "the disturbance is within its bound"
    REFERENCE = "the reference is twice differentiable"
    STOPS = "no joint meets its stop"
    EFFORT = "torques stay inside the effort limits"
    TIME = "continuous time, no delay"
    WRAP = "errors of continuous joints stay within ±π"


@dataclass(frozen=True)
class Condition:
    """An inequality that a theorem asks for, with the numbers on both sides: left > right."""

    name: str
    left: float
    right: float
    unit: str
    label: Label
    because: str
    assumed: bool = True
    """Whether the bounds are void where it does not hold; False for what is printed for comparison."""

    @property
    def holds(self) -> bool:
        """Whether left > right."""
        return self.left > self.right

    def plain(self) -> dict[str, Any]:
        """The condition as JSON can store it, null for infinity."""
        sides = {key: x if math.isfinite(x) else None for key, x in (("left", self.left), ("right", self.right))}
        return {
            "name": self.name,
            **sides,
            "holds": self.holds,
            "unit": self.unit,
            "label": str(self.label),
            "because": self.because,
        }
