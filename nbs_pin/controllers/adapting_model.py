"""The model of an adaptive law at one instant: its torque beyond the believed model, and how its estimates move."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from nbs_pin.base.arrays import Array, array_namespace, constant_like
from nbs_pin.controllers.matrix_logistic import logistic_and_cut
from nbs_pin.controllers.unknowns import UPPER, Unknowns
from nbs_pin.dynamics.body_fields import BodyFields, body_fields
from nbs_pin.dynamics.rigid_tree import RigidTree
from nbs_pin.kernels.layout import NumberCode
from nbs_pin.kernels.symmetric4 import FARTHEST, TRIANGLE

_PLACES = np.zeros((4, 4), dtype=np.int64)
_PLACES[UPPER] = _PLACES.T[UPPER] = np.arange(TRIANGLE)


class Duals(NamedTuple):
    """Duals of bodies (..., B, 4, 4) and of numbers (..., K), or what is like them."""

    bodies: Array
    numbers: Array

    @classmethod
    def of(cls, flat: Array, bodies: int) -> "Duals":
        """From one vector (..., m): the upper triangles of the bodies, then the numbers."""
        split = TRIANGLE * bodies
        return cls(flat[..., :split].reshape(*flat.shape[:-1], bodies, TRIANGLE)[..., _PLACES], flat[..., split:])

    def flat(self) -> Array:
        """That vector."""
        triangles = self.bodies[..., UPPER[0], UPPER[1]]
        rows = triangles.reshape(*triangles.shape[:-2], TRIANGLE * triangles.shape[-2])
        return array_namespace(self.numbers).concat([rows, self.numbers], axis=-1)


@dataclass(frozen=True, eq=False)
class AdaptingModel:
    """Estimates and motion at one instant."""

    unknowns: Unknowns
    duals: Duals
    """Cut to what the estimates can be."""
    shares: Duals
    """X̂ of every body, x of every number."""
    fields: BodyFields
    factors: Array
    """Factor of every number in the torque of its joint, (..., K)."""

    @classmethod
    def of(
        cls, unknowns: Unknowns, tree: RigidTree, gravity: np.ndarray,
        duals: Array, q: Array, v: Array, v_r: Array, a_r: Array,
    ) -> "AdaptingModel":  # fmt: skip
        """The model at (..., n) states and reference velocities and accelerations, with duals (..., m)."""
        xp, given = array_namespace(q), Duals.of(duals, len(unknowns.bodies))
        x, cut = logistic_and_cut(given.bodies)
        numbers = xp.clip(given.numbers, -FARTHEST, FARTHEST)
        kinds = {
            NumberCode.VISCOUS: v_r,
            NumberCode.COULOMB: xp.tanh(v_r / unknowns.transition),
            NumberCode.ROTOR: a_r,
            NumberCode.OFFSET: 1.0 + 0.0 * q,
            NumberCode.ACCELERATION: 1.0 + 0.0 * q,
        }
        columns = [kinds[number.code][..., number.joint] for number in unknowns.numbers]
        factors = xp.stack(columns, axis=-1) if columns else 0.0 * q[..., :0]
        shares = Duals(x, 1.0 / (1.0 + xp.exp(-numbers)))
        return cls(unknowns, Duals(cut, numbers), shares, body_fields(tree, gravity, q, v, v_r, a_r), factors)

    def torque(self) -> Array:
        """What the estimates add to the torque of the believed model, (..., n) [N·m]."""
        bodies: list[Array | None] = [None] * len(self.fields.parents)
        for k, body in enumerate(self.unknowns.bodies):
            factor, known = (constant_like(self.factors, x) for x in (body.factor, body.known))
            excess = factor @ self.shares.bodies[..., k, :, :] @ factor.T - known
            bodies[body.joint] = excess if bodies[body.joint] is None else bodies[body.joint] + excess
        return self.fields.torque(bodies) + self._excess(lambda code: code != NumberCode.ACCELERATION)

    def accelerations(self) -> Array:
        """What the estimates add to the acceleration a_r, (..., n)."""
        return self._excess(lambda code: code == NumberCode.ACCELERATION)

    def _excess(self, chosen: Callable[[NumberCode], bool]) -> Array:
        """What chosen numbers add beyond the known ones, per joint."""
        rows = [(one.lowest, one.width, one.known, chosen(one.code)) for one in self.unknowns.numbers]
        table = np.array(rows, dtype=float).reshape(-1, 4).T
        lowest, width, known, picked = (constant_like(self.factors, x) for x in table)
        added = (lowest + width * self.shares.numbers - known) * picked * self.factors
        return added @ constant_like(self.factors, self._joints())

    def slopes(self, mu: Array) -> Duals:
        """The derivatives KᵀLK of μᵀτ by X̂ of every body, and by x of every number."""
        xp, own = array_namespace(mu), []
        velocities = self.fields.velocities(mu)
        for body in self.unknowns.bodies:
            power = xp.swapaxes(velocities[body.joint], -1, -2) @ self.fields.accelerations[body.joint]
            factor = constant_like(mu, body.factor)
            own.append(0.5 * factor.T @ (power + xp.swapaxes(power, -1, -2)) @ factor)
        width = constant_like(mu, np.array([number.width for number in self.unknowns.numbers], dtype=float))
        bodies = xp.stack(own, axis=-3) if own else 0.0 * self.duals.bodies
        return Duals(bodies, width * self.factors * (mu @ constant_like(mu, self._joints().T)))

    def moved(self, z2: Array, rates: Array, leak: Array, period: float) -> Array:
        """The duals (..., m) after a period of Q̇ = −γL − σ(Q − Q₀) with L held."""
        xp, slopes, count = array_namespace(z2), self.slopes(z2), len(self.unknowns.bodies)
        start = Duals.of(constant_like(z2, self.unknowns.start), count)
        keep = xp.exp(-leak * period)
        drive = rates * (period if leak == 0.0 else -xp.expm1(-leak * period) / leak)
        return Duals(
            start.bodies + keep * (self.duals.bodies - start.bodies) - drive[:count, None, None] * slopes.bodies,
            start.numbers + keep * (self.duals.numbers - start.numbers) - drive[count:] * slopes.numbers,
        ).flat()

    def _joints(self) -> np.ndarray:
        """(K, n), 1 where a number belongs to a joint."""
        place = np.zeros((len(self.unknowns.numbers), len(self.fields.parents)))
        place[np.arange(len(place)), [number.joint for number in self.unknowns.numbers]] = 1.0
        return place
