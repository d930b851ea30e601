"""The paper's own program, re-created from what it does: the law and the training behind its Table I.

It differs from the paper's text, and from the laws of this package, in six ways (docs/theory.md §8): the smoothed ReLU
lacks −d/2 and jumps; the diagonal of the damping factor is (relu(·) + m) times z2, and D = LLᵀ; M, C and G are
constants in the gradient; the cost compares q(t + h) with q_d(t); weights are drawn in float32; there is one start.
"""

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
import torch
from jaxtyping import Float

from nbs_pin.base.arrays import matvec
from nbs_pin.base.progress import tracked
from nbs_pin.base.records import Run
from nbs_pin.dynamics.analytic import AnalyticDynamics
from nbs_pin.motions.references import paper_reference
from nbs_pin.simulation.dynamics_plant import DynamicsPlant
from nbs_pin.simulation.loop import Loop
from nbs_pin.training.optimisers import optimiser, scheduled_rate

PERIOD = 0.01
"""Control period and Euler step [s]."""
WIDTH, CORNER = 32, 0.01
States: TypeAlias = Float[torch.Tensor, "seeds rows 2"]
Desired: TypeAlias = Float[torch.Tensor, "... 2"]
# Names and shapes (inputs, outputs) in the order in which the program draws them: equal seeds give equal weights.
_POTENTIAL = (
    ("x0", (2, WIDTH)), ("x1", (2, WIDTH)), ("x2", (2, WIDTH)), ("y1", (WIDTH, WIDTH)), ("y2", (WIDTH, WIDTH)),
    ("x3", (2, 1)), ("y3", (WIDTH, 1)),
)  # fmt: skip
_DAMPING = (
    ("d0", (2, WIDTH)), ("d1", (WIDTH, WIDTH)), ("d2", (WIDTH, 2)),
    ("o0", (2, WIDTH)), ("o1", (WIDTH, WIDTH)), ("o2", (WIDTH, 1)),
)  # fmt: skip


