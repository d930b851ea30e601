"""Reading of certificate files: JSON by `certificate.schema.json`, which documents every key."""

import hashlib
import json
import math
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from nbs_pin.base.exceptions import FileFormatError, MissingExtra

try:
    import jsonschema
except ModuleNotFoundError as error:
    raise MissingExtra("verify needs jsonschema: pip install 'nbs-pin[verify]'.") from error


def read_document(path: Path) -> dict[str, Any]:
    """The content of the file; raises FileFormatError unless it fits the schema and its own number of joints."""
    schema = json.loads(files("nbs_pin.verification").joinpath("certificate.schema.json").read_text("utf-8"))
    content = path.read_bytes()
    try:
        document: dict[str, Any] = json.loads(
            content, object_pairs_hook=_unique, parse_float=_finite, parse_constant=_finite, parse_int=_whole
        )
        jsonschema.validate(document, schema)
        _check_sizes(document)
    except jsonschema.ValidationError as error:
        rule = f"it does not satisfy {error.validator} {error.validator_value}"
        fault = error.message if len(error.message) < 160 else f"{rule:.160}"
        raise FileFormatError(f"{path}: {error.json_path}: {fault}; write the file again.") from error
    except (ValueError, RecursionError) as error:
        raise FileFormatError(f"{path}: no certificate of format 1 ({error}); write the file again.") from error
    return document


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
