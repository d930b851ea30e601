"""What a control step and a simulated second cost on this machine: the study behind `nbs-pin bench`."""

import gc
import platform
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pinocchio as pin
import psutil
import torch

from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.records import Reference
from nbs_pin.base.versions import versions
from nbs_pin.benchmarks.bench_training import training_epochs
from nbs_pin.benchmarks.serial_chains import serial_chain
from nbs_pin.controllers.controller import Controller
from nbs_pin.controllers.registry import LAWS, build_law
from nbs_pin.dynamics.chain import Chain
from nbs_pin.dynamics.cholesky import CholeskyNetwork
from nbs_pin.dynamics.lagrangian import LagrangianDynamics
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.motions.disturbances import SquareWave, TorqueNoise
from nbs_pin.motions.references import Sinusoid
from nbs_pin.robots.robot import Robot, load_robot
from nbs_pin.simulation import metrics
from nbs_pin.simulation.dynamics_plant import DynamicsPlant
from nbs_pin.simulation.mujoco_plant import MujocoPlant
from nbs_pin.simulation.simulate import simulate, stream

MODELS = ("three_link", "panda")
"""Arms whose models are timed, learned ones beside Pinocchio."""
CHAINS = (1, 2, 3, 5, 7, 10, 15, 20, 25, 30)
PERIOD = 0.001
_CPU_INFO = Path("/proc/cpuinfo")


@dataclass(frozen=True)
class Row:
    """One measured thing: what, on which arm, with which law or plant, and its figures with the unit in the key."""

    what: str
    arm: str
    how: str
    figures: dict[str, float] = field(default_factory=dict)

    @property
    def key(self) -> str:
        """What names the row from one bench to the next."""
        return f"{self.what}/{self.arm}/{self.how}"


