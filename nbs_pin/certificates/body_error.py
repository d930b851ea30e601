"""Bodies that are known to a share, and a payload, in the inequalities (docs/certificates.md §11).

With ΔM = M̂ − M and so on, u = Λ∇Φ and v = v_d − u + z2, the true arm's M in W, the law adds to Ẇ

    z2ᵀ(ΔM(φ̇ − ωz2) + ΔC(q, v)φ + ΔG) = z2ᵀw(q) − z2ᵀΔM(ω + ΛH)z2 + z2ᵀΔM ΛH u − 2z2ᵀΔC(v_d)u + z2ᵀΔC(u)u
                                          + ½z2ᵀ(Σ_k (v_d − u)_k ∂_kΔM)z2,     w = ΔM a_d + ΔC(q, v_d)v_d + ΔG.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from nbs_pin.base.claims import Claim, refuse
from nbs_pin.base.rounding import largest_eigenvalue, up
from nbs_pin.certificates.body_bounds import BodyBounds
from nbs_pin.certificates.body_motion import AlongReference
from nbs_pin.certificates.body_rates import BodyRates, dual
from nbs_pin.certificates.claims import Condition
from nbs_pin.certificates.comparison_system import ComparisonSystem, Level, level, reach
from nbs_pin.certificates.constants import Constants, above_inverse
from nbs_pin.controllers.lyapunov_law import LyapunovLaw

_SHARES = (0.0, 0.02, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
"""Shares of ω that may be given up for what ΔM takes of the damping."""
_ROOM = 1.02
"""Room around the set of motions within which the terms are bounded, so that its border lies inside."""
_ROUNDS = 40


@dataclass(frozen=True)
class BodyError:
    """The inequalities with the terms of the bodies, valid for motions with Φ ≤ `region`."""

    comparison: ComparisonSystem
    level: Level
    potential: float
    """Φ∞ [J]."""
    region: float
    """[J]"""
    lines: tuple[Claim, ...]
    conditions: tuple[Condition, ...]


@dataclass(frozen=True)
class Local:
    """The terms over a set of motions."""

    rate: float
    """a: z2ᵀ(M − M̂)z2 counts a times [1/s]."""
    t: float
    alpha: float
    beta: float


@dataclass(frozen=True, eq=False)
class Terms:
    """Everything that the terms need, for `at` a set of motions."""

    law: LyapunovLaw
    constants: Constants
    bounds: BodyBounds
    along: AlongReference
    rates: BodyRates

    def at(self, potential: float) -> Local:
        """The terms while Φ ≤ `potential` [J]."""
        c, b, along, r = self.constants, self.bounds, self.along, self.rates
        largest = self.curvature(potential)
        middle, spread = 0.5 * (largest + c.rho), 0.5 * (largest - c.rho)
        force = largest * math.sqrt(2.0 * potential / c.rho)
        inverse = potential * above_inverse(c.stiffness)
        near, tilt = (dual(x, inverse) + off for x, off in zip(r.degrees, r.off_pose, strict=True))
        mixed = math.sqrt(b.whole[0] * b.whole[1])
        inertia = min(along.inertia + mixed * near, mixed)
        coriolis = min(along.coriolis + r.around * near, r.around) + r.off_around
        turning = min(along.turning + r.turned * near, r.turned) + r.off_turned
        curved = (near + r.off_pose[0]) * r.pose[0] * r.moved + (tilt + r.off_pose[1]) * r.pose[1] * r.tilted
        alpha = largest * inertia + coriolis + along.pose / c.rho + 0.5 * curved + r.cubic * force
        beta = inertia * spread / math.sqrt(c.delta) + turning + 0.5 * r.force * force
        return Local(middle + c.omega, along.torque + r.between(along), alpha, beta)

    def curvature(self, potential: float) -> float:
        """Upper bound of λ_max(Λ^½∇²ΦΛ^½) while Φ ≤ potential [1/s]."""
        root = np.sqrt(self.constants.rate)
        radii = np.sqrt(potential / _below(self.constants.stiffness))
        matrix = root[:, None] * self.law.stiffness_bound(radii) * root
        return max(up(largest_eigenvalue(matrix)), self.constants.rho) if np.isfinite(matrix).all() else math.inf

    def best(self, base: ComparisonSystem, potential: float) -> ComparisonSystem:
        """The inequalities while Φ ≤ `potential`, with the share of ω that gives the least V∞."""
        found, b = self.at(potential), self.bounds
        k = replace(
            base,
            kappa=b.kappa if base.kappa else 0.0,
            nu=b.nu if np.isfinite(base.nu) else math.inf,
            t=base.t + found.t,
            alpha=base.alpha + found.alpha,
        )
        tried = []
        for share in _SHARES if base.omega else (0.0,):
            beta = base.beta + found.beta + b.shortfall(found.rate, share * base.omega)
            tried.append(replace(k, omega=(1.0 - share) * base.omega, beta=beta))
        return min(tried, key=lambda x: level(x).storage)


def body_error(terms: Terms, base: ComparisonSystem, initial: float) -> BodyError:
    """The terms of the bodies, over a set that the motions from V(0) ≤ `initial` [J] do not leave.

    base: the inequalities without these terms.

    Raises:
        CertificateRefused: If no such set is found.
    """
    region = 0.0
    for _ in range(_ROUNDS):
        comparison = terms.best(base, region)
        least = level(comparison)
        if not math.isfinite(least.storage):
            break
        potential = reach(comparison, least.storage)
        needed = max(initial, potential) * _ROOM
        if needed <= region:
            return BodyError(comparison, least, potential, region, (), ())
        region = needed * _ROOM
    refuse("the bodies are not known well enough", "state smaller shares or payload, or take a larger D₀")


def _below(matrix: np.ndarray) -> np.ndarray:
    """Diagonal of a matrix ⪯ S."""
    diagonal = np.diag(matrix)
    if np.array_equal(matrix, np.diag(diagonal)):
        return diagonal
    root = np.sqrt(diagonal)
    least = float(np.linalg.eigvalsh(matrix / root / root[:, None])[0])
    return diagonal * least * (1.0 - 1e-9)
