"""Input features of the networks: sine and cosine of revolute joints, the position of prismatic joints."""

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
    """x(q) = (sin q_r, cos q_r, q_p) for revolute joints r and prismatic joints p, and ∂x/∂q (docs/theory.md §6).

    Raises:
        ArgumentError: If there are no joints.
    """

    prismatic: torch.Tensor
    _joints: torch.Tensor
    _order: torch.Tensor

    def __init__(self, prismatic: Sequence[bool]) -> None:
        super().__init__()
        slides = torch.tensor([bool(x) for x in prismatic])
        if not len(slides):
            raise ArgumentError("prismatic is empty; give one truth value per joint, at least one.")
        self.register_buffer("prismatic", slides)
        # Joints in the order of the features, and the index of every joint in that order.
        self.register_buffer("_joints", torch.argsort(slides.long(), stable=True), persistent=False)
        self.register_buffer("_order", torch.argsort(self._joints), persistent=False)
        self.turning = int((~slides).sum())

    @property
    def nv(self) -> int:
        """Number of joints."""
        return len(self.prismatic)

    @property
    def order(self) -> np.ndarray:
        """Joints in the order of the features: revolute, then prismatic."""
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
        """(∂x/∂q)ᵀ times a gradient in the features x."""
        (sine, cosine), r = self._waves(x), self.turning
        angles = cosine * gradient[..., :r] - sine * gradient[..., r : 2 * r]
        return torch.cat([angles, gradient[..., 2 * r :]], dim=-1)[..., self._order]

    def _split(self, q: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        ordered = q[..., self._joints]
        return ordered[..., : self.turning], ordered[..., self.turning :]

    def _waves(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return x[..., : self.turning], x[..., self.turning : 2 * self.turning]