def bench(
    arms: tuple[str, ...] = ("two_link", "panda", "ur5"),
    *,
    calls: int = 20_000,
    chains: tuple[int, ...] = CHAINS,
    long: bool = False,
) -> Iterator[Row]:
    """Rows as they are measured: laws, plants, simulation, models, cost against joints, and training epochs.

    calls: how often a control step is timed. A step is timed alone, with the garbage collector off, on one core.
    chains: numbers of joints of the generated arms. long: also an hour of motion and a thousand starts, a few minutes.
    Raises ArgumentError for fewer than 1000 calls.
    """
    if calls < 1000:
        raise ArgumentError(f"calls is {calls}, expected at least 1000 for a p99.9.")
    for arm in arms:
        robot = load_robot(arm)
        for law in LAWS:
            yield control_row(robot, law, calls, against_torch=law == "nbs")
        yield from plant_rows(robot)
        yield simulation_row(robot)
    for arm in MODELS:
        yield from model_rows(load_robot(arm))
    for joints in chains:
        yield control_row(serial_chain(joints), "nbs", max(1000, calls // 4), what="joints")
    for (arm, size), figures in training_epochs().items():
        yield Row("training epoch", arm, size, figures)
    if long:
        yield endurance_row(load_robot("panda"))
        yield workers_row(load_robot("panda"))


def control_row(robot: Robot, law: str, calls: int, *, what: str = "control step", against_torch: bool = False) -> Row:
    """Percentiles of one compiled control step [µs], its ratio to two RNEA, and eager torch's ratio to it."""
    plain: Any = build_law(law, robot, period=PERIOD)
    controller = plain.compile()
    states = _states(robot)
    memory = controller.initial_memory(states[0][0])

    def step(q: np.ndarray, v: np.ndarray, reference: Reference) -> None:
        controller.step(memory, q, v, reference, PERIOD)

    times = _times(step, [(q, v, Reference(*r)) for q, v, *r in states], calls)
    data = robot.model.createData()

    def two_rnea(q: np.ndarray, v: np.ndarray, *_: np.ndarray) -> None:
        pin.rnea(robot.model, data, q, v, v)
        pin.rnea(robot.model, data, q, v, v)

    rnea = np.median(_times(two_rnea, states, calls))
    figures = {
        "joints": float(robot.nv),
        "p50_us": float(np.median(times)),
        "p99_us": float(np.percentile(times, 99.0)),
        "p99.9_us": float(np.percentile(times, 99.9)),
        "max_us": float(times.max()),
        "two_rnea_us": float(rnea),
        "over_two_rnea": float(np.median(times) / rnea),
    }
    if against_torch:
        tensors = [tuple(torch.as_tensor(x) for x in state) for state in states]
        with_graph = np.median(_times(plain.torque, tensors, 200))
        with torch.no_grad():
            eager = np.median(_times(plain.torque, tensors, 200))
        figures |= {
            "torch_us": float(eager),
            "torch_graph_us": float(with_graph),
            "torch_over_compiled": float(eager / np.median(times)),
        }
    return Row(what, robot.name, law, figures)


def plant_rows(robot: Robot) -> Iterator[Row]:
    """The cost of one plant step of 1 ms [µs] for each plant and integrator."""
    plants = {
        "mujoco rk4": MujocoPlant(robot, "rk4"),
        "mujoco euler": MujocoPlant(robot, "euler"),
        "pinocchio rk4": DynamicsPlant(PinocchioDynamics(robot)),
    }
    q, v, *_ = _states(robot)[0]
    for name, plant in plants.items():
        times = _times(lambda *_, plant=plant: plant.step(q, 0.1 * v, 0.0 * v, PERIOD), [()], 2000)
        yield Row("plant step", robot.name, name, {"p50_us": float(np.median(times))})


def model_rows(robot: Robot, calls: int = 5000) -> Iterator[Row]:
    """The cost of M a_r + C(q, v) v_r + G at one state [µs] for each kind of model; weights do not matter to it."""
    parents, prismatic = robot.parents, robot.prismatic
    exact = PinocchioDynamics(robot)
    models = {
        "pinocchio": exact,
        "chain": LagrangianDynamics(Chain(parents, prismatic)),
        "cholesky": LagrangianDynamics(CholeskyNetwork(prismatic.tolist())),
    }
    states = [(q, v, v_ref, a_ref) for q, v, _, v_ref, a_ref in _states(robot)]
    own = np.median(_times(exact.reference_torque, states, calls))
    for name, model in models.items():
        times = _times(model.reference_torque, states, calls)
        figures = {"p50_us": float(np.median(times)), "over_pinocchio": float(np.median(times) / own)}
        yield Row("model torque", robot.name, name, figures)


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
    controller = build_law("nbs", robot, period=PERIOD)
    square, noise = SquareWave(1.0, 5.0), TorqueNoise(0.1, PERIOD)
    blocks = stream(
        MujocoPlant(robot, "euler"),
        controller,
        Sinusoid.for_robot(robot),
        duration,
        PERIOD,
        block=10_000,
        disturbance=lambda t, q, v: square(t, q, v) + noise(t, q, v),
    )
    start, errors, memory = time.perf_counter(), [], []
    for run in blocks:
        errors.append(metrics.rms_error(run) ** 2)
        memory.append(_memory())
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
    """A thousand starts on one core and on two: a process each, without threads of their own."""
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
    """(row, figure, old, new) of every figure that both benches have and that moved by more than a tenth.

    old: `rows_of` the other bench's summary.json.
    """
    moved = []
    for row in rows:
        for name, new in row.figures.items():
            before = old.get(row.key, {}).get(name)
            if before is not None and abs(new - before) > 0.1 * abs(before):
                moved.append((row.key, name, before, new))
    return moved


def rows_of(summary: Any) -> dict[str, dict[str, float]]:
    """The figures of each row of a summary.json, by `Row.key`; raises ArgumentError when it is none."""
    try:
        return {Row(r["what"], r["arm"], r["how"]).key: dict(r["figures"]) for r in summary["rows"]}
    except (TypeError, KeyError, ValueError) as error:
        raise ArgumentError("the file to compare with is no summary.json of a bench; give one.") from error


def summary(rows: list[Row]) -> dict[str, Any]:
    """The bench as JSON stores it: machine, versions, and every row."""
    machine = {"processor": _processor(), "system": platform.platform()}
    return {"machine": machine, "versions": versions(), "rows": [asdict(row) for row in rows]}


def _states(robot: Robot, count: int = 64) -> list[tuple[np.ndarray, ...]]:
    """Random q, v, q_ref, v_ref, a_ref near a reference."""
    rng = np.random.default_rng(0)
    reference = Sinusoid.for_robot(robot)(rng.uniform(0.0, 6.0, count))
    q, v = (x + 0.1 * rng.normal(size=x.shape) for x in reference[:2])
    return list(zip(q, v, *reference, strict=True))


def _times(function: Callable[..., Any], arguments: list[Any], calls: int) -> np.ndarray:
    """Wall times of single calls [µs], the arguments taken in turn."""
    times = np.empty(calls)
    for k in range(min(calls, 200)):
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


def _memory() -> float:
    """Resident memory of this process now [MB]."""
    return psutil.Process().memory_info().rss / 2**20


def _processor() -> str:
    lines = _CPU_INFO.read_text().splitlines() if _CPU_INFO.is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()
