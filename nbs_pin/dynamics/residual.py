"""A nominal model with learned corrections of its inertia and potential energy."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import nn

from nbs_pin.base.arguments import a
from nbs_pin.base.arrays import Matrices, Scalars, Vectors, matvec
from nbs_pin.base.claims import Claim, refuse
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.known_code import foreign_code, known_code
from nbs_pin.base.storable import Tensors, storable
from nbs_pin.dynamics.cholesky import CholeskyNetwork
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.dynamics.lagrangian import LagrangianDynamics
from nbs_pin.dynamics.lagrangian_network import Tensor
from nbs_pin.dynamics.provider import DynamicsProvider
from nbs_pin.dynamics.scales import stored_scales
from nbs_pin.dynamics.structure import ModelClaims, quadratic


class Terms(NamedTuple):
    """Inertia, its derivatives and gravity at q, with leading batch axes."""

    mass: Tensor
    """M (..., n, n) [kg·m²]."""
    rates: Tensor
    """∂M/∂q_k (..., n, n, n), k first."""
    gravity: Tensor
    """G (..., n) [N·m]."""


def _stored(t: Tensors) -> Mapping[str, Any]:
    return {name: x for name, x in stored_scales(t).items() if name != "epsilon"}


@known_code
@storable(("share", "widths"), parts=("nominal",), arrays=_stored, sequence=tuple)
class ResidualNetwork(CholeskyNetwork):
    """M̂ = κM + (1 − κ)FFᵀ with F = chol M(q) + R ΔL(q), and V̂ = V + ΔV(q), for M and V of a nominal model.

    M̂ ⪰ κM ≻ 0 for every parameter value, every M̂ ≻ κM can be represented, and the untrained network, with ΔL = 0 and
    ΔV = 0, equals the nominal model. It is differentiable once in q where the nominal model is.

    Args:
        prismatic: Whether each joint is prismatic; None takes those of `nominal.robot`, or only revolute joints.
        share: κ.
        inertia: As in `CholeskyNetwork`; None is the diagonal of the nominal M at q = 0.
        energy: As in `CholeskyNetwork`; None is the largest nominal gravity torque at q = 0.

    Raises:
        ArgumentError: If share is outside (0, 1) or prismatic has a wrong number of joints.
    """

    fit_widths = (24, 24)

    def __init__(
        self,
        nominal: DynamicsProvider,
        prismatic: Sequence[bool] | None = None,
        *,
        share: float = 0.01,
        widths: Sequence[int] = (64, 64),
        inertia: Sequence[float] | None = None,
        energy: float | None = None,
        seed: int = 0,
    ) -> None:
        if not 0.0 < share < 1.0:
            raise ArgumentError(f"share is {share}; give a number between 0 and 1, the share of M that M̂ keeps.")
        slides = _slides(nominal) if prismatic is None else list(prismatic)
        if len(slides) != nominal.nv:
            raise ArgumentError(f"prismatic has {len(slides)} values, expected {nominal.nv}; give one per joint.")
        home = np.zeros(nominal.nv)
        given = np.diagonal(nominal.mass_matrix(home)).tolist() if inertia is None else inertia
        unit = float(np.abs(nominal.gravity(home)).max()) or 1.0
        super().__init__(slides, widths=widths, inertia=given, energy=unit if energy is None else energy, seed=seed)
        self.nominal, self.share = nominal, share
        for weight in self.network.layers()[-1]:
            nn.init.zeros_(weight)

    def terms(self, q: Vectors, nominal: Terms | None = None) -> Terms:
        """M̂, ∂M̂/∂q and Ĝ; `nominal` takes `nominal_terms` of the same q computed before."""
        given = nominal_terms(self.nominal, q) if nominal is None else nominal
        factor = torch.linalg.cholesky(given.mass)
        x = self.features(q)
        unit = torch.eye(self.nv, dtype=q.dtype, device=q.device)
        output, along, _ = self.network.push(x, [self.features.push(x, e.expand(q.shape)) for e in unit])
        rates = _factor_rates(factor, given.rates) + self._correction(torch.stack(along, dim=-2))
        factor = factor + self._correction(output)
        product = rates @ factor[..., None, :, :].mT
        gravity = given.gravity + self.scales.energy * torch.stack([o[..., -1] for o in along], dim=-1)
        mixed = self.share * given.rates + (1.0 - self.share) * (product + product.mT)
        return Terms(self._mixed(given.mass, factor), mixed, gravity)

    def mass_matrix(self, q: Vectors) -> Matrices:
        """M̂(q) [kg·m²]."""
        mass = self.nominal.mass_matrix(q)
        return self._mixed(mass, torch.linalg.cholesky(mass) + self._correction(self.network(self.features(q))))

    def mass_rates(self, q: Vectors) -> Float[Tensor, "n *batch n n"]:
        """∂M̂/∂q_k, with k as the first axis."""
        return self.terms(q).rates.movedim(-3, 0)

    def potential(self, q: Vectors) -> Scalars:
        """V̂(q) [J]."""
        return self.nominal.potential_energy(q) + super().potential(q)

    def gravity(self, q: Vectors) -> Vectors:
        """Ĝ(q) [N·m]."""
        return self.terms(q).gravity

    def torque(self, q: Vectors, v: Vectors, w: Vectors, a: Vectors, nominal: Terms | None = None) -> Vectors:
        """M̂ a + Ĉ(q, v) w + Ĝ [N·m]; `nominal` as in `terms`, which saves most of the time in training."""
        mass, rates, gravity = self.terms(q, nominal)
        along_v, along_w = (torch.einsum("...kij,...k->...ij", rates, x) for x in (v, w))
        slope = torch.einsum("...kij,...i,...j->...k", rates, v, w)
        return matvec(mass, a) + 0.5 * (matvec(along_v, w) + matvec(along_w, v) - slope) + gravity

    def structure_claims(self) -> ModelClaims | None:
        """M̂ ⪰ κM with the nominal model's claim about M; raises CertificateRefused if κ is outside (0, 1)."""
        if not 0.0 < self.share < 1.0:
            refuse(f"the residual keeps a share κ = {self.share} of M", "κ must lie in (0, 1) for M̂ ⪰ κM ≻ 0")
        inner = None if foreign_code(self.nominal) else self.nominal.structure_claims()
        if inner is None or not np.isfinite(inner.skew.value):
            return None
        m = inner.positive
        because = f"M̂ ⪰ κM with κ = {self.share:g}, and for the nominal model: {m.because}"
        return quadratic(Claim(m.name, self.share * m.value, m.unit, m.label, because))

    def _correction(self, output: Tensor) -> Tensor:
        """R ΔL."""
        return self.scales.root[:, None] * self._factor(output)

    def _mixed(self, mass: Tensor, factor: Tensor) -> Tensor:
        return self.share * mass + (1.0 - self.share) * factor @ factor.mT


