"""Registry of models: network families for `fit`, and the classes that a model file may contain."""

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
"""Network families by name; all take the arguments of `CholeskyNetwork`."""
PROVIDERS: dict[str, Entry] = {
    "pinocchio": Entry(f"{_DYNAMICS}.pinocchio:PinocchioDynamics"),
    "analytic": Entry(f"{_DYNAMICS}.analytic:AnalyticDynamics"),
    "identified": Entry(f"{_DYNAMICS}.identified:IdentifiedDynamics"),
    "coupled": Entry(f"{_DYNAMICS}.coupled:CoupledDynamics"),
    "lagrangian": Entry(f"{_DYNAMICS}.lagrangian:LagrangianDynamics"),
    "residual": Entry(f"{_DYNAMICS}.residual:ResidualDynamics"),
    "chain": Entry(f"{_DYNAMICS}.chain:Chain"),
    "rotors": Entry(f"{_DYNAMICS}.coupled_network:CoupledNetwork"),
}
"""Model classes by name, and the networks that `fit` trains by a method of its own."""


def make_network(name: str, prismatic: Sequence[bool], seed: int = 0, **options: Any) -> "LagrangianNetwork":
    """An untrained network of `NETWORKS`, with the arguments of `CholeskyNetwork`.

    Raises:
        ArgumentError: If the name is unknown or an argument is invalid.
    """
    network: LagrangianNetwork = entry("network", name, NETWORKS).make(prismatic, seed=seed, **options)
    return network
