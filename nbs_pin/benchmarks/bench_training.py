"""What an epoch of training costs: motions, gradient and update, by kernels and by an eager torch loop."""

import time

import numpy as np
import torch
from torch import nn

from nbs_pin.controllers.neural_backstepping import NeuralBackstepping, paper_controller
from nbs_pin.dynamics.analytic import AnalyticDynamics
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.motions.references import DesiredMotion, Sinusoid, paper_reference
from nbs_pin.robots.robot import load_robot
from nbs_pin.simulation.costs import squared_error
from nbs_pin.simulation.dynamics_plant import DynamicsPlant
from nbs_pin.simulation.loop import Loop
from nbs_pin.simulation.rollout import Batch, Engine, motions, running_cost

PERIOD = 0.01


def training_epochs() -> dict[tuple[str, str], dict[str, float]]:
    """Figures by arm and size: median time of an epoch [ms], and on the paper's set-up the torch loop's ratio to it.

    two_link: the paper's set-up (explicit Euler, from rest at zero, 100 steps of 10 ms), for one start and for 64. The
    torch loop is the same law and plant as they are written, closed-form ∇Φ and M, C, G included. panda: 64 starts, 200
    steps of RK4.
    """
    figures = {}
    for starts in (1, 64):
        controller, batch = _paper(starts)
        row = {"starts": float(starts), "steps": 100.0, "p50_ms": _epoch(controller, batch, "kernels", 20)}
        if starts == 1:
            row["torch_ms"] = _epoch(controller, batch, "torch", 3)
            row["torch_over_kernels"] = row["torch_ms"] / row["p50_ms"]
        figures["two_link", f"{starts} × 100"] = row
    figures["panda", "64 × 200"] = {"starts": 64.0, "steps": 200.0, "p50_ms": _epoch(*_panda(64, 200), "kernels", 5)}
    return figures


def _paper(starts: int) -> tuple[nn.Module, Batch]:
    dynamics = AnalyticDynamics()
    spread = np.random.default_rng(0).uniform(-1.0, 1.0, (starts, 2)) * (starts > 1)
    plant = DynamicsPlant(dynamics, "euler")
    return paper_controller(dynamics), _batch(plant, paper_reference(2), spread, 100, lookahead=0.0)


def _panda(starts: int, steps: int) -> tuple[nn.Module, Batch]:
    robot = load_robot("panda")
    dynamics, reference = PinocchioDynamics(robot), Sinusoid.for_robot(robot)
    begin = reference(0.0).q + np.random.default_rng(0).uniform(-0.5, 0.5, (starts, robot.nv))
    controller = NeuralBackstepping.for_robot(robot, dynamics, period=PERIOD)
    return controller, _batch(DynamicsPlant(dynamics), reference, begin, steps, lookahead=None)


def _batch(
    plant: DynamicsPlant, reference: DesiredMotion, q0: np.ndarray, steps: int, lookahead: float | None
) -> Batch:
    settings = {"plant_step": PERIOD, "effort_limit": None, "lookahead": lookahead}
    return Batch.of(Loop.of(plant, plant.nv, steps * PERIOD, PERIOD, **settings), reference, q0)


def _epoch(controller: nn.Module, batch: Batch, engine: Engine, repeats: int) -> float:
    """Median time of forward, backward and update [ms], after one to warm up."""
    optimiser = torch.optim.Adam(controller.parameters(), lr=1e-6)
    times = []
    for _ in range(repeats + 1):
        begin = time.perf_counter()
        optimiser.zero_grad()
        running_cost(motions(controller, batch, engine), batch, squared_error).mean().backward()  # type: ignore[arg-type,no-untyped-call]
        optimiser.step()
        times.append(1e3 * (time.perf_counter() - begin))
    return float(np.median(times[1:]))
