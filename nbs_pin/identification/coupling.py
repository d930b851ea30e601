"""Drives that are coupled: motors that turn with several joints, given or found in data.

Motor k turns by φ_k = Σ_j N_kj q_j, in angles of the joint side, so that the torques of the joints are Nᵀ times those
of the motors. In coordinates of the motors the equations are those of an arm without coupling: the torque of motor k is
row k of N⁻ᵀ Y(q, v, v̇) π and its own friction, offset and rotor inertia, functions of N v and N v̇ (`explain`). Beside
a network its torque takes the place of Y π. A log may hold the torques of the joints, or those of the motors.
"""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize_scalar
from threadpoolctl import threadpool_limits

from nbs_pin.base.arrays import JointArray
from nbs_pin.base.doors import where_printed
from nbs_pin.dynamics.friction import coupling_of
from nbs_pin.identification.datasets import Dataset
from nbs_pin.identification.drive_choice import Wanted
from nbs_pin.identification.explain import noise_of, robust
from nbs_pin.identification.regressor import (
    Geometry,
    RobotGeometry,
    equation_rows,
    of_all_joints,
    torque_size,
    triangle,
)
from nbs_pin.robots.robot import Robot

_SOME = 3_000
"""Samples by which couplings are compared."""
_LEFT = 0.01
"""Unexplained share of the torque's variance of a joint from which on couplings are looked for."""
_BETTER = 0.3
"""Least decrease of Σ_k log σ_k, the residuals' deviations, that makes a coupling: two of 14 % each, one of 26 %."""
_WELL = 0.05
"""Unexplained share of the variance of the motors concerned beyond which a coupling is not believed."""
_EXACT = 1e-6
"""Residual, as a share of the torque, below which one coupling is as good as another."""
_TRIED = (1.0, -1.0)
"""Entries of N that are tried first, between neighbours."""
_NEAR = 0.6
"""How far from these an entry may be."""


class Coupling(NamedTuple):
    """How motors turn with joints."""

    matrix: Float[np.ndarray, "n n"]
    """N."""
    at_motors: bool
    """Whether the torques of the data, or of the log that they are from, are those of the motors."""

    def of_joints(self, data: Dataset) -> Dataset:
        """The data with the torques of the joints."""
        return replace(data, tau=data.tau @ self.matrix) if self.at_motors else data

    def of_motors(self, data: Dataset) -> Dataset:
        """Data with the torques of the joints in coordinates of the motors, but for q."""
        n = self.matrix
        return replace(data, v=data.v @ n.T, a=data.a @ n.T, tau=self.torques_of_motors(data.tau))

    def torques_of_motors(self, tau: Float[np.ndarray, "samples n"]) -> Float[np.ndarray, "samples n"]:
        """N⁻ᵀ τ, for torques of the joints."""
        return np.asarray(tau @ np.linalg.inv(self.matrix))

    def misfit(self, left: JointArray) -> float:
        """Minus the logarithm of the likelihood per sample, less a constant, of torques that leave this to the motors.

        Σ log σ of these residuals, and the change of variables where the torques of the data are those of the joints.
        """
        change = 0.0 if self.at_motors else float(np.linalg.slogdet(self.matrix)[1])
        return float(np.log(np.maximum(left, 1e-300)).sum()) + change

    def plain(self) -> dict[str, Any]:
        """The coupling for the details of a `FitReport`."""
        return {"coupling": self.matrix.tolist(), "torques_of_motors": self.at_motors}

    @classmethod
    def of_plain(cls, details: Mapping[str, Any]) -> "Coupling | None":
        """The coupling in these details, None without."""
        matrix = details.get("coupling")
        return None if matrix is None else cls(np.array(matrix), details["torques_of_motors"])

    def said(self, joints: Sequence[str]) -> str:
        """The coupling in words, without a full stop."""
        off = self.matrix - np.eye(len(self.matrix))
        turns = [f"the motor of {joints[k]} also turns {x:.3g} times with {joints[j]}" for k, j, x in _entries(off)]
        where = "the motors" if self.at_motors else "the joints"
        told = " and ".join(turns) or "no motor turns several joints"
        return f"{told}, and the torques of the log are those of {where}"


Given: TypeAlias = "Coupling | np.ndarray | Sequence[Sequence[float]] | bool | None"
"""What `settled` takes."""


