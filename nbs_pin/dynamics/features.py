"""What a network sees of a configuration: sine and cosine of joints that turn, the position of joints that slide."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import nn

from nbs_pin.base.arrays import Vectors
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.known_code import known_code


@known_code
class JointFeatures(nn.Module):
    """x(q) = (sin q_r, cos q_r, q_p) for the revolute joints r and the prismatic joints p, with its derivative.

    So a network of x has period 2π in every angle; on three links this alone divides its error by four
    (docs/theory.md §6). prismatic: for every joint whether it slides. Raises ArgumentError for no joints.
    """

    prismatic: torch.Tensor
    _joints: torch.Tensor
    _order: torch.Tensor

    def __init__(self, prismatic: Sequence[bool]) -> None:
        super().__init__()
        slides = torch.tensor([bool(x) for x in prismatic])
        if not len(slides):
            raise ArgumentError("prismatic is empty; give a truth value for every joint, at least one.")
        self.register_buffer("prismatic", slides)
        # Joints in the order of the features, and the place of every joint in that order.
        self.register_buffer("_joints", torch.argsort(slides.long(), stable=True), persistent=False)
        self.register_buffer("_order", torch.argsort(self._joints), persistent=False)
        self.turning = int((~slides).sum())

    @property
    def nv(self) -> int:
        """Number of joints."""
        return len(self.prismatic)

    @property
    def order(self) -> np.ndarray:
        """Joints in the order of the features: those that turn, then those that slide."""
        return self._joints.numpy(force=True)

    @property
    def size(self) -> int:
        """Number of features."""
        return self.nv + self.turning

    def forward(self, q: Vectors) -> Float[torch.Tensor, "*batch m"]:
        """x(q)."""
        angles, positions = self._split(q)
        return torch.cat([torch.sin(angles), torch.cos(angles), positions], dim=-1)

    def push(self, x: Float[torch.Tensor, "*batch m"], dq: Vectors) -> Float[torch.Tensor, "*batch m"]:
        """ẋ = ∂x/∂q q̇ at the features x."""
        sine, cosine = self._waves(x)
        angles, positions = self._split(dq)
        return torch.cat([cosine * angles, -sine * angles, positions], dim=-1)

    def pull(self, x: Float[torch.Tensor, "*batch m"], gradient: Float[torch.Tensor, "*batch m"]) -> Vectors:
        """(∂x/∂q)ᵀ of a gradient in the features x."""
        (sine, cosine), r = self._waves(x), self.turning
        angles = cosine * gradient[..., :r] - sine * gradient[..., r : 2 * r]
        return torch.cat([angles, gradient[..., 2 * r :]], dim=-1)[..., self._order]

    def _split(self, q: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        ordered = q[..., self._joints]
        return ordered[..., : self.turning], ordered[..., self.turning :]

    def _waves(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return x[..., : self.turning], x[..., self.turning : 2 * self.turning]
