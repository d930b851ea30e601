"""Claims for the parts of a Lyapunov law, read from their present parameters, however they were set.

Known code is PROVED by its structure; a part of another class, or with a replaced method, is EMPIRICAL, tested on
sampled errors. Parameters that violate an assumption of the proof raise CertificateRefused.
"""

from typing import Any

import numpy as np
from jaxtyping import Float

from nbs_pin.base.arrays import Array, JointArray, is_torch_array
from nbs_pin.base.claims import Claim, Known, Label, known, refuse
from nbs_pin.base.known_code import first_foreign, foreign_code
from nbs_pin.base.rounding import least_eigenvalue, up
from nbs_pin.controllers.activations import Activation
from nbs_pin.controllers.damping import DAMPINGS, Damping
from nbs_pin.controllers.falsification import SAMPLES, falsify_activation, falsify_damping, falsify_potential
from nbs_pin.controllers.gain import Gain
from nbs_pin.controllers.potential import POTENTIALS, Potential
from nbs_pin.dynamics.friction import DriveFriction, JointFriction

DAMPING = "D ⪰ D₀, least eigenvalue"
"""Name of the claim whose value is the largest known d with D ⪰ dI."""


CEILING = "D ⪯ (1 + n)D₀, n"
"""Name of the claim of a damping with a ceiling."""


def potential_claims(phi: Potential, rate: Gain) -> tuple[Claim, ...]:
    """Claims: ψ convex, ψ(0) = 0, and μ and ρ of Φ = zᵀSz + ψ with the rate Λ."""
    n = phi.nv
    if phi.form not in POTENTIALS:
        refuse(f"the potential has the form {phi.form!r}", f"choose one of {', '.join(POTENTIALS)}")
    _scale("Φ", phi.scale.numpy(force=True))
    s, odd_gain = positive_gain("the stiffness S", phi.stiffness, n, 2)
    lam, odd_rate = positive_gain("the rate Λ", rate, n, 1)
    convex, least = _convexity(phi, odd_gain)
    zero = _zero(phi, convex)
    falsify_potential(phi, s, exact=convex.label is Label.PROVED)
    root = np.sqrt(lam)
    mu, rho = 2.0 * least_eigenvalue(s), least_eigenvalue(2.0 * s * root * root[:, None])
    contraction = known(odd_rate, "") if odd_rate else Known(convex.label, "λ_min(2Λ^½SΛ^½), as ψ is convex")
    return (
        Claim("ψ convex", least, "", *convex),
        Claim("ψ(0) = 0, ∇ψ(0) = 0", 0.0, "", *zero),
        Claim("Φ strongly convex, μ", mu, "J/rad²", convex.label, "2λ_min(S), as ψ is convex"),
        Claim("ρ", rho, "1/s", *contraction),
    )


def damping_claims(damping: Damping) -> tuple[Claim, ...]:
    """Claims: D ⪰ D₀ and, with a ceiling, D ⪯ (1 + n)D₀; or lower bounds on D = TᵀT without a floor."""
    if damping.form not in DAMPINGS:
        refuse(f"the damping has the form {damping.form!r}", f"choose one of {', '.join(DAMPINGS)}")
    _scale("D", damping.scale.numpy(force=True))
    networks = (damping.diagonal, damping.lower)
    n, why = damping.nv, foreign_code(damping) or first_foreign(networks)
    if damping.floor is not None:
        floor, odd = positive_gain("the floor D₀", damping.floor, n, 2)
        share = _ceiling(damping)
        falsify_damping(damping, floor, share)
        least = least_eigenvalue(floor)
        claims = [Claim(DAMPING, least, "N·m·s/rad", *known(why or odd, "D = D₀ + TᵀT ⪰ D₀ for every weight of T"))]
        if damping.ceiling is not None:
            said = f"D = D₀ + R TᵀT R with ‖T‖_F² < {float(damping.ceiling):g} for every weight of T"
            claims.append(Claim(CEILING, share, "", *known(why or odd, said)))
        return tuple(claims)
    if damping.form != "paper" or not 0.0 < damping.m < np.inf:
        refuse(f"D = TᵀT has no floor D₀, and m is {damping.m}", "it may be singular: take damping 'bounded'")
    measured = falsify_damping(damping, np.zeros((n, n)))
    if not measured > 0.0:
        refuse("D = TᵀT is singular at a sampled velocity", "take damping 'bounded', which has a floor")
    said = f"D = TᵀT has no floor, and m² does not bound it: smallest on {SAMPLES} sampled velocities"
    claims = [Claim(DAMPING, measured, "N·m·s/rad", Label.EMPIRICAL, said)]
    if not why:
        because = "holds for every z2 as tanh is bounded, but is seldom large enough to be useful (docs/theory.md §5)"
        claims.append(Claim("TᵀT, least eigenvalue", _product_floor(damping), "N·m·s/rad", Label.PROVED, because))
    return tuple(claims)