@dataclass(frozen=True, eq=False)
class CoupledGeometry:
    """The geometry of an arm in coordinates of its motors, as a `regressor.Geometry`."""

    inner: Geometry
    matrix: Float[np.ndarray, "n n"]

    @property
    def names(self) -> Sequence[str]:
        """Joint names."""
        return self.inner.names

    @property
    def places(self) -> tuple[Sequence[int], Float[np.ndarray, "n 3"]]:
        """Parents and positions [m]."""
        return self.inner.places

    def regressor(
        self, q: Float[np.ndarray, "rows n"], v: Float[np.ndarray, "rows n"], a: Float[np.ndarray, "rows n"]
    ) -> Float[np.ndarray, "rows n unknowns"]:
        """Derivatives of the motors' torques, for speeds and accelerations of the motors."""
        back = np.linalg.inv(self.matrix)
        return np.einsum("jk,rju->rku", back, self.inner.regressor(q, v @ back.T, a @ back.T))


def in_motors(data: Dataset, coupled: Coupling | None) -> Dataset:
    """Data with the torques of the joints in coordinates of the motors, but for q; as they are without coupling."""
    return data if coupled is None else coupled.of_motors(data)


def matrix_of(coupled: Coupling | None) -> Float[np.ndarray, "n n"] | None:
    """N, None without coupling."""
    return None if coupled is None else coupled.matrix


def geometry_of(inner: Geometry, coupled: Coupling | None) -> Geometry:
    """The geometry in coordinates of the motors; as it is without coupling."""
    return inner if coupled is None else CoupledGeometry(inner, coupled.matrix)


def find_coupling(geometry: Geometry, data: Dataset, wanted: Wanted) -> Coupling | None:
    """The coupling of neighbouring joints that explains the torques much better than none; None if there is none.

    One entry of N after the other is added, as long as each lowers Σ_k log σ_k by `_BETTER`, with the torques taken as
    those of the joints and of the motors. det N = 1 for such matrices, so that this compares likelihoods. Believed is
    the last matrix that explains the torques well: of two entries that share a joint the first alone leaves much.
    """
    some, n = data.thinned(_SOME), data.nv
    if n < 2 or not data.tau.any() or data.about.get("doubts"):
        return None
    none = Coupling(np.eye(n), at_motors=False)
    deviation = _deviations(geometry, some, wanted, none)
    suspect = deviation > np.sqrt(_LEFT) * np.maximum(some.tau.std(axis=0), 1e-300)
    if not suspect.any():
        return None
    believed: Coupling | None = None
    best, least = none, float(np.log(deviation).sum())
    sides: tuple[bool, ...] = (False, True)
    while True:
        found, lower = best, least
        for k, j in [(i, i + 1) for i in range(n - 1)] + [(i + 1, i) for i in range(n - 1)]:
            if best.matrix[k, j] or best.matrix[j, k] or not (suspect[k] or suspect[j]):
                continue
            for at_motors in sides:
                for first in _TRIED:
                    tried, value = _fitted(geometry, some, wanted, best, least, (k, j), first, at_motors)
                    if value < lower:
                        found, lower = tried, value
        if lower > least - _BETTER:
            return believed
        best, least, sides = found, lower, (found.at_motors,)
        believed = best if _explained(geometry, some, wanted, best) else believed


def settled(
    data: Dataset, robot: Robot, given: "Given", wanted: Wanted, stacklevel: int = 4
) -> tuple[Dataset, "Coupling | None"]:
    """The data with the torques of the joints, and the coupling of the drives, None without.

    given: None looks for one, and warns of one that is found. False is none. A matrix N is one; whether the torques are
        those of the joints or the motors is then found. A `Coupling` is known, and the data have the joints' torques.
    """
    if given is False or isinstance(given, Coupling):
        return data, given or None
    with threadpool_limits(1, "blas"):  # as in `explain`
        found = _settle(data, robot, given, wanted)
    if given is None and found is not None:
        warnings.warn(f"{found.said(robot.joint_names)}; give {_none()} if that cannot be.", stacklevel=stacklevel)
    return (data if found is None else found.of_joints(data)), found


