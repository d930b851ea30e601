"""Stage costs: the cost per second as a function of the error, its rate and the commanded torque."""

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
"""l(z1, v − v_d, τ) [1/s]: error [rad] and its rate [rad/s] at the end of a control period, and the torque commanded
during it [N·m], before the effort limits. Any differentiable callable is accepted."""


def squared_error(z1: Vectors, dz1: Vectors, tau: Vectors) -> Scalars:
    """z1ᵀz1, the paper's cost: torque is free, so training uses much of it (docs/theory.md §7)."""
    return (z1 * z1).sum(-1)


@dataclass(frozen=True, eq=False)
class TorqueAware:
    """z1ᵀz1 + rate²·ż1ᵀż1 + excess·Σ max(|τ_i|/limit_i − 1, 0)² + effort·Σ (τ_i/limit_i)².

    Args:
        limit: Effort limit per joint [N·m], a number or (n,); torque costs nothing where it is inf.
        rate: Weight of the error rate, as a time [s].
        excess: Weight of commands above the limit [rad²]; the part above is not applied and has no other gradient.
        effort: Weight of the torque [rad²].

    Raises:
        ArgumentError: If a number is out of range.
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
        """The cost with the effort limits of the arm."""
        return cls(torch.as_tensor(robot.effort_limit))

    def __call__(self, z1: Vectors, dz1: Vectors, tau: Vectors) -> Scalars:
        """The cost per second."""
        share = tau / self.limit.to(tau.device)
        beyond = torch.clamp(share.abs() - 1.0, min=0.0)
        price = z1 * z1 + self.rate**2 * dz1 * dz1 + self.excess * beyond * beyond + self.effort * share * share
        return price.sum(-1)


@dataclass(frozen=True)
class TimeOutside:
    """‖z1‖²/(‖z1‖² + threshold) + pull·‖z1‖², about 1 outside the ball and 0 inside: its integral is nearly a time.

    Args:
        threshold: Squared radius of the ball [rad²]; 0.01 is the paper's criterion of convergence.
        pull: Weight of ‖z1‖² [1/rad²], a gradient for large errors, where the first term is flat.

    Raises:
        ArgumentError: If a number is out of range.
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
"""Names of the costs in `stage_cost`."""


def stage_cost(name: str, robot: Robot) -> StageCost:
    """The stage cost of that name with the arm's effort limits; raises ArgumentError for an unknown name."""
    known: dict[str, StageCost] = {
        "torque-aware": TorqueAware.for_robot(robot),
        "squared-error": squared_error,
        "time-outside": TimeOutside(),
    }
    if name not in known:
        raise ArgumentError(f"cost '{name}' is unknown; choose one of {', '.join(get_args(CostName))}.")
    return known[name]
