"""How fast an adaptive law may learn: rates γ at which a sampled step is stable."""

import numpy as np
from jaxtyping import Float

from nbs_pin.controllers.adapting_model import AdaptingModel
from nbs_pin.controllers.gains import sample_configurations
from nbs_pin.controllers.model_law import ModelLaw
from nbs_pin.controllers.passive_outputs import Output, damping_of
from nbs_pin.controllers.unknowns import Unknowns
from nbs_pin.dynamics.rigid_tree import RigidTree
from nbs_pin.kernels.layout import NumberCode

_STATES = 200
_SPEED, _START = 0.25, 0.5  # share of the velocity limits, and time in which all of it is reached [s]
_SHARES = {NumberCode.VISCOUS: 0.03, NumberCode.COULOMB: 0.3, NumberCode.ROTOR: 0.3, NumberCode.OFFSET: 0.03}
_SHARES[NumberCode.ACCELERATION] = _SHARES[NumberCode.OFFSET]
"""How fast numbers adapt beside bodies: slowly, as each explains an error of its joint at once, rightly or not.

An offset is felt at every speed with the same factor, so with the delay of the update it oscillates first.
"""


def update_rates(
    law: ModelLaw,
    output: Output,
    unknowns: Unknowns,
    tree: RigidTree,
    gravity: np.ndarray,
    *,
    gain: float,
    period: float,
) -> Float[np.ndarray, " unknowns"]:
    """γ of every unknown [1/J]: a step of all costs at most `gain` times what the law takes, sᵀΔs, in usual motions.

    A step from Q to Q − γhS costs (γh)²‖S‖²/8 of divergence, as the conjugate of the Fermi–Dirac entropy,
    tr log(1 + e^Q), has a Hessian ≤ ¼, so Σ γh‖S‖²/8 of V̇ (docs/theory.md §10). S is linear in s: with
    ℓ² = max λ(SᵀS, Δ) for every unknown, shares w and λ = max(1, max λ(Σ w SᵀS/ℓ², Δ)), γ = gain·8w/(h ℓ² λ). The
    largest are over sampled poses, velocities up to a quarter of the limits and accelerations that reach the limits in
    half a second.
    """
    n, robot, count = law.nv, law.dynamics.robot, len(unknowns.bodies)
    assert robot is not None
    rng, q = np.random.default_rng(0), sample_configurations(robot, _STATES)
    speed = np.where(np.isfinite(robot.velocity_limit), robot.velocity_limit, np.pi)
    v, a = rng.uniform(-_SPEED, _SPEED, q.shape) * speed, rng.uniform(-1.0, 1.0, q.shape) * speed / _START
    now = AdaptingModel.of(unknowns, tree, gravity, np.tile(unknowns.start, (_STATES, 1)), q, v, v, a)
    units = [now.slopes(np.tile(unit, (_STATES, 1))) for unit in np.eye(n)]
    bodies = np.stack([unit.bodies.reshape(_STATES, count, 16) for unit in units], axis=-1)
    numbers = np.stack([unit.numbers for unit in units], axis=-1)
    forms = np.concatenate([bodies.swapaxes(-1, -2) @ bodies, numbers[..., :, None] * numbers[..., None, :]], axis=1)
    root = np.linalg.cholesky(damping_of(law, output, law.dynamics.mass_matrix(q)))[:, None]
    forms = np.linalg.solve(root, np.linalg.solve(root, forms).swapaxes(-1, -2))
    sizes = np.linalg.eigvalsh(forms)[..., -1].max(axis=0)
    shares = np.array([1.0] * count + [_SHARES[number.code] for number in unknowns.numbers]) / sizes
    together = max(1.0, float(np.linalg.eigvalsh(np.einsum("k,skij->sij", shares, forms)).max()))
    return np.asarray(gain * 8.0 * shares / (period * together))
