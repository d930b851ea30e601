"""Identification of the inertial parameters and friction of an arm whose geometry is known.

The torque is linear in them (`regressor`) and depends only on some directions, the base parameters. The others are
chosen such that every body is physically consistent (`consistent_fit`).
"""

import time
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from nbs_pin.base.arguments import checked, flag, maybe, number
from nbs_pin.base.arrays import JointArray
from nbs_pin.base.doors import in_words
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.dynamics.identified import IdentifiedDynamics
from nbs_pin.dynamics.pseudo_inertia import PARAMETERS_OF_COORDINATES, coordinates, inertial_parameters
from nbs_pin.identification.compatibility import arm_fault
from nbs_pin.identification.consistent_fit import ConsistentFit, consistent_fit, in_factors
from nbs_pin.identification.datasets import DATA, Dataset
from nbs_pin.identification.regressor import (
    Expected,
    Geometry,
    RobotGeometry,
    Scalars,
    expectation,
    joint_triangles,
    torque_size,
    triangle,
)
from nbs_pin.robots.robot import ARM, Robot

_EXACT = 1e-11
"""Lower bound of the estimated noise, as a share of the largest torque: above rounding, below any sensor."""
_NEGLIGIBLE = 1e-6
"""Share of the largest singular value below which the torque counts as independent of a direction."""
_RANDOM_STATES = 80
"""Random states that determine the base directions: six equations for each of a joint's 13 unknowns."""
_SOME, _PRIOR = 1_000, 0.3
"""Samples that decide on the signs of torques; γ of these fits."""
_WELL = 0.02
"""Unexplained share of the torque's variance below which its signs are not doubted."""
_ROUNDS = 6
"""Iterations of the reweighted least squares that estimate the noise."""
_UNPHYSICAL, _MUCH = 3.0, 0.1
"""Residual of physical bodies that contradicts the estimated noise, in units of it and of the torque's size."""
_WORSE = 1.1
"""Residual in units of the torque's size that is worse than that of no bodies at all."""


@dataclass(frozen=True, eq=False)
class IdentificationReport:
    """How an arm was identified, and which parameters the data do not determine."""

    samples: int
    """Number of samples."""
    seconds: float
    """Duration of the fit [s]."""
    noise: JointArray
    """Estimated standard deviation of the torque residual per joint [N·m], the inverse of its weight."""
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


@checked(
    data=DATA,
    robot=ARM,
    friction=flag,
    rotor_inertia=maybe(flag),
    transition=number(above=0.0, unit="rad/s"),
    regularisation=number(least=1e-30, most=1e30, unit="measurements"),
)
def identify(
    data: Dataset,
    robot: Robot,
    *,
    friction: bool = False,
    rotor_inertia: bool | None = None,
    transition: float = 0.01,
    regularisation: float = 0.3,
) -> IdentifiedDynamics:
    """Find the physically consistent inertial parameters that explain the data best; `report` tells how well.

    Geometry and gravity are the robot's; its inertias are not used. Least squares weighted by each joint's noise, which
    is estimated from the residual, is followed by the same over physically consistent bodies (`consistent_fit`). Clean
    data give M, C and G to rounding. Where physical bodies leave far more than that noise, joints are weighted by their
    torque, so that the model is never worse than none on the data it is fitted to, in the mean over joints.

    Args:
        data: Samples with torque, at least two equations per base parameter.
        robot: The arm of the data.
        friction: Also find viscous and Coulomb coefficients ≥ 0 of every joint (`IdentifiedDynamics.friction`).
        rotor_inertia: Also find rotor inertias ≥ 0; None does if the robot has any (`Robot.armature`).
        transition: Speed scale of the Coulomb friction [rad/s] (`JointFriction`).
        regularisation: γ, the number of measurements that the prior is worth: homogeneous balls along the links,
            lighter towards the tip, with masses that give torques of the recorded size; it matters if data are scarce.

    Raises:
        ArgumentError: If the data have another joint tree or are of another arm (`compatibility.py`), have fewer than
            two equations per base parameter or no torque, which inertias of every scale explain, if the torque of a
            joint has the wrong sign (`sign_fault`), or if the arm neither moves nor carries weight.

    Example:
        >>> import nbs_pin as nbs
        >>> robot = nbs.load_robot("two_link")
        >>> report = nbs.identify(nbs.collect(robot, "uniform", samples=100), robot).report
        >>> report.base_parameters, report.excited, report.unidentifiable
        (6, 6, ())
    """
    _check_arm(data, robot)
    rotor_inertia = bool(robot.armature.any()) if rotor_inertia is None else rotor_inertia
    scalars = Scalars(friction, rotor_inertia, transition)
    fault = sign_fault(data, robot)
    if fault:
        raise ArgumentError(f"{in_words(data, 'the data')}: {fault}.")
    bodies = explain(RobotGeometry(robot), data, scalars, regularisation)
    parameters = inertial_parameters(bodies.factors @ bodies.factors.swapaxes(1, 2))
    rotors = bodies.scalars[-1] if rotor_inertia else None
    return IdentifiedDynamics(robot, parameters, bodies.friction(scalars), rotors, bodies.report)


