"""Physically consistent bodies, and drives, that explain the torques of an arm of known geometry."""

import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.linalg import solve_triangular
from threadpoolctl import threadpool_limits

from nbs_pin.base.arrays import JointArray
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.shown import mixture
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.dynamics.pseudo_inertia import BASIS, PARAMETER_NAMES, PARAMETERS_OF_COORDINATES, coordinates
from nbs_pin.identification.consistent_fit import ConsistentFit, consistent_fit, in_factors
from nbs_pin.identification.datasets import Dataset
from nbs_pin.identification.drive_choice import Candidates, Wanted, climb, parts_of, triangles_of
from nbs_pin.identification.drive_terms import DriveTerms
from nbs_pin.identification.regressor import (
    Expected,
    Geometry,
    equation_rows,
    expectation,
    of_all_joints,
    torque_size,
    triangle,
)

_EXACT = 1e-11
"""Lower bound of the estimated noise, as a share of the largest torque: above rounding, below any sensor."""
_NEGLIGIBLE = 1e-6
"""Share of the largest singular value below which the torque counts as independent of a direction."""
_RANDOM_STATES = 80
"""Random states that determine the base directions: six equations for each of a joint's 13 unknowns."""
_ROUNDS = 6
"""Iterations of the reweighted least squares that estimate the noise."""
_UNPHYSICAL, _MUCH = 3.0, 0.1
"""Residual of physical bodies that contradicts the estimated noise, in units of it and of the torque's size."""
_WORSE = 1.1
"""Residual in units of the torque's size that is worse than that of no bodies at all."""
_MOST = 20_000
"""Most samples, evenly spaced, that are used: those between them say little new."""
_FAR, _HUBER, _RENEWED = 10.0, 4.0, 5
"""Robust standard deviations that make an outlier, and beyond which samples count less if there is one; rounds."""
_ENOUGH = 3
"""Samples per unknown of a joint from which on its outliers can be told."""


@dataclass(frozen=True, eq=False)
class IdentificationReport:
    """How an arm was identified, and which parameters the data do not determine."""

    samples: int
    """Number of samples."""
    seconds: float
    """Duration of the fit [s]."""
    noise: JointArray
    """Estimated standard deviation of the torque's noise per joint [N·m]: what arbitrary symmetric bodies leave."""
    train_nmse: float
    """Mean squared residual over torque variance, averaged over the joints whose torque varies."""
    base_parameters: int
    """Number of parameter directions that the arm's torque can depend on, friction included."""
    excited: int
    """How many of them the data determine better than the prior."""
    condition: float
    """Largest over smallest singular value of the weighted regressor on the base parameters, in units of the prior."""
    unidentifiable: tuple[str, ...]
    """The other directions, least excited first: parameter combinations that stay near their prior values."""
    steps: int
    """Number of Newton steps."""
    converged: bool = True
    """Whether these ended at the minimum."""
    parameter_deviations: Float[np.ndarray, "n 10"] | None = None
    """Standard deviations of the inertial parameters of `IdentifiedDynamics`, in its units, with the prior as knowledge
    and as if samples were independent: those of a fast log are not, and its true deviations are larger."""
    mass_deviation: float = np.inf
    """The same of the sum of all masses [kg]."""
    drive_deviations: Mapping[str, JointArray] = field(default_factory=dict)
    """The same of the numbers of the drives, by term; zero where a joint lacks it."""
    drive_numbers: int = 0
    """Numbers of friction, offsets and rotor inertias that were fitted."""
    outliers: int = 0
    """Torques far from all others, of single joints and samples, which count little, in `train_nmse` too."""


class Bodies(NamedTuple):
    """Bodies and drives that explain the data of an arm of known geometry."""

    factors: Float[np.ndarray, "n 4 4"]
    """Lower triangular L of the pseudo-inertias LLᵀ ≻ 0."""
    terms: DriveTerms
    """The terms of the drives."""
    scalars: Float[np.ndarray, "kinds n"]
    """Their numbers; those of terms that a joint lacks have no meaning."""
    expected: Expected
    """Prior values of all of these."""
    weighed: JointArray
    """Unit of the residuals of each joint [N·m]: the noise, or more where physical bodies contradict it."""
    report: IdentificationReport

    @property
    def friction(self) -> JointFriction | None:
        """The friction and offsets, None if there are none."""
        return self.terms.friction(self.scalars)

    @property
    def rotors(self) -> JointArray | None:
        """The rotor inertias, None if there are none."""
        return self.terms.rotors(self.scalars)


