"""Stability structure of a controller, read from its present numbers and code, however it was built or edited."""

from typing import Any

import numpy as np

from nbs_pin.base.arrays import matvec
from nbs_pin.base.claims import Claim, Label, known, refuse
from nbs_pin.base.known_code import foreign_code
from nbs_pin.certificates.model_structure import check_finite, check_model, sample_states
from nbs_pin.controllers.adaptive_law import AdaptiveLaw
from nbs_pin.controllers.compiled_adaptive import CompiledAdaptiveLaw
from nbs_pin.controllers.lyapunov_law import Lyapunov, LyapunovLaw
from nbs_pin.dynamics.structure import ModelClaims
from nbs_pin.robots.robot import Robot

_STATES = 48
_TOLERANCE = 1e-6


def check_structure(controller: Any, robot: Robot | None = None) -> Lyapunov:
    """The constants of a `LyapunovLaw` and the claims they rest on: of its parts, the law itself and its model.

    Constructors are not trusted: present weights, gains and constants are read. Known code is PROVED by structure; a
    part of another class, or with a method replaced, is EMPIRICAL, on sampled states.

    Args:
        controller: The law.
        robot: The arm that the controller's model should belong to, if it is to be checked.

    Raises:
        CertificateRefused: If the proof of docs/theory.md §5 does not apply.
    """
    law = lyapunov_law(controller)
    check_finite("the controller", law)
    model = check_model(law.dynamics, robot)
    if not np.isfinite(model.skew.value):
        refuse(f"no bound follows from this model: {model.skew.because}", "take a 'homogenised' or 'cholesky' one")
    lyapunov = law.lyapunov()
    return lyapunov._replace(claims=(*lyapunov.claims, _law_claim(law, model), *model))


def lyapunov_law(controller: Any) -> LyapunovLaw:
    """The controller, if it has a Lyapunov function; raises CertificateRefused if not."""
    if isinstance(controller, (AdaptiveLaw, CompiledAdaptiveLaw)):
        refuse(
            f"the V of {type(controller).__name__} has its estimates in it, which no certificate has",
            "call transient_bound for it, or give the law that it is about",
        )
    if not isinstance(controller, LyapunovLaw):
        refuse(
            f"a {type(controller).__name__} has no Lyapunov function here",
            "give a NeuralBackstepping or SlotineLi, and for a compiled one the controller it was compiled from",
        )
    return controller


def _law_claim(controller: LyapunovLaw, model: ModelClaims) -> Claim:
    """How V̇ of the undisturbed loop is known; raises CertificateRefused if V falls more slowly than claimed."""
    falsify_law(controller)
    why = foreign_code(controller)
    why = why or ("" if model.positive.label is Label.PROVED else model.positive.because)
    return Claim(
        "V̇ + ∇ΦᵀΛ∇Φ + z2ᵀ(ωM + D)z2 without disturbance, largest"
        if controller.coupling == 1.0
        else "V̇ + ∇ΦᵀΛ∇Φ + z2ᵀ(ωM + D)z2 − (1 − ζ)z2ᵀ∇Φ without disturbance, largest",
        0.0,
        "W",
        *known(why, "the law of docs/theory.md §2"),
    )


def falsify_law(controller: LyapunovLaw) -> None:
    """Raises CertificateRefused with a state at which the undisturbed V falls more slowly than its `losses`.

    V̇ = ∇Φᵀ(v − v_d) + z2ᵀ(τ − f(v) − (M a_r + C φ + G)), from the model terms, not from the law's own signals.
    """
    model = controller.dynamics
    q, z, v, v_ref = sample_states(model, _STATES, seed=2)
    z, v, v_ref = 0.2 * z, 0.5 * v, 0.5 * v_ref
    q_ref, a_ref = q - z, v_ref[::-1]
    z1 = model.difference(q, q_ref)
    _, gradient, product = controller.potential_terms(z1, v - v_ref)
    rate, omega, free = controller.rate_like(q), controller.inertial_rate, 1.0 - controller.coupling
    v_r, a_r = v_ref - rate * gradient, a_ref - rate * product
    z2, mass = v - v_r, model.mass_matrix(q)
    tau = controller.torque(q, v, q_ref, v_ref, a_ref)
    terms = [matvec(mass, a_r), matvec(model.coriolis_matrix(q, v), v_r), model.gravity(q)]
    taken = 0.0 * v if controller.friction is None else controller.friction.torque(v)
    loss = [
        -free * z2 * gradient,
        rate * gradient * gradient,
        z2 * omega * matvec(mass, z2),
        z2 * controller.damping_force(z2),
    ]
    gain = [gradient * (v - v_ref), z2 * tau, -z2 * taken, *(-z2 * term for term in terms)]
    balance = sum(part.sum(-1) for part in (*gain, *loss))
    size = sum(np.abs(part).sum(-1) for part in (*gain, *loss))
    bad = ~(balance <= _TOLERANCE * size)
    if bad.any():
        at = np.round(q[int(bad.argmax())], 3).tolist()
        refuse(
            f"V falls more slowly than its dissipation at q = {at}, so τ is not the law that its parts describe",
            "correct the torque",
        )
