"""What makes a controller stable, read from the numbers and the code it now has, whoever built or edited it."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from nbs_pin.arrays import Array, is_torch_array, matvec
from nbs_pin.certificates.claims import Claim, Label
from nbs_pin.certificates.model_structure import (
    check_finite,
    check_model,
    first_strange,
    refuse,
    sample_states,
    strange,
)
from nbs_pin.certificates.rounding import least_eigenvalue
from nbs_pin.controllers.neural_backstepping import NeuralBackstepping
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.networks.activations import Activation, SmoothedReLU, Squareplus
from nbs_pin.networks.convex import FICNN
from nbs_pin.networks.damping import DAMPINGS, Damping
from nbs_pin.networks.gain import Gain
from nbs_pin.networks.potential import POTENTIALS, Potential
from nbs_pin.robot import Robot

DAMPING = "D ⪰ D₀, least eigenvalue"
"""Name of the claim whose value is the largest known d with D ⪰ dI."""
_STATES = 48
_SIZES = (0.03, 0.3, 3.0)
_TOLERANCE = 1e-6


class _Known(NamedTuple):
    """How something is known."""

    label: Label
    because: str


def check_structure(controller: Any, robot: Robot | None = None) -> tuple[Claim, ...]:
    """μ, ρ, Λ, D₀, ψ, ω, friction, M̂ and the law of a `NeuralBackstepping`, each with the way it is known.

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
    return (*potential, *gains, *_friction_claims(controller.friction), _law_claim(controller, model[0]))


def scaled_least_eigenvalue(matrix: Float[np.ndarray, "n n"]) -> float:
    """At most λ_min of a symmetric matrix, and > 0 for positive definite ones with grams beside tonnes.

    The better of A itself and of A = EBE with diag(B) = 1: λ_min(A) ≥ λ_min(B) min A_ii.
    """
    direct, diagonal = float(least_eigenvalue(matrix)), np.diag(matrix)
    if not (diagonal > 0.0).all():
        return direct
    root = np.sqrt(diagonal)
    inner = float(least_eigenvalue(matrix / root / root[:, None]))
    return max(direct, inner * float(diagonal.min()) * (1.0 - 1e-12)) if inner > 0.0 else direct


def _check_sizes(controller: NeuralBackstepping) -> None:
    """Raises CertificateRefused when the parts are for different numbers of joints, or are no such parts."""
    for name, part, kind in (
        ("Φ", controller.potential, Potential),
        ("D", controller.damping, Damping),
        ("Λ", controller.rate, Gain),
    ):
        if not isinstance(part, kind):
            refuse(f"{name} of the controller is a {type(part).__name__}", f"give a {kind.__name__}")
    n = controller.dynamics.nv
    sizes = {"Φ": controller.potential.nv, "D": controller.damping.nv, "Λ": len(controller.rate.nominal)}
    wrong = [f"{name} is for {size}" for name, size in sizes.items() if size != n]
    if wrong:
        refuse(f"the model has {n} joints and {wrong[0]}", "build the controller for one arm")


def _gain(name: str, gain: Gain, n: int, axes: int) -> tuple[Float[np.ndarray, "..."], str]:
    """The gain as it stands and why its code may not be the package's; raises CertificateRefused unless positive."""
    share, value = float(gain.least_share), gain.numpy()
    if not 0.0 <= share < 1.0:
        refuse(f"{name} has a least share of {share:g}, outside [0, 1)", "build the controller again")
    if value.shape != (n,) * axes or not np.isfinite(value).all():
        refuse(f"{name} has shape {value.shape} or is not finite", f"give {n} finite numbers per axis")
    if axes == 2 and not np.array_equal(value, value.T):
        refuse(f"{name} is not symmetric", "give a symmetric positive definite matrix")
    least = scaled_least_eigenvalue(value) if axes == 2 else float(value.min())
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
    _falsify_potential(phi, s, exact=convex.label is Label.PROVED)
    root = np.sqrt(rate)
    mu, rho = 2.0 * scaled_least_eigenvalue(s), scaled_least_eigenvalue(2.0 * s * root * root[:, None])
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
    _falsify_activation(activation)
    return f"{type(activation).__name__} is an activation that is not the package's"


def _falsify_activation(activation: Activation) -> None:
    """Raises CertificateRefused with a witness unless σ, σ', σ'' look like those of a convex, non-decreasing σ."""
    name, tail = type(activation).__name__, np.geomspace(1e-9, 1e2, 400)
    x = np.unique(np.concatenate([-tail, np.linspace(-4.0, 4.0, 1601), tail]))
    value, slope, bend = (np.asarray(part, dtype=float) for part in activation.derivatives(x))
    if not (np.isfinite(value).all() and np.isfinite(slope).all() and np.isfinite(bend).all()):
        refuse(f"the activation {name} is not finite within ±100", "give a finite σ, σ' and σ''")
    along = slope * (x[:, None] - x)
    gap = value[:, None] - value - along  # of σ(y), row y, over its tangent at x, column x
    rounding = 1e-9 * (np.abs(value[:, None]) + np.abs(value) + np.abs(along))
    falls = slope < -1e-12 * np.abs(slope).max()
    bent = (gap < -rounding).any(axis=0) | (bend < -1e-12 * np.abs(bend).max())
    for bad, fault in ((falls, "decreases"), (bent, "is not convex, or σ' not its slope,")):
        if bad.any():
            at = x[int(bad.argmax())]
            refuse(f"the activation {name} {fault} at x = {at:.3g}", "give a convex, non-decreasing σ")
    _falsify_bend(activation, x)


