"""The cost of a control step and of a simulated second on this machine: the study behind `nbs-pin bench`."""

import gc
import platform
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pinocchio as pin
import psutil
import torch
from torch import nn

from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.records import Reference
from nbs_pin.base.versions import versions
from nbs_pin.benchmarks.exported import can_compile, step_times
from nbs_pin.benchmarks.serial_chains import serial_chain
from nbs_pin.controllers.controller import Controller
from nbs_pin.controllers.neural_backstepping import NeuralBackstepping, paper_controller
from nbs_pin.controllers.registry import LAWS, build_law
from nbs_pin.dynamics.analytic import AnalyticDynamics
from nbs_pin.dynamics.chain import Chain
from nbs_pin.dynamics.cholesky import CholeskyNetwork
from nbs_pin.dynamics.lagrangian import LagrangianDynamics
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.motions.disturbances import SquareWave, TorqueNoise
from nbs_pin.motions.references import DesiredMotion, Sinusoid, paper_reference
from nbs_pin.robots.robot import Robot, load_robot
from nbs_pin.runtime.guarded import Guarded, Sample
from nbs_pin.simulation import metrics
from nbs_pin.simulation.costs import squared_error
from nbs_pin.simulation.dynamics_plant import DynamicsPlant
from nbs_pin.simulation.loop import Loop
from nbs_pin.simulation.mujoco_plant import MujocoPlant
from nbs_pin.simulation.rollout import Batch, Engine, motions, running_cost
from nbs_pin.simulation.simulate import simulate, stream

MODELS = ("three_link", "panda")
"""Arms whose models are timed, learned ones beside Pinocchio."""
CHAINS = (1, 2, 3, 5, 7, 10, 15, 20, 25, 30)
PERIOD, TRAINING_PERIOD = 0.001, 0.01
"""Control periods of everything but training, and of training [s]."""
_CPU_INFO = Path("/proc/cpuinfo")


@dataclass(frozen=True)
class Row:
    """One measurement: what, on which arm, with which law or plant, and its figures with the unit in the key."""

    what: str
    arm: str
    how: str
    figures: dict[str, float]

    @property
    def key(self) -> str:
        """Name of the row, the same from one bench to the next."""
        return f"{self.what}/{self.arm}/{self.how}"


