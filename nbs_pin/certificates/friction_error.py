"""Friction of the arm that the law does not feed forward, in the inequalities (docs/certificates.md §8).

With b and c the viscous and Coulomb coefficients of the arm, b̂ and ĉ those fed forward by f̂(φ), Δb = b − b̂,
Δc = c − ĉ, and v = v_d − Λ∇Φ + z2,

    z2ᵀ(f̂(φ) − f(v)) ≤ −z2ᵀb z2 + |z2|ᵀ(|Δb||v_d| + |Δc|) + z2ᵀΔbΛ∇Φ + P.

The first term adds b to D₀. P is for the sign of f, which f̂ smooths.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from nbs_pin.base.arrays import JointArray
from nbs_pin.base.claims import Claim, Group, Label, refuse
from nbs_pin.base.rounding import largest_eigenvalue, up
from nbs_pin.certificates.admissible import Admissible
from nbs_pin.certificates.claims import Assumption, Condition
from nbs_pin.certificates.constants import Constants
from nbs_pin.dynamics.friction import JointFriction, has_viscous_and_coulomb_only

_WORST = 0.2785
"""Above max_x x(1 − tanh x) = 0.27846."""


class FrictionGap(NamedTuple):
    """Friction of the arm, and of it that which is not fed forward."""

    viscous: JointArray
    """Δb, or its largest size where b is known to a share [N·m·s/rad], (n,)."""
    coulomb: JointArray
    """Δc, or its largest size [N·m], (n,)."""
    arm: JointFriction
    """Friction of the arm as stated."""
    damping: JointArray
    """The least b [N·m·s/rad], (n,)."""
    is_shared: bool
    """Whether b or c is known to a share alone."""
    width: float
    """ε, the larger one of f̂ and f [rad/s]."""
    power: float
    """P = max_x x(1 − tanh x) Σ ĉ_i ε [W]."""

    @classmethod
    def of(
        cls,
        nv: int,
        friction: JointFriction | None,
        fed: JointFriction | None,
        shares: tuple[float, float] = (0.0, 0.0),
    ) -> "FrictionGap":
        """The gap between the arm's friction and that fed forward, None for none.

        shares: by which the arm's viscous and Coulomb friction may differ from that stated.
        """
        if not all(has_viscous_and_coulomb_only(f) for f in (friction, fed)):
            refuse("the friction has more terms than viscous and Coulomb friction", "give it with these two alone")
        none = JointFriction(np.zeros(nv), np.zeros(nv))
        arm, law = friction or none, fed or none
        widest = max(arm.transition, law.transition)
        gaps = [arm.viscous - law.viscous, arm.coulomb - law.coulomb]
        for k, (share, stated) in enumerate(zip(shares, (arm.viscous, arm.coulomb), strict=True)):
            gaps[k] = np.abs(gaps[k]) + share * stated if share else gaps[k]
        least = (1.0 - shares[0]) * arm.viscous
        return cls(gaps[0], gaps[1], arm, least, any(shares), widest, _WORST * widest * law.coulomb.sum())

    def torque(self, v: Float[np.ndarray, "*rows n"]) -> Float[np.ndarray, "*rows n"]:
        """Bound of each torque that is not fed forward [N·m]."""
        return np.asarray(np.abs(self.viscous) * np.abs(v) + np.abs(self.coulomb))


class FrictionError(NamedTuple):
    """z2ᵀ(f̂(φ) − f(v)) + z2ᵀb z2 ≤ t y + αxy + P."""

    gap: FrictionGap
    t: float
    alpha: float
    lines: tuple[Claim, ...]
    conditions: tuple[Condition, ...]
    speed: JointArray
    """Bound of |v_d| that they rest on [rad/s], inf where there is none."""


def friction_error(gap: FrictionGap, constants: Constants, speed: JointArray, source: str) -> FrictionError:
    """The terms of a gap for |v_d| ≤ `speed` [rad/s], inf for no bound; `source` says where that comes from.

    The D₀ of `constants` must include b.
    """
    viscous = np.abs(gap.viscous)
    if not (viscous.any() or gap.coulomb.any() or gap.power):
        return FrictionError(gap, 0.0, 0.0, (), (), speed)
    bounded = np.isfinite(speed)
    box = gap.torque(np.where(bounded, speed, 0.0))
    t = math.sqrt(Admissible.of(box, len(box)).energy(constants.metric))
    scaled = viscous * np.sqrt(constants.rate)
    alpha = math.sqrt(up(largest_eigenvalue(scaled[:, None] * constants.metric * scaled))) if viscous.any() else 0.0
    here = "docs/certificates.md §8"
    because = f"|Δb||v_d| + |Δc| of what is not fed forward, |v_d| {source}; {here}"
    lines = (
        Claim("friction, largest joint", float(box.max()), "N·m", Label.PROVED, because, Group.FRICTION),
        Claim("α of viscous friction", alpha, "", Label.PROVED, here, Group.FRICTION),
        Claim("P of Coulomb friction fed forward smoothly", gap.power, "W", Label.PROVED, here, Group.FRICTION),
    )
    if not viscous.any():
        return FrictionError(gap, t, alpha, lines, (), speed)
    name, fastest = "∞ > speed of the reference, for viscous friction", float(speed[viscous > 0.0].max())
    known = Condition(name, math.inf, fastest, "rad/s", Label.PROVED, f"|v_d| {source}", checks=Assumption.FRICTION)
    return FrictionError(gap, t, alpha, lines, (known,), speed)
