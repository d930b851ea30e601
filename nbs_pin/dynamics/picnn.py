"""Partially input-convex networks for the kinetic energy: that of the paper, and one with a quadratic T̂."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import nn
from torch.func import grad

from nbs_pin.base.arrays import Matrices, Scalars, Vectors
from nbs_pin.base.claims import Claim, Label
from nbs_pin.base.known_code import known_code
from nbs_pin.base.storable import storable
from nbs_pin.dynamics.features import JointFeatures
from nbs_pin.dynamics.lagrangian_network import (
    GeneralLagrangianNetwork,
    LagrangianNetwork,
    Tensor,
    along_every_joint,
    derivative,
)
from nbs_pin.dynamics.scales import Scales, stored_scales
from nbs_pin.dynamics.softplus_network import SoftplusNetwork, paper_spread, softplus
from nbs_pin.dynamics.structure import SKEW, ModelClaims, floored, quadratic
from nbs_pin.dynamics.tanh_network import TanhNetwork


@known_code
class PICNN(nn.Module):
    """f(x̃, x), convex in x for every parameter value (paper eq. (7), Amos et al. 2017).

    u_{i+1} = s(W̃ u + b̃), u_0 = x̃;
    y_{i+1} = σ(Wy⁺(y ∘ (Wyu u + by)⁺) + Wx(x ∘ (Wxu u + bx)) + Wu u + b), y_0 = 0, the scalar output linear.
    Both gate and weights of y must be ≥ 0, or f is not convex; the paper omits the ⁺ of the gate.

    Args:
        smooth: False: ⁺ clips at 0, s = σ = softplus, and the initial parameters are the paper's N(0, ν²).
            True: ⁺ is softplus for the gate and |·| for the weights, so that no neuron is dead, s = tanh, σ = softplus,
            and the initial curvature is of order one.
    """

    def __init__(
        self, context: int, inputs: int, widths: Sequence[int], generator: torch.Generator, *, smooth: bool
    ) -> None:
        super().__init__()
        self.smooth, self.depth = smooth, len(widths) + 1
        sizes, contexts = (*widths, 1), (context, *widths)
        for i, (size, seen) in enumerate(zip(sizes, contexts, strict=True)):
            shapes = {"wx": (size, inputs), "wxu": (inputs, seen), "bx": (inputs,), "wu": (size, seen), "b": (size,)}
            if i < len(widths):
                shapes |= {"wt": (size, seen), "bt": (size,)}
            if i:
                shapes |= {"wy": (size, sizes[i - 1]), "wyu": (sizes[i - 1], seen), "by": (sizes[i - 1],)}
            for name, shape in shapes.items():
                start = torch.randn(shape, dtype=torch.float64, generator=generator)
                start = self._smooth_start(name, start) if smooth else paper_spread(i, sizes) * start
                self.register_parameter(f"{name}{i}", nn.Parameter(start))

    @property
    def widths(self) -> tuple[int, ...]:
        """Sizes of the hidden layers."""
        return tuple(len(getattr(self, f"b{i}")) for i in range(self.depth - 1))

    def forward(self, context: Float[Tensor, "*batch m"], x: Vectors) -> Scalars:
        """f(x̃, x)."""
        y = x[..., :0]
        for i, u in enumerate(self._contexts(context)):
            a = self._linear("wu", i, u) + self._linear("wx", i, x * self._linear("wxu", i, u, "bx"), None)
            if i:
                a = a + nn.functional.linear(y * self._gate(i, u), self._weights(i))
            y = softplus(a) if i < self.depth - 1 else a
        return y[..., 0]

    def curvature(self, context: Float[Tensor, "*batch m"], x: Vectors) -> Scalars:
        """d²/ds² f(x̃, sx) at s = 0, by one forward pass with the derivatives ẏ and ÿ of every neuron.

        ẏ = σ'(a) ȧ and ÿ = σ''(a) ȧ² + σ'(a) ä.
        """
        y = dy = ddy = x[..., :0]
        for i, u in enumerate(self._contexts(context)):
            a, da, dda = self._linear("wu", i, u), self._linear("wx", i, x * self._linear("wxu", i, u, "bx"), None), y
            if i:
                gate, weight = self._gate(i, u), self._weights(i)
                rises = (nn.functional.linear(part * gate, weight) for part in (y, dy, ddy))
                a, da, dda = (part + rise for part, rise in zip((a, da, 0.0 * a), rises, strict=True))
            slope = torch.sigmoid(a)
            y, dy, bend = softplus(a), slope * da, slope * (1.0 - slope) * da * da
            ddy = bend + slope * dda if i else bend
        return dda[..., 0]

    def _contexts(self, u: Tensor) -> list[Tensor]:
        """Context u of every layer."""
        found = [u]
        for i in range(self.depth - 1):
            a = self._linear("wt", i, found[-1], "bt")
            found.append(torch.tanh(a) if self.smooth else softplus(a))
        return found

    def _gate(self, i: int, u: Tensor) -> Tensor:
        gate = self._linear("wyu", i, u, "by")
        return softplus(gate) if self.smooth else torch.relu(gate)

    def _weights(self, i: int) -> Tensor:
        free = getattr(self, f"wy{i}")
        return free.abs() if self.smooth else torch.relu(free)

    def _linear(self, name: str, i: int, x: Tensor, bias: str | None = "b") -> Tensor:
        shift = None if bias is None else getattr(self, f"{bias}{i}")
        return nn.functional.linear(x, getattr(self, f"{name}{i}"), shift)

    @staticmethod
    def _smooth_start(name: str, start: Tensor) -> Tensor:
        if name in ("b", "bt"):
            return 0.0 * start
        if name in ("bx", "by"):
            return 0.0 * start + 1.0
        columns = start.shape[1]
        return start / (columns if name == "wy" else 1.0 if name == "wx" else columns**0.5)


@known_code
@storable(("widths",), arrays=stored_scales, sequence=tuple)
class PaperPicnn(GeneralLagrangianNetwork):
    """The paper's L = T̂(q, v) − V̂(q): T̂ by a PICNN convex in v, V̂ by an FCNN, both with softplus.

    T̂ is not quadratic, so M̂ depends on v. Unlike in the paper, gates are clipped and ½ε‖v‖² is added: ∂²T̂/∂v² ⪰ εI
    (docs/theory.md §6). Source: paper, sections II-B and V-B. Arguments and errors as in `CholeskyNetwork`.
    """

    fit_widths = (16, 16, 16)

    def __init__(
        self,
        prismatic: Sequence[bool],
        *,
        widths: Sequence[int] = (32, 32, 32),
        epsilon: float = 1e-6,
        inertia: Sequence[float] | None = None,
        energy: float = 1.0,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.features = JointFeatures(prismatic)
        self.nv = self.features.nv
        self.scales = Scales(self.nv, epsilon, inertia, energy)
        generator = torch.Generator().manual_seed(seed)
        self.convex = PICNN(self.features.size, self.nv, widths, generator, smooth=False)
        self.network = SoftplusNetwork(self.features.size, widths, generator)

    @property
    def widths(self) -> tuple[int, ...]:
        """Sizes of the hidden layers."""
        return self.network.widths

    def lagrangian(self, q: Vectors, v: Vectors) -> Scalars:
        """T̂(q, v) − V̂(q) [J]."""
        x, s = self.features(q), self.scales
        kinetic = self.convex(x, s.root * v) + 0.5 * s.epsilon * (v * v).sum(-1)
        return kinetic - s.energy * self.network(x)

    def structure_claims(self) -> ModelClaims:
        """∂²T̂/∂v² ⪰ εI, but T̂ is not quadratic; raises CertificateRefused unless ε > 0."""
        positive = floored(float(self.scales.epsilon), "∂²T̂/∂v² of a PICNN convex in v with clipped gates, plus εI,")
        because = "T̂ is not quadratic in v, so V̇ has a term ½z2ᵀ(∂M̂/∂v v̇)z2 without a bound"
        return ModelClaims(positive, Claim(SKEW, np.inf, "", Label.EMPIRICAL, because))


@known_code
@storable(("widths",), arrays=stored_scales, sequence=tuple)
class HomogenisedPicnn(LagrangianNetwork):
    """M̂(q) = R ∂²f/∂v²(q, 0) R + εI ⪰ εI of a smooth PICNN f, and V̂ of a tanh network: T̂ is exactly quadratic.

    The paper's network with M̂ independent of v (docs/theory.md §6). Arguments and errors as in `CholeskyNetwork`.
    """

    fit_widths = (20, 20)

    def __init__(
        self,
        prismatic: Sequence[bool],
        *,
        widths: Sequence[int] = (32, 32),
        epsilon: float = 1e-6,
        inertia: Sequence[float] | None = None,
        energy: float = 1.0,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.features = JointFeatures(prismatic)
        self.nv = self.features.nv
        self.scales = Scales(self.nv, epsilon, inertia, energy)
        generator = torch.Generator().manual_seed(seed)
        self.convex = PICNN(self.features.size, self.nv, widths, generator, smooth=True)
        self.network = TanhNetwork((self.features.size, *widths, 1), generator)

    @property
    def widths(self) -> tuple[int, ...]:
        """Sizes of the hidden layers."""
        return self.convex.widths

    def kinetic(self, q: Vectors, v: Vectors) -> Scalars:
        """T̂(q, v) = ½ vᵀM̂(q)v [J], without forming M̂."""
        curvature = self.convex.curvature(self.features(q), self.scales.root * v)
        return 0.5 * (curvature + self.scales.epsilon * (v * v).sum(-1))

    def mass_matrix(self, q: Vectors) -> Matrices:
        """M̂(q) [kg·m²]."""
        return along_every_joint(lambda v: self._momentum(q.expand(v.shape), v), torch.zeros_like(q)).movedim(0, -1)

    def potential(self, q: Vectors) -> Scalars:
        """V̂(q) [J]."""
        return self.scales.energy * self.network(self.features(q))[..., 0]

    def torque(self, q: Vectors, v: Vectors, w: Vectors, a: Vectors) -> Vectors:
        """M̂ a + Ĉ(q, v) w + Ĝ [N·m] from derivatives of T̂; half the cost when w is the same object as v.

        With h(x) = Ĉ(q, x) x: Ĉ(q, v) w = h((v + w)/2) − h((v − w)/2) (docs/theory.md §1).
        """
        if w is v:
            return self._inertial(q, v, a) + self.gravity(q)
        ahead = self._inertial(q, 0.5 * (v + w), a)
        return ahead - self._inertial(q, 0.5 * (v - w), torch.zeros_like(a)) + self.gravity(q)

    def structure_claims(self) -> ModelClaims:
        """M̂ = ∂²f/∂v² + εI ⪰ εI of a convex f; raises CertificateRefused unless ε > 0."""
        return quadratic(floored(float(self.scales.epsilon), "M̂ = ∂²f/∂v² + εI with a convex f"))

    def _inertial(self, q: Tensor, v: Tensor, a: Tensor) -> Tensor:
        """M̂ a + Ĉ(q, v) v = d/dt ∂T̂/∂v − ∂T̂/∂q."""
        return derivative(self._momentum, (q, v), (v, a)) - grad(lambda x: self.kinetic(x, v).sum())(q)

    def _momentum(self, q: Tensor, v: Tensor) -> Tensor:
        return grad(lambda x: self.kinetic(q, x).sum())(v)
