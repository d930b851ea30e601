"""Pseudo-inertias of bodies: symmetric 4×4 matrices that are positive definite if the body is physically consistent.

A body with mass density ρ(x) ≥ 0 has J = ∫ (x, 1)(x, 1)ᵀ ρ dx = [[Σ, h], [hᵀ, m]] with Σ = ½ tr(I) 1 − I. J is linear
in Pinocchio's ten inertial parameters, and J ≻ 0 holds exactly for those of solid bodies, triangle inequality included.
Source: Wensing, Kim and Slotine, "Linear matrix inequalities for physically consistent inertial parameter
identification", RA-L 2018.
"""

import itertools

import numpy as np
from jaxtyping import Float

PARAMETER_NAMES = ("m", "mx", "my", "mz", "Ixx", "Ixy", "Iyy", "Ixz", "Iyz", "Izz")
"""Mass, first moment and inertia about the joint's origin, in Pinocchio's order."""
PARAMETER_UNITS = ("kg", *["kg·m"] * 3, *["kg·m²"] * 6)
"""Their units."""


def _basis() -> np.ndarray:
    basis = np.zeros((10, 4, 4))
    for k, (i, j) in enumerate(itertools.combinations_with_replacement(range(4), 2)):
        basis[k, i, j] = basis[k, j, i] = 1.0 if i == j else np.sqrt(0.5)
    return basis


BASIS = _basis()
"""An orthonormal basis of the symmetric 4×4 matrices, shape (10, 4, 4)."""


def coordinates(matrix: Float[np.ndarray, "*batch 4 4"]) -> Float[np.ndarray, "*batch 10"]:
    """Coordinates of the symmetric matrix in `BASIS`, an isometry."""
    return np.einsum("...ij,kij->...k", matrix, BASIS)


def symmetric(x: Float[np.ndarray, "*batch 10"]) -> Float[np.ndarray, "*batch 4 4"]:
    """The symmetric matrix with the given coordinates."""
    return np.einsum("...k,kij->...ij", x, BASIS)


def inertial_parameters(pseudo_inertia: Float[np.ndarray, "*batch 4 4"]) -> Float[np.ndarray, "*batch 10"]:
    """The ten parameters of `PARAMETER_NAMES`; I = tr(Σ) 1 − Σ."""
    j = pseudo_inertia
    spread = np.trace(j[..., :3, :3], axis1=-2, axis2=-1)[..., None, None] * np.eye(3) - j[..., :3, :3]
    inertia = [spread[..., i, k] for i, k in ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2))]
    return np.stack([j[..., 3, 3], j[..., 0, 3], j[..., 1, 3], j[..., 2, 3], *inertia], axis=-1)


PARAMETERS_OF_COORDINATES = inertial_parameters(BASIS).T
"""Matrix (10, 10) from coordinates of J to inertial parameters."""
_COORDINATES_OF_PARAMETERS = np.linalg.inv(PARAMETERS_OF_COORDINATES)


def pseudo_inertia(parameters: Float[np.ndarray, "*batch 10"]) -> Float[np.ndarray, "*batch 4 4"]:
    """J of a body with the ten parameters of `PARAMETER_NAMES`."""
    return symmetric(parameters @ _COORDINATES_OF_PARAMETERS.T)
