"""Structure of a model, checked without trusting its constructor: M̂ ≻ 0, Ṁ − 2C skew, and the arm it belongs to."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import nn

from nbs_pin.base.arrays import matvec
from nbs_pin.base.claims import Claim, Label, refuse
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.known_code import first_foreign, foreign_code
from nbs_pin.dynamics.analytic import AnalyticDynamics
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.dynamics.provider import DynamicsProvider
from nbs_pin.dynamics.structure import POSITIVE, SKEW, ModelClaims
from nbs_pin.robots.robot import Robot

_SAMPLES = 24


def check_model(provider: DynamicsProvider, robot: Robot | None = None) -> ModelClaims:
    """How it is known that M̂(q) ≻ 0 and that Ṁ − 2C is skew, from the model's present numbers and code.

    A model whose code is known states it (`DynamicsProvider.structure_claims`); for others, or with a method replaced,
    it is EMPIRICAL, on sampled states.

    Args:
        provider: The model.
        robot: The arm that the model should belong to.

    Raises:
        CertificateRefused: If the model is of another arm, has numbers that are not finite, an M̂ without its εI or with
            a negative eigenvalue, or a C that is not the Christoffel one (docs/theory.md §1, §6).
    """
    if not isinstance(provider, DynamicsProvider):
        refuse(f"the model is a {type(provider).__name__}", "give a DynamicsProvider, such as PinocchioDynamics(robot)")
    _check_arm(provider, robot)
    check_finite("the model", provider)
    parts = provider.modules() if isinstance(provider, nn.Module) else ()
    why = foreign_code(provider) or first_foreign(parts)
    claims = (None if why else provider.structure_claims()) or _sampled_claims(provider, why)
    _check_routes(provider, claims.skew)
    return claims


def check_finite(name: str, part: Any) -> None:
    """Raises CertificateRefused if a parameter or buffer is not finite."""
    if not isinstance(part, nn.Module):
        return
    for key, x in (*part.named_parameters(), *part.named_buffers()):
        bad = int((~x.isfinite()).sum())
        if bad:
            refuse(f"'{key}' of {name} has {bad} numbers that are not finite", "load the last sound checkpoint")


EXACT = 1e-9
"""Relative difference of torques below which a model counts as exact."""


def is_exact(dynamics: DynamicsProvider, robot: Robot | None) -> bool:
    """Whether a model is exact: Pinocchio's of the arm, or a closed form that agrees with it up to rounding.

    Without an arm a closed form counts as exact; the certificate is then about the arm that it describes.
    """
    if type(dynamics) not in (PinocchioDynamics, AnalyticDynamics):
        return False
    return robot is None or torque_difference(dynamics, robot) < EXACT


def torque_difference(dynamics: DynamicsProvider, robot: Robot) -> float:
    """The largest difference of the model's torques from those of the arm's URDF, over the largest of these.

    Both are linear in ten inertial parameters per body, so generic states reveal any difference.
    """
    q, v, v_r, a_r = sample_states(dynamics, 50), *np.random.default_rng(1).standard_normal((3, 50, dynamics.nv))
    truth = PinocchioDynamics(robot.as_described()).reference_torque(q[0], v, v_r, a_r)
    return float(np.abs(dynamics.reference_torque(q[0], v, v_r, a_r) - truth).max() / np.abs(truth).max())


def sample_states(provider: DynamicsProvider, count: int, seed: int = 0) -> list[Float[np.ndarray, "count n"]]:
    """Seeded q within the arm's limits (a full turn without limits), and three standard normal vectors."""
    rng, n = np.random.default_rng(seed), provider.nv
    low, high = (-np.pi, np.pi) if provider.robot is None else provider.robot.sampling_range
    return [rng.uniform(low, high, (count, n)), *rng.normal(size=(3, count, n))]


