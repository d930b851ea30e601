"""What makes a controller stable, read from the numbers and the code it now has, whoever built or edited it."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from nbs_pin.base.arrays import Array, is_torch_array
from nbs_pin.base.claims import Claim, Label
from nbs_pin.certificates.falsification import (
    SAMPLES,
    falsify_activation,
    falsify_damping,
    falsify_law,
    falsify_potential,
)
from nbs_pin.certificates.model_structure import check_finite, check_model, first_strange, refuse, strange
from nbs_pin.controllers.activations import Activation, SmoothedReLU, Squareplus
from nbs_pin.controllers.convex import FICNN
from nbs_pin.controllers.damping import DAMPINGS, Damping
from nbs_pin.controllers.gain import Gain
from nbs_pin.controllers.neural_backstepping import NeuralBackstepping
from nbs_pin.controllers.potential import POTENTIALS, Potential
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.inertia.rounding import least_eigenvalue
from nbs_pin.robots.robot import Robot

DAMPING = "D ⪰ D₀, least eigenvalue"
"""Name of the claim whose value is the largest known d with D ⪰ dI."""


class _Known(NamedTuple):
    """How something is known."""

    label: Label
    because: str


def check_structure(controller: Any, robot: Robot | None = None) -> tuple[Claim, ...]:
    """μ, ρ, Λ, D₀, ψ, ω, friction and the law of a `NeuralBackstepping`, each with the way it is known.

    Constructors are not trusted: effective weights, gains and constants are read as they now stand. What is the
    package's own code is PROVED by structure; a part of another class, or with a method replaced, is EMPIRICAL, on
    sampled errors and states. robot: the arm the controller is meant for, if its belief shall be held to it.
    Raises CertificateRefused, in one sentence, where the proof of docs/theory.md §5 has no ground.
    """
    if not isinstance(controller, NeuralBackstepping):
        refuse(
            f"a {type(controller).__name__} has no Lyapunov function here",
            "give a NeuralBackstepping, and for a compiled one the controller it was compiled from",
        )
    check_finite("the controller", controller)
    model = check_model(controller.dynamics, robot)
    _check_sizes(controller)
    if not np.isfinite(model[1].value):
        refuse(f"no bound follows from this model: {model[1].because}", "take a 'homogenised' or 'cholesky' one")
    potential = _potential_claims(controller)
    gains = (*_damping_claims(controller.damping), *_rate_claims(controller))
    return (*potential, *gains, *_friction_claims(controller.friction), _law_claim(controller, model[0]), *model)


def _check_sizes(controller: NeuralBackstepping) -> None:
    """Raises CertificateRefused when the parts are for different numbers of joints, or are no such parts."""
    _check_kind("Φ", controller.potential, Potential)
    _check_kind("D", controller.damping, Damping)
    _check_kind("Λ", controller.rate, Gain)
    _check_kind("S", controller.potential.stiffness, Gain)
    _check_kind("D₀", controller.damping.floor, Gain | None)
    n = controller.dynamics.nv
    sizes = {"Φ": controller.potential.nv, "D": controller.damping.nv, "Λ": len(controller.rate.nominal)}
    if controller.friction is not None:
        sizes["friction"] = controller.friction.viscous.size
    wrong = [f"{name} is for {size}" for name, size in sizes.items() if size != n]
    if wrong:
        refuse(f"the model has {n} joints and {wrong[0]}", "build the controller for one arm")


def _check_kind(name: str, part: Any, kind: Any) -> None:
    if not isinstance(part, kind):
        refuse(f"{name} of the controller is a {type(part).__name__}", "give what its constructor makes of it")


def _gain(name: str, gain: Gain, n: int, axes: int) -> tuple[Float[np.ndarray, "..."], str]:
    """The gain as it stands and why its code may not be the package's; raises CertificateRefused unless positive."""
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
    return value, strange(gain, Gain)


def _scale(name: str, scale: Float[np.ndarray, " n"]) -> None:
    if not (scale > 0.0).all():
        refuse(f"the scale R of {name} is {scale.tolist()}", "all its numbers must be positive")


def _known(why: str, proof: str) -> _Known:
    """PROVED by the structure of the package's code, or EMPIRICAL because of why it may be another."""
    return _Known(Label.EMPIRICAL, f"{why}: held on samples") if why else _Known(Label.PROVED, proof)