def rate_claims(rate: Gain, inertial_rate: Any, nv: int) -> tuple[Claim, ...]:
    """Claims: the least entry of Λ, and ω."""
    lam, odd = positive_gain("the rate Λ", rate, nv, 1)
    if not isinstance(inertial_rate, float | int) or not 0.0 <= inertial_rate < np.inf:
        refuse(f"the inertial rate ω is {inertial_rate}", "give a finite number ≥ 0")
    return (
        Claim("Λ, least", float(lam.min()), "rad/s per N·m", *known(odd, "constant and diagonal")),
        Claim("ω", float(inertial_rate), "1/s", Label.PROVED, "constant"),
    )


def friction_claims(friction: JointFriction | None) -> tuple[Claim, ...]:
    """Claim about the friction, if any; raises CertificateRefused for friction that falls with velocity."""
    if friction is None:
        return ()
    if isinstance(friction, DriveFriction):
        why = "certificates know viscous and Coulomb friction only"
        refuse(why, "build the law with JointFriction(friction.viscous, friction.coulomb)")
    constants = np.concatenate([friction.viscous, friction.coulomb, [friction.transition]])
    if not (np.isfinite(constants).all() and (constants >= 0.0).all() and friction.transition > 0.0):
        refuse("the friction fed forward falls with velocity", "its coefficients must be ≥ 0 and its transition > 0")
    v = np.geomspace(1e-6, 1e2, 200)[:, None] * np.ones(friction.viscous.size)
    torque = friction.torque(np.concatenate([-v[::-1], v]))
    if not (np.diff(torque, axis=0) >= -1e-12 * np.abs(torque).max()).all():
        refuse("the friction fed forward falls with velocity", "give one that is monotone")
    how = known(foreign_code(friction), "monotone: it only adds dissipation, on an arm that has it")
    return (Claim("friction fed forward, least viscous", float(friction.viscous.min()), "N·m·s/rad", *how),)


def check_parts(dynamics_nv: int, sizes: dict[str, int], friction: JointFriction | None) -> None:
    """Raises CertificateRefused if the parts are for different numbers of joints."""
    if friction is not None:
        sizes = sizes | {"friction": friction.viscous.size}
    wrong = [f"{name} is for {size}" for name, size in sizes.items() if size != dynamics_nv]
    if wrong:
        refuse(f"the model has {dynamics_nv} joints and {wrong[0]}", "build the controller for one arm")


def check_kind(name: str, part: Any, kind: Any) -> None:
    """Raises CertificateRefused if the part is not an instance of `kind`."""
    if not isinstance(part, kind):
        refuse(f"{name} of the controller is a {type(part).__name__}", "keep the part that the constructor made")


def positive_gain(name: str, gain: Gain, n: int, axes: int) -> tuple[Float[np.ndarray, "..."], str]:
    """The gain and why its code is not known, empty if it is; raises CertificateRefused unless it is positive."""
    share, value = float(gain.least_share), gain.numpy()
    if not 0.0 <= share < 1.0:
        refuse(f"{name} has a least share of {share:g}, outside [0, 1)", "build the controller again")
    if value.shape != (n,) * axes or not np.isfinite(value).all():
        refuse(f"{name} has shape {value.shape} or is not finite", f"give {n} finite numbers per axis")
    if axes == 2 and not np.array_equal(value, value.T):
        refuse(f"{name} is not symmetric", "give a symmetric positive definite matrix")
    least = least_eigenvalue(value) if axes == 2 else float(value.min())
    if not least > 0.0:
        refuse(f"{name} has the eigenvalue {least:.3g} or less", "it must be positive definite")
    return value, foreign_code(gain)


def _ceiling(damping: Damping) -> float:
    """n with D ⪯ (1 + n)D₀ by the ceiling, inf without one; raises CertificateRefused if it is out of range."""
    if damping.ceiling is None:
        return np.inf
    if damping.ceiling.shape != () or not 0.0 < float(damping.ceiling) < np.inf:
        refuse(f"the ceiling of D is {damping.ceiling.tolist()}", "it must be a positive number")
    return up(float(damping.ceiling) * damping.stretch)


def _scale(name: str, scale: JointArray) -> None:
    if not (scale > 0.0).all():
        refuse(f"the scale R of {name} is {scale.tolist()}", "all its numbers must be positive")


