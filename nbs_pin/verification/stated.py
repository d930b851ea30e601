"""What becomes of each statement of a certificate file, and what a file states without a number that can be checked."""

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

from nbs_pin.verification.document import ASSUMED, is_unchanged, unit

VERIFIED, TAKEN, OPEN, FALSE = "re-verified", "taken as stated", "NOT re-verified", "FALSE"
"""What becomes of a statement: checked here, a premise of what is checked, beyond this program, or not shown true."""
_LABELS = ("PROVED", "VERIFIED", "PROBABILISTIC", "EMPIRICAL")
_STOPS = "no joint reaches its stop"


class Check(NamedTuple):
    """One statement of the file, and what became of it."""

    name: str
    status: str
    because: str


def decided(name: str, true: bool, because: str) -> Check:
    """A statement that was checked here."""
    return Check(name, VERIFIED if true else FALSE, because)


def stated(document: dict[str, Any]) -> Iterator[Check]:
    """Seal, label, conditions and premises."""
    yield decided("the file is as it was written", is_unchanged(document), "its SHA-256, which names no author")
    used = document["constants"]["kappa"] > 0.0 or document["constants"]["nu"] is not None
    claims, holding = [*document["claims"], *(document["inertia"][:2] if used else [])], True
    for x in document["conditions"]:
        left, right = _sides(x)
        if x["role"] != "comparison":
            true = x["holds"] and left > right
            holding, claims = holding and true, claims + [x] * (x["role"] == "sufficient")
            unchecked = "" if x["checks"] is None else "; the file does not hold what would show it: not checked"
            because = f"{left:.6g} > {right:.6g} {x['unit']}".rstrip() + unchecked
            yield Check(x["name"], TAKEN if true else FALSE, because)
            if x["checks"] == _STOPS:
                because = "the error in the condition is at least the bound of that joint"
                yield decided(f"{x['name']}: right side", right >= _largest_error(document, x["name"]), because)
    weakest = max([*(x["label"] for x in claims), "PROVED" if holding else "EMPIRICAL"], key=_LABELS.index)
    yield decided(f"label {document['label']}", document["label"] == weakest, "the weakest of claims and conditions")
    given, kind = document["disturbance"], document["law"]["kind"]
    box = f"‖τ_d‖ ≤ {given['radius']:g}" if given["box"] is None else f"|τ_d,i| ≤ {given['box']}"
    yield Check("disturbance", TAKEN, f"{box} {unit(document, 'N·m', 'N')}")
    if any(any(document["friction"][key]) for key in ("viscous", "coulomb", "fed_viscous", "fed_coulomb")):
        yield Check("joint friction and |v_d|", TAKEN, "b, c, b̂, ĉ, ε and the speed of the reference as in the file")
    yield Check(f"law {kind}", TAKEN, "Φ ≥ z1ᵀSz1, D ⪰ D₀, Λ, ω and ζ as in the file, by the structure of its code")
    for x in document["assumptions"]:
        true = x["assumption"] not in ASSUMED or x["checked"] == _how_far(document, x["assumption"])
        because = f"assumption; of its conditions the file says: {x['checked']}"
        yield Check(x["assumption"], TAKEN if true else FALSE, because)


def _sides(condition: dict[str, Any]) -> tuple[float, float]:
    left, right = (math.inf if condition[side] is None else condition[side] for side in ("left", "right"))
    return left, right


def _largest_error(document: dict[str, Any], name: str) -> float:
    """The bound of the error of the joint that a condition names, from every start that the file bounds; inf if none.

    Of several names that fit, the longest.
    """
    named = [(i, x["name"]) for i, x in enumerate(document["arm"]["joints"] if document["arm"] else [])]
    fitting = [(len(joint), i) for i, joint in named if name.startswith(f"room of {joint} ")]
    if not fitting:
        return math.inf
    i = max(fitting)[1]
    closest = document["held"] or document["linear"] or document["bounds"]
    return max(sizes["joint_errors"][i] for sizes in (closest, document["start"]) if sizes)


def _how_far(document: dict[str, Any], assumption: str) -> str:
    """How far the conditions of the file check an assumption."""
    own = [x for x in document["conditions"] if x["checks"] == assumption]
    if any(x["role"] != "comparison" and not _sides(x)[0] > _sides(x)[1] for x in own):
        return "FAILS"
    if any(x["role"] == "sufficient" for x in own):
        return "checked"
    return "checked in part" if own else "not checked"