def _potential_claims(controller: NeuralBackstepping) -> tuple[Claim, ...]:
    phi, n = controller.potential, controller.nv
    if phi.form not in POTENTIALS:
        refuse(f"the potential has the form {phi.form!r}", f"choose one of {', '.join(POTENTIALS)}")
    _scale("Φ", phi.scale.numpy(force=True))
    s, odd_gain = _gain("the stiffness S", phi.stiffness, n, 2)
    rate, odd_rate = _gain("the rate Λ", controller.rate, n, 1)
    convex, least = _convexity(phi, odd_gain)
    zero = _zero(phi, convex)
    falsify_potential(phi, s, exact=convex.label is Label.PROVED)
    root = np.sqrt(rate)
    mu, rho = 2.0 * least_eigenvalue(s), least_eigenvalue(2.0 * s * root * root[:, None])
    contraction = _Known(convex.label, "λ_min(2Λ^½SΛ^½), as ψ is convex")
    contraction = _Known(Label.EMPIRICAL, f"{odd_rate}: held on samples") if odd_rate else contraction
    return (
        Claim("ψ convex", least, "", *convex),
        Claim("ψ(0) = 0, ∇ψ(0) = 0", 0.0, "", *zero),
        Claim("Φ strongly convex, μ", mu, "J/rad²", convex.label, "2λ_min(S), as ψ is convex"),
        Claim("ρ", rho, "1/s", *contraction),
    )


def _convexity(phi: Potential, odd_gain: str) -> tuple[_Known, float]:
    """How ψ is known to be convex, and its least effective weight; raises CertificateRefused where it is not."""
    network: Any = phi.network
    why = odd_gain or strange(phi, Potential) or strange(network, FICNN)
    if strange(network, FICNN):
        return _known(why, ""), 0.0
    least = 0.0
    for numpy in (True, False):
        layers = network.layers(numpy=numpy)
        weights = [float(_array(layer.wy).min()) for layer in layers if layer.wy is not None]
        if weights and not min(weights) >= 0.0:
            refuse(f"ψ has the effective weight {min(weights):.3g} in W^(y), so it need not be convex", "keep them ≥ 0")
        if len(layers[-1].wx) != 1 or layers[0].wx.shape[1] != phi.nv:
            refuse("the network of ψ is no scalar function of the error", f"give one of {phi.nv} inputs and one output")
        least = min(weights, default=0.0)
    activation = _activation(network.activation)
    return _known(why or activation, "weights W^(y) ≥ 0, σ convex and non-decreasing; value: the least of W^(y)"), least


def _array(x: Array) -> Float[np.ndarray, "*shape"]:
    return x.numpy(force=True) if is_torch_array(x) else x


def _activation(activation: Activation) -> str:
    """Why σ is not known to be convex and non-decreasing, empty if it is; raises CertificateRefused if it is not."""
    known = strange(activation, SmoothedReLU, Squareplus)
    if not known:
        width = next(iter(vars(activation).values()))
        if not 0.0 < width < np.inf:
            refuse(f"the activation is {activation}", "its width must be positive and finite, or its slope jumps")
        return ""
    falsify_activation(activation)
    return f"{type(activation).__name__} is an activation that is not the package's"


def _zero(phi: Potential, convex: _Known) -> _Known:
    """How ψ(0) = 0 and ∇ψ(0) = 0 are known; raises CertificateRefused where they do not hold."""
    zero = np.zeros(phi.nv)
    value, gradient, _ = phi.terms(zero, zero)
    size, slope, _ = phi.terms(zero + 1.0, zero)
    # The smooth form subtracts what f(0) and ∇f(0) are, to rounding; the paper's is zero to the last bit.
    allowed = 0.0 if phi.form == "paper" else 1e-9
    if abs(value) > allowed * abs(size) or np.abs(gradient).max() > allowed * np.abs(slope).max():
        refuse(
            f"Φ(0) = {float(value):.3g} and ‖∇Φ(0)‖ = {np.linalg.norm(gradient):.3g}, so errors do not end at zero",
            "the paper's ψ takes no biases and needs σ(0) = σ'(0) = 0: take form 'smooth' for others",
        )
    if convex.label is not Label.PROVED:
        return convex
    return _Known(Label.PROVED, "evaluated at 0" if phi.form == "paper" else "ψ = f(Rz) − f(0) − ∇f(0)ᵀRz")


