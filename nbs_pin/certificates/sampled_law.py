"""A loop with held torques: what its proof needs of law, arm, reference, readings and disturbance."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from nbs_pin.base.arrays import JointArray
from nbs_pin.base.rounding import diagonal_below, largest_eigenvalue, least_eigenvalue
from nbs_pin.certificates.admissible import Admissible
from nbs_pin.certificates.constants import Constants
from nbs_pin.certificates.coriolis import CoriolisBounds, MotionBounds
from nbs_pin.certificates.sampling import Noise, Timing
from nbs_pin.controllers.lyapunov_law import LyapunovLaw
from nbs_pin.dynamics.friction import JointFriction

UP = 1.0 + 1e-9


class Fed(NamedTuple):
    """Friction f̂ = b̂φ + ĉ tanh(φ/ε) that the law feeds forward and holds."""

    jump: float = 0.0
    """|2ĉ|_* [√W]."""
    viscous: float = 0.0
    """λ_max(D₀^-½b̂D₀^-½)."""
    slope: float = 0.0
    """λ_max(D₀^-½(b̂ + ĉ/ε)D₀^-½)."""
    power: float = 0.0
    """P of docs/certificates.md §8 [W]."""

    @classmethod
    def of(cls, friction: JointFriction | None, constants: Constants, power: float) -> "Fed":
        """That of the law, None for none; `power` is P."""
        if friction is None:
            return NOT_FED
        jump = Admissible.of(2.0 * friction.coulomb, len(friction.coulomb)).energy(constants.metric)
        root = root_of_inverse(constants.floor)
        steepest = friction.viscous + friction.coulomb / friction.transition
        viscous, slope = (UP * largest_eigenvalue(root @ np.diag(x) @ root) for x in (friction.viscous, steepest))
        return cls(math.sqrt(jump) * UP, viscous, slope, power * UP)


NOT_FED = Fed()


def root_of_inverse(floor: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """D₀^-½."""
    values, vectors = np.linalg.eigh(floor)
    return np.asarray((vectors / np.sqrt(values)) @ vectors.T)


@dataclass(frozen=True, eq=False)
class SampledLaw:
    """What the proof needs of law, arm, reference and disturbance."""

    law: LyapunovLaw
    constants: Constants
    arm: CoriolisBounds
    motion: MotionBounds
    t: float
    """√Δ, with friction as a disturbance."""
    alpha: float
    """α of friction, docs/certificates.md §8."""
    friction: JointArray
    """Viscous friction of the joints within D₀, which is not held [N·m·s/rad]."""
    h: float
    """Period [s]."""
    lead: float
    """Look-ahead [s]."""
    delay: float = 0.0
    """From the reading to the beginning of the hold that it acts in [s]."""
    step: JointArray | None = None
    """Encoder steps, with velocities that are differences over a period [rad]; None for exact states."""
    fed: Fed = NOT_FED
    """What the law feeds forward of friction."""
    unfed: JointArray | None = None
    """|b − b̂|, the viscous friction that it does not, None for `friction` [N·m·s/rad]."""

    @cached_property
    def timing(self) -> Timing:
        """When the law reads and acts."""
        return Timing(self.h, self.lead, self.delay, self.step is not None)

    @cached_property
    def noise(self) -> Noise:
        """What the encoders add to the readings."""
        isk = 1.0 / math.sqrt(self.constants.kappa)
        return Noise.of(self.timing, self.step, self.constants.floor, self.arm.diagonal, isk)

    @property
    def fastest(self) -> float:
        """Largest rate of V' [1/s]."""
        return 2.0 * min(self.constants.rho, self.constants.omega + self.constants.kappa)

    @property
    def past(self) -> float:
        """How much more what was m holds ago weighs than what is now."""
        decay = 0.500001 * self.h * self.fastest
        return ((1.0 + decay) / (1.0 - decay)) ** self.timing.holds if decay < 1.0 else math.inf

    @property
    def left(self) -> float:
        """1 − (½h + T)ν: the share of the inertia that V' counts."""
        return 1.0 - (0.5 * self.h + self.timing.age) * self.constants.nu

    @cached_property
    def root(self) -> Float[np.ndarray, "n n"]:
        """D₀^-½."""
        return root_of_inverse(self.constants.floor)

    @cached_property
    def viscous(self) -> float:
        """Largest share of viscous friction in D₀."""
        return largest_eigenvalue(self.root @ np.diag(self.friction) @ self.root)

    @cached_property
    def unfed_viscous(self) -> float:
        """The same for what is not fed forward."""
        return self.viscous if self.unfed is None else largest_eigenvalue(self.root @ np.diag(self.unfed) @ self.root)

    @cached_property
    def loss_of_speed(self) -> float:
        """λ_max(Λ^½D₀Λ^½): |Λf|² ≤ loss_of_speed·fᵀΛf."""
        rate = np.sqrt(self.constants.rate)
        return largest_eigenvalue(rate[:, None] * self.constants.floor * rate)


class Curvature(NamedTuple):
    """∇²Φ = cΛ⁻¹ + Ψ on a set of z1."""

    centre: float
    """c [1/s]."""
    steepest: float
    """λ_max(D₀^-½∇²ΦD₀^-½)."""
    growth: float
    """a with z1ᵀ∇Φ ≤ aΦ."""
    loss: float
    """λ_max(Λ^½∇²ΦΛ^½)."""
    rest: float
    """‖D₀^-½ΨD₀^-½‖."""
    rest_loss: float
    """‖Λ^½ΨΛ^½‖."""
    change: float
    """|D₀^-½(∇²Φ(z) − ∇²Φ(z'))D₀^-½| ≤ change·|z − z'|."""

    @classmethod
    def of(cls, loop: SampledLaw, potential: float) -> "Curvature":
        """The bounds where z1ᵀSz1 ≤ potential."""
        return cls.with_diagonal(loop, potential)[0]

    @classmethod
    def with_diagonal(cls, loop: SampledLaw, potential: float) -> "tuple[Curvature, JointArray]":
        """The bounds where z1ᵀSz1 ≤ potential, and that of the diagonal of ∇²Φ [N·m/rad]."""
        k, root, rate = loop.constants, loop.root, np.sqrt(loop.constants.rate)
        radii = np.sqrt(potential / diagonal_below(k.stiffness))
        low, high = loop.law.stiffness_range(radii)
        if not np.isfinite(high).all():
            return cls(*np.full(7, np.inf)), np.diag(high)
        losses = least_eigenvalue(rate[:, None] * low * rate), largest_eigenvalue(rate[:, None] * high * rate)
        centre, shape = 0.5 * (losses[0] + losses[1]), np.linalg.inv(np.linalg.cholesky(k.stiffness))
        middle = centre * np.diag(1.0 / k.rate)
        above, below = largest_eigenvalue(root @ (high - middle) @ root), least_eigenvalue(root @ (low - middle) @ root)
        found = cls(
            centre=centre,
            steepest=largest_eigenvalue(root @ high @ root),
            growth=largest_eigenvalue(shape @ high @ shape.T),
            loss=losses[1],
            rest=max(above, -below),
            rest_loss=0.5 * (losses[1] - losses[0]),
            change=loop.law.stiffness_rate(radii, diagonal_below(k.floor)),
        )
        return found, np.asarray(np.diag(high))
