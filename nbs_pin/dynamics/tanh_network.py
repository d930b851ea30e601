"""Tanh networks with explicit tangents and gradients, so that training needs a single reverse pass."""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import TypeAlias

import torch
from jaxtyping import Float
from torch import nn

from nbs_pin.base.known_code import known_code

Tape: TypeAlias = list[torch.Tensor]
"""Slopes of the hidden layers, for `pull`."""


@known_code
class TanhNetwork(nn.Module):
    """Network with tanh hidden layers and a linear output; float64 parameters w0, b0, w1, b1 and so on.

    `sizes` are those of input, hidden layers and output. `generator` draws the initial weights of a layer from
    N(0, 1/inputs), those of the output layer a tenth as large; biases are zero.
    """

    def __init__(self, sizes: Sequence[int], generator: torch.Generator) -> None:
        super().__init__()
        self.depth = len(sizes) - 1
        for i, (size, out) in enumerate(pairwise(sizes)):
            spread = (0.1 if i == self.depth - 1 else 1.0) / math.sqrt(size)
            weight = spread * torch.randn(out, size, dtype=torch.float64, generator=generator)
            self.register_parameter(f"w{i}", nn.Parameter(weight))
            self.register_parameter(f"b{i}", nn.Parameter(torch.zeros(out, dtype=torch.float64)))

    def layers(self) -> list[tuple[torch.Tensor, torch.Tensor]]:
        """Weights and biases, input to output."""
        named = {name: p for name, p in self._parameters.items() if p is not None}
        return [(named[f"w{i}"], named[f"b{i}"]) for i in range(self.depth)]

    def forward(self, x: Float[torch.Tensor, "*batch m"]) -> Float[torch.Tensor, "*batch k"]:
        """The output at x."""
        *hidden, (weight, bias) = self.layers()
        for w, b in hidden:
            x = torch.tanh(nn.functional.linear(x, w, b))
        return nn.functional.linear(x, weight, bias)

    def push(
        self, x: Float[torch.Tensor, "*batch m"], tangents: Sequence[Float[torch.Tensor, "*batch m"]]
    ) -> tuple[Float[torch.Tensor, "*batch k"], list[Float[torch.Tensor, "*batch k"]], Tape]:
        """The output at x, its derivatives along the tangents, and the tape for `pull`."""
        *hidden, (weight, bias) = self.layers()
        slopes = []
        for w, b in hidden:
            x = torch.tanh(nn.functional.linear(x, w, b))
            slopes.append(1.0 - x * x)
            tangents = [slopes[-1] * nn.functional.linear(dx, w) for dx in tangents]
        return nn.functional.linear(x, weight, bias), [nn.functional.linear(dx, weight) for dx in tangents], slopes

    def pull(self, tape: Tape, gradient: Float[torch.Tensor, "*batch k"]) -> Float[torch.Tensor, "*batch m"]:
        """The gradient in the input for a gradient in the output, with the tape of `push`."""
        *hidden, (weight, _) = self.layers()
        gradient = gradient @ weight
        for (w, _), slope in zip(reversed(hidden), reversed(tape), strict=True):
            gradient = (slope * gradient) @ w
        return gradient
