"""Stage costs: the cost per second as a function of the error, its rate and the commanded torque."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, TypeAlias, get_args

import numpy as np
import torch
from jaxtyping import Float

from nbs_pin.base.arguments import check_fields, checked, joints, number
from nbs_pin.base.arrays import Scalars, Vectors
from nbs_pin.base.checks import floats, told
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.robots.robot import ARM, Robot

StageCost: TypeAlias = Callable[[Vectors, Vectors, Vectors], Scalars]
"""l(z1, v − v_d, τ) [1/s]: error [rad] and its rate [rad/s] at the end of a control period, and the torque commanded
during it [N·m], before the effort limits. Any differentiable callable is accepted."""


def squared_error(z1: Vectors, dz1: Vectors, tau: Vectors) -> Scalars:
    """z1ᵀz1, the paper's cost: torque is free, so training uses much of it (docs/theory.md §7).

    Example:
        >>> import torch
        >>> import nbs_pin as nbs
        >>> nbs.squared_error(torch.tensor([0.3, 0.4]), torch.zeros(2), torch.zeros(2))
        tensor(0.2500)
    """
    z1 = z1 if isinstance(z1, torch.Tensor) else floats("z1", z1)
    if z1.ndim == 0:
        raise ArgumentError(f"z1 is {told(z1)}, expected errors (..., n) [rad]; give one number per joint.")
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

    Example:
        >>> import torch
        >>> import nbs_pin as nbs
        >>> cost = nbs.TorqueAware.for_robot(nbs.load_robot("two_link"))  # 100 N·m
        >>> inside, beyond = (cost(torch.zeros(2), torch.zeros(2), torch.tensor([x, 0.0])) for x in (50.0, 150.0))
        >>> bool(beyond > inside)
        True
    """

    limit: Float[torch.Tensor, " n"]
    rate: float = 0.02
    excess: float = 1e-2
    effort: float = 1e-4

    def __post_init__(self) -> None:
        share = number(least=0.0)
        check_fields(self, rate=share, excess=share, effort=share, limit=joints(above=0.0, unit="N·m", infinite=True))
        object.__setattr__(self, "limit", torch.from_numpy(np.array(self.limit)))

    @classmethod
    @checked(robot=ARM)
    def for_robot(cls, robot: Robot) -> "TorqueAware":
        """The cost with the effort limits of the arm."""
        return cls(torch.as_tensor(robot.effort_limit))

    def __call__(self, z1: Vectors, dz1: Vectors, tau: Vectors) -> Scalars:
        """The cost per second."""
        _check_tensors(z1=z1, dz1=dz1, tau=tau)
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

    Example:
        >>> import torch
        >>> import nbs_pin as nbs
        >>> cost = nbs.TimeOutside(threshold=0.01, pull=0.0)
        >>> [round(float(cost(torch.tensor([x]), torch.zeros(1), torch.zeros(1))), 2) for x in (1.0, 0.1, 0.0)]
        [0.99, 0.5, 0.0]
    """

    threshold: float = 0.01
    pull: float = 0.1

    def __post_init__(self) -> None:
        check_fields(self, threshold=number(above=0.0, unit="rad²"), pull=number(least=0.0, unit="1/rad²"))

    def __call__(self, z1: Vectors, dz1: Vectors, tau: Vectors) -> Scalars:
        """The cost per second."""
        _check_tensors(z1=z1)
        squared = (z1 * z1).sum(-1)
        return squared / (squared + self.threshold) + self.pull * squared


def _check_tensors(**vectors: Vectors) -> None:
    """Raise ArgumentError unless all are tensors of real numbers (..., n) of one shape."""
    shapes = {getattr(x, "shape", None) for x in vectors.values()}
    for name, x in vectors.items():
        if (
            not isinstance(x, torch.Tensor)
            or not x.is_floating_point()
            or x.ndim == 0
            or len(shapes) > 1
            or x.is_sparse
        ):
            raise ArgumentError(
                f"{name} is {told(x)}, expected tensors (..., n) of one shape for {', '.join(vectors)}; give such."
            )


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
