"""What errors of the bodies do along a reference: everything is linear in them (docs/certificates.md §14)."""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float

from nbs_pin.base.arrays import Scalars
from nbs_pin.certificates.body_regressor import BodyRegressor
from nbs_pin.certificates.body_response import Response, instants
from nbs_pin.certificates.constants import Constants, above_inverse
from nbs_pin.controllers.lyapunov_law import LyapunovLaw
from nbs_pin.motions.references import DesiredMotion, at_times

_OUTWARD = 1.0 + 1e-9


@dataclass(frozen=True, eq=False)
class AlongReference:
    """Bounds at the instants t_j for all errors at once; R is a root of D₀, RRᵀ = D₀, and Λ the rate."""

    t: Scalars
    """[s]"""
    torque: Scalars
    """√(wᵀD₀⁻¹w) [√W]."""
    defect: Scalars
    """√(rᵀD₀⁻¹r) of what the response leaves of w = ΔM a_d + ΔC(q_d, v_d)v_d + ΔG [√W]."""
    static: Scalars
    """‖Λ^½f‖ [√W]."""
    lag: Scalars
    """‖Λ^−½η‖ [√W]."""
    slip: Scalars
    """‖Λ^−½(η − Λf)‖ [√W]."""
    drift: Scalars
    """‖Λ^½(H(η − Λf) − ḟ)‖ [√W/s]."""
    heave: Scalars
    """‖Λ^−½η̇‖ [√W/s]."""
    push: Scalars
    """‖R⁻¹ΔM η̇‖ [√W]."""
    speed: Scalars
    """‖Rᵀη‖ [√W]."""
    pose: Scalars
    """‖R⁻¹ ∂w/∂q Λ^½‖."""
    inertia: Scalars
    """‖R⁻¹ ΔM Λ^½‖."""
    coriolis: Scalars
    """‖R⁻¹ 2ΔC(q_d, v_d) Λ^½‖."""
    turning: Scalars
    """‖½R⁻¹ (Σ_k v_d,k ∂_kΔM) R⁻ᵀ‖."""
    cross: Scalars
    """‖R⁻¹ (ΔM ΛH − 2ΔC(q_d, v_d) + ∂w/∂q H⁻¹Λ⁻¹) Λ^½‖."""
    spin: Scalars
    """‖sym R⁻¹ΔM(ΛH − m)R⁻ᵀ‖, m the middle of the eigenvalues of ΛH."""
    energy: Scalars
    """½fᵀ(2S)⁻¹f [J]."""
    shift: Float[np.ndarray, "rows n"]
    """|(H⁻¹f)_i| [rad]."""
    eta: Float[np.ndarray, "rows n"]
    """|η_i| [rad/s]."""
    bends: Float[np.ndarray, "rows n"]
    """‖R⁻¹ (∂_lM̂ (η̇ + ωη) + ∂_lĈ(q_d, v_d)η)‖ for every joint l [√W]."""
    twist: Scalars
    """‖R⁻¹Ĉ(q_d, η)Λ^½‖."""
    roll: Scalars
    """‖½R⁻¹(Σ_k η_k ∂_kM̂)R⁻ᵀ‖."""

    @classmethod
    def of(
        cls, regressor: BodyRegressor, law: LyapunovLaw, reference: DesiredMotion, duration: float, c: Constants
    ) -> "AlongReference":
        """The bounds for a law with the model whose errors the regressor holds."""
        t = instants(duration)
        states = at_times(reference, t, law.nv)
        found = [regressor.at(*state) for state in zip(*states, strict=True)]
        torque, slope, errors, coriolis = (np.array([x[i] for x in found]) for i in range(4))
        mass, christoffel = law.dynamics.mass_matrix(states[0]), law.dynamics.coriolis_matrix(states[0], states[1])
        sums = _Sums(t, torque, slope, errors, coriolis, mass, christoffel, law, c)
        rows = [sums.at(k) for k in range(len(t))]
        joints = [np.array([x[i] for x in rows]) * _OUTWARD for i in range(1, 3)]
        model_terms = (x * _OUTWARD for x in sums.of_model(states[0], states[1], regressor.slides))
        return cls(t, *(np.array([x[0] for x in rows]).T * _OUTWARD), *joints, *model_terms)._widened()

    def _widened(self) -> "AlongReference":
        """The bounds up to the neighbouring instants, so that products of them hold between the instants too."""
        names = [field.name for field in fields(self) if field.name != "t"]
        return replace(self, **{name: _nearby(getattr(self, name)) for name in names})


