"""The Lagrangian networks by name."""

from collections.abc import Callable, Sequence
from typing import Any

from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.dynamics.cholesky import CholeskyNetwork
from nbs_pin.dynamics.lagrangian_network import LagrangianNetwork
from nbs_pin.dynamics.picnn import HomogenisedPicnn, PaperPicnn
from nbs_pin.dynamics.unconstrained import UnconstrainedLagrangian

_FAMILIES: dict[str, Callable[..., LagrangianNetwork]] = {
    "cholesky": CholeskyNetwork,
    "homogenised": HomogenisedPicnn,
    "picnn": PaperPicnn,
    "unconstrained": UnconstrainedLagrangian,
}
NETWORKS = tuple(_FAMILIES)
"""Names that `make_network` knows."""


def make_network(name: str, prismatic: Sequence[bool], seed: int = 0, **options: Any) -> LagrangianNetwork:
    """An untrained network of that family for joints that slide where `prismatic` says so.

    options: widths, epsilon, inertia and energy, as in `CholeskyNetwork`. Raises ArgumentError for an unknown name.
    """
    if name not in _FAMILIES:
        raise ArgumentError(f"network '{name}' is unknown; choose one of {', '.join(NETWORKS)}.")
    return _FAMILIES[name](prismatic, seed=seed, **options)