def bench(
    arms: tuple[str, ...] = ("two_link", "panda", "ur5"),
    *,
    calls: int = 20_000,
    chains: tuple[int, ...] = CHAINS,
    long: bool = False,
) -> Iterator[Row]:
    """Rows as they are measured: laws, plants, simulation, models, cost against joints, and training epochs.

    Args:
        arms: Arms of the laws, plants and simulations.
        calls: Timed calls of a control step, each alone, with the garbage collector off, on one core; at least 1000.
        chains: Numbers of joints of the generated arms.
        long: Also simulate an hour of motion and a thousand starts, a few minutes.
    """
    if calls < 1000:
        raise ArgumentError(f"calls is {calls}, expected at least 1000 for a p99.9.")
    for arm in arms:
        robot = load_robot(arm)
        for law in LAWS:
            yield control_row(robot, law, calls, against_torch=law == "nbs")
        yield from exported_rows(robot, calls)
        yield guarded_row(robot, calls)
        yield from plant_rows(robot)
        yield simulation_row(robot)
    for arm in MODELS:
        yield from model_rows(load_robot(arm))
    for joints in chains:
        yield control_row(serial_chain(joints), "nbs", max(1000, calls // 4), what="joints")
        yield from exported_rows(serial_chain(joints), max(1000, calls // 4), laws=("slotine-li",), what="joints in C")
    yield from training_rows()
    if long:
        yield endurance_row(load_robot("panda"))
        yield workers_row(load_robot("panda"))


def control_row(robot: Robot, law: str, calls: int, *, what: str = "control step", against_torch: bool = False) -> Row:
    """Percentiles of a control step [µs], compiled if it can be, its ratio to two RNEA, and eager torch's to it."""
    eager: Any = build_law(law, robot, period=PERIOD)
    states = _states(robot)
    times = _step_times(eager.compile(), states, calls)
    p50, p99, p999, longest = np.percentile(times, [50.0, 99.0, 99.9, 100.0]).tolist()
    data = robot.model.createData()

    def two_rnea(q: np.ndarray, v: np.ndarray, *_: np.ndarray) -> None:
        pin.rnea(robot.model, data, q, v, v)
        pin.rnea(robot.model, data, q, v, v)

    rnea = _median(two_rnea, states, calls)
    figures = {"joints": float(robot.nv), "p50_us": p50, "p99_us": p99, "p99.9_us": p999, "max_us": longest,
               "two_rnea_us": rnea, "over_two_rnea": p50 / rnea}  # fmt: skip
    if against_torch:
        tensors = [tuple(torch.as_tensor(x) for x in state) for state in states]
        with_graph = _median(eager.torque, tensors, 200)
        with torch.no_grad():
            without = _median(eager.torque, tensors, 200)
        figures |= {"torch_us": without, "torch_graph_us": with_graph, "torch_over_compiled": without / p50}
    return Row(what, robot.name, law, figures)


def exported_rows(
    robot: Robot, calls: int, laws: tuple[str, ...] = ("nbs", "adaptive", "slotine-li"), *, what: str = "step in C"
) -> Iterator[Row]:
    """A step of laws in C [µs] with bytes of code and data, and how much longer the compiled law takes in Python.

    "nbs, no networks" is the law with ψ = T = 0. Nothing where there is no compiler.
    """
    if not can_compile():
        return
    states = _states(robot)
    for name in laws:
        law: Any = build_law(name, robot, period=PERIOD)
        cases = {name: law}
        if isinstance(law, NeuralBackstepping):
            cases["nbs, no networks"] = _without_networks(robot)
        for how, each in cases.items():
            times, size = step_times(each, np.array(states), calls)
            p50, p99 = np.percentile(times, [50.0, 99.0]).tolist()
            python = float(np.median(_step_times(each.compile(), states, calls)))
            figures = {"joints": float(robot.nv), "p50_us": p50, "p99_us": p99, "python_us": python,
                       "python_over_c": python / p50, "bytes": float(size)}  # fmt: skip
            yield Row(what, robot.name, how, figures)


def guarded_row(robot: Robot, calls: int) -> Row:
    """A step of the compiled law behind the guard, in Python, along the default motion, and what the law takes [µs]."""
    guarded, motion, steps = Guarded(build_law("nbs", robot, period=PERIOD), robot), Sinusoid.for_robot(robot), 1000
    at_rest, aims = motion(0.0), [motion(PERIOD * k + guarded.lead) for k in range(steps)]
    here = [motion(PERIOD * k) for k in range(steps)]
    arguments = [(Sample(PERIOD * k, here[k].q, here[k].v), aims[k]) for k in range(steps)]
    times = []
    for _ in range(max(1, calls // steps)):
        guarded.begin(at_rest.q, aims[0])
        times.append(_times(guarded.step, arguments, steps, warm=0))
    law = float(np.median(_step_times(guarded.law, _states(robot), calls)))
    p50, p99 = np.percentile(times, [50.0, 99.0]).tolist()
    return Row("guarded step", robot.name, "nbs", {"p50_us": p50, "p99_us": p99, "law_us": law, "guard_us": p50 - law})


def _without_networks(robot: Robot) -> NeuralBackstepping:
    """The law with ψ = 0 and T = 0."""
    law = NeuralBackstepping.for_robot(robot, period=PERIOD)
    with torch.no_grad():
        for network in (law.potential.network, law.damping.diagonal, law.damping.lower):
            for parameter in network.parameters():
                parameter.zero_()
    return law


def plant_rows(robot: Robot) -> Iterator[Row]:
    """The cost of one plant step of 1 ms [µs] for each plant and integrator."""
    plants = {
        "mujoco rk4": MujocoPlant(robot, "rk4"),
        "mujoco euler": MujocoPlant(robot, "euler"),
        "pinocchio rk4": DynamicsPlant(PinocchioDynamics(robot)),
    }
    q, v, *_ = _states(robot)[0]
    for name, plant in plants.items():
        cost = _median(plant.step, [(q, 0.1 * v, 0.0 * v, PERIOD)], 2000)
        yield Row("plant step", robot.name, name, {"p50_us": cost})


def model_rows(robot: Robot, calls: int = 5000) -> Iterator[Row]:
    """The cost of M a_r + C(q, v) v_r + G at one state [µs] for each kind of model; weights do not matter to it."""
    models = {
        "pinocchio": PinocchioDynamics(robot),
        "chain": LagrangianDynamics(Chain(robot.parents, robot.prismatic)),
        "cholesky": LagrangianDynamics(CholeskyNetwork(robot.prismatic.tolist())),
    }
    states = [(q, v, v_ref, a_ref) for q, v, _, v_ref, a_ref in _states(robot)]
    costs = {name: _median(model.reference_torque, states, calls) for name, model in models.items()}
    for name, cost in costs.items():
        figures = {"p50_us": cost, "over_pinocchio": cost / costs["pinocchio"]}
        yield Row("model torque", robot.name, name, figures)


def training_rows() -> Iterator[Row]:
    """Median time of a training epoch [ms], and for one start on the paper's set-up the ratio of the torch loop to it.

    two_link: the paper's set-up (explicit Euler, from rest at zero, 100 steps of 10 ms). The torch loop is the same law
    and plant in eager torch, with closed-form ∇Φ and M, C, G. panda: 200 steps of RK4.
    """
    dynamics, robot = AnalyticDynamics(), load_robot("panda")
    truth, reference = PinocchioDynamics(robot), Sinusoid.for_robot(robot)
    for starts in (1, 64):
        q0 = np.random.default_rng(0).uniform(-1.0, 1.0, (starts, 2)) * (starts > 1)
        batch = _batch(DynamicsPlant(dynamics, "euler"), paper_reference(2), q0, 100, lookahead=0.0)
        controller = paper_controller(dynamics)
        figures = {"starts": float(starts), "steps": 100.0, "p50_ms": _epoch(controller, batch, "kernels", 20)}
        if starts == 1:
            figures["torch_ms"] = _epoch(controller, batch, "torch", 3)
            figures["torch_over_kernels"] = figures["torch_ms"] / figures["p50_ms"]
        yield Row("training epoch", "two_link", f"{starts} × 100", figures)
    q0 = reference(0.0).q + np.random.default_rng(0).uniform(-0.5, 0.5, (64, robot.nv))
    batch = _batch(DynamicsPlant(truth), reference, q0, 200, lookahead=None)
    controller = NeuralBackstepping.for_robot(robot, truth, period=TRAINING_PERIOD)
    figures = {"starts": 64.0, "steps": 200.0, "p50_ms": _epoch(controller, batch, "kernels", 5)}
    yield Row("training epoch", "panda", "64 × 200", figures)


def _batch(
    plant: DynamicsPlant, reference: DesiredMotion, q0: np.ndarray, steps: int, lookahead: float | None
) -> Batch:
    settings = {"plant_step": TRAINING_PERIOD, "effort_limit": None, "lookahead": lookahead}
    loop = Loop.of(plant, plant.nv, steps * TRAINING_PERIOD, TRAINING_PERIOD, **settings)
    return Batch.of(loop, reference, q0)


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


def simulation_row(robot: Robot, duration: float = 5.0) -> Row:
    """Steps per second of `simulate` with full recording, NBS against MuJoCo Euler at 1 ms, and the memory it keeps."""
    controller: Controller = build_law("nbs", robot, period=PERIOD).compile()
    reference = Sinusoid.for_robot(robot)
    plant = MujocoPlant(robot, "euler")
    simulate(plant, controller, reference, 0.1, PERIOD)
    start = time.perf_counter()
    run = simulate(plant, controller, reference, duration, PERIOD)
    wall = time.perf_counter() - start
    arrays = [value for value in vars(run).values() if isinstance(value, np.ndarray)]
    figures = {"steps_per_s": duration / PERIOD / wall, "recorded_MB": sum(x.nbytes for x in arrays) / 2**20}
    return Row("simulate", robot.name, "nbs mujoco euler", figures)


def endurance_row(robot: Robot, duration: float = 3600.0) -> Row:
    """An hour at 1 kHz under square-wave and noise torques, streamed: time, memory growth, and whether errors grow."""
    plant, controller = MujocoPlant(robot, "euler"), build_law("nbs", robot, period=PERIOD)
    square, noise = SquareWave(1.0, 5.0), TorqueNoise(0.1, PERIOD)

    def disturbance(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        return square(t, q, v) + noise(t, q, v)

    reference = Sinusoid.for_robot(robot)
    blocks = stream(plant, controller, reference, duration, PERIOD, block=10_000, disturbance=disturbance)
    start, errors, memory = time.perf_counter(), [], []
    for run in blocks:
        errors.append(metrics.rms_error(run) ** 2)
        memory.append(psutil.Process().memory_info().rss / 2**20)
    sixth = len(errors) // 6
    first, last = (float(np.sqrt(np.mean(part, axis=0)).max()) for part in (errors[:sixth], errors[-sixth:]))
    figures = {
        "duration_s": duration,
        "wall_s": time.perf_counter() - start,
        "memory_growth_MB": memory[-1] - memory[len(memory) // 10],
        "last_over_first_error": last / first,
    }
    return Row("endurance", robot.name, "nbs mujoco euler", figures)


def workers_row(robot: Robot, starts: int = 1000, duration: float = 1.0) -> Row:
    """A thousand starts in one process and in two, without threads of their own."""
    controller, reference = build_law("nbs", robot, period=PERIOD), Sinusoid.for_robot(robot)
    plant = MujocoPlant(robot, "euler")
    q0 = reference(0.0).q + 0.1 * np.random.default_rng(0).normal(size=(starts, robot.nv))
    simulate(plant, controller, reference, 0.01, PERIOD, q0=q0, workers=2)  # starts the processes
    walls = []
    threads, numba.config.NUMBA_NUM_THREADS = numba.config.NUMBA_NUM_THREADS, 1  # type: ignore[attr-defined]
    try:
        for workers in (1, 2):
            start = time.perf_counter()
            simulate(plant, controller, reference, duration, PERIOD, q0=q0, workers=workers)
            walls.append(time.perf_counter() - start)
    finally:
        numba.config.NUMBA_NUM_THREADS = threads  # type: ignore[attr-defined]
    figures = {"starts": float(starts), "one_s": walls[0], "two_s": walls[1], "speed_up": walls[0] / walls[1]}
    return Row("workers", robot.name, "nbs mujoco euler", figures)


def compare(rows: list[Row], old: dict[str, dict[str, float]]) -> list[tuple[str, str, float, float]]:
    """(row, figure, old, new) of every figure of both benches that moved by more than a tenth; old: from `rows_of`."""
    moved = []
    for row in rows:
        for name, new in row.figures.items():
            before = old.get(row.key, {}).get(name)
            if before is not None and abs(new - before) > 0.1 * abs(before):
                moved.append((row.key, name, before, new))
    return moved


def rows_of(summary: Any) -> dict[str, dict[str, float]]:
    """The figures of each row of a summary.json, by `Row.key`."""
    try:
        rows = [Row(r["what"], r["arm"], r["how"], dict(r["figures"])) for r in summary["rows"]]
        return {row.key: row.figures for row in rows}
    except (TypeError, KeyError, ValueError) as error:
        raise ArgumentError("the file to compare with is not a summary.json of a bench; give one.") from error


def summary(rows: list[Row]) -> dict[str, Any]:
    """The bench as JSON stores it: machine, versions, and every row."""
    return {"machine": machine(), "versions": versions(), "rows": [asdict(row) for row in rows]}


def machine() -> dict[str, str]:
    """Processor and operating system."""
    return {"processor": _processor(), "system": platform.platform()}


def _states(robot: Robot, count: int = 64) -> list[tuple[np.ndarray, ...]]:
    """Random q, v, q_ref, v_ref, a_ref near a reference."""
    rng = np.random.default_rng(0)
    reference = Sinusoid.for_robot(robot)(rng.uniform(0.0, 6.0, count))
    q, v = (x + 0.1 * rng.normal(size=x.shape) for x in reference[:2])
    return list(zip(q, v, *reference, strict=True))


def _step_times(controller: Controller, states: list[tuple[np.ndarray, ...]], calls: int) -> np.ndarray:
    """Wall times of single steps [µs] from the first memory, the states taken in turn."""
    memory = controller.initial_memory(states[0][0])

    def step(q: np.ndarray, v: np.ndarray, reference: Reference) -> None:
        controller.step(memory, q, v, reference, PERIOD)

    return _times(step, [(q, v, Reference(*r)) for q, v, *r in states], calls)


def _times(function: Callable[..., Any], arguments: list[Any], calls: int, warm: int = 200) -> np.ndarray:
    """Wall times of single calls [µs], the arguments taken in turn, after some that are not counted."""
    times = np.empty(calls)
    for k in range(min(calls, warm)):
        function(*arguments[k % len(arguments)])
    collecting = gc.isenabled()
    gc.disable()
    try:
        for k in range(calls):
            given = arguments[k % len(arguments)]
            start = time.perf_counter_ns()
            function(*given)
            times[k] = time.perf_counter_ns() - start
    finally:
        if collecting:
            gc.enable()
    return 1e-3 * times


def _median(function: Callable[..., Any], arguments: list[Any], calls: int) -> float:
    return float(np.median(_times(function, arguments, calls)))


def _processor() -> str:
    lines = _CPU_INFO.read_text().splitlines() if _CPU_INFO.is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()
