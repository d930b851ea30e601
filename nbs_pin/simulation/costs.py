"""What a motion costs per second: small functions of the error, its rate and the torque asked for."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, TypeAlias, get_args

import torch
from jaxtyping import Float

from nbs_pin.base.arrays import Scalars, Vectors
from nbs_pin.base.checks import positive
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.robots.robot import Robot

StageCost: TypeAlias = Callable[[Vectors, Vectors, Vectors], Scalars]
"""l(z1, v − v_d, τ) [1/s]: error [rad] and its rate [rad/s] at the end of a control period, and the torque that the
law asked for during it [N·m], before any limit. Differentiable; anything callable will do."""


def squared_error(z1: Vectors, dz1: Vectors, tau: Vectors) -> Scalars:
    """z1ᵀz1, the paper's: torque is free, and training buys its last tenth of a second with it (docs/theory.md §7)."""
    return (z1 * z1).sum(-1)


@dataclass(frozen=True, eq=False)
class TorqueAware:
    """z1ᵀz1 + rate²·ż1ᵀż1 + excess·Σ max(|τ_i|/limit_i − 1, 0)² + effort·Σ (τ_i/limit_i)².

    limit: torque per joint [N·m], a number or (n,); where it is inf the torque is free. rate [s]: how far ahead an
    error counts. excess, effort [rad²]: the price of asking for more than the limit, and of torque as such. What
    exceeds a limit is never applied and so has no gradient of its own: `excess` gives it one.
    Raises ArgumentError for numbers out of range.
    """

    limit: Float[torch.Tensor, " n"]
    rate: float = 0.02
    excess: float = 1e-2
    effort: float = 1e-4

    def __post_init__(self) -> None:
        for name in ("rate", "excess", "effort"):
            if getattr(self, name) != 0.0:
                positive(f"TorqueAware's {name}", getattr(self, name), "")
        limit = torch.as_tensor(self.limit, dtype=torch.float64)
        if not bool((limit > 0.0).all()):
            raise ArgumentError(f"TorqueAware's limit is {limit.tolist()}, expected torques > 0 [N·m]; inf means none.")
        object.__setattr__(self, "limit", limit)

    @classmethod
    def for_robot(cls, robot: Robot) -> "TorqueAware":
        """With the arm's effort limits."""
        return cls(torch.as_tensor(robot.effort_limit))

    def __call__(self, z1: Vectors, dz1: Vectors, tau: Vectors) -> Scalars:
        """The cost per second."""
        share = tau / self.limit.to(tau.device)
        beyond = torch.clamp(share.abs() - 1.0, min=0.0)
        price = z1 * z1 + self.rate**2 * dz1 * dz1 + self.excess * beyond * beyond + self.effort * share * share
        return price.sum(-1)


@dataclass(frozen=True)
class TimeOutside:
    """‖z1‖²/(‖z1‖² + threshold) + pull·‖z1‖²: about 1 outside the ball and 0 inside, so its integral is nearly a time.

    threshold [rad²]: 0.01 is the paper's mark of convergence. pull [1/rad²]: what far errors, whose first term is flat,
    still feel. Raises ArgumentError for numbers out of range.
    """

    threshold: float = 0.01
    pull: float = 0.1

    def __post_init__(self) -> None:
        positive("TimeOutside's threshold", self.threshold, "rad²")
        if self.pull != 0.0:
            positive("TimeOutside's pull", self.pull, "1/rad²")

    def __call__(self, z1: Vectors, dz1: Vectors, tau: Vectors) -> Scalars:
        """The cost per second."""
        squared = (z1 * z1).sum(-1)
        return squared / (squared + self.threshold) + self.pull * squared


CostName: TypeAlias = Literal["torque-aware", "squared-error", "time-outside"]
"""What `stage_cost` knows."""


def stage_cost(name: str, robot: Robot) -> StageCost:
    """The stage cost of that name, with the arm's effort limits; raises ArgumentError for an unknown name."""
    known: dict[str, StageCost] = {
        "torque-aware": TorqueAware.for_robot(robot),
        "squared-error": squared_error,
        "time-outside": TimeOutside(),
    }
    if name not in known:
        raise ArgumentError(f"cost '{name}' is unknown; choose one of {', '.join(get_args(CostName))}.")
    return known[name]