def _damping_claims(damping: Damping) -> tuple[Claim, ...]:
    if damping.form not in DAMPINGS:
        refuse(f"the damping has the form {damping.form!r}", f"choose one of {', '.join(DAMPINGS)}")
    _scale("D", damping.scale.numpy(force=True))
    networks = (damping.diagonal, damping.lower)
    n, own = damping.nv, type(Damping(1, floor=np.eye(1), widths=()).diagonal)
    why = strange(damping, Damping) or first_strange(networks, own)
    if damping.floor is not None:
        floor, odd = _gain("the floor D₀", damping.floor, n, 2)
        falsify_damping(damping, floor)
        least = least_eigenvalue(floor)
        return (Claim(DAMPING, least, "N·m·s/rad", *_known(why or odd, "D = D₀ + TᵀT ⪰ D₀ for every weight of T")),)
    if damping.form != "paper" or not 0.0 < damping.m < np.inf:
        refuse(f"D = TᵀT has no floor D₀, and m is {damping.m}", "it may be singular: take damping 'bounded'")
    measured = falsify_damping(damping, np.zeros((n, n)))
    if not measured > 0.0:
        refuse("D = TᵀT is singular at a sampled velocity", "take damping 'bounded', which has a floor")
    said = f"D = TᵀT has no floor, and m² is none: least on {SAMPLES} sampled velocities"
    claims = [Claim(DAMPING, measured, "N·m·s/rad", Label.EMPIRICAL, said)]
    if not why:
        because = "true for every z2 as tanh is bounded, seldom large enough to be of use (docs/theory.md §5)"
        claims.append(Claim("TᵀT, least eigenvalue", _product_floor(damping), "N·m·s/rad", Label.PROVED, because))
    return tuple(claims)


def _product_floor(damping: Damping) -> float:
    """λ_min(R TᵀT R) ≥ min R² σ², the better of two bounds on T with t_ii in [m, d_i], |t_ij| ≤ c_ij.

    σ ≥ mⁿ((n − 1)/F²)^((n−1)/2) with F² = Σd_i² + Σc_ij² ≥ ‖T‖_F² (docs/theory.md §5), and |T⁻¹| ≤ ⟨T⟩⁻¹ with ⟨T⟩ of
    diagonal m and −c_ij below it, entry by entry.
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
    for i in range(1, n):  # (mI − C)⁻¹ row by row: sums of positive numbers, of which none loses digits
        inverse[i] += below[i, :i] @ inverse[:i] / m
    norm = float(np.linalg.norm(inverse, 2))
    sigma = max(product, 1.0 / norm if np.isfinite(norm) else 0.0)
    return float((1.0 - 1e-9) * sigma**2 * damping.scale.min() ** 2)


def _range(network: Any) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Least and largest outputs of a tanh network: b ∓ Σ|w|; ∓inf for one without a hidden layer."""
    layers = network.layers(numpy=True)
    weight, bias = layers[-1]
    spread = np.abs(weight).sum(axis=1) if len(layers) > 1 else np.full(len(bias), np.inf)
    return bias - spread, bias + spread


def _rate_claims(controller: NeuralBackstepping) -> tuple[Claim, ...]:
    rate, odd = _gain("the rate Λ", controller.rate, controller.nv, 1)
    omega = controller.inertial_rate
    if not isinstance(omega, float | int) or not 0.0 <= omega < np.inf:
        refuse(f"the inertial rate ω is {omega}", "give a finite number ≥ 0")
    return (
        Claim("Λ, least", float(rate.min()), "rad/s per N·m", *_known(odd, "constant and diagonal")),
        Claim("ω", float(omega), "1/s", Label.PROVED, "constant"),
    )


def _friction_claims(friction: JointFriction | None) -> tuple[Claim, ...]:
    """None without friction; raises CertificateRefused for friction that falls with velocity."""
    if friction is None:
        return ()
    constants = np.concatenate([friction.viscous, friction.coulomb, [friction.transition]])
    if not (np.isfinite(constants).all() and (constants >= 0.0).all() and friction.transition > 0.0):
        refuse("the friction fed forward falls with velocity", "its coefficients must be ≥ 0 and its transition > 0")
    v = np.geomspace(1e-6, 1e2, 200)[:, None] * np.ones(friction.viscous.size)
    torque = friction.torque(np.concatenate([-v[::-1], v]))
    if not (np.diff(torque, axis=0) >= -1e-12 * np.abs(torque).max()).all():
        refuse("the friction fed forward falls with velocity", "give one that is monotone")
    known = _known(strange(friction, JointFriction), "monotone: it only adds dissipation, on an arm that has it")
    return (Claim("friction fed forward, least viscous", float(friction.viscous.min()), "N·m·s/rad", *known),)


def _law_claim(controller: NeuralBackstepping, model: Claim) -> Claim:
    """How V̇ of the undisturbed loop is known; raises CertificateRefused where V falls more slowly than it says."""
    falsify_law(controller)
    why = strange(controller, NeuralBackstepping) or ("" if model.label is Label.PROVED else model.because)
    known = _known(why, "the law of docs/theory.md §2")
    return Claim("V̇ + ∇ΦᵀΛ∇Φ + z2ᵀ(ωM + D)z2 without disturbance, largest", 0.0, "W", *known)
