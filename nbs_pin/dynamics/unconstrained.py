"""A Lagrangian network without structure, as a baseline: its inertia need not be positive definite."""

from collections.abc import Sequence

import torch

from nbs_pin.base.arrays import Scalars, Vectors
from nbs_pin.base.claims import refuse
from nbs_pin.base.known_code import known_code
from nbs_pin.base.storable import storable
from nbs_pin.dynamics.features import JointFeatures
from nbs_pin.dynamics.lagrangian_network import GeneralLagrangianNetwork
from nbs_pin.dynamics.scales import Scales, stored_scales
from nbs_pin.dynamics.softplus_network import SoftplusNetwork
from nbs_pin.dynamics.structure import ModelClaims


@known_code
@storable(("widths",), arrays=stored_scales, sequence=tuple)
class UnconstrainedLagrangian(GeneralLagrangianNetwork):
    """L(q, v) = e f(x(q), Rv) + ½ε‖v‖² with one softplus network f; ∂²L/∂v² may be indefinite or singular.

    Source: Cranmer et al. 2020, "Lagrangian Neural Networks", with sine and cosine of angles, and the initialisation of
    the paper (`paper_spread`). Arguments and errors as in `CholeskyNetwork`.
    """

    fit_widths = (32, 32)

    def __init__(
        self,
        prismatic: Sequence[bool],
        *,
        widths: Sequence[int] = (64, 64),
        epsilon: float = 1e-6,
        inertia: Sequence[float] | None = None,
        energy: float = 1.0,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.features = JointFeatures(prismatic)
        self.nv = self.features.nv
        self.scales = Scales(self.nv, epsilon, inertia, energy)
        self.network = SoftplusNetwork(self.features.size + self.nv, widths, torch.Generator().manual_seed(seed))

    @property
    def widths(self) -> tuple[int, ...]:
        """Sizes of the hidden layers."""
        return self.network.widths

    def lagrangian(self, q: Vectors, v: Vectors) -> Scalars:
        """L(q, v) [J]."""
        s = self.scales
        value = self.network(torch.cat([self.features(q), s.root * v], dim=-1))
        return s.energy * value + 0.5 * s.epsilon * (v * v).sum(-1)

    def structure_claims(self) -> ModelClaims:
        """Raises CertificateRefused, because ∂²L/∂v² need not be positive definite."""
        fault = "the inertia of an UnconstrainedLagrangian need not be positive definite"
        refuse(fault, "learn a 'chain', 'cholesky' or 'homogenised' model")
