"""Softplus networks with the initialisation of the paper's Lagrangian networks."""

from collections.abc import Sequence
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import nn

from nbs_pin.base.arrays import Scalars
from nbs_pin.base.known_code import known_code


def softplus(x: Float[torch.Tensor, "*shape"]) -> Float[torch.Tensor, "*shape"]:
    """log(1 + eˣ), accurate for all x together with its derivatives; torch's default replaces it by x above 20."""
    return nn.functional.softplus(x, threshold=40.0)  # above 40 the difference is below rounding


def paper_spread(layer: int, sizes: Sequence[int]) -> float:
    """ν of a layer's initial parameters N(0, ν²): √n ν is 2.2 in the first layer, 0.58 i in layer i, n in the last.

    `sizes` are the numbers n of neurons of all layers, without the input, and i is 0 in the first layer.
    Source: paper, section II-B, after Cranmer et al. 2020.
    """
    n, last = sizes[layer], layer == len(sizes) - 1
    return (n if last else 0.58 * layer if layer else 2.2) / n**0.5


@known_code
class SoftplusNetwork(nn.Module):
    """Scalar network with softplus hidden layers and a linear output, in float64.

    `generator` draws the initial weights and biases from N(0, ν²) (`paper_spread`).
    """

    def __init__(self, inputs: int, widths: Sequence[int], generator: torch.Generator) -> None:
        super().__init__()
        sizes = (*widths, 1)
        self.depth = len(sizes)
        for i, (size, out) in enumerate(pairwise((inputs, *sizes))):
            spread = paper_spread(i, sizes)
            for name, shape in ((f"w{i}", (out, size)), (f"b{i}", (out,))):
                start = spread * torch.randn(shape, dtype=torch.float64, generator=generator)
                self.register_parameter(name, nn.Parameter(start))

    @property
    def widths(self) -> tuple[int, ...]:
        """Sizes of the hidden layers."""
        return tuple(len(getattr(self, f"b{i}")) for i in range(self.depth - 1))

    def forward(self, x: Float[torch.Tensor, "*batch m"]) -> Scalars:
        """The value at x."""
        for i in range(self.depth):
            x = nn.functional.linear(x, getattr(self, f"w{i}"), getattr(self, f"b{i}"))
            x = softplus(x) if i < self.depth - 1 else x
        return x[..., 0]
