"""Bounds of ‖z1‖ and of each |z1_i| from bounds of the energies V and Φ."""

import math

import numpy as np
from jaxtyping import Float

from nbs_pin.base.arrays import JointArray
from nbs_pin.base.rounding import least_eigenvalue
from nbs_pin.certificates import one_joint
from nbs_pin.certificates.comparison_system import ComparisonSystem
from nbs_pin.certificates.constants import Constants, above_inverse
from nbs_pin.controllers.lyapunov_law import LyapunovLaw
from nbs_pin.dynamics.pinocchio import PinocchioDynamics


def errors(
    controller: LyapunovLaw, constants: Constants, comparison: ComparisonSystem, storage: float, potential: float
) -> tuple[float, JointArray, str]:
    """Bounds of ‖z1‖ and each |z1_i| [rad], and their source."""
    size, joints = radians(constants.stiffness, potential)
    exact = math.inf
    # Friction that is fed forward and a model error each leave a nonlinear term.
    if controller.nv == 1 and controller.friction is None and comparison.alpha == comparison.beta == 0.0:
        exact = _of_one_joint(controller, constants, comparison, storage, size)
    if exact < size:
        return exact, np.array([exact]), "the loop of one joint is linear up to ψ and T, docs/certificates.md §4"
    return size, joints, "Φ ≥ z1ᵀSz1 and Φ∞, docs/certificates.md §3"


def _of_one_joint(
    controller: LyapunovLaw, constants: Constants, comparison: ComparisonSystem, storage: float, size: float
) -> float:
    """The bound of |z1| from linear theory [rad], inf if it does not apply; `size` is a bound already known [rad]."""
    if type(controller.dynamics) is not PinocchioDynamics:
        return math.inf
    loop = one_joint.Loop(
        inertia=float(controller.dynamics.mass_matrix(np.zeros(1))[0, 0]),
        rate=constants.largest_rate,
        omega=constants.omega,
        stiffness=2.0 * float(constants.stiffness[0, 0]),
        damping=float(constants.floor[0, 0]),
        coupling=constants.coupling,
    )
    within = one_joint.Worst(size, math.sqrt(2.0 * storage / loop.inertia) * (1.0 + 1e-12))
    return one_joint.worst_error(loop, comparison.t * math.sqrt(loop.damping), controller, within)


def radians(stiffness: Float[np.ndarray, "n n"], potential: float) -> tuple[float, JointArray]:
    """√(Φ/λ_min(S)) and √(Φ (S⁻¹)_ii), the bounds of ‖z1‖ and |z1_i| for z1ᵀSz1 ≤ Φ ≤ `potential` [J]."""
    joints = np.sqrt(potential * np.diag(above_inverse(stiffness)))
    # ‖z1‖ exceeds neither the longest semi-axis of the ellipsoid nor the corner of the box of the |z1_i|.
    total = min(math.sqrt(potential / least_eigenvalue(stiffness)), float(np.linalg.norm(joints)))
    return total, np.minimum(joints, total)
