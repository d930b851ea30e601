"""What a control step and a simulated second cost on this machine: the study behind `nbs-pin bench`."""

import gc
import platform
import resource
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import torch

from nbs_pin.controllers.controller import Controller
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.exceptions import ArgumentError
from nbs_pin.plants.dynamics_plant import DynamicsPlant
from nbs_pin.plants.mujoco_plant import MujocoPlant
from nbs_pin.references import Sinusoid
from nbs_pin.robot import Robot, load_robot
from nbs_pin.simulation import simulate
from nbs_pin.state import Reference
from nbs_pin.studies.chains import serial_chain
from nbs_pin.studies.tracking import ControllerName, build_controller, versions

LAWS: tuple[ControllerName, ...] = ("nbs", "nbs-paper", "slotine-li", "computed-torque", "pd-plus", "pd-gravity", "pid")
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


def bench(arms: tuple[str, ...] = ("two_link", "panda", "ur5"), *, calls: int = 20_000) -> Iterator[Row]:
    """Rows as they are measured: control steps, plant steps, simulation, and cost against the number of joints.

    calls: how often a control step is timed. A step is timed alone, with the garbage collector off, on one core.
    """
    if calls < 1000:
        raise ArgumentError(f"calls is {calls}, expected at least 1000 for a p99.9.")
    for arm in arms:
        robot = load_robot(arm)
        for law in LAWS:
            yield control_row(robot, law, calls, against_torch=law == "nbs")
        yield from plant_rows(robot)
        yield simulation_row(robot)
    for joints in CHAINS:
        yield control_row(serial_chain(joints), "nbs", max(1000, calls // 4), what="joints")


def control_row(robot: Robot, law: str, calls: int, *, what: str = "control step", against_torch: bool = False) -> Row:
    """Percentiles of one compiled control step [µs], its ratio to two RNEA, and eager torch's ratio to it."""
    plain = build_controller(law, robot, period=PERIOD)
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
        eager = np.median(_times(plain.torque, tensors, 200))  # type: ignore[attr-defined]
        figures |= {"torch_us": float(eager), "torch_over_compiled": float(eager / np.median(times))}
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


def simulation_row(robot: Robot, duration: float = 5.0) -> Row:
    """Steps per second of `simulate` with full recording, NBS against MuJoCo Euler at 1 ms, and the memory it keeps."""
    controller: Controller = build_controller("nbs", robot, period=PERIOD).compile()
    reference = Sinusoid.for_robot(robot)
    plant = MujocoPlant(robot, "euler")
    simulate(plant, controller, reference, 0.1, PERIOD)
    before = _peak_memory()
    start = time.perf_counter()
    simulate(plant, controller, reference, duration, PERIOD)
    wall = time.perf_counter() - start
    rate = duration / PERIOD / wall
    return Row("simulate", robot.name, "nbs mujoco euler", {"steps_per_s": rate, "peak_MB": _peak_memory() - before})


def compare(rows: list[Row], old: dict[str, Any]) -> list[tuple[str, str, float, float]]:
    """(row, figure, old, new) of every figure that both benches have and that moved by more than a tenth.

    old: a bench's summary.json. Raises ArgumentError when it is none.
    """
    if not isinstance(old.get("rows"), list):
        raise ArgumentError("the file to compare with has no 'rows'; give the summary.json of another bench.")
    known = {f"{r['what']}/{r['arm']}/{r['how']}": r["figures"] for r in old["rows"]}
    moved = []
    for row in rows:
        for name, new in row.figures.items():
            before = known.get(row.key, {}).get(name)
            if before is not None and abs(new - before) > 0.1 * abs(before):
                moved.append((row.key, name, before, new))
    return moved


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


def _peak_memory() -> float:
    """Largest resident memory of this process so far [MB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def _processor() -> str:
    lines = _CPU_INFO.read_text().splitlines() if _CPU_INFO.is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()