def _convexity(phi: Potential, odd_gain: str) -> tuple[Known, float]:
    """How ψ is known to be convex, and its least effective weight; raises CertificateRefused if it may not be."""
    network: Any = phi.network
    why = odd_gain or foreign_code(phi) or foreign_code(network)
    if foreign_code(network):
        return known(why, ""), 0.0
    least = 0.0
    for numpy in (True, False):
        layers = network.layers(numpy=numpy)
        weights = [float(_array(layer.wy).min()) for layer in layers if layer.wy is not None]
        if weights and not min(weights) >= 0.0:
            refuse(f"ψ has the effective weight {min(weights):.3g} in W^(y), so it need not be convex", "keep them ≥ 0")
        if len(layers[-1].wx) != 1 or layers[0].wx.shape[1] != phi.nv:
            refuse("the network of ψ has other inputs or outputs", f"give one with {phi.nv} inputs and one output")
        least = min(weights, default=0.0)
    activation = _activation(network.activation)
    return known(why or activation, "weights W^(y) ≥ 0, σ convex and non-decreasing; value: the least of W^(y)"), least


def _array(x: Array) -> Float[np.ndarray, "*shape"]:
    return x.numpy(force=True) if is_torch_array(x) else x


def _activation(activation: Activation) -> str:
    """Why σ is not proved convex and non-decreasing, empty if it is; raises CertificateRefused if tests refute it."""
    if not foreign_code(activation):
        width = next(iter(vars(activation).values()))
        if not 0.0 < width < np.inf:
            refuse(f"the activation is {activation}", "its width must be positive and finite")
        return ""
    falsify_activation(activation)
    return f"the activation {type(activation).__name__} is not from this package"


def _zero(phi: Potential, convex: Known) -> Known:
    """How ψ(0) = 0 and ∇ψ(0) = 0 are known; raises CertificateRefused if they do not hold."""
    zero = np.zeros(phi.nv)
    value, gradient, _ = phi.terms(zero, zero)
    size, slope, _ = phi.terms(zero + 1.0, zero)
    # The smooth form subtracts f(0) and ∇f(0) up to rounding; the paper's form is exactly zero.
    allowed = 0.0 if phi.form == "paper" else 1e-9
    if abs(value) > allowed * abs(size) or np.abs(gradient).max() > allowed * np.abs(slope).max():
        refuse(
            f"Φ(0) = {float(value):.3g} and ‖∇Φ(0)‖ = {np.linalg.norm(gradient):.3g}, so errors need not vanish",
            "the paper's ψ takes no biases and needs σ(0) = σ'(0) = 0: take form 'smooth' for others",
        )
    if convex.label is not Label.PROVED:
        return convex
    return Known(Label.PROVED, "evaluated at 0" if phi.form == "paper" else "ψ = f(Rz) − f(0) − ∇f(0)ᵀRz")


def _product_floor(damping: Damping) -> float:
    """λ_min(R TᵀT R) ≥ min R² σ², σ the larger of two lower bounds on σ_min(T) with t_ii in [m, d_i], |t_ij| ≤ c_ij.

    They are mⁿ((n − 1)/F²)^((n−1)/2) with F² = Σd_i² + Σc_ij² ≥ ‖T‖_F² (docs/theory.md §5), and 1/‖⟨T⟩⁻¹‖, as
    |T⁻¹| ≤ ⟨T⟩⁻¹ entry by entry, with m on the diagonal of ⟨T⟩ and −c_ij below it.
    """
    n, m = damping.nv, float(damping.m)
    top, (low, high) = np.maximum(_range(damping.diagonal)[1], 0.0) + m, _range(damping.lower)
    below = np.zeros((n, n))
    below[np.tril_indices(n, -1)] = np.maximum(-low, high)
    square = float((top**2).sum() + (below**2).sum())
    if not np.isfinite(square):
        return 0.0
    product = m**n * ((n - 1) / square) ** ((n - 1) / 2) if n > 1 else m
    inverse = np.eye(n) / m
    for i in range(1, n):  # (mI − C)⁻¹ row by row: sums of positive numbers, without cancellation
        inverse[i] += below[i, :i] @ inverse[:i] / m
    norm = float(np.linalg.norm(inverse, 2))
    sigma = max(product, 1.0 / norm if np.isfinite(norm) else 0.0)
    return float((1.0 - 1e-9) * sigma**2 * damping.scale.min() ** 2)


def _range(network: Any) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Smallest and largest outputs of a tanh network: b ∓ Σ|w|; ∓inf without a hidden layer."""
    layers = network.layers(numpy=True)
    weight, bias = layers[-1]
    spread = np.abs(weight).sum(axis=1) if len(layers) > 1 else np.full(len(bias), np.inf)
    return bias - spread, bias + spread