NETWORK = a(ResidualNetwork, "a ResidualNetwork")


@known_code
@storable(("report",), parts=("network", "friction"))
class ResidualDynamics(LagrangianDynamics):
    """A nominal model corrected by a `ResidualNetwork`, which is copied and frozen with its nominal model.

    Arguments and errors as in `LagrangianDynamics`.

    Example:
        >>> import nbs_pin as nbs
        >>> robot = nbs.load_robot("two_link")
        >>> data = nbs.collect(robot, "uniform", samples=50)
        >>> nbs.fit(data, "residual", robot=robot, iterations=2).nominal.robot.name
        'two_link'
    """

    def __init__(self, network: ResidualNetwork, friction: JointFriction | None = None, report: Any = None) -> None:
        NETWORK("ResidualDynamics: network", network)
        super().__init__(network, network.nominal.robot, friction, report)

    @property
    def nominal(self) -> DynamicsProvider:
        """The model that is corrected."""
        nominal: Any = self.network.nominal
        return nominal


def nominal_terms(dynamics: DynamicsProvider, q: Vectors) -> Terms:
    """M, ∂M/∂q and G of any model, with ∂M/∂q_k = C(q, e_k) + C(q, e_k)ᵀ because Ṁ − 2C is skew."""
    unit = torch.eye(dynamics.nv, dtype=q.dtype, device=q.device)
    coriolis = torch.stack([dynamics.coriolis_matrix(q, e.expand(q.shape)) for e in unit], dim=-3)
    return Terms(dynamics.mass_matrix(q), coriolis + coriolis.mT, dynamics.gravity(q))


def _factor_rates(factor: Tensor, rates: Tensor) -> Tensor:
    """∂L/∂q_k = L Φ(L⁻¹ ∂_kM L⁻ᵀ) of M = LLᵀ, where Φ takes the lower triangle with half the diagonal."""
    lower = factor[..., None, :, :]
    inner = torch.linalg.solve_triangular(lower, rates, upper=False)
    inner = torch.linalg.solve_triangular(lower, inner.mT, upper=False)
    return lower @ (inner.tril() - 0.5 * torch.diag_embed(inner.diagonal(dim1=-2, dim2=-1)))


def _slides(dynamics: DynamicsProvider) -> list[bool]:
    robot = dynamics.robot
    return [False] * dynamics.nv if robot is None else [bool(joint.prismatic) for joint in robot.joints]