class Bodies(NamedTuple):
    """Bodies, friction and rotors that explain the data of an arm of known geometry."""

    factors: Float[np.ndarray, "n 4 4"]
    """Lower triangular L of the pseudo-inertias LLᵀ ≻ 0."""
    scalars: Float[np.ndarray, "kinds n"]
    """The unknowns of `Scalars`, all > 0."""
    expected: Expected
    """Their prior values."""
    report: IdentificationReport

    def friction(self, scalars: Scalars) -> JointFriction | None:
        """The friction among the scalars, None if it was not fitted."""
        return JointFriction(self.scalars[0], self.scalars[1], scalars.transition) if scalars.friction else None


def explain(geometry: Geometry, data: Dataset, scalars: Scalars, regularisation: float, others: int = 0) -> Bodies:
    """The physically consistent bodies, friction and rotors that explain the data best, for that geometry.

    `others` is the number of geometric parameters fitted to the same data, for the degrees of freedom of the noise.
    Errors are those of `identify`.
    """
    start = time.perf_counter()
    triangles = joint_triangles(geometry, data, scalars)
    expected = expectation(geometry, data, scalars, triangles)
    equations = expected.in_units(triangles)
    base = _base_directions(geometry, data, scalars, expected)
    fit, design, noise = _physical(
        equations, _noise(equations, base.shape[1] + others, len(data)), data, regularisation
    )
    weak, values = _unexcited(design, base)
    report = IdentificationReport(
        samples=len(data),
        seconds=time.perf_counter() - start,
        noise=noise,
        train_nmse=_nmse(equations, fit, data),
        base_parameters=base.shape[1],
        excited=base.shape[1] - len(weak),
        condition=float(values[0] / values[-1]) if values[-1] > 0.0 else np.inf,
        unidentifiable=tuple(_direction(x, expected, scalars.names(geometry.names)) for x in weak),
        steps=fit.steps,
        converged=fit.converged,
    )
    found = (fit.scalars * expected.scalars).reshape(-1, data.nv)
    return Bodies(expected.bodies @ fit.factors, found, expected, report)


def sign_fault(data: Dataset, robot: Robot) -> str:
    """Whether the torque of a joint, or of all, has the wrong sign, as a clause for an error message, or "".

    Friction and physical bodies in the arm's geometry are fitted to some of the samples, with signs as they are and
    reversed: of one joint or of all, then of a further one, as long as that halves what is unexplained. The data are
    at fault if a tenth or less remains.
    """
    some = data.take(np.sort(np.random.default_rng(0).permutation(len(data))[:_SOME]))
    geometry, rotors = RobotGeometry(robot), bool(robot.armature.any())
    scalars = Scalars(friction=True, rotor_inertia=rotors, transition=0.01)
    triangles = joint_triangles(geometry, some, scalars)
    equations = expectation(geometry, some, scalars, triangles).in_units(triangles)
    size, n = torque_size(equations, len(some)), data.nv

    def unexplained(signs: np.ndarray) -> float:
        turned = equations.copy()
        turned[:, :, -1] *= signs[:, None]
        fit = consistent_fit(*_weighted(turned, size), n, _PRIOR)
        return _nmse(turned, fit, some)

    stated = best = unexplained(np.ones(n))
    signs, tries = np.ones(n), [*(1.0 - 2.0 * np.eye(n)), -np.ones(n)]
    while best > _WELL:
        left, found = min(((unexplained(signs * turn), k) for k, turn in enumerate(tries)), key=lambda x: x[0])
        if left > 0.5 * best:
            break
        best, signs = left, signs * tries[found]
    if best > 0.1 * stated or (signs > 0.0).all():
        return ""
    wrong = [name for name, sign in zip(robot.joint_names, signs, strict=True) if sign < 0.0]
    all_wrong = len(wrong) == n
    which = "every joint" if all_wrong else " and ".join(wrong)
    return (
        f"sign of tau of {which}? {_percent(stated)} of the torque's variance is unexplained, and with the sign "
        f"reversed {_percent(best)}; reverse it{', or gravity if the arm hangs' if all_wrong else ''}"
    )


