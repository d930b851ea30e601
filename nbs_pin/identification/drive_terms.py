"""What the drive of a joint adds to the torque of its bodies, linear in its unknowns.

    τ = Y(q, v, v̇) π + viscous·v + coulomb·tanh(v/ε) + offset + asymmetry·|v| + stribeck·exp(−(v/v_s)²)·tanh(v/ε)
        + load·|Yπ + rotor·v̇|·tanh(v/ε) + rotor·v̇

The load is taken from a fit without this term.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import lsq_linear

from nbs_pin.base.arrays import JointArray
from nbs_pin.dynamics.friction import DriveFriction, JointFriction
from nbs_pin.identification.datasets import Dataset

TERMS = ("viscous", "coulomb", "offset", "asymmetry", "stribeck", "load", "rotor")
"""All terms, the rotor inertia last."""
_MOST_LOAD = 0.9
"""Largest share of the load that friction takes: with all of it, no torque would move the joint."""
SIGNED = ("offset", "asymmetry")
"""Terms of any sign; the others are ≥ 0."""


@dataclass(frozen=True, eq=False)
class DriveTerms:
    """The terms that each joint has."""

    used: Bool[np.ndarray, "terms n"]
    """Rows as in `TERMS`."""
    transition: float
    """ε: speed scale of the Coulomb friction [rad/s]."""
    stribeck_speed: JointArray
    """v_s [rad/s]."""

    @classmethod
    def of(cls, n: int, *names: str, transition: float = 0.01) -> "DriveTerms":
        """These terms in each of n joints."""
        used = np.array([[name in names] * n for name in TERMS])
        return cls(used, transition, np.full(n, 0.1))

    @classmethod
    def of_friction(cls, friction: JointFriction) -> tuple["DriveTerms", Float[np.ndarray, "kinds n"]]:
        """The terms of a friction, and their numbers."""
        drive = friction if isinstance(friction, DriveFriction) else None
        names = TERMS[:2] if drive is None else TERMS[:-1]
        n, speed = friction.viscous.size, np.full(friction.viscous.size, 0.1)
        terms = cls.of(n, *names, transition=friction.transition)
        speed = speed if drive is None else drive.stribeck_speed
        return replace(terms, stribeck_speed=speed), np.array([getattr(friction, name) for name in names])

    @property
    def kinds(self) -> tuple[str, ...]:
        """The terms that some joint has: rows of all that follows."""
        return tuple(name for name, row in zip(TERMS, self.used, strict=True) if row.any())

    @property
    def signed(self) -> Bool[np.ndarray, "kinds n"]:
        """Where a number may be negative."""
        return np.array([[name in SIGNED] * self.used.shape[1] for name in self.kinds], dtype=bool).reshape(
            -1, self.used.shape[1]
        )

    def factors(
        self, data: Dataset, needed: Float[np.ndarray, "samples n"] | None = None
    ) -> Float[np.ndarray, "kinds samples n"]:
        """Derivative of each joint's torque by its own numbers; zero where a joint lacks the term.

        needed: Yπ + rotor·v̇ [N·m], for load-dependent friction; None takes the measured torque for it.
        """
        rows = [self.factor(name, data, needed) * self.used[TERMS.index(name)] for name in self.kinds]
        return np.array(rows).reshape(-1, *data.v.shape)

    def factor(
        self, name: str, data: Dataset, needed: Float[np.ndarray, "samples n"] | None = None
    ) -> Float[np.ndarray, "samples n"]:
        """Derivative of the torques by one term, whether joints have it or not."""
        v, side = data.v, np.tanh(data.v / self.transition)
        match name:
            case "viscous":
                return v
            case "coulomb":
                return side
            case "offset":
                return np.ones_like(v)
            case "asymmetry":
                return np.abs(v)
            case "stribeck":
                return np.exp(-np.square(v / self.stribeck_speed)) * side
            case "load":
                return np.abs(data.tau if needed is None else needed) * side
            case _:
                return data.a

    def solved(
        self, factors: Float[np.ndarray, "kinds samples n"], left: Float[np.ndarray, "samples n"]
    ) -> Float[np.ndarray, "kinds n"]:
        """The numbers that explain the torque `left` [N·m] best, by least squares within their signs."""
        found = np.zeros((len(factors), left.shape[1]))
        for j in range(left.shape[1]):
            own = np.flatnonzero(np.abs(factors[:, :, j]).max(axis=1, initial=0.0) > 0.0)
            if own.size:
                least = np.where(self.signed[own, j], -np.inf, 0.0)
                found[own, j] = lsq_linear(factors[own, :, j].T, left[:, j], (least, np.inf)).x
        return found

    def names(self, joints: Sequence[str]) -> list[str]:
        """Names of the numbers, joint by joint in every kind."""
        return [f"{kind}({joint})" for kind in self.kinds for joint in joints]

    def numbers(self, found: Float[np.ndarray, "kinds n"]) -> Mapping[str, JointArray]:
        """The numbers of every term of `TERMS`, zero where a joint lacks it."""
        given = dict(zip(self.kinds, found, strict=True))
        n = self.used.shape[1]
        return {
            name: np.where(row, given.get(name, np.zeros(n)), 0.0) for name, row in zip(TERMS, self.used, strict=True)
        }

    def friction(
        self, found: Float[np.ndarray, "kinds n"], coupling: Float[np.ndarray, "n n"] | None = None
    ) -> JointFriction | None:
        """The friction with these numbers, of the simplest class that has its terms; None if no joint has any."""
        numbers = self.numbers(found)
        plain, more = self.used[:2].any(), self.used[2:6].any()
        if not (plain or more):
            return None
        viscous, coulomb = numbers["viscous"], numbers["coulomb"]
        if not more and coupling is None:
            return JointFriction(viscous, coulomb, self.transition)
        return DriveFriction(
            viscous,
            coulomb,
            self.transition,
            numbers["offset"],
            numbers["asymmetry"],
            numbers["stribeck"],
            self.stribeck_speed,
            np.minimum(numbers["load"], _MOST_LOAD),
            coupling,
        )

    def rotors(self, found: Float[np.ndarray, "kinds n"]) -> JointArray | None:
        """The rotor inertias with these numbers, None if no joint has any."""
        return self.numbers(found)["rotor"] if self.used[-1].any() else None

    @property
    def count(self) -> int:
        """How many numbers there are."""
        return int(self.used.sum())

    def without(self, *names: str) -> "DriveTerms":
        """All but these terms."""
        keep = np.array([name not in names for name in TERMS])
        return replace(self, used=self.used & keep[:, None])