def _nearby(x: Float[np.ndarray, "rows *n"]) -> Float[np.ndarray, "rows *n"]:
    """The largest of each row and its neighbours."""
    found = x.copy()
    found[1:] = np.maximum(found[1:], x[:-1])
    found[:-1] = np.maximum(found[:-1], x[1:])
    return found


@dataclass(frozen=True, eq=False)
class _Sums:
    """What `AlongReference` needs at every instant."""

    t: Scalars
    torque: Float[np.ndarray, "rows n g"]
    slope: Float[np.ndarray, "rows g n n"]
    errors: Float[np.ndarray, "rows g n n"]
    coriolis: Float[np.ndarray, "rows g n n"]
    mass: Float[np.ndarray, "rows n n"]
    christoffel: Float[np.ndarray, "rows n n"]
    law: LyapunovLaw
    constants: Constants

    @cached_property
    def hessian(self) -> Float[np.ndarray, "n n"]:
        """H = ∇²Φ(0) [N·m/rad]."""
        return hessian_at_zero(self.law)

    @cached_property
    def own(self) -> Float[np.ndarray, "rows n n"]:
        """ωM̂ + D₀ + Ĉ."""
        return self.constants.omega * self.mass + self.constants.floor + self.christoffel

    @cached_property
    def response(self) -> Response:
        return Response.of(self.t, self.mass, self.own, self.torque, self.hessian, self.constants)

    @cached_property
    def root(self) -> Float[np.ndarray, "n n"]:
        """R⁻¹."""
        return np.linalg.inv(np.linalg.cholesky(self.constants.floor))

    def at(self, k: int) -> tuple[list[float], np.ndarray, np.ndarray]:
        """The numbers of `AlongReference` in its order, and the rows `shift` and `eta`."""
        c, inverse, rate = self.constants, self.root, np.sqrt(self.constants.rate)
        f, eta, hessian, mass = self.response.f[k], self.response.eta[k], self.hessian, self.mass[k]
        slip = eta - c.rate[:, None] * f
        rest = self.torque[k] - c.coupling * f - self.own[k] @ eta
        beside = self.response.beside(k)
        # At the instant, and half a step from it with the matrices of the instant.
        left_over = [inverse @ (rest - mass @ deta) for _, _, deta in beside]
        left_over += [
            x - h * inverse @ (c.coupling * df + self.own[k] @ deta)
            for x, (h, df, deta) in zip(left_over, beside, strict=True)
        ]
        ahead, left = hessian @ slip, inverse @ self.coriolis[k]
        sides = inverse @ self.slope[k] * rate, inverse @ self.errors[k] * rate, 2.0 * left * rate
        cross = inverse @ self.errors[k] * c.rate @ hessian * rate - sides[2]
        cross = cross + sides[0] / rate @ np.linalg.inv(hessian) / rate
        turning = 0.5 * inverse @ (self.coriolis[k] + self.coriolis[k].mT) @ inverse.T
        turns = np.linalg.eigvalsh(rate[:, None] * hessian * rate)
        turn = c.rate[:, None] * hessian - 0.5 * (turns[0] + turns[-1]) * np.eye(len(rate))
        spin = inverse @ self.errors[k] @ turn @ inverse.T
        numbers = [
            _size(inverse @ self.torque[k]),
            max(_size(x) for x in left_over),
            _size(rate[:, None] * f),
            _size(eta / rate[:, None]),
            _size(slip / rate[:, None]),
            max(_size(rate[:, None] * (ahead - df)) for _, df, _ in beside),
            max(_size(deta / rate[:, None]) for _, _, deta in beside),
            max(float(_boxes(inverse @ self.errors[k] @ deta).sum()) for _, _, deta in beside),
            _size(np.linalg.inv(inverse).T @ eta),
            *(float(_norms(x).sum()) for x in (*sides, turning, cross)),
            float(_norms(0.5 * (spin + spin.mT)).sum()),
            0.5 * _size(self._stiff @ f) ** 2,
        ]
        return numbers, np.abs(np.linalg.solve(hessian, f)).sum(axis=1), np.abs(eta).sum(axis=1)

    def of_model(
        self, q: Float[np.ndarray, "rows n"], v: Float[np.ndarray, "rows n"], slides: np.ndarray
    ) -> tuple[np.ndarray, ...]:
        """The rows `bends`, and the numbers `twist` and `roll`."""
        law, inverse, eta, unit = self.law, self.root, self.response.eta, np.eye(self.law.nv)
        size = np.abs(eta).sum(axis=2)
        deta = self.response.deta
        rates = np.concatenate([deta[:1], deta]), np.concatenate([deta, deta[-1:]])
        bends, twist, roll = [], np.zeros(len(q)), np.zeros(len(q))
        for k, sliding in enumerate(slides):
            gradient = _gradient(law.dynamics.mass_matrix, q, unit[k], sliding)
            turned = _gradient(lambda x: law.dynamics.coriolis_matrix(x, v), q, unit[k], sliding) @ eta
            bent = [_boxes(inverse @ (gradient @ (x + self.constants.omega * eta) + turned)) for x in rates]
            bends.append(np.maximum(*bent))
            christoffel = law.dynamics.coriolis_matrix(q, np.broadcast_to(unit[k], q.shape))
            twist += size[:, k] * _norms(inverse @ christoffel * np.sqrt(self.constants.rate))
            roll += size[:, k] * _norms(0.5 * inverse @ gradient @ inverse.T)
        return np.array(bends).T, twist, roll

    @cached_property
    def _stiff(self) -> Float[np.ndarray, "n n"]:
        """U with UᵀU = (2S)⁻¹."""
        return np.linalg.cholesky(0.5 * above_inverse(self.constants.stiffness)).T


