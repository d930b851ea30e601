"""The error potential Φ: strongly convex for every parameter value, with its minimum at zero."""

import torch
from jaxtyping import Float
from torch import nn

from nbs_pin.arrays import Array, array_namespace, is_torch_array, matvec
from nbs_pin.exceptions import ArgumentError
from nbs_pin.networks.activations import Activation, SmoothedReLU, Squareplus
from nbs_pin.networks.convex import FICNN, rectified
from nbs_pin.runtime.convex import subtract_tangent
from nbs_pin.runtime.layout import Packed, pack_potential

POTENTIALS = ("paper", "smooth")


class Potential(nn.Module):
    """Φ(z) = zᵀSz + ψ(z) [J], so that ∇²Φ ⪰ 2S everywhere (docs/theory.md §3).

    form "paper": ψ(z) = f(Rz), f a FICNN without biases and with the smoothed ReLU, zero with zero gradient at 0; its
    second derivative, and so the torque, jumps where a pre-activation crosses 0 or d.
    form "smooth": the Bregman form ψ(z) = f(Rz) − f(0) − ∇f(0)ᵀRz of a smooth FICNN with biases; C^∞.

    S: (n, n) symmetric positive definite [J/rad²]. R: diagonal input scale (n,), which brings errors of weak and
    strong joints to one size; 1 is the paper's. Raises ArgumentError for an unknown form, an S that is not symmetric
    positive definite or an R that is not positive.
    """

    stiffness: torch.Tensor
    scale: torch.Tensor

    def __init__(
        self,
        stiffness: Float[Array, "n n"],
        *,
        form: str = "smooth",
        widths: tuple[int, ...] = (32, 32, 32),
        activation: Activation | None = None,
        scale: Float[Array, " n"] | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__()
        if form not in POTENTIALS:
            raise ArgumentError(f"potential '{form}' is unknown; choose one of {', '.join(POTENTIALS)}.")
        s = positive_definite("the stiffness S", stiffness)
        self.form = form
        self.register_buffer("stiffness", s)
        self.register_buffer("scale", positive_scale("the input scale R", scale, len(s)))
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.network = FICNN(
                len(s),
                widths,
                activation or (SmoothedReLU() if form == "paper" else Squareplus()),
                biases=form == "smooth",
                nonnegative=rectified if form == "paper" else abs,
            )

    @property
    def nv(self) -> int:
        """Number of joints."""
        return len(self.scale)

    @property
    def modulus(self) -> float:
        """μ = 2 λ_min(S): Φ is μ-strongly convex [J/rad²]."""
        return 2.0 * float(torch.linalg.eigvalsh(self.stiffness)[0])

    def terms(
        self, z: Float[Array, "*batch n"], dz: Float[Array, "*batch n"]
    ) -> tuple[Float[Array, "*batch"], Float[Array, "*batch n"], Float[Array, "*batch n"]]:
        """Φ(z) [J], ∇Φ(z) [N·m] and ∇²Φ(z) dz, in the kind of z."""
        xp = array_namespace(z)
        s, r = (self.stiffness, self.scale) if is_torch_array(z) else (self.stiffness.numpy(), self.scale.numpy())
        value, gradient, product = self._psi(r * z, r * dz)
        force, force_rate = 2.0 * matvec(s, z), 2.0 * matvec(s, dz)
        return value + 0.5 * xp.sum(z * force, axis=-1), r * gradient + force, r * product + force_rate

    @property
    def is_packable(self) -> bool:
        """Whether all parts are the ones the kernels know, and not those of a subclass."""
        parts = (type(self), type(self.network), type(self.network.activation))
        return parts[:2] == (Potential, FICNN) and parts[2] in (SmoothedReLU, Squareplus)

    def packed(self) -> Packed:
        """The weights as the compiled form of `terms` takes them (`runtime/convex.py`).

        Raises ArgumentError when the activation has no compiled form.
        """
        activation = self.network.activation
        if activation.kernel is None:
            raise ArgumentError(f"{activation} has no compiled form; take SmoothedReLU or Squareplus.")
        layers = self.network.layers(numpy=True)
        packed = pack_potential(layers, activation.kernel, self.scale.numpy(), self.stiffness.numpy())
        return packed if self.form == "paper" else subtract_tangent(packed)

    def _psi(
        self, x: Float[Array, "*batch n"], dx: Float[Array, "*batch n"]
    ) -> tuple[Float[Array, "*batch"], Float[Array, "*batch n"], Float[Array, "*batch n"]]:
        if self.form == "paper":
            return self.network.terms(x, dx)
        xp = array_namespace(x)
        zero = 0.0 * x
        values, gradients, products = self.network.terms(xp.stack([x, zero]), xp.stack([dx, zero]))
        gradient_0 = gradients[1]
        psi = values[0] - values[1] - xp.sum(gradient_0 * x, axis=-1)
        return psi, gradients[0] - gradient_0, products[0]


def positive_definite(name: str, matrix: Float[Array, "n n"]) -> Float[torch.Tensor, "n n"]:
    """The matrix as a float64 tensor; raises ArgumentError unless it is symmetric positive definite."""
    tensor = torch.as_tensor(matrix, dtype=torch.float64).clone()
    square = tensor.ndim == 2 and tensor.shape[0] == tensor.shape[1]
    if not square or not bool(torch.isfinite(tensor).all()) or not torch.equal(tensor, tensor.T):
        raise ArgumentError(
            f"{name} of shape {tuple(tensor.shape)} is not a finite symmetric matrix; give an n × n one."
        )
    smallest = float(torch.linalg.eigvalsh(tensor)[0])
    if not smallest > 0.0:
        raise ArgumentError(f"{name} has the eigenvalue {smallest:.3g}; give a positive definite matrix.")
    return tensor


def positive_scale(name: str, scale: Float[Array, " n"] | None, nv: int) -> Float[torch.Tensor, " n"]:
    """The scale as a float64 tensor of shape (nv,), ones for None; raises ArgumentError unless all are positive."""
    tensor = (
        torch.ones(nv, dtype=torch.float64) if scale is None else torch.as_tensor(scale, dtype=torch.float64).clone()
    )
    if tensor.shape != (nv,) or not bool((tensor > 0.0).all() & torch.isfinite(tensor).all()):
        raise ArgumentError(f"{name} is {tensor.tolist()}; give {nv} positive numbers.")
    return tensor
