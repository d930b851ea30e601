"""What the law without adaptation does under the loads of `transient_bound`: its certificate, and simulated errors."""

import math
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from nbs_pin.base.arrays import JointArray
from nbs_pin.base.exceptions import CertificateRefused
from nbs_pin.certificates.certificate import Certificate
from nbs_pin.certificates.certify import certify
from nbs_pin.certificates.uncertainty import Payload, Uncertainty
from nbs_pin.certificates.worst_load import WorstLoad
from nbs_pin.controllers.adaptive_law import AdaptiveLaw
from nbs_pin.controllers.unknowns import LOAD_AT
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.dynamics.provider import DynamicsProvider
from nbs_pin.dynamics.pseudo_inertia import inertial_parameters
from nbs_pin.motions.references import DesiredMotion
from nbs_pin.robots.carrying import carrying
from nbs_pin.robots.urdf_options import Payload as Load
from nbs_pin.simulation.dynamics_plant import DynamicsPlant
from nbs_pin.simulation.simulate import simulate

_PERIOD = 0.001  # of simulated loops [s]


class FixedLaw(NamedTuple):
    """The law without adaptation under the same loads, along a reference."""

    joint_errors: JointArray
    """Largest |z1_i| measured with the worst load and with the largest one at the frame's origin [rad, m], of the arm
    with its friction and without disturbance."""
    certificate: Certificate | None
    """Its certificate for all loads of the box; None if that is refused."""
    refused: str
    """Why it is refused; empty if it is not."""


def fixed_law(
    law: AdaptiveLaw, payload: Payload, worst: WorstLoad, given: dict[str, Any], reference: DesiredMotion, length: float
) -> FixedLaw:
    """The inner law with the same loads: what is certified of it, and its largest errors along the reference."""
    inner, refused, certificate = law.law, "", None
    try:
        certificate = certify(
            inner, **given, reference=reference, duration=length, uncertainty=Uncertainty(payload=payload)
        )
    except CertificateRefused as error:
        refused = str(error)
    frame, errors = frame_of(law), []
    for mass, centre in {(worst.mass, tuple(worst.centre)), (payload.mass, (0.0, 0.0, 0.0))}:
        plant = DynamicsPlant(loaded_model(law, frame, mass, np.array(centre)), friction=given["friction"])
        run = simulate(plant, inner.compile(), reference, math.ceil(length / _PERIOD) * _PERIOD, _PERIOD)
        errors.append(np.abs(inner.dynamics.difference(run.q, run.q_ref)).max(axis=0))
    return FixedLaw(np.max(errors, axis=0), certificate, refused)


def loaded_model(law: AdaptiveLaw, frame: str, mass: float, centre: Float[np.ndarray, "3"]) -> DynamicsProvider:
    """The law's model with a point mass [kg] there [m], besides a load that it carries there."""
    model = law.law.dynamics
    if mass == 0.0:
        return model
    if type(model) is PinocchioDynamics:
        x, y, z = centre.tolist()
        return PinocchioDynamics(carrying(law.robot, [(frame, Load(mass, (x, y, z)))]))
    first = law.estimate()
    at = 10 * [body.is_load for body in first.unknowns.bodies].index(True)
    values, point = first.values.copy(), np.append(centre, 1.0)
    values[at : at + 10] = inertial_parameters(mass * point[:, None] * point)
    return replace(first, values=values).dynamics()


def frame_of(law: AdaptiveLaw) -> str:
    """The link that carries the load."""
    return next(body.name for body in law.unknowns.bodies if body.is_load).removeprefix(LOAD_AT)
