"""Admissible disturbances: every τ_d(t) that stays inside a box or a ball."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float

from nbs_pin.base.arguments import MOST_JOINTS, a, check_fields, checked, count, many, numbers, text
from nbs_pin.base.arrays import JointArray, Vectors
from nbs_pin.base.checks import PerJoint, floats, told
from nbs_pin.base.claims import Claim, Label, weakest
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.units import TURNING, several, with_units

_LEAST, _GREATEST = 1e-100, 1e100


@dataclass(frozen=True, eq=False)
class Admissible:
    """The disturbances with |τ_d,i(t)| ≤ box_i for every joint, or with ‖τ_d(t)‖ ≤ radius, varying arbitrarily in t.

    Raises:
        ArgumentError: If not exactly one of the two is given, or a bound is neither 0 nor between 1e-100 and 1e100.

    Example:
        >>> import nbs_pin as nbs
        >>> print(nbs.Admissible.of([5.0, 2.0], nv=2))
        |τ_d,i| ≤ (5, 2) N·m
    """

    box: JointArray | None = None
    """Largest |τ_d,i| [N·m]."""
    radius: float | None = None
    """Largest ‖τ_d‖ [N·m]."""
    claims: tuple[Claim, ...] = ()
    """How the bound is known where it was computed, as from a payload; none for bounds that are given."""

    def __post_init__(self) -> None:
        is_one = (self.box is None) != (self.radius is None)
        given = floats("disturbance", self.radius if self.box is None else self.box) if is_one else np.zeros(0)
        usable = (given == 0.0) | ((given >= _LEAST) & (given <= _GREATEST))  # its square is a number > 0
        if given.ndim != (self.radius is None) or given.size == 0 or not usable.all():
            raise ArgumentError(
                f"disturbance has the box {told(self.box)} and the radius {told(self.radius)}, in N·m, or N where it "
                f"slides, expected one of the two, each bound 0 or from {_LEAST:g} to {_GREATEST:g}; correct it."
            )
        object.__setattr__(self, *(("radius", float(given)) if self.box is None else ("box", given)))
        check_fields(self, claims=many(a(Claim, "a Claim")))

    @classmethod
    @checked(nv=count(1, MOST_JOINTS, "joints"))
    def of(cls, disturbance: "PerJoint | Admissible", nv: int) -> "Admissible":
        """The box of one bound per joint, the ball of a single number [N·m], or the given `Admissible` itself.

        Raises:
            ArgumentError: If the bounds do not fit `nv` joints, or are not finite and ≥ 0.
        """
        if isinstance(disturbance, Admissible):
            if disturbance.box is not None and len(disturbance.box) != nv:
                raise ArgumentError(
                    f"the disturbance has {len(disturbance.box)} bounds for {nv} joints; give one per joint."
                )
            return disturbance
        given = floats("disturbance", disturbance)
        if given.shape not in ((), (nv,)):
            raise ArgumentError(
                f"disturbance is {told(disturbance)}, expected one bound on ‖τ_d‖ or {nv}, one on each |τ_d,i| "
                "[N·m, N where it slides]."
            )
        return cls(radius=float(given)) if given.ndim == 0 else cls(box=given)

    @property
    def label(self) -> Label:
        """The weakest label of its claims; PROVED for bounds that are given, as these are an assumption."""
        return weakest(*(claim.label for claim in self.claims))

    @checked(nv=count(1, MOST_JOINTS, "joints"))
    def largest(self, nv: int) -> JointArray:
        """Largest |τ_d| of each of the joints [N·m]."""
        return np.full(nv, self.radius) if self.box is None else self.box

    @checked(metric=numbers(None, None))
    def energy(self, metric: Float[np.ndarray, "n n"]) -> float:
        """Upper bound of τ_dᵀAτ_d over the set for A ≻ 0, rounded up; the supremum for a ball or a diagonal A."""
        n = len(metric)
        if metric.shape != (n, n) or (self.box is not None and len(self.box) != n):
            raise ArgumentError(f"A has shape {metric.shape}, expected (n, n) for the {n} joints; correct it.")
        if self.box is not None:
            value = float(self.box @ np.abs(metric) @ self.box)
        else:
            # The symmetric eigenvalue solver is accurate to about n·eps·‖A‖; eight times that is allowed for.
            slack = 8.0 * n * np.finfo(float).eps * float(np.linalg.norm(metric))
            value = (self.radius or 0.0) ** 2 * (float(np.linalg.eigvalsh(metric)[-1]) + slack)
        return value * (1.0 + 1e-12)

    @cached_property
    def is_zero(self) -> bool:
        """Whether only τ_d = 0 is admissible."""
        return not self.radius if self.box is None else not self.box.any()

    def contains(self, tau_d: Vectors) -> bool:
        """Whether every torque is admissible, up to a relative tolerance of 1e-12."""
        tau_d = self._torques("tau_d", tau_d)
        if self.box is not None:
            return bool((np.abs(tau_d) <= self.box * (1.0 + 1e-12)).all())
        return bool((np.linalg.norm(tau_d, axis=-1) <= (self.radius or 0.0) * (1.0 + 1e-12)).all())

    def towards(self, direction: Vectors) -> Vectors:
        """The admissible torque with the greatest inner product with each direction g: box·sign(g), or radius·g/‖g‖."""
        direction = self._torques("direction", direction)
        if self.box is not None:
            return self.box * np.sign(direction)
        size = np.linalg.norm(direction, axis=-1, keepdims=True)
        return (self.radius or 0.0) * direction / np.where(size > 0.0, size, 1.0)

    def _torques(self, name: str, value: Vectors) -> Vectors:
        """The value as an array (..., n)."""
        x = floats(name, value)
        if x.ndim == 0 or (self.box is not None and x.shape[-1] != len(self.box)):
            n = "n" if self.box is None else len(self.box)
            raise ArgumentError(f"{name} has shape {x.shape}, expected (..., {n}); give one number per joint.")
        return x

    @checked(units=many(text, 1, MOST_JOINTS, "units"))
    def told(self, units: Sequence[str]) -> str:
        """The bound in words, with the unit of every joint's torque."""
        if self.box is not None and len(units) != len(self.box):
            raise ArgumentError(f"{len(units)} units were given for {len(self.box)} joints; give one per joint.")
        if self.box is None:
            return f"‖τ_d‖ ≤ {self.radius:g} {several(units)}"
        if len({*zip(self.box.tolist(), units, strict=True)}) == 1:
            return f"|τ_d,i| ≤ {self.box[0]:g} {units[0]} on every joint"
        sides = with_units([f"{x:g}" for x in self.box], units)
        return f"|τ_d,i| ≤ ({', '.join(sides)})" + (f" {units[0]}" if len(set(units)) == 1 else "")

    def __str__(self) -> str:
        return self.told((TURNING.torque,) * (1 if self.box is None else len(self.box)))