def _percent(share: float) -> str:
    return f"{share:.2%}" if share < 0.1 else f"{share:.0%}"


def _check_arm(data: Dataset, robot: Robot) -> None:
    """Raise ArgumentError unless the data have the joints of the robot and some torque."""
    fault = arm_fault(data, robot)
    if fault:
        raise ArgumentError(f"{fault}.")
    if not data.tau.any():
        raise ArgumentError(
            f"{in_words(data, 'the data')} has no torque: inertias of every scale explain such a motion; "
            "record torques."
        )


def _base_directions(
    geometry: Geometry, data: Dataset, scalars: Scalars, expected: Expected
) -> Float[np.ndarray, "unknowns base"]:
    """An orthonormal basis of the directions that the torque can depend on, from random states at the data's speeds."""
    rng, size = np.random.default_rng(0), (_RANDOM_STATES, data.nv)
    speed, rate = (max(float(np.abs(x).max()), 1.0) for x in (data.v, data.a))
    v, a, order = speed * rng.normal(size=size), rate * rng.normal(size=size), np.arange(_RANDOM_STATES)
    q = rng.uniform(-np.pi, np.pi, size)
    states = replace(data, q=q, v=v, a=a, tau=0.0 * q, t=order.astype(float), trajectory=order)
    rows = expected.in_units(joint_triangles(geometry, states, scalars))[:, :, :-1]
    rows = rows / np.linalg.norm(rows, axis=(1, 2), keepdims=True)
    _, values, directions = np.linalg.svd(rows.reshape(-1, rows.shape[-1]), full_matrices=False)
    return directions[values > _NEGLIGIBLE * values[0]].T


def _noise(equations: np.ndarray, base: int, samples: int) -> JointArray:
    """Standard deviation of the residual per joint [N·m], from iteratively reweighted least squares."""
    n = len(equations)
    if samples * n < 2 * base:
        raise ArgumentError(
            f"{samples} samples of {n} joints are too few for {base} base parameters; give {-(-2 * base // n)} or more."
        )
    noise = torque_size(equations, samples)
    least = _EXACT * noise.max()
    for _ in range(_ROUNDS):
        design, target = _weighted(equations, noise)
        solution = np.linalg.lstsq(design, target, rcond=1e-10)[0]
        residual = np.linalg.norm(equations @ np.append(solution, -1.0), axis=1)
        noise = np.maximum(residual / np.sqrt(samples - base / n), least)
    return noise


def _physical(
    equations: np.ndarray, noise: JointArray, data: Dataset, strength: float
) -> tuple[ConsistentFit, np.ndarray, JointArray]:
    """The physically consistent fit, its weighted design, and the noise by which it is weighted [N·m].

    `noise` is the residual of arbitrary bodies. Where physical bodies leave far more, as with a torque of wrong sign,
    a joint that only unphysical bodies explain would count for all. The joints are then weighted by their torque
    instead, with which the fit is never worse than no torque at all, but for the prior.
    """
    design, target = _weighted(equations, noise)
    fit, size = consistent_fit(design, target, data.nv, strength), torque_size(equations, len(data))
    left = np.sqrt(_squares(equations, fit, len(data)))
    if (left > np.maximum(_UNPHYSICAL * noise, _MUCH * size)).any() or (left > _WORSE * size).any():
        noise = np.maximum(noise, size)
        design, target = _weighted(equations, noise)
        fit = consistent_fit(design, target, data.nv, strength)
    return fit, design, noise


def _weighted(equations: np.ndarray, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
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
    parts = np.concatenate([(moved / units).ravel(), direction[10 * n :]])
    parts /= np.linalg.norm(parts)
    largest = [k for k in np.argsort(-np.abs(parts))[:4] if abs(parts[k]) > 0.2]
    return " ".join(f"{parts[k]:+.2f} {names[k]}" for k in largest)


def _nmse(equations: np.ndarray, fit: ConsistentFit, data: Dataset) -> float:
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