def explain(geometry: Geometry, data: Dataset, wanted: Wanted, regularisation: float, others: int = 0) -> Bodies:
    """The physically consistent bodies and the drives that explain the data best, for that geometry.

    `others` is the number of geometric parameters fitted to the same data, for the degrees of freedom of the noise.
    Errors are those of `identify`.
    """
    with threadpool_limits(1, "blas"):  # threads of BLAS wait for each other longer than these matrices take
        return _explain(geometry, data.thinned(_MOST), wanted, regularisation, others)


def _explain(geometry: Geometry, some: Dataset, wanted: Wanted, regularisation: float, others: int) -> Bodies:
    start = time.perf_counter()
    terms, factors, triangles, outliers = _equations(geometry, some, wanted)
    expected = expectation(geometry, len(some), factors, triangles)
    equations = expected.in_units(triangles)
    base = base_directions(geometry, some, terms, expected)
    signed = terms.signed.ravel()
    noise = noise_of(equations, base.shape[1] + others, len(some))
    fit, design, weighed = _physical(equations, noise, some, regularisation, signed)
    weak, values = _unexcited(design, base)
    bodies = [f"{parameter}({joint})" for joint in geometry.names for parameter in PARAMETER_NAMES]
    names = bodies + terms.names(geometry.names)
    report = IdentificationReport(
        samples=len(some),
        seconds=time.perf_counter() - start,
        noise=noise,
        train_nmse=nmse(equations, fit, some),
        base_parameters=base.shape[1],
        excited=base.shape[1] - len(weak),
        condition=float(values[0] / values[-1]) if values[-1] > 0.0 else np.inf,
        unidentifiable=tuple(_direction(x, expected, names) for x in weak),
        steps=fit.steps,
        converged=fit.converged,
        **_deviations(design, fit, expected, regularisation, terms),
        drive_numbers=terms.count,
        outliers=outliers,
    )
    found = (fit.scalars * expected.scalars).reshape(-1, some.nv)
    return Bodies(expected.bodies @ fit.factors, terms, found, expected, weighed, report)


def _equations(geometry: Geometry, data: Dataset, wanted: Wanted) -> tuple[DriveTerms, np.ndarray, np.ndarray, int]:
    """The terms of the drives, their factors, R of each joint's equations with them, and the number of outliers."""
    n, parts = data.nv, parts_of(data)
    needed = data.tau if wanted.terms()["load"] is False else _needed(geometry, data, wanted)
    candidates = Candidates.of(wanted, data, needed)
    rows, outliers = robust(equation_rows(geometry, data, candidates.factors))
    triangles, samples = triangles_of(rows, parts)
    whole = triangle(np.concatenate(list(triangles), axis=1))
    expected = expectation(geometry, len(data), candidates.factors, of_all_joints(whole))
    used = np.array([[wanted.terms()[name] is True] * n for name in candidates.names], dtype=bool).reshape(-1, n)
    if not wanted.is_settled:
        unit = [
            in_factors(r[:, :, : 10 * n].reshape(-1, 10 * n), expected.bodies).reshape(*r.shape[:2], -1)
            for r in triangles
        ]
        usual = expected.scalars.reshape(-1, n)
        own = triangles[..., 10 * n : -1] * usual.T[:, None]
        given = np.concatenate([np.array(unit), own, triangles[..., -1:]], axis=-1)
        used = climb(candidates, given, samples, _left(whole) / np.sqrt(len(data)), 10 * n, usual)
    terms, which = candidates.chosen(used)
    columns = np.concatenate(
        [whole[:, :, : 10 * n], np.zeros((*whole.shape[:2], len(which))), whole[:, :, -1:]], axis=-1
    )
    for j in range(n):
        columns[j, :, 10 * n : -1] = whole[j][:, 10 * n + which[:, j]] * used[which[:, j], j]
    return terms, terms.factors(data, needed), of_all_joints(columns), outliers


def _needed(geometry: Geometry, data: Dataset, wanted: Wanted) -> Float[np.ndarray, "samples n"]:
    """The torque that bodies and rotors need [N·m], from a fit of all joints with the first terms of the drives."""
    terms, n = wanted.first(data.nv), data.nv
    rows, _ = robust(equation_rows(geometry, data, terms.factors(data)))
    triangles = of_all_joints(triangle(rows))
    design, target = weighted(triangles, torque_size(triangles, len(data)))
    found = np.linalg.lstsq(design, target, rcond=1e-10)[0]
    rotors = terms.rotors(found[10 * n :].reshape(-1, n))
    bodies = np.asarray((rows[:, :, : 10 * n] @ found[: 10 * n]).T)
    return bodies if rotors is None else bodies + rotors * data.a


