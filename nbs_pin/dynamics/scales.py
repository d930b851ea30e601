"""Units of the network outputs in kg·m² and J."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import nn

from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.known_code import known_code
from nbs_pin.base.storable import Tensors
from nbs_pin.base.tensors import positive_scale


@known_code
class Scales(nn.Module):
    """T̂ = T(q, Rv) + ½ε‖v‖² and V̂ = e V(q), with network outputs T and V of order one.

    Args:
        epsilon: ε [kg·m²], a lower bound of the eigenvalues of M̂.
        inertia: R², (n,) [kg·m²], for instance the standard deviation of τ over that of v̇; None is 1.
        energy: e [J].

    Raises:
        ArgumentError: If a number is not positive and finite.
    """

    root: torch.Tensor
    epsilon: torch.Tensor
    energy: torch.Tensor

    def __init__(self, nv: int, epsilon: float, inertia: Sequence[float] | None, energy: float) -> None:
        super().__init__()
        given = None if inertia is None else np.array(inertia, dtype=float)
        self.register_buffer("inertia", positive_scale("the scale of the inertia", given, nv))
        self.register_buffer("root", self.inertia.sqrt(), persistent=False)
        for name, value in (("epsilon", epsilon), ("energy", energy)):
            if not 0.0 < value < float("inf"):
                raise ArgumentError(f"{name} is {value}; give a finite number > 0.")
            self.register_buffer(name, torch.tensor(value, dtype=torch.float64))

    inertia: torch.Tensor

    @property
    def floor(self) -> torch.Tensor:
        """εI (n, n)."""
        return self.epsilon * torch.eye(len(self.root), dtype=self.root.dtype, device=self.root.device)


def stored_scales(t: Tensors) -> Mapping[str, Any]:
    """Constructor arguments of a network that are read from its tensors (`base/storable.py`)."""
    numbers = {name: float(t[f"scales.{name}"]) for name in ("epsilon", "energy")}
    return numbers | {"prismatic": t["features.prismatic"].tolist(), "inertia": t["scales.inertia"].tolist()}
