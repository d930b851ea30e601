"""Assumptions of certificates, and the conditions of their theorems."""

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from nbs_pin.base.claims import Label


class Assumption(StrEnum):
    """The assumptions of the bounds, in the words that certificates and monitors print."""

    MODEL = "the model is exact"
    FRICTION = "joint friction is fed forward exactly, or counted as disturbance"
    DISTURBANCE = "the disturbance is within its bound"
    REFERENCE = "the reference is twice differentiable"
    STOPS = "no joint reaches its stop"
    EFFORT = "torques stay within the effort limits"
    TIME = "continuous time, no delay"
    WRAP = "errors of continuous joints stay within ±π"


@dataclass(frozen=True)
class Condition:
    """A condition left > right of a theorem, with the numbers on both sides."""

    name: str
    left: float
    right: float
    unit: str
    label: Label
    because: str
    assumed: bool = True
    """Whether the bounds are void if it fails; False for a condition printed for comparison."""

    @property
    def holds(self) -> bool:
        """Whether left > right."""
        return self.left > self.right

    def plain(self) -> dict[str, Any]:
        """The condition as JSON can store it, None for infinity."""
        sides = {key: x if math.isfinite(x) else None for key, x in (("left", self.left), ("right", self.right))}
        return {
            "name": self.name,
            **sides,
            "holds": self.holds,
            "unit": self.unit,
            "label": str(self.label),
            "because": self.because,
        }
