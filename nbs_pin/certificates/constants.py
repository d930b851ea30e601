"""The constants of the bounds, each rounded to the safe side and labelled by how it is known."""

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from nbs_pin.base.arrays import JointArray
from nbs_pin.base.claims import Claim, Group, Label, weakest
from nbs_pin.base.rounding import least_eigenvalue
from nbs_pin.certificates.structure import check_structure
from nbs_pin.controllers.gains import sample_configurations
from nbs_pin.controllers.lyapunov_law import LyapunovLaw
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.dynamics.provider import DynamicsProvider
from nbs_pin.inertia.bounds import largest_inertia_bound, least_inertia_bound
from nbs_pin.kernels.layout import Packed
from nbs_pin.robots.robot import Robot

_SAMPLES = 2000


@dataclass(frozen=True, eq=False)
class Constants:
    """The constants of docs/certificates.md §1 for one controller."""

    rho: float
    """ρ = λ_min(2Λ^½SΛ^½) [1/s]."""
    delta: float
    """δ = λ_min(Λ^½D₀Λ^½)."""
    kappa: float
    """κ = 1/max_q λ_max(D₀^-½M(q)D₀^-½) [1/s], 0 if no bound is known."""
    nu: float
    """ν = 1/min_q λ_min(D₀^-½M(q)D₀^-½) [1/s], inf if no bound is known."""
    omega: float
    """ω [1/s]."""
    coupling: float
    """ζ: 1 for a law that feeds back −∇Φ, 0 for one that does not."""
    rate: JointArray
    """Diagonal of Λ [rad/s per N·m]."""
    least_floor: float
    """λ_min(D₀) [N·m·s/rad]."""
    stiffness: Float[np.ndarray, "n n"]
    """S [J/rad²]."""
    floor: Float[np.ndarray, "n n"]
    """D₀ with the viscous friction of the joints [N·m·s/rad]."""
    metric: Float[np.ndarray, "n n"]
    """D₀⁻¹, for Δ = sup τ_dᵀD₀⁻¹τ_d."""
    label: Label
    """The weakest label of all that they rest on."""
    lines: tuple[Claim, ...]

    @property
    def largest_rate(self) -> float:
        """λ_max(Λ) [rad/s per N·m]."""
        return float(self.rate.max())


def constants_of(law: LyapunovLaw, viscous: JointArray | None = None) -> Constants:
    """The constants of a controller; raises CertificateRefused if it or its model does not admit a proof.

    viscous: friction of the joints [N·m·s/rad], ≥ 0, which adds to D₀ (docs/certificates.md §8).
    """
    v = check_structure(law)
    if viscous is not None and viscous.any():
        v = v._replace(floor=v.floor + np.diag(viscous))
    root = np.sqrt(v.rate)
    delta = least_eigenvalue(root[:, None] * v.floor * root)
    largest, least, *plain = _inertia(law.dynamics, v.floor)
    # With ωM in the damping no bound of M is needed, so an unproved one is not used.
    used = v.inertial_rate == 0.0 or largest.label is Label.PROVED
    claim = Claim("δ = λ_min(Λ^½D₀Λ^½)", delta, "", Label.PROVED, "eigenvalue of the gains", Group.CONSTANTS)
    return Constants(
        rho=least_eigenvalue(2.0 * root[:, None] * v.stiffness * root),
        delta=delta,
        kappa=1.0 / largest.value if used and largest.value > 0.0 else 0.0,
        nu=1.0 / least.value if used and least.value > 0.0 else math.inf,
        omega=v.inertial_rate,
        coupling=v.coupling,
        rate=v.rate,
        least_floor=least_eigenvalue(v.floor),
        stiffness=v.stiffness,
        floor=v.floor,
        metric=above_inverse(v.floor),
        label=weakest(*(line.label for line in v.claims), *([largest.label, least.label] if used else [])),
        lines=(*v.claims, *plain, largest, least, claim),
    )


def _inertia(dynamics: DynamicsProvider, floor: Float[np.ndarray, "n n"]) -> tuple[Claim, ...]:
    """1/κ, 1/ν [s], a₂ and a₁ [kg·m²]: rigorous for a rigid tree, learned or given, sampled for other models."""
    names = ("1/κ ≥ λ_max(D₀^-½MD₀^-½)", "1/ν ≤ λ_min(D₀^-½MD₀^-½)", "a₂ ≥ λ_max(M)", "a₁ ≤ λ_min(M)")
    arm = rigid_arm(dynamics)
    if arm is not None:
        weights = (floor, np.eye(len(floor)))
        known = [bound for w in weights for bound in (largest_inertia_bound(arm, w), least_inertia_bound(arm, w))]
    else:
        known = _sampled(dynamics.mass_matrix(configurations(dynamics)), floor)
    units = ("s", "s", "kg·m²", "kg·m²")
    rows = zip(names, units, known, strict=True)
    return tuple(replace(x, name=name, unit=unit, group=Group.INERTIA) for name, unit, x in rows)


def rigid_arm(dynamics: DynamicsProvider) -> Robot | Packed | None:
    """The rigid tree that a model is, given or learned; None for a model of another kind."""
    return dynamics.robot if type(dynamics) is PinocchioDynamics else dynamics.packed_tree()


def _sampled(mass: Float[np.ndarray, "count n n"], floor: Float[np.ndarray, "n n"]) -> list[Claim]:
    root = np.linalg.inv(np.linalg.cholesky(floor))
    spectra = [np.linalg.eigvalsh(x) for x in (root @ mass @ root.T, mass)]
    ends = [end for x in spectra for end in (float(x[:, -1].max()), float(x[:, 0].min()))]
    because = f"the extreme of {len(mass)} configurations"
    return [Claim("inertia of the model", end, "", Label.EMPIRICAL, because) for end in ends]


def configurations(dynamics: DynamicsProvider) -> Float[np.ndarray, "count n"]:
    """Seeded random configurations of the arm, or within ±π if the model names no arm [rad]."""
    if dynamics.robot is not None:
        return sample_configurations(dynamics.robot, _SAMPLES)
    return np.random.default_rng(0).uniform(-np.pi, np.pi, (_SAMPLES, dynamics.nv))


def above_inverse(matrix: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """A⁻¹, enlarged so that rounding cannot make a quadratic form with it too small."""
    diagonal = np.diag(matrix)
    if np.array_equal(matrix, np.diag(diagonal)):
        return np.asarray(np.diag((1.0 + 4.0 * np.finfo(float).eps) / diagonal))
    n, inverse = len(matrix), np.linalg.inv(matrix)
    slack = 16.0 * n * np.finfo(float).eps * float(np.linalg.cond(matrix)) * float(np.linalg.norm(inverse, 2))
    return np.asarray(0.5 * (inverse + inverse.T) + slack * np.eye(n))
