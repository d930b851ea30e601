"""Claims about a controller or a model, each labelled by how it is known."""

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, NamedTuple, NoReturn

from nbs_pin.base.exceptions import ArgumentError, CertificateRefused


class Label(StrEnum):
    """How a claim is known, strongest first."""

    PROVED = "PROVED"
    """Holds everywhere, by structure or by finitely many evaluations that a theorem extends to all states."""
    VERIFIED = "VERIFIED"
    """Checked exhaustively on a box."""
    PROBABILISTIC = "PROBABILISTIC"
    """Holds with a stated confidence for draws from the distribution of the samples."""
    EMPIRICAL = "EMPIRICAL"
    """Holds on the samples tested; other samples may violate it."""


class Group(StrEnum):
    """The section of a certificate in which a claim is listed."""

    BOUNDS = "bounds"
    MODEL_ERROR = "model error"
    STRUCTURE = "structure"
    INERTIA = "inertia"
    CONSTANTS = "constants"
    SAMPLED = "sampled control"
    LOADS = "disturbance"
    FRICTION = "friction"
    BODIES = "errors of the bodies"


def weakest(*labels: Label) -> Label:
    """The label of a conclusion from claims with these labels: the weakest, or PROVED if there are none."""
    order = list(Label)
    return max(labels, key=order.index, default=Label.PROVED)


@dataclass(frozen=True)
class Claim:
    """One number of a certificate and how it is known."""

    name: str
    """Name of the quantity, with its symbol."""
    value: float
    """The number; inf where there is no bound."""
    unit: str
    """SI unit, empty for a dimensionless number."""
    label: Label
    because: str
    """Its origin, and its assumptions in addition to those of the certificate."""
    group: Group = Group.STRUCTURE
    evidence: tuple[float, ...] | None = None
    """Multipliers by which others can check the claim again (docs/certificates.md §6, §11); None if it has none."""

    def __post_init__(self) -> None:
        if math.isnan(self.value):
            raise ArgumentError(f"the value of claim '{self.name}' is not a number; give one, or inf for no bound.")

    def plain(self) -> dict[str, Any]:
        """The claim as a JSON object, with null for infinity."""
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
    """Raise CertificateRefused with the fault and its remedy."""
    raise CertificateRefused(f"{fault}; {remedy}.")


class Known(NamedTuple):
    """A label and its justification."""

    label: Label
    because: str


def known(why: str, proof: str) -> Known:
    """PROVED by `proof`, or EMPIRICAL if `why` states a reason that the code may differ from the known code."""
    return Known(Label.EMPIRICAL, f"{why}: tested on samples") if why else Known(Label.PROVED, proof)
