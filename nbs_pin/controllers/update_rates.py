"""How fast an adaptive law may learn: rates γ at which a sampled step is stable, and what training makes of them."""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import nn

from nbs_pin.base.arrays import Array, array_namespace, is_torch_array
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.known_code import known_code
from nbs_pin.controllers.adapting_model import AdaptingModel
from nbs_pin.controllers.gains import sample_configurations
from nbs_pin.controllers.model_law import ModelLaw
from nbs_pin.controllers.passive_outputs import Output, damping_of
from nbs_pin.controllers.unknowns import Unknowns
from nbs_pin.dynamics.rigid_tree import RigidTree
from nbs_pin.kernels.layout import NumberCode

_STATES = 200
_SPEED, _START = 0.25, 0.5  # share of the velocity limits, and time in which all of it is reached [s]
_SLOW = 0.02  # share of the velocity limits at which Coulomb friction has its full size
_DELAY = 3.0  # periods from the output to its effect without look-ahead; the one of `simulate` saves half a period
_SHARES = {
    NumberCode.VISCOUS: 0.03,
    NumberCode.COULOMB: 0.1,
    NumberCode.ROTOR: 0.07,
    NumberCode.OFFSET: 0.1,
    NumberCode.ACCELERATION: 0.1,
}
"""How fast numbers adapt beside bodies: slowly, as each explains an error of its joint at once, rightly or not."""
_OFFSETS = (NumberCode.OFFSET, NumberCode.ACCELERATION)
_WELL_DAMPED = 0.18  # of what the delay allows: offsets act at every speed, and so are to be damped well


class UsualMotions(NamedTuple):
    """SᵀS of sampled states and every unknown in the metric Δ, (states, unknowns, n, n)."""

    moving: Float[np.ndarray, "states unknowns n n"]
    """At usual velocities and accelerations."""
    slow: Float[np.ndarray, "states unknowns n n"]
    """At little velocity and without acceleration."""

    @classmethod
    def of(
        cls, law: ModelLaw, output: Output, unknowns: Unknowns, tree: RigidTree, gravity: np.ndarray
    ) -> "UsualMotions":
        """At poses, velocities and accelerations drawn from the arm's ranges."""
        n, robot, count = law.nv, law.dynamics.robot, len(unknowns.bodies)
        assert robot is not None
        rng, q = np.random.default_rng(0), sample_configurations(robot, _STATES)
        speed = np.where(np.isfinite(robot.velocity_limit), robot.velocity_limit, np.pi)
        v, a = rng.uniform(-_SPEED, _SPEED, q.shape) * speed, rng.uniform(-1.0, 1.0, q.shape) * speed / _START
        root = np.linalg.cholesky(damping_of(law, output, law.dynamics.mass_matrix(q)))[:, None]

        def forms(v: np.ndarray, a: np.ndarray) -> np.ndarray:
            now = AdaptingModel.of(unknowns, tree, gravity, np.tile(unknowns.start, (_STATES, 1)), q, v, v, a)
            units = [now.slopes(np.tile(unit, (_STATES, 1))) for unit in np.eye(n)]
            bodies = np.stack([unit.bodies.reshape(_STATES, count, 16) for unit in units], axis=-1)
            rows = np.stack([unit.numbers for unit in units], axis=-1)
            own = np.concatenate([bodies.swapaxes(-1, -2) @ bodies, rows[..., :, None] * rows[..., None, :]], axis=1)
            return np.asarray(np.linalg.solve(root, np.linalg.solve(root, own).swapaxes(-1, -2)))

        return cls(forms(v, a), forms(_SLOW * np.sign(v) * speed, 0.0 * a))

    def cost(self, rates: Float[np.ndarray, " unknowns"]) -> float:
        """The largest Σ γ‖S‖²/8 of V̇ in sᵀΔs per second of period, in usual motions."""
        return float(np.linalg.eigvalsh(np.einsum("k,skij->sij", rates, self.moving)).max()) / 8.0


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
    """γ of every unknown [1/J], as large as two conditions allow; V̇ ≤ −sᵀΔs of the law with a perfect model.

    A step from Q to Q − γhS costs (γh)²‖S‖²/8 of divergence, as the conjugate of the Fermi–Dirac entropy,
    tr log(1 + e^Q), has a Hessian ≤ ¼, so Σ γh‖S‖²/8 of V̇ (docs/theory.md §10). S is linear in s: in usual motions all
    costs together are at most `gain` times sᵀΔs. These are sampled poses, velocities up to a quarter of the limits and
    accelerations that reach the limits in half a second.

    In slow motions S(s) hardly changes: there an estimate is integral action of a stiffness I = Σ γSᵀS/4 at most, and
    M s̈ + Δ ṡ + I s(t − d) = 0 with the delay d = 3h is stable for I d ≺ Δ. So all but loads are slower where I d
    would be above `gain`·Δ. A load begins far from the middle of its interval, where the stiffness is a fraction of I.
    """
    motions, count = UsualMotions.of(law, output, unknowns, tree, gravity), len(unknowns.bodies)
    shares = np.array([1.0] * count + [_SHARES[number.code] for number in unknowns.numbers])
    shares = shares / np.linalg.eigvalsh(motions.moving)[..., -1].max(axis=0)
    delayed = np.array([not body.is_load for body in unknowns.bodies] + [True] * len(unknowns.numbers))
    at_most = np.full(len(shares), 1.0 / motions.cost(shares))
    rest = np.linalg.eigvalsh(np.einsum("k,skij->sij", shares[delayed], motions.slow[:, delayed])).max(initial=0.0)
    if rest > 0.0:
        at_most[delayed] = np.minimum(at_most[delayed], 4.0 / (_DELAY * rest))
    rates = shares * at_most
    for k, number in enumerate(unknowns.numbers, start=count):
        if number.code in _OFFSETS:
            rates[k] = min(
                rates[k], _WELL_DAMPED * 4.0 / (_DELAY * float(np.linalg.eigvalsh(motions.slow[:, k])[:, -1].max()))
            )
    return np.asarray(gain / period * rates)