def _falsify_bend(activation: Activation, x: Float[np.ndarray, " m"]) -> None:
    """Raises CertificateRefused where σ'' is not the derivative of σ', looking ever closer at steps that disagree."""
    a, b = x[:-1], x[1:]
    least = 1e-13 * float(np.abs(activation.derivatives(x[np.abs(x) < 4.0])[1]).max())
    for _ in range(20):
        (_, s_a, c_a), (_, s_b, c_b) = activation.derivatives(a), activation.derivatives(b)
        allowed = np.abs(c_b - c_a) + 1e-3 * (np.abs(c_a) + np.abs(c_b))
        rounding = 1e-12 * (np.abs(s_a) + np.abs(s_b)) + least
        bad = np.abs((s_b - s_a) - 0.5 * (c_a + c_b) * (b - a)) > allowed * (b - a) + rounding
        if not bad.any():
            return
        a, b = a[bad], b[bad]
        middle = 0.5 * (a + b)
        a, b = np.concatenate([a, middle]), np.concatenate([middle, b])
    refuse(
        f"σ'' of the activation {type(activation).__name__} is not the derivative of σ' near x = {a[0]:.3g}",
        "give a σ whose slope does not jump, with its derivatives",
    )


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


def _falsify_potential(phi: Potential, s: Float[np.ndarray, "n n"], *, exact: bool) -> None:
    """Raises CertificateRefused with a pair of errors at which Φ is not as convex as S says, or ∇Φ not its gradient.

    Φ(y) ≥ Φ(x) + ∇Φ(x)ᵀ(y − x) + (y − x)ᵀS(y − x). exact: False asks of ∇²Φ dz too whether it is the derivative.
    """
    rng = np.random.default_rng(0)
    x, y = (np.concatenate([size * rng.normal(size=(_STATES, phi.nv)) for size in _SIZES]) for _ in range(2))
    step = y - x
    (at_x, gradient, product), (at_y, _, _) = phi.terms(x, step), phi.terms(y, step)
    if not all(np.isfinite(part).all() for part in (at_x, at_y, gradient, product)):
        refuse("Φ is not finite within a few radians", "load the last sound checkpoint")
    along, least = (gradient * step).sum(-1), (step * matvec(s, step)).sum(-1)
    lack = at_x + along + least - at_y
    bad = lack > _TOLERANCE * (np.abs(at_x) + np.abs(at_y) + np.abs(along) + least)
    if bad.any():
        at = np.round(x[int(bad.argmax())], 3).tolist()
        refuse(f"Φ is not as convex as its S says, or ∇Φ is not its gradient, at z = {at}", "correct its terms")
    if exact:
        return
    h = 1e-6
    rate = (phi.terms(x + h * step, step)[1] - phi.terms(x - h * step, step)[1]) / (2.0 * h)
    off = np.linalg.norm(rate - product, axis=-1) / (np.linalg.norm(rate, axis=-1) + np.linalg.norm(product, axis=-1))
    if np.median(off) > 1e-4:
        refuse("∇²Φ dz of the potential is not the derivative of ∇Φ", "correct its terms")


def _damping_claims(damping: Damping) -> tuple[Claim, ...]:
    if damping.form not in DAMPINGS:
        refuse(f"the damping has the form {damping.form!r}", f"choose one of {', '.join(DAMPINGS)}")
    _scale("D", damping.scale.numpy(force=True))
    networks = (damping.diagonal, damping.lower)
    n, own = damping.nv, type(Damping(1, floor=np.eye(1), widths=()).diagonal)
    why = strange(damping, Damping) or first_strange(networks, own)
    if damping.floor is not None:
        floor, odd = _gain("the floor D₀", damping.floor, n, 2)
        _falsify_damping(damping, floor)
        least = scaled_least_eigenvalue(floor)
        return (Claim(DAMPING, least, "N·m·s/rad", *_known(why or odd, "D = D₀ + TᵀT ⪰ D₀ for every weight of T")),)
    if damping.form != "paper" or not 0.0 < damping.m < np.inf:
        refuse(f"D = TᵀT has no floor D₀, and m is {damping.m}", "it may be singular: take damping 'bounded'")
    measured = _falsify_damping(damping, np.zeros((n, n)))
    if not measured > 0.0:
        refuse("D = TᵀT is singular at a sampled velocity", "take damping 'bounded', which has a floor")
    said = f"D = TᵀT has no floor, and m² is none: least on {len(_SIZES) * _STATES} sampled velocities"
    claims = [Claim(DAMPING, measured, "N·m·s/rad", Label.EMPIRICAL, said)]
    if not why:
        because = "true for every z2 as tanh is bounded, and too small to be of use (docs/theory.md §5)"
        claims.append(Claim("TᵀT, least eigenvalue", _product_floor(damping), "N·m·s/rad", Label.PROVED, because))
    return tuple(claims)


