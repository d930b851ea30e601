"""What errors of the bodies add along a reference: matrices at every instant, linear in the errors (docs/certificates.md §11)."""

from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from jaxtyping import Float

from nbs_pin.certificates.constants import Constants
from nbs_pin.certificates.sampled_motion import SampledMotion
from nbs_pin.certificates.uncertainty import BodyErrors
from nbs_pin.robots.robot import Robot

_OUTWARD = 1.0 + 1e-9
_CHUNK = 128


@dataclass(frozen=True, eq=False)
class AlongReference:
    """Largest sums over the errors at the instants of a reference; R is a root of D₀, RRᵀ = D₀, and Λ the rate."""

    torque: float
    """Bound of √(wᵀD₀⁻¹w) with w = ΔM a_d + ΔC(q_d, v_d)v_d + ΔG [√W]."""
    pose: float
    """‖R⁻¹ ∂w/∂q Λ^½‖."""
    inertia: float
    """‖R⁻¹ ΔM Λ^½‖."""
    coriolis: float
    """‖R⁻¹ 2ΔC(q_d, v_d) Λ^½‖."""
    turning: float
    """‖½R⁻¹ (Σ_k v_d,k ∂_kΔM) R⁻ᵀ‖."""

    @classmethod
    def of(
        cls, robot: Robot, model: pin.Model, errors: BodyErrors, motion: SampledMotion, constants: Constants
    ) -> "AlongReference":
        """The sums for a model of the arm."""
        regressor = _Regressor(robot, model, errors)
        inverse, root = np.linalg.inv(np.linalg.cholesky(constants.floor)), np.sqrt(constants.rate)
        largest = np.zeros(5)
        for first in range(0, len(motion.t), _CHUNK):
            rows = range(first, min(first + _CHUNK, len(motion.t)))
            found = [regressor.at(motion.q[i], motion.v[i], motion.a[i]) for i in rows]
            torque, slope, mass, coriolis = (np.array(x) for x in zip(*found, strict=True))
            scaled = inverse @ torque
            energy = np.abs(scaled.mT @ scaled).sum(axis=(1, 2))
            turning = 0.5 * inverse @ (coriolis + coriolis.mT) @ inverse.T
            sides = [inverse @ slope * root, inverse @ mass * root, 2.0 * inverse @ coriolis * root, turning]
            now = [np.sqrt(energy).max(), *(_norms(x).sum(axis=1).max() for x in sides)]
            largest = np.maximum(largest, now)
        return cls(*(largest * _OUTWARD).tolist())


class _Regressor:
    """Torque, inertia and Christoffel matrices of each error, from Pinocchio's regressor of the ten parameters."""

    def __init__(self, robot: Robot, model: pin.Model, errors: BodyErrors) -> None:
        self._model, self._data = model, model.createData()
        self._weightless = model.copy()
        self._weightless.gravity = pin.Motion.Zero()
        self._columns = np.zeros((10 * model.nv, len(errors.body)))
        for g, (body, row) in enumerate(zip(errors.body.tolist(), errors.parameters, strict=True)):
            self._columns[10 * body : 10 * body + 10, g] = row
        self._unit, self._zero, self._slides = np.eye(model.nv), np.zeros(model.nv), robot.prismatic

    def at(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> tuple[np.ndarray, ...]:
        """w (n, g), ∂w/∂q, ΔM and ΔC(q, v) (g, n, n) of every error.

        With h(x) = C(q, x)x, C(q, v)e = ¼(h(v + e) − h(v − e)), as C(q, v)e is symmetric in v and e.
        """
        torque = self._full(q, v, a) @ self._columns
        slope = [self._derivative(q, v, a, e, slides) for e, slides in zip(self._unit, self._slides, strict=True)]
        mass = [self._free(q, self._zero, e) for e in self._unit]
        coriolis = [0.25 * (self._free(q, v + e, self._zero) - self._free(q, v - e, self._zero)) for e in self._unit]
        return torque, *((np.array(x) @ self._columns).transpose(2, 1, 0) for x in (slope, mass, coriolis))

    def _derivative(self, q: np.ndarray, v: np.ndarray, a: np.ndarray, e: np.ndarray, slides: bool) -> np.ndarray:
        """∂/∂q_l of the regressor, exactly: it is a trigonometric polynomial of degree ≤ 2 in the angle of a joint that
        turns, and a polynomial of degree ≤ 2 in the travel of one that slides."""
        wide, half = (self._half_difference(q, v, a, x * e) for x in ((1.0, 1.0) if slides else (0.5 * np.pi, 0.25 * np.pi)))
        return wide if slides else 2.0 * half + (1.0 - np.sqrt(2.0)) * wide

    def _half_difference(self, q: np.ndarray, v: np.ndarray, a: np.ndarray, step: np.ndarray) -> np.ndarray:
        return 0.5 * (self._full(q + step, v, a) - self._full(q - step, v, a))

    def _full(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        return np.array(pin.computeJointTorqueRegressor(self._model, self._data, q, v, a))

    def _free(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        return np.array(pin.computeJointTorqueRegressor(self._weightless, self._data, q, v, a))


def _norms(x: Float[np.ndarray, "*batch n n"]) -> Float[np.ndarray, "*batch"]:
    """Upper bounds of the spectral norms, ‖A‖⁸ ≤ tr((AᵀA)⁴)."""
    square = x.mT @ x
    fourth = square @ square
    return np.asarray(np.sqrt(np.sqrt(np.sqrt((fourth * fourth.mT).sum(axis=(-2, -1))))))
