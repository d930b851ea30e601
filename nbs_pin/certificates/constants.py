"""The constants of the bounds, each moved to the safe side and labelled with the way it is known."""

import math
from dataclasses import dataclass
from typing import cast

import numpy as np
from jaxtyping import Float

from nbs_pin.certificates.claims import Claim, Label, weakest
from nbs_pin.certificates.inertia import largest_inertia_bound, least_inertia_bound
from nbs_pin.certificates.model_structure import check_model
from nbs_pin.certificates.rounding import largest_eigenvalue, least_eigenvalue
from nbs_pin.certificates.structure import DAMPING, check_structure
from nbs_pin.controllers.controller import Controller
from nbs_pin.controllers.gains import sample_configurations
from nbs_pin.controllers.neural_backstepping import NeuralBackstepping
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.dynamics.provider import DynamicsProvider

_SAMPLES = 2000


@dataclass(frozen=True, eq=False)
class Constants:
    """What docs/certificates.md §1 names, for one controller."""

    rho: float
    """ρ = λ_min(2Λ^½SΛ^½) [1/s]."""
    delta: float
    """δ = λ_min(Λ^½D₀Λ^½)."""
    kappa: float
    """κ = 1/max_q λ_max(D₀^-½M(q)D₀^-½) [1/s], 0 for none."""
    nu: float
    """ν = 1/min_q λ_min(D₀^-½M(q)D₀^-½) [1/s], inf for none."""
    omega: float
    """ω [1/s]."""
    largest_rate: float
    """λ_max(Λ) [rad/s per N·m]."""
    least_floor: float
    """λ_min(D₀) [N·m·s/rad]."""
    metric: Float[np.ndarray, "n n"]
    """D₀⁻¹, for Δ = sup τ_dᵀD₀⁻¹τ_d."""
    label: Label
    """How all that the bounds use is known."""
    lines: tuple[Claim, ...]


def constants_of(law: Controller) -> Constants:
    """The constants of a controller, after a check of its structure and of its model's.

    Raises CertificateRefused where those give no ground for a proof.
    """
    structure = check_structure(law)
    controller = cast(NeuralBackstepping, law)  # any other law was refused
    model = check_model(controller.dynamics)
    floor = _floor(controller, structure)
    stiffness, rate = (np.asarray(gain.numpy()) for gain in (controller.potential.stiffness, controller.rate))
    omega, root = float(controller.inertial_rate), np.sqrt(rate)
    rho = least_eigenvalue(2.0 * root[:, None] * stiffness * root)
    delta = least_eigenvalue(root[:, None] * floor * root)
    inertia = _inertia(controller.dynamics, floor)
    # With ωM in the damping no bound of M is needed, so one that is not proved is not used.
    used = [line for line in inertia if omega == 0.0 or line.label is Label.PROVED]
    kappa = next((1.0 / line.value for line in used if line.name.startswith(_LARGEST) and line.value > 0.0), 0.0)
    least = next((line.value for line in used if line.name.startswith(_LEAST)), 0.0)
    own = (
        Claim("δ = λ_min(Λ^½D₀Λ^½)", delta, "", Label.PROVED, "eigenvalue of the gains, rounded down"),
        Claim("κ = 1/max λ(D₀^-½MD₀^-½)", kappa, "1/s", weakest(*(x.label for x in used)), "from the line above it"),
    )
    return Constants(
        rho=rho,
        delta=delta,
        kappa=kappa,
        nu=largest_eigenvalue(floor) / least if least > 0.0 else math.inf,
        omega=omega,
        largest_rate=float(rate.max()),
        least_floor=least_eigenvalue(floor),
        metric=_inverse(floor),
        label=weakest(*(line.label for line in (*structure, *model, *used))),
        lines=(*structure, *model, *inertia, *own),
    )


_LARGEST, _LEAST = "max λ(D₀^-½MD₀^-½)", "a₁ ≤ λ_min(M)"


def _floor(controller: NeuralBackstepping, structure: tuple[Claim, ...]) -> Float[np.ndarray, "n n"]:
    """D₀: that of the damping, or as large a multiple of I as the check of its structure found."""
    if controller.damping.floor is not None:
        return np.asarray(controller.damping.floor.numpy())
    return next(line.value for line in structure if line.name == DAMPING) * np.eye(controller.nv)


def _inertia(dynamics: DynamicsProvider, floor: Float[np.ndarray, "n n"]) -> tuple[Claim, ...]:
    """Bounds of the inertia: rigorous for a rigid tree, learned or given, sampled for other models."""
    arm = dynamics.robot if type(dynamics) is PinocchioDynamics else dynamics.packed_tree()
    if arm is not None:
        largest, least = largest_inertia_bound(arm, floor), least_inertia_bound(arm)
    else:
        largest, least = _sampled(dynamics, floor)
    named = ((_LARGEST, largest), (_LEAST, least))
    return tuple(Claim(name, x.value, x.unit, x.label, x.because) for name, x in named)


def _sampled(dynamics: DynamicsProvider, floor: Float[np.ndarray, "n n"]) -> tuple[Claim, Claim]:
    mass = dynamics.mass_matrix(configurations(dynamics))
    root = np.linalg.inv(np.linalg.cholesky(floor))
    largest = float(np.linalg.eigvalsh(root @ mass @ root.T)[:, -1].max())
    because = f"the extreme of {_SAMPLES} configurations of the model"
    return (
        Claim(_LARGEST, largest, "s", Label.EMPIRICAL, because),
        Claim(_LEAST, float(np.linalg.eigvalsh(mass)[:, 0].min()), "kg·m²", Label.EMPIRICAL, because),
    )


def configurations(dynamics: DynamicsProvider) -> Float[np.ndarray, "count n"]:
    """Seeded configurations of the arm, within ±π where the model knows no arm [rad]."""
    if dynamics.robot is not None:
        return sample_configurations(dynamics.robot, _SAMPLES)
    return np.random.default_rng(0).uniform(-np.pi, np.pi, (_SAMPLES, dynamics.nv))


def _inverse(floor: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """D₀⁻¹, so much larger that no rounding makes a quadratic form with it too small."""
    n = len(floor)
    inverse = np.linalg.inv(floor)
    slack = 16.0 * n * np.finfo(float).eps * float(np.linalg.cond(floor))
    return np.asarray(0.5 * (inverse + inverse.T) * (1.0 + slack))
