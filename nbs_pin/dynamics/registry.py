"""Models by name: the networks that `fit` trains, and every class that a file of a model may name."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from nbs_pin.base.registry import Entry, entry

if TYPE_CHECKING:
    from nbs_pin.dynamics.lagrangian_network import LagrangianNetwork

_DYNAMICS = "nbs_pin.dynamics"
NETWORKS: dict[str, Entry] = {
    "cholesky": Entry(f"{_DYNAMICS}.cholesky:CholeskyNetwork"),
    "homogenised": Entry(f"{_DYNAMICS}.picnn:HomogenisedPicnn"),
    "picnn": Entry(f"{_DYNAMICS}.picnn:PaperPicnn"),
    "unconstrained": Entry(f"{_DYNAMICS}.unconstrained:UnconstrainedLagrangian"),
}
"""Network families by name, with the constructor of `CholeskyNetwork`."""
PROVIDERS: dict[str, Entry] = {
    "pinocchio": Entry(f"{_DYNAMICS}.pinocchio:PinocchioDynamics"),
    "analytic": Entry(f"{_DYNAMICS}.analytic:AnalyticDynamics"),
    "identified": Entry(f"{_DYNAMICS}.identified:IdentifiedDynamics"),
    "lagrangian": Entry(f"{_DYNAMICS}.lagrangian:LagrangianDynamics"),
    "residual": Entry(f"{_DYNAMICS}.residual:ResidualDynamics"),
    "chain": Entry(f"{_DYNAMICS}.chain:Chain"),
}
"""Classes of models, and the rigid tree as a network, which `fit` finds by a search of its own."""


def make_network(name: str, prismatic: Sequence[bool], seed: int = 0, **options: Any) -> "LagrangianNetwork":
    """An untrained network of a family.

    Args:
        name: One of `NETWORKS`.
        prismatic: For every joint whether it slides.
        seed: Of the first parameters.
        options: widths, epsilon, inertia and energy, as in `CholeskyNetwork`.

    Raises:
        ArgumentError: For an unknown name, or numbers that the network refuses.
    """
    network: LagrangianNetwork = entry("network", name, NETWORKS).make(prismatic, seed=seed, **options)
    return network