def _check_arm(provider: DynamicsProvider, robot: Robot | None) -> None:
    """Raises CertificateRefused if the model is not of the given arm, or not of the arm that it names."""
    own = provider.robot
    if own is not None and own.nv != provider.nv:
        refuse(f"the model has {provider.nv} joints and its arm {own.name} {own.nv}", "give the model of that arm")
    if robot is not None and (robot.nv != provider.nv or (own is not None and own.sha256 != robot.sha256)):
        named = "no named arm" if own is None else f"{own.name} ({own.sha256:.12})"
        refuse(
            f"the model is of {named} with {provider.nv} joints, not of {robot.name} ({robot.sha256:.12})",
            "give the model of this arm",
        )
    arm = own if own is not None else robot
    if arm is not None and not provider.suits(arm):
        refuse(f"the network's joints are not those of {arm.name}", "give the model that was learned from this arm")


def _sampled_claims(provider: DynamicsProvider, why: str) -> ModelClaims:
    """M̂ ≻ 0 and Ṁ = C + Cᵀ on sampled states; raises CertificateRefused if one of them fails."""
    q, v, _, _ = sample_states(provider, 4 * _SAMPLES)
    mass = _finite(provider.mass_matrix, q)
    size = np.abs(mass).max(axis=(-2, -1))
    skewed = np.abs(mass - mass.mT).max(axis=(-2, -1)) / size
    least = np.linalg.eigvalsh(0.5 * (mass + mass.mT))[:, 0]
    for bad, fault in ((skewed > 1e-9, "not symmetric"), (least <= 0.0, "not positive definite")):
        if bad.any():
            at = int(bad.argmax())
            refuse(f"M̂ is {fault} at q = {np.round(q[at], 3).tolist()}", "give a model whose M̂ is an inertia")
    step = 1e-5
    rate = (_finite(provider.mass_matrix, q + step * v) - _finite(provider.mass_matrix, q - step * v)) / (2.0 * step)
    coriolis = _finite(provider.coriolis_matrix, q, v)
    off = np.abs(rate - coriolis - coriolis.mT).max(axis=(-2, -1)) / (size + np.abs(rate).max(axis=(-2, -1)))
    if off.max() > 1e-4:
        at = np.round(q[int(off.argmax())], 3).tolist()
        refuse(f"Ṁ − 2C is not skew at q = {at}", "give the Christoffel C of M̂")
    said = f"{why or 'a body alone has no inertia about its own joint'}: checked at {len(q)} sampled states"
    return ModelClaims(
        Claim(POSITIVE, float(least.min()), "kg·m²", Label.EMPIRICAL, said),
        Claim(SKEW, float(off.max()), "", Label.EMPIRICAL, said),
    )


def _check_routes(provider: DynamicsProvider, skew: Claim) -> None:
    """Raises CertificateRefused unless reference_torque equals M a + C w + G, whatever code it runs."""
    if not np.isfinite(skew.value):
        return  # the energy is not quadratic in v, so its exact torque differs
    q, v, w, a = sample_states(provider, _SAMPLES, seed=1)
    parts = [
        matvec(_finite(provider.mass_matrix, q), a),
        matvec(_finite(provider.coriolis_matrix, q, v), w),
        _finite(provider.gravity, q),
    ]
    off = np.abs(_finite(provider.reference_torque, q, v, w, a) - sum(parts)).max()
    if off > 1e-6 * sum(np.abs(part).max() for part in parts):
        refuse(f"the model's reference torque is {off:.3g} N·m from its M a + C v + G", "load or build it again")


def _finite(function: Callable[..., np.ndarray], *arguments: np.ndarray) -> np.ndarray:
    try:
        value = function(*arguments)
    except (ArgumentError, np.linalg.LinAlgError, torch.linalg.LinAlgError) as error:  # type: ignore[attr-defined]
        refuse(f"an inertia of the model is not positive definite ({error})", "load or build it again")
    if not np.isfinite(value).all():
        refuse("the model gives numbers that are not finite", "load the last sound checkpoint or build it again")
    return value
