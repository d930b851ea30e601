"""From what is known of the bodies of the true arm to the bounds that hold for all of them."""

import math
from dataclasses import replace

import numpy as np

from nbs_pin.base.claims import refuse
from nbs_pin.base.doors import where_printed
from nbs_pin.certificates.body_bounds import BodyBounds
from nbs_pin.certificates.body_error import BodyError, Terms, body_error
from nbs_pin.certificates.body_motion import AlongReference
from nbs_pin.certificates.body_rates import BodyRates
from nbs_pin.certificates.body_regressor import BodyRegressor
from nbs_pin.certificates.certificate import Start
from nbs_pin.certificates.claims import if_without_rotors
from nbs_pin.certificates.comparison_system import ComparisonSystem
from nbs_pin.certificates.constants import Constants
from nbs_pin.certificates.friction_error import FrictionError
from nbs_pin.certificates.sampled_motion import SampledMotion
from nbs_pin.certificates.uncertainty import Uncertainty
from nbs_pin.controllers.lyapunov_law import LyapunovLaw
from nbs_pin.dynamics.identified import IdentifiedDynamics
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.dynamics.rigid_tree import RigidTree
from nbs_pin.motions.references import DesiredMotion


def bounds_for_all(
    law: LyapunovLaw,
    uncertainty: Uncertainty,
    constants: Constants,
    base: ComparisonSystem,
    friction: FrictionError,
    reference: DesiredMotion,
    motion: SampledMotion,
    start: Start | None,
) -> BodyError:
    """The bounds of a loop whose arm is any of those admitted; `base` holds the inequalities for the model alone.

    Raises:
        CertificateRefused: If the model is no rigid arm with stated bodies, or no bound is found.
    """
    dynamics = law.dynamics
    if not isinstance(dynamics, PinocchioDynamics) or type(dynamics) not in (PinocchioDynamics, IdentifiedDynamics):
        refuse(
            f"uncertain bodies need a law whose model has bodies, and this one has {type(dynamics).__name__}",
            "take the arm's own model or an identified one, or "
            + where_printed(python="give mismatch=compare(…).mismatch", shell="omit --inertia-within"),
        )
    robot, model = dynamics.robot, dynamics.model
    packed = dynamics.packed_tree()
    tree = RigidTree.of(robot) if packed is None else RigidTree.of(packed)
    if len(tree.endless):
        refuse(f"joint {int(tree.endless[0]) + 1} slides without position limits", "give it limits")
    errors = uncertainty.errors(robot, model)
    regressor = BodyRegressor(robot, model, errors)
    bounds = BodyBounds.of(robot, tree, errors, constants)
    if not np.isfinite([*bounds.whole, *bounds.damped, *bounds.rated]).all():
        refuse(
            "no bound in every pose is found for bodies that are off by so much",
            "state smaller shares or a lighter payload",
        )
    # A payload only adds to M, the shares may take from it.
    own = (
        bounds
        if uncertainty.payload is None
        else BodyBounds.of(robot, tree, replace(uncertainty, payload=None).errors(robot, model), constants)
    )
    if uncertainty.inertia > 0.0 and not math.isfinite(own.nu):
        refuse("within these shares M is not shown to be positive definite in every pose", "give smaller ones")
    along = AlongReference.of(regressor, law, reference, float(motion.t[-1]), constants)
    rates = BodyRates.of(bounds, constants, motion)
    terms = Terms(law, constants, bounds, along, rates, friction, if_without_rotors(robot))
    return body_error(terms, base, 0.0 if start is None else _first(law, regressor, start))


def _first(law: LyapunovLaw, regressor: BodyRegressor, start: Start) -> float:
    """V(0) with the largest M [J]: that of the model times 1 + Σ |λ(M̂^−½ ΔM_g M̂^−½)| at most."""
    errors = regressor.at(start.q, start.v, 0.0 * start.v)[2]
    root = np.linalg.cholesky(law.dynamics.mass_matrix(start.q))
    inner = np.linalg.solve(root, np.linalg.solve(root, errors).mT)
    share = float(np.abs(np.linalg.eigvalsh(0.5 * (inner + inner.mT))).max(axis=1).sum())
    return start.storage * (1.0 + share) * (1.0 + 1e-9)
