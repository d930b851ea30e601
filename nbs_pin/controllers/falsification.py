"""Seeded sampling tests that try to falsify the properties on which the stability proof of a controller rests."""

import numpy as np
from jaxtyping import Float

from nbs_pin.base.arrays import matvec
from nbs_pin.base.claims import refuse
from nbs_pin.base.known_code import foreign_code
from nbs_pin.controllers.activations import Activation
from nbs_pin.controllers.damping import Damping
from nbs_pin.controllers.potential import Potential

_STATES = 48
_SIZES = (0.03, 0.3, 3.0)
_TOLERANCE = 1e-6
SAMPLES = _STATES * len(_SIZES)
"""Number of errors or velocities at which a potential or a damping is tested."""


def falsify_activation(activation: Activation) -> None:
    """Raises CertificateRefused with a counterexample unless σ, σ', σ'' fit a convex, non-decreasing σ."""
    name, tail = type(activation).__name__, np.geomspace(1e-9, 1e2, 400)
    x = np.unique(np.concatenate([-tail, np.linspace(-4.0, 4.0, 1601), tail]))
    value, slope, curvature = (np.asarray(part, dtype=float) for part in activation.derivatives(x))
    if not (np.isfinite(value).all() and np.isfinite(slope).all() and np.isfinite(curvature).all()):
        refuse(f"the activation {name} is not finite within ±100", "give a finite σ, σ' and σ''")
    along = slope * (x[:, None] - x)
    gap = value[:, None] - value - along  # σ(y), row y, minus its tangent at x, column x
    rounding = 1e-9 * (np.abs(value[:, None]) + np.abs(value) + np.abs(along))
    decreasing = slope < -1e-12 * np.abs(slope).max()
    nonconvex = (gap < -rounding).any(axis=0) | (curvature < -1e-12 * np.abs(curvature).max())
    for bad, fault in ((decreasing, "decreases"), (nonconvex, "is not convex, or σ' is not its derivative,")):
        if bad.any():
            at = x[int(bad.argmax())]
            refuse(f"the activation {name} {fault} at x = {at:.3g}", "give a convex, non-decreasing σ")
    _falsify_curvature(activation, x)


def _falsify_curvature(activation: Activation, x: Float[np.ndarray, " m"]) -> None:
    """Raises CertificateRefused where σ'' is not the derivative of σ', bisecting the steps that disagree."""
    a, b = x[:-1], x[1:]
    least = 1e-13 * float(np.abs(activation.derivatives(x[np.abs(x) < 4.0])[1]).max())
    for _ in range(20):
        (_, s_a, c_a), (_, s_b, c_b) = activation.derivatives(a), activation.derivatives(b)
        allowed = np.abs(c_b - c_a) + 1e-3 * (np.abs(c_a) + np.abs(c_b))
        rounding = 1e-12 * (np.abs(s_a) + np.abs(s_b)) + least
        bad = np.abs((s_b - s_a) - 0.5 * (c_a + c_b) * (b - a)) > allowed * (b - a) + rounding
        if not bad.any():
            return
        some = np.flatnonzero(bad)[:: 1 + int(bad.sum()) // 200]
        a, b = a[some], b[some]
        middle = 0.5 * (a + b)
        a, b = np.concatenate([a, middle]), np.concatenate([middle, b])
    refuse(
        f"σ'' of the activation {type(activation).__name__} is not the derivative of σ' near x = {a[0]:.3g}",
        "give a σ with continuous σ', and its exact derivatives",
    )


def falsify_potential(phi: Potential, s: Float[np.ndarray, "n n"], *, exact: bool) -> None:
    """Raises CertificateRefused with an error z at which Φ is less convex than S states, or ∇Φ is not its gradient.

    Tests Φ(y) ≥ Φ(x) + ∇Φ(x)ᵀ(y − x) + (y − x)ᵀS(y − x) and, unless `exact`, that ∇²Φ dz is the derivative of ∇Φ.
    """
    rng = np.random.default_rng(0)
    x, y = (np.concatenate([size * rng.normal(size=(_STATES, phi.nv)) for size in _SIZES]) for _ in range(2))
    step = y - x
    (at_x, gradient, product), (at_y, _, _) = phi.terms(x, step), phi.terms(y, step)
    if not all(np.isfinite(part).all() for part in (at_x, at_y, gradient, product)):
        refuse("Φ is not finite within a few radians", "load an earlier checkpoint")
    along, least = (gradient * step).sum(-1), (step * matvec(s, step)).sum(-1)
    lack = at_x + along + least - at_y
    bad = lack > _TOLERANCE * (np.abs(at_x) + np.abs(at_y) + np.abs(along) + least)
    if bad.any():
        at = np.round(x[int(bad.argmax())], 3).tolist()
        refuse(f"Φ is less convex than its S states, or ∇Φ is not its gradient, at z = {at}", "correct `terms`")
    if exact:
        return
    h = 1e-6
    rate = (phi.terms(x + h * step, step)[1] - phi.terms(x - h * step, step)[1]) / (2.0 * h)
    off = np.linalg.norm(rate - product, axis=-1) / (np.linalg.norm(rate, axis=-1) + np.linalg.norm(product, axis=-1))
    if np.median(off) > 1e-4:
        refuse("∇²Φ dz of the potential is not the derivative of ∇Φ", "correct `terms`")


def falsify_damping(damping: Damping, floor: Float[np.ndarray, "n n"], share: float = np.inf) -> float:
    """λ_min(D) over sampled z2; raises CertificateRefused if D₀ ⪯ D ⪯ (1 + share)D₀ fails or the force is not D z2."""
    rng = np.random.default_rng(1)
    z = np.concatenate([size * rng.normal(size=(_STATES, damping.nv)) for size in _SIZES])
    d, force = damping.matrix(z), damping.force(z)
    if not (np.isfinite(d).all() and np.isfinite(force).all()):
        refuse("D is not finite at velocities of a few rad/s", "load an earlier checkpoint")
    size = np.abs(d).max(axis=(-2, -1))
    least = np.linalg.eigvalsh(d - floor)[:, 0]
    off = np.abs(matvec(d, z) - force).max(axis=-1) > 1e-9 * size * np.abs(z).sum(axis=-1)
    bad = (least < -1e-10 * size) | off | (np.abs(d - d.mT).max(axis=(-2, -1)) > 1e-10 * size)
    if np.isfinite(share):
        high = np.linalg.eigvalsh(d - (1.0 + share) * floor)[:, -1] > 1e-10 * size
        if high.any():
            at = np.round(z[int(high.argmax())], 3).tolist()
            refuse(f"D exceeds {1.0 + share:.3g} D₀, which its ceiling states, at z2 = {at}", "correct `factor`")
    if bad.any():
        at = np.round(z[int(bad.argmax())], 3).tolist()
        refuse(f"D is not symmetric with D ⪰ D₀, or its force is not D z2, at z2 = {at}", "correct `matrix` or `force`")
    if foreign_code(damping) or damping.floor is not None:
        return float(np.linalg.eigvalsh(d)[:, 0].min())
    r = damping.scale.numpy(force=True)  # λ_min(TᵀT) = σ_min(T)², which keeps twice as many digits
    return float(np.linalg.svd(damping.factor(r * z) * r, compute_uv=False)[:, -1].min()) ** 2
