"""What is claimed of a controller or a model, and how it is known."""

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, NamedTuple, NoReturn

from nbs_pin.base.exceptions import ArgumentError, CertificateRefused


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


def refuse(fault: str, remedy: str) -> NoReturn:
    """Raise CertificateRefused in one sentence."""
    raise CertificateRefused(f"{fault}; {remedy}.")


class Known(NamedTuple):
    """How something is known."""

    label: Label
    because: str


def known(why: str, proof: str) -> Known:
    """PROVED by the structure of known code, or EMPIRICAL because of `why` the code may be another."""
    return Known(Label.EMPIRICAL, f"{why}: held on samples") if why else Known(Label.PROVED, proof)
