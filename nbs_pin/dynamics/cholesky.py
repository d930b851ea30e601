"""The Lagrangian network with M̂ = LLᵀ + εI, positive definite for every parameter value."""

from collections.abc import Sequence

import numpy as np
import torch

from nbs_pin.base.arrays import Matrices, Scalars, Vectors, matvec
from nbs_pin.base.known_code import known_code
from nbs_pin.base.storable import storable
from nbs_pin.dynamics.features import JointFeatures
from nbs_pin.dynamics.lagrangian_network import CompiledTorque, LagrangianNetwork, Tensor
from nbs_pin.dynamics.scales import Scales, stored_scales
from nbs_pin.dynamics.structure import ModelClaims, floored, quadratic
from nbs_pin.dynamics.tanh_network import TanhNetwork


@known_code
@storable(("widths",), arrays=stored_scales, sequence=tuple)
class CholeskyNetwork(LagrangianNetwork):
    """M̂(q) = R L(q)L(q)ᵀ R + εI ⪰ εI and V̂(q), with L lower triangular; one tanh network gives L and V̂.

    Source: Lutter, Ritter and Peters 2019, "Deep Lagrangian Networks", but without softplus on the diagonal of L.

    Args:
        epsilon: ε [kg·m²], below the smallest eigenvalue of the arm's M.
        inertia: R², (n,) [kg·m²], inertia of one unit of the network (`Scales`); None is 1.
        energy: Potential energy of one unit of the network [J].

    Raises:
        ArgumentError: If there are no joints, or ε or a scale is not positive and finite.
    """

    fit_widths = (32, 32)
    few_widths = (8,)

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
        self.nv = n = self.features.nv
        self.scales = Scales(n, epsilon, inertia, energy)
        rows, columns = np.tril_indices(n)
        place = torch.zeros(len(rows) + 1, n * n, dtype=torch.float64)
        place[np.arange(len(rows)), rows * n + columns] = 1.0
        self.register_buffer("_place", place, persistent=False)
        generator = torch.Generator().manual_seed(seed)
        self.network = TanhNetwork((self.features.size, *widths, len(rows) + 1), generator)
        with torch.no_grad():
            self.network.get_parameter(f"b{self.network.depth - 1}")[:-1] = torch.eye(n)[rows, columns].double()

    _place: Tensor

    @property
    def widths(self) -> tuple[int, ...]:
        """Sizes of the hidden layers."""
        return tuple(len(bias) for _, bias in self.network.layers()[:-1])

    def mass_matrix(self, q: Vectors) -> Matrices:
        """M̂(q) [kg·m²]."""
        factor = self.scales.root[:, None] * self._factor(self.network(self.features(q)))
        return factor @ factor.mT + self.scales.floor

    def potential(self, q: Vectors) -> Scalars:
        """V̂(q) [J]."""
        return self.scales.energy * self.network(self.features(q))[..., -1]

    def torque(self, q: Vectors, v: Vectors, w: Vectors, a: Vectors) -> Vectors:
        """M̂ a + Ĉ(q, v) w + Ĝ [N·m] by one forward pass with tangents along v and w, and one reverse pass.

        The gradient of vᵀLLᵀw in L is v(Lᵀw)ᵀ + w(Lᵀv)ᵀ.
        """
        root, x = self.scales.root, self.features(q)
        tangents = [self.features.push(x, s) for s in ((v,) if w is v else (v, w))]
        output, rates, tape = self.network.push(x, tangents)
        factor, along_v, along_w = (self._factor(o) for o in (output, rates[0], rates[-1]))
        v_, w_, a_ = root * v, root * w, root * a
        at_v, at_w = matvec(factor.mT, v_), matvec(factor.mT, w_)
        inner = matvec(factor.mT, a_) + 0.5 * (matvec(along_v.mT, w_) + matvec(along_w.mT, v_))
        inertial = matvec(factor, inner) + 0.5 * (matvec(along_v, at_w) + matvec(along_w, at_v))
        in_factor = v_[..., :, None] * at_w[..., None, :] + w_[..., :, None] * at_v[..., None, :]
        in_output = -0.5 * in_factor.flatten(-2, -1) @ self._place.T
        in_output = in_output + self.scales.energy * self._is_potential
        return root * inertial + self.scales.epsilon * a + self.features.pull(x, self.network.pull(tape, in_output))

    def structure_claims(self) -> ModelClaims | None:
        """M̂ = LLᵀ + εI ⪰ εI; raises CertificateRefused unless ε > 0."""
        return quadratic(floored(float(self.scales.epsilon), "M̂ = LLᵀ + εI"))

    def compiled(self) -> CompiledTorque | None:
        """`torque` as machine code (`kernels/cholesky.py`); None for a subclass, which may change it."""
        if type(self) is not CholeskyNetwork:
            return None
        from nbs_pin.kernels.cholesky import CholeskyTorque, pack_cholesky

        layers = [(w.numpy(force=True), b.numpy(force=True)) for w, b in self.network.layers()]
        scales = self.scales.root.numpy(force=True), float(self.scales.epsilon), float(self.scales.energy)
        return CholeskyTorque(pack_cholesky(layers, self.features.order, self.features.turning, *scales))

    @property
    def _is_potential(self) -> Tensor:
        """1 at the output V̂, 0 elsewhere."""
        return 1.0 - self._place.sum(-1)

    def _factor(self, output: Tensor) -> Tensor:
        """The outputs arranged as L, without the last one, V̂."""
        return (output @ self._place).reshape(*output.shape[:-1], self.nv, self.nv)
