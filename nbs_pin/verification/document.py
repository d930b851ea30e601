"""Reading of certificate files: JSON by `certificate.schema.json`, which documents every key."""

import hashlib
import json
import math
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np

from nbs_pin.base.exceptions import FileFormatError, MissingExtra, NoSuchFile

try:
    import jsonschema
except ModuleNotFoundError as error:
    raise MissingExtra("verify needs jsonschema: pip install 'nbs-pin[verify]'.") from error


ASSUMED = (
    "position and velocity are measured as stated",
    "the reference is twice differentiable",
    "no joint reaches its stop",
    "no joint is held back by its velocity limit",
    "torques stay within the effort limits",
    "continuous time, no delay",
)
"""Assumptions of every certificate whose words do not vary (docs/certificates.md §9)."""
COMPARED = "> largest torque of the law"
"""End of the name of a condition that may be a comparison, besides those of the paper as printed."""


@runtime_checkable
class Arm(Protocol):
    """An arm as `load_robot` gives it, as far as a file states it."""

    @property
    def name(self) -> str:
        """What it is called."""

    @property
    def sha256(self) -> str:
        """Of links, joints, limits and gravity."""

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints that move."""


def check_arm(path: Path, stated: dict[str, Any] | None, robot: Arm) -> None:
    """Raise FileFormatError unless the robot is the one that the file states."""
    joints = [joint["name"] for joint in stated["joints"]] if stated else []
    if stated is None or stated["sha256"] is None:
        raise FileFormatError(f"{path}: the certificate names no arm, and {robot.name} was given; leave out the robot.")
    if joints != list(robot.joint_names):
        raise FileFormatError(
            f"{path}: the joints of the certificate that move are {', '.join(joints)}, those of {robot.name} "
            f"{', '.join(robot.joint_names)}; give the robot with the same joints locked."
        )
    if stated["sha256"] != robot.sha256:
        raise FileFormatError(
            f"{path}: the certificate is of the arm {stated['name']} with the sha256 {stated['sha256'][:12]}…, and "
            f"that of {robot.name} is {robot.sha256[:12]}…; give the robot that was certified, with its gravity."
        )


def read_document(path: Path) -> dict[str, Any]:
    """The content of the file; raises FileFormatError unless it fits the schema and its own number of joints."""
    content = file_content(path)
    foreign = False
    try:
        document: dict[str, Any] = json.loads(
            content, object_pairs_hook=_unique, parse_float=_finite, parse_constant=_finite, parse_int=_whole
        )
        foreign = isinstance(document, dict) and "format" not in document
        fault = jsonschema.exceptions.best_match(_schema().iter_errors(document))
        if fault is not None:
            raise fault
        _check_sizes(document)
        _check_premises(document)
    except jsonschema.ValidationError as error:
        if foreign:
            remedy = "give certificate.json, as nbs-pin certify --json writes it"
            raise FileFormatError(f"{path}: not a certificate; {remedy}.") from error
        rule = f"it does not satisfy {error.validator} {error.validator_value}"
        words = error.message if len(error.message) < 160 else f"{rule:.160}"
        raise FileFormatError(f"{path}: {error.json_path}: {words}; write the file again.") from error
    except (ValueError, RecursionError) as error:
        raise FileFormatError(f"{path}: no certificate of format 1 ({error}); write the file again.") from error
    return document


@cache
def _schema() -> Any:
    """What holds documents against the schema, which is checked itself only once: that takes longer than a document."""
    schema = json.loads(files("nbs_pin.verification").joinpath("certificate.schema.json").read_text("utf-8"))
    kind = jsonschema.validators.validator_for(schema)
    kind.check_schema(schema)
    return kind(schema)


def file_content(path: Path) -> bytes:
    """The bytes of a file; raises NoSuchFile if there is none, FileFormatError if it cannot be read."""
    try:
        if path.is_file():
            return path.read_bytes()
        if not path.exists():
            raise NoSuchFile(f"no file {str(path)!r:.200}; correct the path.")
        fault = "it is no regular file"
    except (OSError, ValueError) as error:
        if isinstance(error, NoSuchFile):
            raise
        fault = getattr(error, "strerror", None) or str(error)
    raise FileFormatError(f"{str(path)!r:.200} cannot be read: {fault}; give the path of a file.")


def is_unchanged(document: dict[str, Any]) -> bool:
    """Whether the file's SHA-256 is that of the rest, as JSON with sorted keys in ASCII."""
    rest = {key: x for key, x in document.items() if key != "sha256"}
    content = json.dumps(rest, sort_keys=True)
    return bool(hashlib.sha256(content.encode()).hexdigest() == document["sha256"])


def _check_sizes(document: dict[str, Any]) -> None:
    """Raise ValueError unless lists fit the number of joints, forms are symmetric and parents come first."""
    law, friction, n = document["law"], document["friction"], len(document["law"]["rate"])
    joints, cut = document["arm"]["joints"] if document["arm"] else None, document["polygon"]
    rows = [document["disturbance"]["box"], joints, *(x for x in friction.values() if isinstance(x, list))]
    rows += [x["joint_errors"] for x in (document["bounds"], document["linear"], document["start"]) if x]
    if {(n, n)} != {np.shape(law["stiffness"]), np.shape(law["floor"])} or any(
        len(x) != n for x in rows if x is not None
    ):
        raise ValueError(f"its lists do not all fit {n} joints")
    if any(not np.array_equal(x, np.transpose(x)) for x in (law["stiffness"], law["floor"])):
        raise ValueError("S or D₀ is not symmetric")
    if cut and len(cut["steepness"]) != len(cut["heights"]):
        raise ValueError("its polygon has not as many heights as edges")
    if any(joint["parent"] >= i for i, joint in enumerate(joints or [])):
        raise ValueError("a joint comes before its parent")


def _check_premises(document: dict[str, Any]) -> None:
    """Raise ValueError if a premise that every certificate has is missing, or one that may fail is only compared."""
    listed = {x["assumption"] for x in document["assumptions"]}
    if missing := [text for text in ASSUMED if text not in listed]:
        raise ValueError(f"it does not list the assumption '{missing[0]}'")
    names = [x["name"] for x in document["conditions"]]
    if not any(name.startswith("Theorem 1:") for name in names):
        raise ValueError("it has no condition of Theorem 1")
    compared = [x["name"] for x in document["conditions"] if x["role"] == "comparison"]
    if hidden := [name for name in compared if not name.startswith("printed: ") and not name.endswith(COMPARED)]:
        raise ValueError(f"its condition '{hidden[0]}' counts as a comparison")


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    if len(dict(pairs)) < len(pairs):
        raise ValueError("a key is repeated")
    return dict(pairs)


def _finite(text: str) -> float:
    if not math.isfinite(float(text)):
        raise ValueError(f"{text} is not finite")
    return float(text)


def _whole(text: str) -> int:
    _finite(text)
    return int(text)


def unit(document: dict[str, Any], turning: str, sliding: str) -> str:
    """The unit of a number over all joints of the arm: those of joints that turn and of joints that slide."""
    slides = {joint["prismatic"] for joint in (document["arm"] or {"joints": []})["joints"]} or {False}
    return ", ".join(sliding if kind else turning for kind in sorted(slides))