def _left(rows: Float[np.ndarray, "n rows columns"]) -> JointArray:
    """Norm of what each joint's equations leave by themselves."""
    found = [np.linalg.lstsq(row[:, :-1], row[:, -1], rcond=1e-10)[0] for row in rows]
    return np.array([np.linalg.norm(row[:, :-1] @ x - row[:, -1]) for row, x in zip(rows, found, strict=True)])


def robust(rows: Float[np.ndarray, "n samples columns"]) -> tuple[np.ndarray, int]:
    """The equations, weighted after Huber if some residuals are far from all others, and how many are.

    The residual of every joint is that of a fit to its own equations.
    """
    if rows.shape[1] < _ENOUGH * rows.shape[2]:
        return rows, 0
    weighted = rows
    for round_ in range(_RENEWED):
        left = np.empty(rows.shape[:2])
        for j, (r, own) in enumerate(zip(triangle(weighted), rows, strict=True)):
            x = np.linalg.lstsq(r[:, :-1], r[:, -1], rcond=1e-10)[0]
            left[j] = np.abs(own[:, :-1] @ x - own[:, -1])
        scale = 1.4826 * np.median(left, axis=1, keepdims=True)
        scale = np.maximum(scale, _EXACT * np.abs(rows[:, :, -1]).max())
        outliers = int((left > _FAR * scale).sum())
        if round_ == 0 and not outliers:
            return rows, 0
        weight = np.minimum(1.0, _HUBER * scale / np.maximum(left, 1e-300))
        weighted = rows * np.sqrt(weight)[:, :, None]
    return weighted, outliers


def base_directions(
    geometry: Geometry, data: Dataset, terms: DriveTerms, expected: Expected
) -> Float[np.ndarray, "unknowns base"]:
    """An orthonormal basis of the directions that the torque can depend on, from random states at the data's speeds."""
    rng, size = np.random.default_rng(0), (_RANDOM_STATES, data.nv)
    speed, rate = (max(float(np.abs(x).max()), 1.0) for x in (data.v, data.a))
    v, a, order = speed * rng.normal(size=size), rate * rng.normal(size=size), np.arange(_RANDOM_STATES)
    q = rng.uniform(-np.pi, np.pi, size)
    tau = data.tau.std(axis=0) * rng.normal(size=size)
    states = replace(data, q=q, v=v, a=a, tau=tau, t=order.astype(float), trajectory=order)
    equations = of_all_joints(triangle(equation_rows(geometry, states, terms.factors(states))))
    rows = expected.in_units(equations)[:, :, :-1]
    rows = rows / np.linalg.norm(rows, axis=(1, 2), keepdims=True)
    _, values, directions = np.linalg.svd(rows.reshape(-1, rows.shape[-1]), full_matrices=False)
    return directions[values > _NEGLIGIBLE * values[0]].T


def noise_of(equations: np.ndarray, base: int, samples: int) -> JointArray:
    """Standard deviation of the residual per joint [N·m], from iteratively reweighted least squares.

    base: Numbers that are fitted, for the degrees of freedom.
    """
    n = len(equations)
    if samples * n < 2 * base:
        raise ArgumentError(
            f"{samples} samples of {n} joints are too few for {base} base parameters; give {-(-2 * base // n)} or more."
        )
    noise = torque_size(equations, samples)
    least = _EXACT * noise.max()
    for _ in range(_ROUNDS):
        design, target = weighted(equations, noise)
        solution = np.linalg.lstsq(design, target, rcond=1e-10)[0]
        residual = np.linalg.norm(equations @ np.append(solution, -1.0), axis=1)
        noise = np.maximum(residual / np.sqrt(samples - base / n), least)
    return noise


