"""Optimisers by name, their learning rate schedules, and their state as tensors and JSON values.

"adam-backtracking" is Adam that returns to the best parameters with half the step whenever the cost exceeds the lowest
by the share `RISE`; "adam" has its step halved after every fifth of the epochs, as in the paper; "lbfgs" has a strong
Wolfe line search. The cost of a sampled loop jumps where gains become too high for the period. Adam may step across
such a jump and then search on the wrong side; a line search stops in front of it (docs/theory.md §7).
"""

from collections.abc import Sequence
from typing import Any

import torch

from nbs_pin.base.checks import positive
from nbs_pin.base.exceptions import ArgumentError

LEARNING_RATES: dict[str, float] = {"adam-backtracking": 1e-2, "adam": 1e-2, "lbfgs": 1.0}
"""Default learning rates; the paper uses 1e-3 for Adam."""
RISE = 0.02
"""Share of the lowest cost by which "adam-backtracking" lets the cost rise."""
STAGES = 5


def optimiser(name: str, parameters: Sequence[torch.nn.Parameter], learning_rate: float) -> torch.optim.Optimizer:
    """The optimiser of that name; raises ArgumentError for an unknown name or a rate that is not positive."""
    positive("learning_rate", learning_rate, "")
    if name in ("adam", "adam-backtracking"):
        return torch.optim.Adam(parameters, lr=learning_rate)
    if name == "lbfgs":
        # One iteration per epoch; its line search usually needs one evaluation of the cost.
        # With torch's default tolerances it would stop at once, as costs here are of the order of 1e-3.
        return torch.optim.LBFGS(
            parameters,
            lr=learning_rate,
            max_iter=1,
            history_size=20,
            line_search_fn="strong_wolfe",
            tolerance_grad=0.0,
            tolerance_change=1e-16,
        )
    raise ArgumentError(f"optimiser '{name}' is unknown; choose one of {', '.join(LEARNING_RATES)}.")


def scheduled_rate(name: str, learning_rate: float, epoch: int, epochs: int) -> float:
    """Learning rate at an epoch; for "adam" halved after every fifth of the epochs (the paper: every 40 of 200)."""
    return learning_rate * 0.5 ** (epoch * STAGES // epochs) if name == "adam" else learning_rate


def packed_state(state: Any, tensors: dict[str, torch.Tensor], path: str = "optimiser") -> Any:
    """The nested state of an optimiser as JSON values, with its tensors moved into `tensors` under their paths."""
    if isinstance(state, torch.Tensor):
        tensors[path] = state.detach().clone()
        return {"tensor": path}
    if isinstance(state, dict):
        return {"dict": [[key, packed_state(value, tensors, f"{path}.{key}")] for key, value in state.items()]}
    if isinstance(state, list | tuple):
        return {"list": [packed_state(value, tensors, f"{path}.{k}") for k, value in enumerate(state)]}
    return {"plain": state}


def unpacked_state(packed: Any, tensors: dict[str, torch.Tensor]) -> Any:
    """The inverse of `packed_state`."""
    ((kind, content),) = packed.items()
    if kind == "tensor":
        return tensors[content].clone()
    if kind == "dict":
        return {key: unpacked_state(value, tensors) for key, value in content}
    if kind == "list":
        return [unpacked_state(value, tensors) for value in content]
    return content