def hessian_at_zero(law: LyapunovLaw) -> Float[np.ndarray, "n n"]:
    """∇²Φ(0) [N·m/rad]."""
    hessian = law.potential_terms(np.zeros((law.nv, law.nv)), np.eye(law.nv))[2]
    return np.asarray(0.5 * (hessian + hessian.T))


def _gradient(
    of: Callable[[np.ndarray], np.ndarray], q: Float[np.ndarray, "rows n"], e: np.ndarray, slides: bool
) -> np.ndarray:
    """∂/∂q_k from differences, exact for trigonometric polynomials of degree ≤ 2, and polynomials where it slides."""

    def half_difference(step: np.ndarray) -> np.ndarray:
        return np.asarray(0.5 * (of(q + step) - of(q - step)))

    if slides:
        return half_difference(e)
    return 2.0 * half_difference(0.25 * np.pi * e) + (1.0 - np.sqrt(2.0)) * half_difference(0.5 * np.pi * e)


def _boxes(x: Float[np.ndarray, "*batch n g"]) -> Float[np.ndarray, "*batch"]:
    """Bounds of ‖Σ s_g x_g‖ over |s_g| ≤ 1 by those of its components."""
    return np.asarray(np.linalg.norm(np.abs(x).sum(axis=-1), axis=-1))


def _size(x: Float[np.ndarray, "n g"]) -> float:
    """Bound of ‖Σ s_g x_g‖ over |s_g| ≤ 1: its square is at most Σ |x_g·x_h|."""
    return float(np.sqrt(np.abs(x.T @ x).sum()))


def _norms(x: Float[np.ndarray, "*batch n n"]) -> Float[np.ndarray, "*batch"]:
    """Upper bounds of the spectral norms, ‖A‖⁸ ≤ tr((AᵀA)⁴)."""
    square = x.mT @ x
    fourth = square @ square
    return np.asarray(np.sqrt(np.sqrt(np.sqrt((fourth * fourth.mT).sum(axis=(-2, -1))))))
