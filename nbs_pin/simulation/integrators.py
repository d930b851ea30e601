"""Integrators: one step of a mechanical state (q, v) with the acceleration a(q, v)."""

from collections.abc import Callable
from typing import Literal, TypeAlias

from nbs_pin.base.arrays import Array

Vector: TypeAlias = Array
Acceleration: TypeAlias = Callable[[Vector, Vector], Vector]
"""a(q, v) [rad/s²] with the torque held."""
Integrator: TypeAlias = Callable[[Acceleration, Vector, Vector, float], tuple[Vector, Vector]]
"""(a, q, v, h) -> (q, v) after h seconds."""
IntegratorName: TypeAlias = Literal["rk4", "semi_implicit_euler", "euler"]


def rk4(acceleration: Acceleration, q: Vector, v: Vector, h: float) -> tuple[Vector, Vector]:
    """Classical fourth-order Runge–Kutta; global error O(h⁴)."""
    a1 = acceleration(q, v)
    v2 = v + (0.5 * h) * a1
    a2 = acceleration(q + (0.5 * h) * v, v2)
    v3 = v + (0.5 * h) * a2
    a3 = acceleration(q + (0.5 * h) * v2, v3)
    v4 = v + h * a3
    a4 = acceleration(q + h * v3, v4)
    return q + (h / 6.0) * (v + 2.0 * (v2 + v3) + v4), v + (h / 6.0) * (a1 + 2.0 * (a2 + a3) + a4)


def semi_implicit_euler(acceleration: Acceleration, q: Vector, v: Vector, h: float) -> tuple[Vector, Vector]:
    """v⁺ = v + h a, q⁺ = q + h v⁺: first order, called Euler in MuJoCo."""
    v = v + h * acceleration(q, v)
    return q + h * v, v


def euler(acceleration: Acceleration, q: Vector, v: Vector, h: float) -> tuple[Vector, Vector]:
    """q⁺ = q + h v, v⁺ = v + h a: first order, gains energy; used by the paper's authors (docs/theory.md §8)."""
    return q + h * v, v + h * acceleration(q, v)


INTEGRATORS: dict[str, Integrator] = {"rk4": rk4, "semi_implicit_euler": semi_implicit_euler, "euler": euler}
"""All integrators by name."""
