"""What is claimed, and how it is known."""

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from nbs_pin.base.exceptions import ArgumentError


class Label(StrEnum):
    """How a claim is known, the strongest first."""

    PROVED = "PROVED"
    """By structure, everywhere, or by finitely many evaluations that a theorem extends to everywhere."""
    VERIFIED = "VERIFIED"
    """Exhaustively on a box."""
    PROBABILISTIC = "PROBABILISTIC"
    """With a confidence, for what is drawn as the samples were."""
    EMPIRICAL = "EMPIRICAL"
    """On samples; others may break it."""


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


class Group(StrEnum):
    """Where a claim stands in a certificate."""

    BOUNDS = "bounds"
    MODEL_ERROR = "model error"
    STRUCTURE = "structure"
    INERTIA = "inertia"
    CONSTANTS = "constants"
    SAMPLED = "sampled control"
    LOADS = "disturbance"


def weakest(*labels: Label) -> Label:
    """The label of what follows from claims with these labels; PROVED for none."""
    order = list(Label)
    return max(labels, key=order.index, default=Label.PROVED)


@dataclass(frozen=True)
class Claim:
    """One number of a certificate, with the way it is known."""

    name: str
    """What it is, in words, with its symbol."""
    value: float
    """The number; inf for a bound that is none."""
    unit: str
    """SI, empty for a pure number."""
    label: Label
    because: str
    """Where it comes from, and what it assumes beyond the assumptions of the certificate."""
    group: Group = Group.STRUCTURE

    def __post_init__(self) -> None:
        if math.isnan(self.value):
            raise ArgumentError(f"the claim '{self.name}' is not a number; give its value, inf for no bound.")

    def plain(self) -> dict[str, Any]:
        """The claim as JSON can store it, null for infinity."""
        value = self.value if math.isfinite(self.value) else None
        return {
            "name": self.name,
            "value": value,
            "unit": self.unit,
            "label": str(self.label),
            "because": self.because,
            "group": str(self.group),
        }


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