def possible(
    data: Dataset, others: Dataset | None, robot: Robot | None, given: Given, wanted: Wanted, stacklevel: int
) -> list[tuple[Dataset, Dataset | None, Coupling | None]]:
    """What `settled` tells, with `others`, held-out data whose torques are of the same kind.

    Without a robot no coupling is looked for, and for a matrix there are two answers: torques of joints, and of motors.
    """
    if given is False or isinstance(given, Coupling) or (given is None and robot is None):
        return [(data, others, given or None)]
    found = _sides(given, data) if robot is None else [settled(data, robot, given, wanted, stacklevel + 1)[1]]
    return [
        (data, others, None)
        if side is None
        else (side.of_joints(data), None if others is None else side.of_joints(others), side)
        for side in found
    ]


def _settle(data: Dataset, robot: Robot, given: Given, wanted: Wanted) -> Coupling | None:
    """The coupling looked for, or which torques the data hold for a given one."""
    geometry, some = RobotGeometry(robot), data.thinned(_SOME)
    if given is None:
        return find_coupling(geometry, data, wanted)
    sides = _sides(given, data)
    return sides[0] if len(sides) == 1 else min(sides, key=lambda side: _value(geometry, some, wanted, side))


def _sides(given: Given, data: Dataset) -> list[Coupling]:
    """A given matrix with the torques as those of the joints and of the motors, which are one where all are zero."""
    matrix = coupling_of(given, data.nv)
    return [Coupling(matrix, at_motors) for at_motors in ((False, True) if data.tau.any() else (False,))]


def _none() -> str:
    return where_printed(python="coupling=False", shell="--coupling off")


def _fitted(
    geometry: Geometry,
    data: Dataset,
    wanted: Wanted,
    base: Coupling,
    before: float,
    at: tuple[int, int],
    first: float,
    at_motors: bool,
) -> tuple[Coupling, float]:
    """The coupling with one more entry near `first`, and its Σ log σ."""

    def with_entry(x: float) -> Coupling:
        matrix = base.matrix.copy()
        matrix[at] = x
        return Coupling(matrix, at_motors)

    def value(x: float) -> float:
        return _value(geometry, data, wanted, with_entry(x))

    start = value(first)
    if start > before - 0.5 * _BETTER:
        return with_entry(first), start
    found = minimize_scalar(value, bounds=(first - _NEAR, first + _NEAR), method="bounded", options={"xatol": 1e-4})
    return with_entry(float(found.x)), float(found.fun)


def _explained(geometry: Geometry, data: Dataset, wanted: Wanted, coupling: Coupling) -> bool:
    """Whether the torques of the motors concerned are well explained, and no entry is at the bound of its search."""
    off = coupling.matrix - np.eye(data.nv)
    entries = np.abs(off[off != 0.0])
    if (np.abs(entries - 1.0) > 0.98 * _NEAR).any():
        return False
    moved = coupling.of_motors(coupling.of_joints(data))
    share = np.square(_deviations(geometry, data, wanted, coupling)) / np.maximum(moved.tau.var(axis=0), 1e-300)
    concerned = (off != 0.0).any(axis=0) | (off != 0.0).any(axis=1)
    return bool((share[concerned] < _WELL).all())


def _value(geometry: Geometry, data: Dataset, wanted: Wanted, coupling: Coupling) -> float:
    """The misfit of arbitrary bodies in this geometry."""
    return coupling.misfit(_deviations(geometry, data, wanted, coupling))


def _deviations(geometry: Geometry, data: Dataset, wanted: Wanted, coupling: Coupling) -> np.ndarray:
    """RMS residuals of the motors' torques [N·m] after a fit of arbitrary bodies and the usual terms of drives."""
    moved = coupling.of_motors(coupling.of_joints(data))
    factors = wanted.first(data.nv).factors(moved)
    rows, _ = robust(equation_rows(CoupledGeometry(geometry, coupling.matrix), moved, factors))
    triangles = of_all_joints(triangle(rows))
    least = _EXACT * torque_size(triangles, len(data))
    return np.maximum(noise_of(triangles, 0, len(data)), least)


def _entries(off: Float[np.ndarray, "n n"]) -> list[tuple[int, int, float]]:
    return [(int(k), int(j), float(off[k, j])) for k, j in np.argwhere(np.abs(off) > 1e-12) if k != j]