@known_code
class TrainedRates(nn.Module):
    """γ(s) = γ₀/(g + (1 − g)e^−s) of every unknown [1/J] and σ(s) = σ₀eˢ [1/s], with s = `change`, initially zero.

    γ(0) = γ₀, and γ(s) < γ₀/g for every s: where γ₀ makes a step cost at most the share g of the damping's work in
    usual motions, no s makes it cost all of that damping's work. A rate or leak of 0 stays 0.

    Args:
        rates: γ₀.
        leak: σ₀.
        gain: g, between 0 and 1.
    """

    rates: torch.Tensor
    leak: torch.Tensor

    def __init__(self, rates: Float[np.ndarray, " unknowns"], leak: float, gain: float) -> None:
        super().__init__()
        self.gain = gain
        self.register_buffer("rates", torch.as_tensor(np.array(rates, dtype=float)))
        self.register_buffer("leak", torch.tensor(leak, dtype=torch.float64))
        self.change = nn.Parameter(torch.zeros(len(rates) + 1, dtype=torch.float64))

    def value(self, *, numpy: bool) -> tuple[Float[Array, " unknowns"], Float[Array, ""]]:
        """γ and σ as numpy arrays, or as tensors differentiable in s."""
        parts = self.rates, self.leak, self.change
        rates, leak, s = (x.numpy(force=True) for x in parts) if numpy else parts
        xp = array_namespace(s)
        return rates / (1.0 + (1.0 - self.gain) * xp.expm1(-s[:-1])), leak * xp.exp(s[-1])  # the first is exact at 0

    def settled(self) -> tuple[Float[np.ndarray, " unknowns"], float]:
        """γ and σ of a law that is to run; raises ArgumentError unless they are finite."""
        rates, leak = self.value(numpy=True)
        if not (np.isfinite(rates).all() and np.isfinite(leak)):
            raise ArgumentError("AdaptiveLaw: γ or σ is not finite; take the law as it was before this training.")
        return np.asarray(rates), float(leak)

    def like(self, x: Array) -> tuple[Float[Array, " unknowns"], Float[Array, ""]]:
        """γ and σ with the array type of x."""
        return self.value(numpy=not is_torch_array(x))