def _physical(
    equations: np.ndarray, noise: JointArray, data: Dataset, strength: float, signed: Bool[np.ndarray, " scalars"]
) -> tuple[ConsistentFit, np.ndarray, JointArray]:
    """The physically consistent fit, its weighted design, and the unit of the residuals of each joint [N·m].

    `noise` is the residual of arbitrary bodies. Where physical bodies leave far more, as with a torque of wrong sign,
    a joint that only unphysical bodies explain would count for all. The joints are then weighted by their torque
    instead, with which the fit is never worse than no torque at all, but for the prior.
    """
    design, target = weighted(equations, noise)
    fit, size = consistent_fit(design, target, data.nv, strength, signed), torque_size(equations, len(data))
    if not contradicted(noise, np.sqrt(_squares(equations, fit, len(data))), size):
        return fit, design, noise
    weighed = np.maximum(noise, size)
    design, target = weighted(equations, weighed)
    return consistent_fit(design, target, data.nv, strength, signed), design, weighed


def contradicted(noise: JointArray, left: JointArray, size: JointArray) -> bool:
    """Whether physical bodies leave far more of the torque of some joint than the noise, or more than no bodies [N·m].

    size: Root mean square torque per joint.
    """
    return bool((left > np.maximum(_UNPHYSICAL * noise, _MUCH * size)).any() or (left > _WORSE * size).any())


def weighted(equations: np.ndarray, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Design and target of all joints in units of the noise, compressed by one QR decomposition."""
    rows = (equations / noise[:, None, None]).reshape(-1, equations.shape[-1])
    compressed = triangle(rows)
    return compressed[:, :-1], compressed[:, -1]


def _unexcited(design: np.ndarray, base: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The base directions with a standard error above their prior value, the largest first; all singular values."""
    _, values, directions = np.linalg.svd(design @ base)
    return (base @ directions[values <= 1.0].T).T[::-1], values


def _direction(direction: np.ndarray, expected: Expected, names: list[str]) -> str:
    """The largest components of a direction in words, each parameter in units of its body's scale."""
    n = len(expected.bodies)
    matrices = in_factors(np.eye(10 * n), expected.bodies).reshape(n, 10, 10 * n)
    moved = matrices @ direction[: 10 * n] @ PARAMETERS_OF_COORDINATES.T
    mass = np.square(expected.bodies[:, 3]).sum(axis=1)
    spread = np.square(expected.bodies[:, :3]).sum(axis=(1, 2))
    units = np.column_stack([mass, *[np.sqrt(mass * spread)] * 3, *[spread] * 6])
    return mixture(np.concatenate([(moved / units).ravel(), direction[10 * n :]]), names)


def _deviations(
    design: np.ndarray, fit: ConsistentFit, expected: Expected, strength: float, terms: DriveTerms
) -> dict[str, Any]:
    """Standard deviations, from the Hessian of the objective in the steps of `consistent_fit`."""
    n = len(fit.factors)
    scale = np.where(terms.signed.ravel(), 1.0, fit.scalars)
    local = np.hstack([in_factors(design[:, : 10 * n], fit.factors), design[:, 10 * n :] * scale])
    R = np.linalg.qr(np.vstack([local, np.sqrt(strength) * np.eye(local.shape[1])]), mode="r")
    root = solve_triangular(R, np.eye(len(R)))  # of the covariance
    factors = expected.bodies @ fit.factors
    moves = np.einsum("nij,kjl,nml->nkim", factors, BASIS, factors)  # of a step along each of BASIS
    maps = PARAMETERS_OF_COORDINATES @ coordinates(moves).swapaxes(1, 2)
    each = maps @ root[: 10 * n].reshape(n, 10, -1)
    drives = expected.scalars * scale * np.linalg.norm(root[10 * n :], axis=-1)
    return {
        "parameter_deviations": np.linalg.norm(each, axis=-1),
        "mass_deviation": float(np.linalg.norm(each[:, 0].sum(axis=0))),
        "drive_deviations": terms.numbers(drives.reshape(-1, n)),
    }


def nmse(equations: np.ndarray, fit: ConsistentFit, data: Dataset) -> float:
    """Mean squared residual over variance, averaged over the joints whose torque varies."""
    squares = _squares(equations, fit, len(data))
    variance = data.tau.var(axis=0)
    varies = variance > 1e-12 * max(variance.max(), np.square(data.tau).max())
    return float((squares[varies] / variance[varies]).mean()) if varies.any() else 0.0


def _squares(equations: np.ndarray, fit: ConsistentFit, samples: int) -> JointArray:
    """Mean squared residual per joint [N²·m²]."""
    bodies = coordinates(fit.factors @ fit.factors.swapaxes(1, 2)).ravel()
    residual = equations @ np.concatenate([bodies, fit.scalars, [-1.0]])
    return np.asarray(np.square(residual).sum(axis=1) / samples)
