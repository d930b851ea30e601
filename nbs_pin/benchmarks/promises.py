"""What our own laws promise of a task: the bounds of their certificates, in continuous time."""

from itertools import product
from typing import Any

import numpy as np

from nbs_pin.base.arrays import JointArray
from nbs_pin.base.exceptions import CertificateRefused
from nbs_pin.benchmarks.challenge_tasks import Task
from nbs_pin.certificates.adaptive_bound import transient_bound
from nbs_pin.certificates.certify import certify
from nbs_pin.certificates.uncertainty import Payload, Uncertainty
from nbs_pin.controllers.adaptive_law import AdaptiveLaw
from nbs_pin.controllers.controller import Controller
from nbs_pin.controllers.lyapunov_law import LyapunovLaw
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.dynamics.pinocchio import PinocchioDynamics

_LEAST_LOAD = 1e-3
"""Load of a box of loads for an arm without one [kg]."""


def promised_by(law: Controller, task: Task) -> JointArray | None:
    """What the certificate of the law bounds every |z1_i| by, from `task.settled` on [rad]; None where it says nothing.

    Late torques and readings of encoders are outside of what is proved from a start off the reference.
    """
    if task.condition.delay or task.condition.bits is not None:
        return None
    try:
        if isinstance(law, LyapunovLaw):
            return _certified(law, task)
        if isinstance(law, AdaptiveLaw):
            return _transient(law, task)
    except CertificateRefused:
        return None
    return None


def _certified(law: LyapunovLaw, task: Task) -> JointArray | None:
    condition, n = task.condition, law.nv
    q0, v0, _ = _worst_start(law, task, law.dynamics)
    unknown: dict[str, Any] = {}
    if condition.inertia or condition.load:
        payload = Payload(condition.load) if condition.load else None
        unknown["uncertainty"] = Uncertainty(inertia=condition.inertia, payload=payload)
    certificate = certify(
        law,
        np.zeros(n),
        reference=task.reference,
        duration=task.duration,
        q0=q0,
        v0=v0,
        robot=task.robot.with_effort_limit(task.effort_limit),
        friction=_friction(task),
        **unknown,
    )
    assert certificate.start is not None
    if certificate.void:
        return None
    storage = float(certificate.storage_bound(np.array(task.settled), certificate.start.storage))
    if certificate.bodies is not None:
        storage = certificate.start.storage
    bound = certificate.from_start(storage)[1] if np.isfinite(storage) else np.full(n, np.inf)
    return bound if np.isfinite(bound).all() else None


def _transient(law: AdaptiveLaw, task: Task) -> JointArray | None:
    """The bound for every load up to that of the condition; none where the bodies of the arm or its drives differ."""
    condition, inner = task.condition, law.law
    if condition.inertia or condition.headroom is not None or not isinstance(inner, LyapunovLaw):
        return None
    arm = condition.arm(task.robot, np.random.default_rng(0))
    *_, start = _worst_start(inner, task, PinocchioDynamics(arm))
    load = max(condition.load, _LEAST_LOAD)
    found = transient_bound(law, load, start=start, friction=_friction(task), duration=task.duration)
    return found.joint_errors if np.isfinite(found.joint_errors).all() else None


def _friction(task: Task) -> JointFriction:
    return task.friction or JointFriction(np.zeros(task.robot.nv), np.zeros(task.robot.nv))


def _worst_start(law: LyapunovLaw, task: Task, dynamics: Any) -> tuple[JointArray, JointArray, float]:
    """The corner of the box of starts with the largest V, and V there with the inertia of these dynamics."""
    begin = task.reference(0.0)
    corners = begin.q + task.start_error * np.array(list(product((-1.0, 1.0), repeat=law.nv)))
    rows = np.broadcast_to(begin.v, corners.shape)
    e = law.errors(corners, rows, np.broadcast_to(begin.q, corners.shape), rows, 0.0 * rows)
    storage = e.value + 0.5 * np.einsum("ki,kij,kj->k", e.z2, dynamics.mass_matrix(corners), e.z2)
    k = int(np.argmax(storage))
    return corners[k], begin.v, float(storage[k])
