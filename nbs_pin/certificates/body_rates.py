"""How fast the terms of the bodies change with pose and velocity, in every pose (docs/certificates.md §14)."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from nbs_pin.base.arrays import JointArray, Scalars
from nbs_pin.certificates.body_bounds import BodyBounds
from nbs_pin.certificates.body_motion import AlongReference
from nbs_pin.certificates.body_response import LONGEST
from nbs_pin.certificates.constants import Constants
from nbs_pin.certificates.sampled_motion import SampledMotion

_OUTWARD = 1.0 + 1e-9


@dataclass(frozen=True, eq=False)
class BodyRates:
    """With the e_k, f_k and g_k of `BodyBounds`, X = ‖Λ^½∇Φ‖, |·| the norm of D₀ and y = |z2|."""

    degrees: tuple[JointArray, JointArray]
    """g_k, and the same for gravity."""
    pose: tuple[float, float]
    """Σ g_k|z1_k| ≤ pose·X."""
    around: float
    """|2z2ᵀΔC(q, v_d)u| ≤ around·y‖Λ^−½u‖."""
    turned: float
    """|½z2ᵀ(Σ_k v_d,k ∂_kΔM)z2| ≤ turned·y²."""
    moved: float
    """|z2ᵀ(ΔM a_d + ΔC(q, v_d)v_d)| ≤ moved·y."""
    tilted: float
    """|z2ᵀΔG| ≤ tilted·y."""
    cubic: float
    """|z2ᵀΔC(q, u)u| ≤ cubic·y X²."""
    force: float
    """Σ g_k e_k|u_k| ≤ force·X."""
    off_pose: tuple[float, float]
    """Σ g_k|q_d,k(t) − q_d,k(t_j)| at most, to the nearest instant t_j."""
    off_joints: JointArray
    """|q_d,k(t) − q_d,k(t_j)| at most."""
    off_model: float
    """The same with g_k of M̂."""
    off_around: float
    off_turned: float
    """`around` and `turned` of v_d(t) − v_d(t_j)."""
    off: tuple[float, float, float]
    """‖Λ^−½·‖ of the largest differences of q_d and v_d to the nearest instant, and |·| of that of a_d."""
    whole: float
    """e with E(q) ⪯ e D₀ [s]."""
    model: "ModelRates"

    @classmethod
    def of(cls, b: BodyBounds, c: Constants, motion: SampledMotion) -> "BodyRates":
        """The constants along a reference."""
        rates, mixed, rate = b.degree * b.damped, b.degree * np.sqrt(b.damped * b.rated), np.diag(c.rate)
        tilts, gains = b.tilts, (dual(rates, rate), dual(mixed, c.metric))
        v, a = np.abs(motion.v), np.abs(motion.a)
        half = max(motion.half, 0.5 * LONGEST)
        off_q, off_v = half * motion.speed, half * a.max(axis=0)
        # Between neighbours, so it may change by all that separates them.
        off_a = max(1.0, math.ceil(half / motion.half)) * np.abs(np.diff(motion.a, axis=0)).max(axis=0)

        def around(x: Float[np.ndarray, "rows n"]) -> Float[np.ndarray, " rows"]:
            return np.asarray(x @ mixed + sum(gains) * _sizes(x, c.floor))

        # The instants of the response lie between those of the motion.
        v, a = v + off_v, a + off_a
        speed = _sizes(v, c.floor)
        moved = b.whole[0] * _sizes(a, c.floor) + (v @ rates) * speed + 0.5 * dual(rates, c.metric) * speed**2
        return cls(
            degrees=(b.degree, tilts),
            pose=(dual(b.degree, rate) / c.rho, dual(tilts, rate) / c.rho),
            around=float(around(v).max()),
            turned=0.5 * float((v @ rates).max()),
            moved=float(moved.max()),
            tilted=dual(b.weight, c.metric),
            cubic=dual(mixed, rate) + 0.5 * dual(b.degree * b.rated, c.metric),
            force=gains[0],
            off_pose=(float(b.degree @ off_q), float(tilts @ off_q)),
            off_joints=off_q,
            off_model=float(b.model_degree @ off_q),
            off_around=float(around(off_v[None])[0]),
            off_turned=0.5 * float(off_v @ rates),
            off=(
                float(np.linalg.norm(off_q / np.sqrt(c.rate))),
                float(np.linalg.norm(off_v / np.sqrt(c.rate))),
                float(_sizes(off_a[None], c.floor)[0]),
            ),
            whole=b.whole[0],
            model=ModelRates.of(b, c, motion),
        )

    def between(self, along: AlongReference, reached: Scalars) -> Scalars:
        """√(τᵀD₀⁻¹τ) of what w changes up to the nearest instant, for a_d between those of neighbours.

        reached: Σ g_k|q_k − q_d,k(t_j)| at most.
        """
        (q, v, a), (near, tilt) = self.off, self.off_pose
        curved = 0.5 * near**2 * self.moved + 0.5 * tilt**2 * self.tilted
        turned = (along.coriolis + self.around * reached + 0.5 * self.off_around) * v
        return np.asarray(along.pose * q + curved + turned + self.whole * a)


@dataclass(frozen=True, eq=False)
class ModelRates:
    """The same constants for the model itself, for the torques that a velocity η and an acceleration take of it."""

    mixed: float
    """Σ g_k|q_k − q_d,k| ≤ near: |z2ᵀ(M̂(q) − M̂(q_d))Λ^½x| ≤ mixed·near·y‖x‖."""
    around: float
    """|z2ᵀĈ(q, v_d)η| ≤ around·y‖Λ^−½η‖."""
    cubic: float
    """|z2ᵀĈ(q, u)η| ≤ cubic·y‖Λ^−½u‖‖Λ^−½η‖."""
    force: float
    """|z2ᵀĈ(q, z2)η| ≤ force·y²‖Λ^−½η‖."""
    off_around: float
    """`around` of v_d(t) − v_d(t_j)."""
    floor: float
    """√(λ_max(Λ^½MΛ^½)), M that of the true arm."""

    @classmethod
    def of(cls, b: BodyBounds, c: Constants, motion: SampledMotion) -> "ModelRates":
        """The constants along a reference."""
        (damped, rated), degree, rate = b.model_behind, b.model_degree, np.diag(c.rate)
        mixed = degree * np.sqrt(damped * rated)
        gains = dual(degree * damped, rate) + dual(mixed, c.metric)

        def around(x: Float[np.ndarray, "rows n"]) -> float:
            return 0.5 * float((x @ mixed + gains * _sizes(x, c.floor)).max())

        off_v = max(motion.half, 0.5 * LONGEST) * np.abs(motion.a).max(axis=0)
        return cls(
            mixed=math.sqrt(b.model[0] * b.model[1]),
            around=around(np.abs(motion.v) + off_v),
            cubic=dual(mixed, rate) + 0.5 * dual(degree * rated, c.metric),
            force=0.5 * dual(degree * damped, rate),
            off_around=around(off_v[None]),
            floor=math.sqrt(b.model[1] + b.whole[1]),
        )


def dual(weights: JointArray, metric: Float[np.ndarray, "n n"]) -> float:
    """The largest Σ w_k|x_k| with xᵀA⁻¹x ≤ 1, w ≥ 0: at most √(wᵀ|A|w), A the metric."""
    return math.sqrt(float(weights @ np.abs(metric) @ weights)) * _OUTWARD


def _sizes(rows: Float[np.ndarray, "rows n"], floor: Float[np.ndarray, "n n"]) -> Float[np.ndarray, " rows"]:
    """Bounds of √(xᵀD₀x) for |x_i| ≤ the rows."""
    return np.asarray(np.sqrt(np.einsum("ti,ij,tj->t", rows, np.abs(floor), rows)) * _OUTWARD)
