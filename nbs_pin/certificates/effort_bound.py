"""Bounds of the torque that a law asks for while its storage function is below a level (docs/certificates.md §15)."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from nbs_pin.base.arrays import JointArray
from nbs_pin.base.rounding import largest_eigenvalue
from nbs_pin.certificates.constants import Constants, above_inverse
from nbs_pin.certificates.coriolis import CoriolisBounds, MotionBounds, Sizes
from nbs_pin.certificates.sampled_law import UP, Curvature
from nbs_pin.controllers.lyapunov_law import LyapunovLaw


class Asked(NamedTuple):
    """What the torque that a law asks for depends on, besides the arm and the reference."""

    law: LyapunovLaw
    constants: Constants
    curve: Curvature
    stiffest: JointArray
    """Bound of the diagonal of ∇²Φ [N·m/rad]."""
    level: float
    """Φ + ½z2ᵀM z2 at most [J]."""

    @property
    def kinetic(self) -> float:
        """|z2|_M at most."""
        return math.sqrt(2.0 * self.level)

    @property
    def descent(self) -> float:
        """x = √(∇ΦᵀΛ∇Φ) at most."""
        return math.sqrt(self.curve.loss * self.curve.growth * self.level)


def speed_bound(asked: Asked, arm: CoriolisBounds) -> JointArray:
    """How far each velocity can be from that of the reference, |v_i − v_d,i| with v − v_d = z2 − Λ∇Φ [rad/s]."""
    if not np.isfinite(asked.curve).all():
        return np.full(len(arm.single), np.inf)
    # The squares of |z2|_M and of √Φ share the level.
    return np.asarray(arm.single * math.hypot(asked.kinetic, arm.loss_m * asked.descent) * UP)


def torque_bound(asked: Asked, arm: CoriolisBounds, motion: MotionBounds, half: float) -> JointArray:
    """How far each torque of the law can be from that of the reference at its samples [N·m]; inf if unknown.

    The difference of τ = M(φ̇ − ωz2) + C(q, v)φ + G − ∇Φ − D z2 + f̂(φ) from M a_d + C(q_d, v_d)v_d + G + f̂(v_d) at q_d.
    half: half the time between the samples [s].
    """
    share = asked.law.damping_share(math.sqrt(asked.constants.nu) * asked.kinetic * UP)
    if not (math.isfinite(arm.turn) and np.isfinite(asked.curve).all() and math.isfinite(share)):
        return np.full(len(asked.constants.floor), np.inf)
    rows = _Rows(asked, arm, motion)
    parts = rows.feedback(share), rows.coriolis(), (0.0, rows.pose()), (0.0, rows.viscous * rows.pull)
    by_speed, by_potential = (sum(side) for side in zip(*parts, strict=True))
    # |z2|_M and √Φ share the level.
    linear = math.sqrt(asked.level) * np.hypot(math.sqrt(2.0) * by_speed, by_potential)
    slipped = rows.slipped(rows.pull * math.sqrt(asked.level))
    return np.asarray((linear + rows.curved() + slipped + rows.between(half)) * UP)


@dataclass(frozen=True, eq=False)
class _Rows:
    """The parts of the difference, for each joint; z2, and p = Λ∇Φ with √(∇ΦᵀΛ∇Φ) ≤ `steep`·√Φ."""

    asked: Asked
    arm: CoriolisBounds
    motion: MotionBounds

    def feedback(self, share: float) -> tuple[JointArray, JointArray]:
        """M(φ̇ − ωz2 − a_d) − ∇Φ − D z2: what stands before |z2|_M, and before √Φ. share: n of D ⪯ (1 + n)D₀."""
        k, curve, arm = self.asked.constants, self.asked.curve, self.arm
        far = self.isk * self.slowing**2 * curve.rest  # |ΛΨb|_M ≤ far|b|
        loss = arm.loss_m * curve.rest_loss
        turned = min(far * self.snu, loss * min(arm.loss_inverse, self.snu / math.sqrt(k.delta)))
        pulled = curve.centre * arm.loss_m + min(far * self.slowing, loss)
        # D = (1 + ½n)D₀ and a rest within ±½nD₀.
        damping = (1.0 + 0.5 * share) * np.abs(k.floor) @ arm.single + 0.5 * share * self.own * self.snu
        by_speed = self.row * (curve.centre + k.omega + turned) + damping
        return by_speed, self.row * pulled * self.steep + np.sqrt(self.asked.stiffest * curve.growth)

    def coriolis(self) -> tuple[JointArray, JointArray]:
        """C(q, z2)v_d, and C(q, p)v_d + C(q, v_d)p."""
        arm, wanted = self.arm, self._wanted
        of_rates = arm.christoffel @ self.motion.fastest  # |C(q, b)v_d| ≤ of_rates |b|, entry by entry
        by_energy = of_rates @ arm.single
        by_speed = self.snu * np.sqrt(np.einsum("ij,jk,ik->i", of_rates, self._inverse, of_rates))
        by_pull = np.sqrt(of_rates**2 @ self.asked.constants.rate)
        speed = self._bilinear(arm.sizes(1.0, self.snu), wanted), by_energy, by_speed
        pulled = self._bilinear(arm.sizes(arm.loss_m, self.slowing), wanted), by_energy * arm.loss_m, by_pull
        return np.min(speed, axis=0), 2.0 * self.steep * np.min(pulled, axis=0)

    def curved(self) -> JointArray:
        """C(q, ż1)p [N·m], for the whole level."""
        asked, arm = self.asked, self.arm
        pull = arm.loss_m * asked.descent, self.slowing * asked.descent
        error = math.hypot(asked.kinetic, pull[0]), math.hypot(self.snu * asked.kinetic, pull[1])
        return self._bilinear(arm.sizes(*error), arm.sizes(*pull))

    def pose(self) -> JointArray:
        """M a_d + C(q, v_d)v_d + G over z1 with z1ᵀSz1 ≤ Φ, before √Φ."""
        arm, softness = self.arm, np.abs(above_inverse(self.asked.constants.stiffness))
        weight = np.sqrt(np.einsum("ij,jk,ik->i", arm.gravity_slope, softness, arm.gravity_slope))
        inertia = math.sqrt(arm.by_floor @ softness @ arm.by_floor) * self.own * self.motion.acceleration
        return np.asarray(weight + inertia + math.sqrt(softness.sum()) * self._turning)

    def between(self, half: float) -> JointArray:
        """What the reference's torque changes in the time to the nearest sample [N·m]."""
        arm, motion = self.arm, self.motion
        faster = arm.sizes(self.isk * motion.acceleration, motion.acceleration)
        change = motion.turn_d * self.own * motion.acceleration + motion.speed_1 * self._turning
        change += arm.gravity_slope @ motion.fastest + self.row * self.isk * motion.jerk
        change += 2.0 * self._bilinear(faster, self._wanted)
        gained = half * motion.acceleration * np.sqrt(np.diag(self._inverse))
        return np.asarray(half * change + self.viscous * gained + self.slipped(gained))

    def slipped(self, moved: JointArray) -> JointArray:
        """What Coulomb friction that is fed forward changes over velocities that far apart [N·m]."""
        friction = self.asked.law.friction
        if friction is None:
            return np.zeros(len(moved))
        return np.minimum(2.0, moved / friction.transition) * friction.coulomb

    @property
    def viscous(self) -> JointArray:
        """Viscous friction that is fed forward [N·m·s/rad]."""
        friction = self.asked.law.friction
        return np.zeros(self.asked.law.nv) if friction is None else friction.viscous

    @cached_property
    def pull(self) -> JointArray:
        """|p_i| ≤ pull_i √Φ."""
        return self.steep * np.minimum(np.sqrt(self.asked.constants.rate), self.arm.single * self.arm.loss_m)

    @cached_property
    def steep(self) -> float:
        return math.sqrt(self.asked.curve.loss * self.asked.curve.growth)

    @cached_property
    def slowing(self) -> float:
        """|Λf| ≤ slowing √(fᵀΛf)."""
        rate = np.sqrt(self.asked.constants.rate)
        return math.sqrt(largest_eigenvalue(rate[:, None] * self.asked.constants.floor * rate))

    @cached_property
    def isk(self) -> float:
        """|b|_M ≤ isk|b|."""
        return 1.0 / math.sqrt(self.asked.constants.kappa)

    @cached_property
    def snu(self) -> float:
        """|b| ≤ snu|b|_M."""
        return math.sqrt(self.asked.constants.nu)

    @cached_property
    def row(self) -> JointArray:
        """|(Mb)_i| ≤ row_i|b|_M."""
        return np.sqrt(self.arm.diagonal)

    @cached_property
    def own(self) -> JointArray:
        """|(D₀b)_i| ≤ own_i|b|."""
        return np.sqrt(np.diag(self.asked.constants.floor))

    @cached_property
    def _inverse(self) -> Float[np.ndarray, "n n"]:
        """|D₀⁻¹|."""
        return np.abs(above_inverse(self.asked.constants.floor))

    @cached_property
    def _wanted(self) -> Sizes:
        motion = self.motion
        return Sizes(motion.turn, motion.turn_d, self.isk * motion.speed, motion.speed)

    @cached_property
    def _turning(self) -> JointArray:
        """What C(q, v_d)v_d changes per angle that any joint turns [N·m/rad]."""
        return 2.0 * self._norms(self._wanted, self._wanted)[1]

    def _bilinear(self, a: Sizes, b: Sizes) -> JointArray:
        """Bound of |(C(q, a)b)_i| in every pose [N·m]."""
        return np.minimum(*self._norms(a, b))

    def _norms(self, a: Sizes, b: Sizes) -> tuple[JointArray, JointArray]:
        """The same, in the norm of M and in that of D₀."""
        arm = self.arm
        by_energy = self.row * (a.turn * b.energy + b.turn * a.energy) + arm.relative * a.energy * b.energy
        by_speed = self.own * (a.turn_d * b.speed + b.turn_d * a.speed) + arm.by_floor * a.speed * b.speed
        return 0.5 * by_energy, 0.5 * by_speed
