"""What a resumed training must share with the one that wrote the checkpoint, and which of it differs."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch

from nbs_pin.base.doors import option, where_printed
from nbs_pin.simulation.rollout import Batch
from nbs_pin.storage.descriptions import describe

_TYPED = ("epochs", "optimiser", "learning_rate", "period", "duration", "seed")
"""Settings that a message gives as they are typed, before and now."""


def statement(
    controller: Any, training: Sequence[Batch], held_out: Sequence[Batch], costs: list[float], **settings: Any
) -> Any:
    """What determines a training, as JSON can store it; arrays and the law by hash.

    Cost, regulariser, model and plant may be any callables; they are identified by the initial costs.
    Raises ArgumentError if the controller cannot be stored.
    """
    loop, batches = training[0].loop, [*training, *held_out]
    law, tensors = describe(controller)
    return {
        **settings,
        "period": loop.period,
        "duration": loop.steps * loop.period,
        "plant_step": loop.period / loop.substeps,
        "plant": "; ".join(repr(batch.loop.plant) for batch in training),
        "effort_limit": _hash(loop.limit),
        "number": [len(batch.q0) for batch in batches],
        "law": _hash(json.dumps(law, sort_keys=True).encode(), *(x.detach().cpu().numpy() for x in tensors.values())),
        "references": _hash(*(array for batch in batches for array in (batch.aims, batch.desired))),
        "starts": _hash(*(array for batch in batches for array in (batch.q0, batch.v0, batch.tau_d))),
        "costs": [f"{cost:.9g}" for cost in costs],
    }


def difference(before: Any, now: Mapping[str, Any]) -> str:
    """What differs between two statements, in words; an empty text if they are equal.

    Of settings that follow from each other, such as the starts from the seed, only the first is named.
    """
    if not isinstance(before, Mapping) or before.keys() != now.keys():
        return "" if before == now else "it was written by another version"
    changed = [name for name in now if before[name] != now[name]]
    typed = [name for name in changed if name in _TYPED]
    if typed:
        then, here = (", ".join(option(name, x[name]) for name in typed) for x in (before, now))
        return f"it has {then}, and here is {here}"
    return f"it differs in {_words(changed[0])}" if changed else ""


def _words(name: str) -> str:
    return {
        "gains": where_printed(python="gains", shell="--fixed-gains"),
        "effort_limit": where_printed(python="effort_limit", shell="the effort limits"),
        "number": where_printed(python="the number of starts", shell="--starts"),
        "law": where_printed(python="the controller", shell="the law that it begins with, --controller or --bandwidth"),
        "references": where_printed(python="references", shell="--frequencies"),
        "starts": where_printed(python="the starts or the disturbance", shell="--start-error"),
        "costs": where_printed(python="cost, regulariser or the model of the plant", shell="--cost"),
    }.get(name, name)


def _hash(*parts: bytes | np.ndarray | torch.Tensor) -> str:
    digest = hashlib.sha256()
    for part in parts:
        digest.update(part if isinstance(part, bytes) else np.ascontiguousarray(part).tobytes())
    return digest.hexdigest()
