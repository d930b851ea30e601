"""Checked arguments as float64 tensors that share no memory with them."""

import numpy as np
import torch
from jaxtyping import Float

from nbs_pin.base.arrays import Array, is_torch_array
from nbs_pin.base.checks import LARGEST, SMALLEST, floats, told
from nbs_pin.base.exceptions import ArgumentError


def positive_definite(name: str, matrix: Float[Array, "n n"]) -> Float[torch.Tensor, "n n"]:
    """The matrix as a float64 tensor; raises ArgumentError unless it is finite and symmetric positive definite."""
    tensor = _copied(name, matrix)
    square = tensor.ndim == 2 and tensor.shape[0] == tensor.shape[1]
    if not square or not bool((tensor.abs() <= LARGEST).all()) or not torch.equal(tensor, tensor.T):
        raise ArgumentError(
            f"{name} of shape {tuple(tensor.shape)} is not a finite symmetric matrix; give an n × n one."
        )
    smallest = float(torch.linalg.eigvalsh(tensor)[0])
    if not smallest >= SMALLEST:
        raise ArgumentError(f"{name} has the eigenvalue {smallest:.3g}; give a positive definite matrix.")
    return tensor


def positive_scale(name: str, scale: Float[Array, " n"] | None, nv: int) -> Float[torch.Tensor, " n"]:
    """The scale as a float64 tensor of shape (nv,), ones for None; raises ArgumentError unless finite and > 0."""
    tensor = torch.ones(nv, dtype=torch.float64) if scale is None else _copied(name, scale)
    if tensor.shape != (nv,) or not bool(((tensor >= SMALLEST) & (tensor <= LARGEST)).all()):
        raise ArgumentError(f"{name} is {told(tensor.numpy())}; give {nv} positive numbers.")
    return tensor


def _copied(name: str, x: Array) -> torch.Tensor:
    """A float64 copy; numpy makes the copy of an array, because torch warns about read-only arrays."""
    if not is_torch_array(x):
        return torch.from_numpy(np.array(floats(name, x)))
    if x.layout is not torch.strided or x.is_meta or not x.dtype.is_floating_point:
        raise ArgumentError(f"{name} is {told(x)}, expected a dense tensor of real numbers; give one.")
    return x.detach().clone().double()