class AuthorsLaw:
    """The program's law for several seeds at once: start k of a batch (seeds, 2) is under the weights of seed k.

    τ = M a_r + C v_r + G − ∇Φ − LLᵀz2 with S = I and L = [[d₁, 0], [o, d₂]], d = (relu(·) + m)z2.

    Args:
        seeds: Seeds of torch's generator, whose float32 draws are those of the program.
        m: 0.001, or 1 under a disturbance.
    """

    def __init__(self, seeds: Sequence[int], m: float = 0.001) -> None:
        drawn = [_drawn(seed) for seed in seeds]
        self.m, self.dynamics = m, AnalyticDynamics()
        self.weights = {name: torch.nn.Parameter(torch.stack([w[name] for w in drawn])) for name in drawn[0]}

    def torques(self, q: States, v: States, q_ref: Desired, v_ref: Desired, a_ref: Desired) -> States:
        """τ [N·m] for many states of every seed, differentiable in weights and errors, not through M, C and G."""
        dv = v - v_ref
        gradient, gradient_rate = self._potential(q - q_ref, dv)
        z2, v_r, a_r = dv + gradient, v_ref - gradient, a_ref - gradient_rate
        q, v = q.detach(), v.detach()
        inertial = matvec(self.dynamics.mass_matrix(q), a_r) + matvec(self.dynamics.coriolis_matrix(q, v), v_r)
        return inertial + self.dynamics.gravity(q) - gradient - self._damping(z2)

    def _potential(self, z: torch.Tensor, dz: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """∇Φ(z) and ∇²Φ(z)dz: tangents of a forward and a reverse pass, as in `controllers/convex.py`."""
        w, tape = self.weights, []
        y = dy = torch.zeros(())
        for i in range(4):
            a, da = z @ w[f"x{i}"], dz @ w[f"x{i}"]
            if i:
                wy = torch.relu(w[f"y{i}"])
                a, da = a + y @ wy, da + dy @ wy
            slope = torch.clamp(a / CORNER, 0.0, 1.0)
            bend = ((a > 0.0) & (a < CORNER)) * (da / CORNER)
            y, dy = torch.where(a < CORNER, 0.5 * CORNER * slope * slope, a), slope * da
            tape.append((slope, bend))
        lam, dlam = torch.ones_like(y), torch.zeros_like(y)
        gradient, product = 2.0 * z, 2.0 * dz
        for i, (slope, bend) in reversed(list(enumerate(tape))):
            delta, ddelta = slope * lam, bend * lam + slope * dlam
            gradient, product = gradient + delta @ w[f"x{i}"].mT, product + ddelta @ w[f"x{i}"].mT
            if i:
                wy = torch.relu(w[f"y{i}"]).mT
                lam, dlam = delta @ wy, ddelta @ wy
        return gradient, product

    def _damping(self, z: torch.Tensor) -> torch.Tensor:
        """LLᵀz."""
        d1, d2 = ((torch.relu(self._tanh_network("d", z)) + self.m) * z).unbind(-1)
        o, (z1, z2) = self._tanh_network("o", z)[..., 0], z.unbind(-1)
        first = d1 * z1 + o * z2
        return torch.stack([d1 * first, o * first + d2 * d2 * z2], dim=-1)

    def _tanh_network(self, name: str, x: torch.Tensor) -> torch.Tensor:
        w = self.weights
        for i in range(3):
            x = x @ w[f"{name}{i}"] + w[f"{name}b{i}"]
            x = torch.tanh(x) if i < 2 else x
        return x


def task(duration: float) -> Loop:
    """The paper's loop: two links, explicit Euler at 10 ms, no torque limit."""
    plant = DynamicsPlant(AnalyticDynamics(), integrator="euler")
    return Loop.of(plant, 2, duration, PERIOD, plant_step=PERIOD, effort_limit=None, lookahead=0.0)


def follow_authors(law: AuthorsLaw, duration: float, torque: Any = 0.0) -> Run:
    """Every seed follows q_d = [sin 0.1t, cos 0.1t] from rest at zero under a constant disturbance `torque` [N·m].

    A seed whose motion diverges continues with infinities and does not affect the others.
    """
    loop = task(duration)
    schedule = loop.schedule(paper_reference(2))
    rest = np.zeros((len(law.weights["x0"]), 2))
    run = loop.blank_run(schedule.times, schedule.desired, rest, rest, type(law).__name__)
    run.disturbance[:] = torque
    with np.errstate(all="ignore"), torch.inference_mode():
        for k, desired in enumerate(zip(*schedule.desired, strict=True)):
            q, v = run.q[k], run.v[k]
            state = (torch.from_numpy(x)[:, None] for x in (q, v))
            run.tau[k] = law.torques(*state, *map(torch.from_numpy, desired))[:, 0].numpy()
            if k < loop.steps:
                acceleration = law.dynamics.forward_dynamics(q, v, run.tau[k] + torque)
                run.q[k + 1], run.v[k + 1] = q + PERIOD * v, v + PERIOD * acceleration
    for x in (run.q, run.v, run.tau):
        x[~np.isfinite(x)] = np.inf
    run.tau_command[:] = run.tau
    return run


def train_authors(law: AuthorsLaw, *, epochs: int = 200, torque: Any = 0.0, progress: bool = False) -> None:
    """The program's training, in place: Σ ‖q(t + h) − q_d(t)‖² over 1 s, Adam at 1e-3, halved every 40 epochs.

    A seed whose motion diverges is lost, as in the program, and does not affect the others.
    """
    adam = optimiser("adam", list(law.weights.values()), 1e-3)
    for epoch in tracked(range(epochs), "training as the paper's program does", progress):
        for group in adam.param_groups:
            group["lr"] = scheduled_rate("adam", 1e-3, epoch, epochs)
        run = follow_authors(law, 1.0, torque)
        recorded = (run.q, run.v, run.q_ref, run.v_ref, run.a_ref)
        q, v, *desired = (torch.from_numpy(x[:-1].swapaxes(0, 1)) for x in recorded)
        tau = law.torques(q.requires_grad_(), v.requires_grad_(), *desired)
        by_state = [torch.autograd.grad(tau[..., i].sum(), (q, v), retain_graph=True) for i in range(2)]
        jacobians = [torch.stack(rows, dim=-2).numpy().swapaxes(0, 1) for rows in zip(*by_state, strict=True)]
        adam.zero_grad()
        tau.backward(torch.from_numpy(_torque_cotangents(law, run, *jacobians).swapaxes(0, 1)))  # type: ignore[no-untyped-call]
        adam.step()


def _torque_cotangents(law: AuthorsLaw, run: Run, by_q: np.ndarray, by_v: np.ndarray) -> Float[np.ndarray, "T seeds 2"]:
    """∂(cost)/∂τ of every period, back in time through q ← q + hv, v ← v + hM⁻¹τ + constants."""
    inverse = np.linalg.inv(law.dynamics.mass_matrix(run.q[:-1]))
    pull = 2.0 * (run.q[1:] - run.q_ref[:-1])
    q_bar, v_bar = np.zeros_like(pull[0]), np.zeros_like(pull[0])
    tau_bar = np.zeros_like(pull)
    for k in reversed(range(len(pull))):
        q_bar = q_bar + pull[k]
        tau_bar[k] = PERIOD * matvec(inverse[k], v_bar)
        v_bar = v_bar + PERIOD * q_bar + matvec(by_v[k].swapaxes(-1, -2), tau_bar[k])
        q_bar = q_bar + matvec(by_q[k].swapaxes(-1, -2), tau_bar[k])
    return tau_bar


def _drawn(seed: int) -> dict[str, torch.Tensor]:
    """Weights of one seed, (inputs, outputs) each, in float64; the biases of the damping networks are zero."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        weights = {name: torch.empty(shape).uniform_(-0.1, 0.2).double() for name, shape in _POTENTIAL}
        weights |= {name: torch.empty(shape).uniform_(-0.2, 0.2).double() for name, shape in _DAMPING}
    return weights | {f"{n[0]}b{n[1]}": torch.zeros(1, outs, dtype=torch.float64) for n, (_, outs) in _DAMPING}
