"""Bounds of Ṁ and of C(q, v) over a hold, each part of the velocity in the norm that suits it (certificates.md §13)."""

from dataclasses import dataclass
from typing import NamedTuple

from nbs_pin.certificates.coriolis import CoriolisBounds, MotionBounds


class Coriolis(NamedTuple):
    """Bounds of C(q, v)."""

    by_speed: float
    """|C(q, v)z|_* ≤ by_speed·|z|, in every pose for any v of the hold."""
    here: float
    """|C(q, v)z|_* ≤ here·|z| in the pose in which the arm has the velocity v."""
    by_energy: float
    """|C(q, v)z|_* ≤ by_energy·|z|_M."""
    slow: float
    """|C(q, φ)b|_* ≤ slow·|b|_M, with φ in place of v."""
    form: float
    """|aᵀC(q, v)b| ≤ form·|a|_M|b|_M."""
    slow_form: float
    """|aᵀC(q, φ)b| ≤ slow_form·|a|_M|b|_M."""


class Norms(NamedTuple):
    """How the norms of a velocity compare: b of any kind, and f of Λf."""

    isk: float
    """|b|_M ≤ isk·|b|."""
    snu: float
    """|b| ≤ snu·|b|_M."""
    loss: float
    """|Λf| ≤ loss·√(fᵀΛf)."""


@dataclass(frozen=True)
class Velocity:
    """The velocity of the arm during a hold: v = v_d + ż1 with ż1 = z2 − Λ∇Φ."""

    arm: CoriolisBounds
    motion: MotionBounds
    norms: Norms
    rate: float
    """|ż1|."""
    rate_m: float
    """|ż1|_M."""
    speed_m: float
    """|z2|_M."""
    loss: float
    """√(∇ΦᵀΛ∇Φ)."""

    @property
    def turn(self) -> float:
        """Σ γ_i|v_i|: ±Ṁ ⪯ turn·M in every pose [1/s]."""
        return self.motion.turn + self._sum(self.arm.turn, self.arm.spread, self.arm.pull)

    @property
    def sum(self) -> float:
        """Σ |v_i| [rad/s]."""
        return self.motion.speed_1 + self._sum(self.arm.sum_m, self.arm.sum, self.arm.pull_sum)

    def coriolis(self, ahead: float) -> Coriolis:
        """The bounds of C; ahead: √(∇ΦᵀΛ∇Φ) also of the predicted state."""
        arm, motion, (isk, snu, los) = self.arm, self.motion, self.norms
        turned = motion.turn_d + self._sum(arm.turn_d, arm.spread_d, arm.pull_d)
        mixed = min(arm.turn_d, arm.spread_d * snu)
        slow_angle = motion.turn + min(arm.turn * arm.loss_m, arm.spread * los, arm.pull) * ahead
        slow = mixed * motion.speed + min(mixed * los, isk * arm.turn * arm.loss_m) * ahead
        error = self._sum(isk * arm.spread, arm.spread_d, arm.spread_d * los)
        error_m = self._sum(isk * arm.turn, mixed, mixed * los)
        reference_m = isk * motion.speed
        speed_m = reference_m + self.rate_m
        return Coriolis(
            by_speed=0.5 * (turned + 2.0 * arm.spread_d * (motion.speed + self.rate)),
            here=0.5 * (turned + 2.0 * (arm.spread_d * motion.speed + error)),
            by_energy=0.5 * (isk * self.turn + mixed * motion.speed + error_m + arm.spread * speed_m),
            slow=0.5 * (isk * slow_angle + slow + arm.spread * (reference_m + arm.loss_m * ahead)),
            form=0.5 * (self.turn + 2.0 * arm.turn * speed_m),
            slow_form=0.5 * (slow_angle + 2.0 * arm.turn * (reference_m + arm.loss_m * ahead)),
        )

    def _sum(self, by_m: float, by_d: float, pull: float) -> float:
        """A seminorm of ż1 that is at most by_m·|b|_M and by_d·|b| for all b, and pull·√(fᵀΛf) for b = Λf."""
        return min(by_m * self.rate_m, by_d * self.rate, by_m * self.speed_m + pull * self.loss)
