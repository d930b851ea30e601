"""Bounds of the torque that a law asks for while its storage function is below a level (docs/certificates.md §15)."""

import math
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

    The difference of τ = M(φ̇ − ωz2) + C(q, v)φ + G − ∇Φ − D z2 from M a_d + C(q_d, v_d)v_d + G at q_d.
    half: half the time between the samples [s].
    """
    law, k, curve, level, kinetic = asked.law, asked.constants, asked.curve, asked.level, asked.kinetic
    floor, isk, snu = k.floor, 1.0 / math.sqrt(k.kappa), math.sqrt(k.nu)
    rate = np.sqrt(k.rate)
    slowing = math.sqrt(largest_eigenvalue(rate[:, None] * floor * rate))  # |Λ∇Φ| ≤ slowing x
    share = law.damping_share(snu * kinetic * UP)
    if not (math.isfinite(arm.turn) and np.isfinite(curve).all() and math.isfinite(share)):
        return np.full(len(floor), np.inf)
    rest_m = min(isk * slowing**2 * curve.rest, arm.loss_m * curve.rest_loss / math.sqrt(k.delta))
    row, own = np.sqrt(arm.diagonal), np.sqrt(np.diag(floor))
    # Linear in |z2|_M and in √Φ, whose squares share the level.
    by_speed = row * (curve.centre + k.omega + rest_m * snu) + np.abs(floor) @ arm.single + share * own * snu
    by_potential = row * (curve.centre * arm.loss_m + rest_m * slowing) * math.sqrt(curve.loss * curve.growth)
    by_potential += np.sqrt(asked.stiffest * curve.growth)
    linear = math.sqrt(level) * np.hypot(math.sqrt(2.0) * by_speed, by_potential)
    pull = arm.loss_m * asked.descent, slowing * asked.descent  # Λ∇Φ in the two norms
    error = math.hypot(kinetic, pull[0]), math.hypot(snu * kinetic, pull[1])
    wanted = Sizes(motion.turn, motion.turn_d, isk * motion.speed, motion.speed)
    pairs = (arm.sizes(*error), wanted), (wanted, arm.sizes(*pull)), (arm.sizes(*error), arm.sizes(*pull))
    curved = sum(np.minimum(*_coriolis(arm, row, own, *pair)) for pair in pairs)
    z1 = np.sqrt(level * np.diag(above_inverse(k.stiffness)))
    # The pose, and the time to the nearest sample.
    pose = (float(arm.by_floor @ z1) + half * motion.turn_d) * own * motion.acceleration
    pose += (z1.sum() + half * motion.speed_1) * (arm.weight + 2.0 * _coriolis(arm, row, own, wanted, wanted)[1])
    faster = arm.sizes(isk * motion.acceleration, motion.acceleration)
    pose += half * (row * isk * motion.jerk + 2.0 * np.minimum(*_coriolis(arm, row, own, faster, wanted)))
    return np.asarray((linear + curved + pose) * UP)


def _coriolis(
    arm: CoriolisBounds, row: JointArray, own: JointArray, a: Sizes, b: Sizes
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Bounds of |(C(q, a)b)_i| in every pose [N·m], in the norm of M and in that of D₀."""
    by_energy = row * (a.turn * b.energy + b.turn * a.energy) + arm.relative * a.energy * b.energy
    by_speed = own * (a.turn_d * b.speed + b.turn_d * a.speed) + arm.by_floor * a.speed * b.speed
    return 0.5 * by_energy, 0.5 * by_speed