def _falsify_damping(damping: Damping, floor: Float[np.ndarray, "n n"]) -> float:
    """λ_min(D) on sampled z2, small and large; raises CertificateRefused where D ⪰ D₀ fails or its force is no D z2."""
    rng = np.random.default_rng(1)
    z = np.concatenate([size * rng.normal(size=(_STATES, damping.nv)) for size in _SIZES])
    d, force = damping.matrix(z), damping.force(z)
    if not (np.isfinite(d).all() and np.isfinite(force).all()):
        refuse("D is not finite at velocities of a few rad/s", "load the last sound checkpoint")
    size = np.abs(d).max(axis=(-2, -1))
    least = np.linalg.eigvalsh(d - floor)[:, 0]
    off = np.abs(matvec(d, z) - force).max(axis=-1) > 1e-9 * size * np.abs(z).sum(axis=-1)
    bad = (least < -1e-10 * size) | off | (np.abs(d - d.mT).max(axis=(-2, -1)) > 1e-10 * size)
    if bad.any():
        at = np.round(z[int(bad.argmax())], 3).tolist()
        refuse(f"D is not symmetric with D ⪰ D₀, or its force is not D z2, at z2 = {at}", "correct the damping")
    if strange(damping, Damping) or damping.floor is not None:
        return float(np.linalg.eigvalsh(d)[:, 0].min())
    r = damping.scale.numpy(force=True)  # of TᵀT by T itself, which knows twice as many digits of small eigenvalues
    return float(np.linalg.svd(damping.factor(r * z) * r, compute_uv=False)[:, -1].min()) ** 2


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
    inverse = np.linalg.norm(np.linalg.inv(m * np.eye(n) - below))
    sigma = max(product, 1.0 / float(inverse) if np.isfinite(inverse) else 0.0)
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
    if not 0.0 <= omega < np.inf:
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
    """V̇ along the law on its own model, term by term; raises CertificateRefused where V falls more slowly than it says.

    V̇ = ∇Φᵀ(v − v_d) + z2ᵀ(τ − f(v) − (M a_r + C φ + G)), from the ingredients and not from the law's own signals.
    """
    excess, at = _excess(controller)
    if excess > _TOLERANCE:
        refuse(f"V falls more slowly than its dissipation at q = {at}, so τ is not the NBS law", "correct the torque")
    why = strange(controller, NeuralBackstepping) or ("" if model.label is Label.PROVED else model.because)
    known = _known(why, "the law of docs/theory.md §2")
    return Claim("V̇ + ∇ΦᵀΛ∇Φ + z2ᵀ(ωM + D)z2 without disturbance, largest", 0.0, "W", *known)


def _excess(controller: NeuralBackstepping) -> tuple[float, list[float]]:
    """Largest V̇ above minus the dissipation, as a share of its terms, and where."""
    model, phi = controller.dynamics, controller.potential
    q, z, v, v_ref = sample_states(model, _STATES, seed=2)
    z, v, v_ref = 0.2 * z, 0.5 * v, 0.5 * v_ref
    q_ref, a_ref = q - z, v_ref[::-1]
    z1 = model.difference(q, q_ref)
    _, gradient, product = phi.terms(z1, v - v_ref)
    rate, omega = controller.rate.numpy(), controller.inertial_rate
    v_r, a_r = v_ref - rate * gradient, a_ref - rate * product
    z2, mass = v - v_r, model.mass_matrix(q)
    tau = controller.torque(q, v, q_ref, v_ref, a_ref)
    terms = [matvec(mass, a_r), matvec(model.coriolis_matrix(q, v), v_r), model.gravity(q)]
    taken = 0.0 * v if controller.friction is None else controller.friction.torque(v)
    loss = [rate * gradient * gradient, z2 * omega * matvec(mass, z2), z2 * controller.damping.force(z2)]
    gain = [gradient * (v - v_ref), z2 * tau, -z2 * taken, *(-z2 * term for term in terms)]
    balance = sum(part.sum(-1) for part in (*gain, *loss))
    size = sum(np.abs(part).sum(-1) for part in (*gain, *loss))
    share = np.where(np.isfinite(balance), balance / size, np.inf)
    worst = int(share.argmax())
    return float(share[worst]), np.round(q[worst], 3).tolist()
