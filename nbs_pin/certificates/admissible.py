"""The disturbances a certificate is about: every τ_d(t) whose torques stay inside a box or a ball."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float

from nbs_pin.base.arrays import JointArray, Vectors
from nbs_pin.base.checks import PerJoint, floats
from nbs_pin.base.exceptions import ArgumentError

_LEAST, _GREATEST = 1e-100, 1e100


@dataclass(frozen=True, eq=False)
class Admissible:
    """|τ_d,i| ≤ box_i for every joint or ‖τ_d‖ ≤ radius [N·m], at every instant; nothing else is asked of τ_d(t)."""

    box: JointArray | None = None
    """Largest |τ_d,i| [N·m]."""
    radius: float | None = None
    """Largest ‖τ_d‖ [N·m]."""

    def __post_init__(self) -> None:
        given = np.asarray(self.radius if self.box is None else self.box, dtype=float)
        usable = (given == 0.0) | ((given >= _LEAST) & (given <= _GREATEST))  # whose squares are numbers too
        if (self.box is None) == (self.radius is None) or given.ndim > 1 or not usable.all():
            raise ArgumentError(
                f"disturbance has the box {self.box} and the radius {self.radius} N·m, expected one of the two, every "
                f"number 0 or from {_LEAST:g} to {_GREATEST:g}; correct it."
            )

    @classmethod
    def of(cls, disturbance: "PerJoint | Admissible", nv: int) -> "Admissible":
        """One bound per joint is a box, a single number a ball; raises ArgumentError unless they are finite and ≥ 0."""
        if isinstance(disturbance, Admissible):
            if disturbance.box is not None and len(disturbance.box) != nv:
                raise ArgumentError(
                    f"the disturbance has {len(disturbance.box)} bounds for {nv} joints; give one for each."
                )
            return disturbance
        given = floats("disturbance", disturbance)
        if given.shape not in ((), (nv,)):
            raise ArgumentError(
                f"disturbance is {disturbance}, expected one bound on ‖τ_d‖ or {nv}, one on each |τ_d,i| [N·m]."
            )
        return cls(radius=float(given)) if given.ndim == 0 else cls(box=given)

    def energy(self, metric: Float[np.ndarray, "n n"]) -> float:
        """At least sup τ_dᵀ A τ_d for the positive definite A, and just that for a diagonal A or a ball.

        Over a box: Σ |A_ij| box_i box_j. Rounded up.
        """
        n = len(metric)
        if self.box is not None:
            value = float(self.box @ np.abs(metric) @ self.box)
        else:
            # The spectrum from the symmetric eigenvalue solver, with its error n·eps·‖A‖ eight times over.
            slack = 8.0 * n * np.finfo(float).eps * float(np.linalg.norm(metric))
            value = (self.radius or 0.0) ** 2 * (float(np.linalg.eigvalsh(metric)[-1]) + slack)
        return value * (1.0 + 1e-12)

    @cached_property
    def is_zero(self) -> bool:
        """Whether only τ_d = 0 is admissible."""
        return not self.radius if self.box is None else not self.box.any()

    def contains(self, tau_d: Vectors) -> bool:
        """Whether every torque is admissible, to twelve digits."""
        if self.box is not None:
            return bool((np.abs(tau_d) <= self.box * (1.0 + 1e-12)).all())
        return bool((np.linalg.norm(tau_d, axis=-1) <= (self.radius or 0.0) * (1.0 + 1e-12)).all())

    def towards(self, direction: Vectors) -> Vectors:
        """The admissible torque of greatest inner product with each direction: a corner of the box, or d·g/‖g‖."""
        if self.box is not None:
            return self.box * np.sign(direction)
        size = np.linalg.norm(direction, axis=-1, keepdims=True)
        return (self.radius or 0.0) * direction / np.where(size > 0.0, size, 1.0)

    def __str__(self) -> str:
        if self.box is None:
            return f"‖τ_d‖ ≤ {self.radius:g} N·m"
        if len(set(self.box.tolist())) == 1:
            return f"|τ_d,i| ≤ {self.box[0]:g} N·m on every joint"
        return f"|τ_d,i| ≤ ({', '.join(f'{x:g}' for x in self.box)}) N·m"
