"""Bodies that are known to a share, and a payload, in the inequalities (docs/certificates.md §14).

The response (f, η) of the linearised loop to w = ΔM a_d + ΔC(q_d, v_d)v_d + ΔG, linear in the errors of the bodies, is
followed exactly. With ∇Φ(ξ) = f, e1 = z1 − ξ and e2 = z2 − η the rest obeys the two inequalities of V' = Φ(z1) − Φ(ξ) −
fᵀe1 + ½e2ᵀM e2, with terms that are of second order along the reference.
"""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from nbs_pin.base.arrays import JointArray, Scalars
from nbs_pin.base.claims import Claim, Group, Label, refuse
from nbs_pin.base.rounding import diagonal_below, largest_eigenvalue, least_eigenvalue, up
from nbs_pin.certificates.body_bounds import BodyBounds
from nbs_pin.certificates.body_motion import AlongReference, hessian_at_zero
from nbs_pin.certificates.body_rates import BodyRates
from nbs_pin.certificates.comparison_system import ComparisonSystem, Level, decay, level
from nbs_pin.certificates.constants import Constants
from nbs_pin.certificates.error_bounds import radians
from nbs_pin.certificates.friction_error import FrictionError
from nbs_pin.controllers.lyapunov_law import LyapunovLaw

_SHARES = (0.0, 0.02, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
"""Shares of ω that may be given up for what ΔM takes of the damping."""
_DRIFTS = (0.02, 0.05, 0.1, 0.2)
"""Shares of x² that may be given up for the drift of the static torque."""
_SPLITS = np.linspace(0.02, 1.0, 50).tolist()
"""Shares θ of y² that may compensate t."""
_ROOM = 1.02
"""Room around the set of motions within which the terms are bounded, so that its border lies inside."""
_ROUNDS, _FARTHEST = 40, 1e3
"""How often the set is widened, and the ‖z1‖ at which that ends [rad, m]: a larger bound is of no use to anyone."""
_LEAST_ENERGY = 1e-30
"""Least z1ᵀSz1 of a set [J]."""


class Local(NamedTuple):
    """The terms over a set of motions."""

    rate: float
    """a: e2ᵀ(M − M̂)e2 counts a times [1/s]."""
    t: Scalars
    """At every instant [√W]."""
    alpha: float
    beta: float
    power: float
    """[W]"""
    drift: Scalars
    """Of x at every instant: V̇' gains drift·x [√W]."""


@dataclass(frozen=True, eq=False)
class BodyError:
    """The bounds with errors of the bodies, for motions that start with V' ≤ `storage`."""

    comparison: ComparisonSystem
    storage: float
    """Bound of V' = Φ(z1) − Φ(ξ) − fᵀ(z1 − ξ) + ½e2ᵀM e2 [J]."""
    level: Level
    """c, and a bound of V of the law itself over these motions."""
    potential: float
    """Bound of Φ over these motions [J]."""
    error: float
    """Bound of ‖z1‖ [rad]."""
    joint_errors: JointArray
    """Bounds of |z1_i| [rad]."""
    start: float
    """The largest V'(0) admitted [J]."""
    torque: float
    """Largest √(wᵀD₀⁻¹w) along the reference [√W]."""
    lines: tuple[Claim, ...]


@dataclass(frozen=True, eq=False)
class Terms:
    """Everything that the terms need, for `at` a set of motions."""

    law: LyapunovLaw
    constants: Constants
    bounds: BodyBounds
    along: AlongReference
    rates: BodyRates
    friction: FrictionError
    rotors: str
    """What to say of rotors where nothing is proved."""

    def at(self, storage: float) -> Local:
        """The terms while V' ≤ `storage` [J]."""
        c, b, along, r, m = self.constants, self.bounds, self.along, self.rates, self.rates.model
        low, high, spread = self.curvature(self.reached(storage))
        force = high * math.sqrt(2.0 * storage / c.rho)
        joints = self.joints(storage)
        near, tilt, within = (joints @ x for x in (*r.degrees, b.model_degree))
        mixed, slip, lag = math.sqrt(b.whole[0] * b.whole[1]), along.slip, along.lag
        curved = 0.5 * (near * r.pose[0] * r.moved + tilt * r.pose[1] * r.tilted)
        inertia, around = along.inertia + mixed * near, r.around * near + r.off_around
        turned = along.turning + r.turned * near + r.off_turned
        alpha = along.cross + spread * (along.inertia + along.pose / c.rho**2) + mixed * near * high + around
        alpha = alpha + 2.0 * curved + r.cubic * (force + 2.0 * slip) + along.twist + m.cubic * within * lag
        slope = self.law.damping_slope() * float(along.speed.max())
        turn = spread * inertia + mixed * near * 0.5 * (high - low)
        beta = along.spin + turn / math.sqrt(c.delta) + turned + 0.5 * r.force * (force + slip)
        beta = beta + along.roll + m.force * within * lag + 0.5 * slope**2
        t = along.defect + r.between(along, near) + (along.pose / c.rho + 2.0 * curved) * along.static
        t = t + (along.coriolis + around + high * inertia + r.cubic * slip) * slip
        t = t + (along.twist + m.cubic * within * lag) * slip + m.off_around * lag
        t = t + self.friction.alpha * (along.static + 2.0 * lag)
        t = t + along.push + mixed * near * along.heave + self._moved(joints, within)
        fed = self.law.friction
        power = 0.0 if fed is None else 2.0 * float(fed.coulomb @ along.eta.max(axis=0))
        power += 0.5 * slope**2 * float(along.speed.max()) ** 2
        drift = (spread * slip + along.drift) / c.rho
        middle = 0.5 * sum(self._turns())
        return Local(middle + c.omega, t, float(alpha.max()), float(beta.max()), power, drift)

    def _turns(self) -> tuple[float, float]:
        """The extreme eigenvalues of Λ^½HΛ^½ [1/s]."""
        root = np.sqrt(self.constants.rate)
        turns = np.linalg.eigvalsh(root[:, None] * hessian_at_zero(self.law) * root)
        return float(turns[0]), float(turns[-1])

    def shift(self, storage: float) -> Float[np.ndarray, "rows n"]:
        """Bounds of |ξ_i| at and next to every instant [rad].

        ξ − H⁻¹f = H⁻¹(H − H̃)ξ with ‖Λ^−½ξ‖ ≤ ‖Λ^½f‖/ρ and H ⪰ ρΛ⁻¹.
        """
        c, along = self.constants, self.along
        spread = self.curvature(self.reached(storage))[2]
        here = along.shift + spread / c.rho**2 * along.static[:, None] * np.sqrt(c.rate)
        # f is linear in each step, so that its largest values are at the instants.
        return np.asarray(np.maximum(here, np.maximum(np.roll(here, 1, axis=0), np.roll(here, -1, axis=0))))

    def joints(self, storage: float) -> Float[np.ndarray, "rows n"]:
        """Bounds of |q_i − q_d,i(t_j)| at and next to every instant [rad]."""
        error = radians(self.constants.stiffness, storage)[1]
        return np.asarray(self.shift(storage) + error + self.rates.off_joints)

    def _moved(self, joints: Float[np.ndarray, "rows n"], within: Scalars) -> Scalars:
        """Of M̂(η̇ + ωη) + Ĉ(v_d)η by the pose: by its slopes on the reference, or by what holds in every pose."""
        along, m = self.along, self.rates.model
        size = m.mixed * (along.heave + self.constants.omega * along.lag) + m.around * along.lag
        bent = (joints * along.bends).sum(axis=1)
        return np.minimum(bent + 0.5 * within**2 * size, within * size)

    def reached(self, storage: float) -> float:
        """Bound of z1ᵀSz1 [J]: (z1 − ξ)ᵀS(z1 − ξ) ≤ V' and ξᵀSξ ≤ ½fᵀ(2S)⁻¹f."""
        return (math.sqrt(storage) + math.sqrt(float(self.along.energy.max()))) ** 2

    def curvature(self, potential: float) -> tuple[float, float, float]:
        """Bounds of the eigenvalues of Λ^½∇²ΦΛ^½, and of the norm of its difference from that at 0 [1/s], while
        z1ᵀSz1 ≤ potential.
        """
        low, high = self.law.stiffness_range(self._radii(potential))
        if not np.isfinite(high).all():
            refuse("no bound of ∇²Φ is known for this law", "give one that states it, such as nbs or slotine-li")
        root, centre, rho = np.sqrt(self.constants.rate), hessian_at_zero(self.law), self.constants.rho
        scaled = [root[:, None] * x * root for x in (low, high, low - centre, high - centre)]
        least, largest = max(least_eigenvalue(scaled[0]), rho), max(up(largest_eigenvalue(scaled[1])), rho)
        spread = max(up(largest_eigenvalue(scaled[3])), up(largest_eigenvalue(-scaled[2])), 0.0)
        return least, max(largest, least), spread

    def _radii(self, potential: float) -> JointArray:
        # A load that moves nothing leaves no error; its set is taken a little larger than a point.
        return np.sqrt(max(potential, _LEAST_ENERGY) / diagonal_below(self.constants.stiffness))

    def best(self, base: ComparisonSystem, storage: float) -> tuple[ComparisonSystem, float, Scalars]:
        """The inequalities while V' ≤ `storage`, with the shares of ω and x² of the least V∞; V' from 0; t.

        t is that of every instant, with that of `base`; the inequalities have its mean.
        """
        found, b, rho = self.at(storage), self.bounds, self.constants.rho
        t = base.t + found.t
        k = replace(base, kappa=b.kappa if base.kappa else 0.0, nu=b.nu, t=_mean(self.along.t, t))
        tried = []
        for share in _SHARES if base.omega else (0.0,):
            beta = base.beta + found.beta + b.shortfall(found.rate, share * base.omega)
            for kept in (1.0 - x for x in _DRIFTS):
                power = base.power + found.power + _mean(self.along.t, found.drift) ** 2 / (4.0 * (1.0 - kept))
                alpha = (base.alpha + found.alpha) / math.sqrt(kept)
                scaled = replace(k, rho=kept * rho, delta=kept * base.delta, alpha=alpha, beta=beta, power=power)
                tried.append((replace(scaled, omega=(1.0 - share) * base.omega), kept))
        best, kept = min(tried, key=lambda x: level(x[0]).storage)
        power = base.power + found.power + found.drift**2 / (4.0 * (1.0 - kept))
        return best, self._largest_storage(best, t, power), t

    def _largest_storage(self, k: ComparisonSystem, t: Scalars, power: Scalars) -> float:
        """The largest V' from V' = 0: V̇' ≤ −cV' + t²/4θ + P, with t and P the larger of neighbouring instants."""
        h, found = np.diff(self.along.t), math.inf
        for share in _SPLITS:
            c = decay(k, share) / (1.0 + 1e-9)
            if c <= 0.0:
                continue
            supply = t**2 / (4.0 * share) + power
            level_here = np.maximum(supply[1:], supply[:-1]) / c
            kept, value, most = np.exp(-c * h), 0.0, 0.0
            for stays, end in zip(kept.tolist(), level_here.tolist(), strict=True):
                value = stays * value + (1.0 - stays) * end
                most = max(most, value)
            found = min(found, most * (1.0 + 1e-9))
        return found


def body_error(terms: Terms, base: ComparisonSystem, start: float) -> BodyError:
    """The bounds for motions that start with V' ≤ `start` [J]; `base` holds the inequalities without these terms.

    Raises:
        CertificateRefused: If no set is found that the motions do not leave.
    """
    region = start * _ROOM**2
    for _ in range(_ROUNDS):
        comparison, storage, t = terms.best(base, region)
        if not math.isfinite(storage):
            break
        needed = (start + storage) * _ROOM
        if needed <= region:
            return _bounds(terms, comparison, start, start + storage, t)
        if radians(terms.constants.stiffness, needed)[0] > _FARTHEST:
            break
        region = needed * _ROOM
    k = comparison
    left = "they may take more than all the damping"
    if k.beta < 1.0:
        left = f"1 − β = {1.0 - k.beta:.3g}, α = {k.cross:.3g} and ω = {k.omega:.3g}"
    remedy = "state smaller shares or a lighter payload, or take a larger D₀"
    refuse(f"the errors of the bodies leave no bound: {left}", remedy + terms.rotors)


def _bounds(terms: Terms, comparison: ComparisonSystem, start: float, storage: float, t: Scalars) -> BodyError:
    """z1 = ξ + e1 with (e1)ᵀS e1 ≤ V', ∇Φ(ξ) = f, and ∇²Φ between 0 and ξ near H."""
    c, along = terms.constants, terms.along
    potential = terms.reached(storage)
    shift = terms.shift(storage)
    size, joints = radians(c.stiffness, storage)
    whole = float(np.linalg.norm(shift, axis=1).max()) + size
    joints = shift.max(axis=0) + joints
    moving = (math.sqrt(storage) + math.sqrt(0.5) * terms.rates.model.floor * float(along.lag.max())) ** 2
    phi = terms.curvature(potential)[1] / c.rho * potential
    reached = Level(decay(comparison), phi + moving)
    lines = _lines(terms, comparison, shift, t)
    whole = min(whole, float(np.linalg.norm(joints)))
    return BodyError(comparison, storage, reached, phi, whole, joints, start, float(along.torque.max()), lines)


def _lines(terms: Terms, k: ComparisonSystem, shift: np.ndarray, t: Scalars) -> tuple[Claim, ...]:
    here, b = "docs/certificates.md §14", terms.bounds
    rows = (
        ("errors of the bodies over D₀, e", b.whole[0], "s", "largest in every pose, by multipliers"),
        ("κ of every arm admitted", b.kappa, "1/s", "M̂ + E, by multipliers"),
        ("|ξ_i|, largest", float(shift.max()), "rad", "response of the linearised loop"),
        ("t with errors of the bodies, largest", float(t.max()), "√W", "what the response leaves, at any instant"),
        ("α with errors of the bodies", k.alpha, "", "the same"),
        ("β with errors of the bodies", k.beta, "", "the same"),
        ("ω left", k.omega, "1/s", "what ΔM takes of ω, by multipliers"),
        ("P with errors of the bodies", k.power, "W", "drift of f, damping beyond D₀ and friction"),
    )
    return tuple(
        Claim(name, value, unit, Label.PROVED, f"{why}, {here}", Group.BODIES) for name, value, unit, why in rows
    )


def _mean(instants: Scalars, x: Scalars) -> float:
    """Root of the mean square over time."""
    h = np.diff(instants)
    return math.sqrt(float((h * np.maximum(x[1:], x[:-1]) ** 2).sum() / h.sum()))
