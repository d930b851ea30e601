"""The sampled control loop: control instants, reference, plant steps, starts and effort limits, all checked."""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from nbs_pin.base.arguments import MOST_PERIODS, MOST_STEPS
from nbs_pin.base.checks import LARGEST, SMALLEST, floats, is_usual, told, whole
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.records import ROW_ARRAYS, Reference, Run
from nbs_pin.base.shown import joints_told
from nbs_pin.motions.references import DesiredMotion, at_times
from nbs_pin.simulation.plant import Plant

LONGEST_PLANT_STEP = 1e-3
"""Default plant step [s], or the nearest shorter one that divides the period."""

MOST_RECORDED = 2**30
"""Most numbers of a run (8 GiB)."""


class Schedule(NamedTuple):
    """Control instants of a loop and the reference at them."""

    times: np.ndarray
    """Control instants [s], (rows,)."""
    leads: np.ndarray
    """How far ahead of each instant the law is evaluated [s], (rows,)."""
    desired: Reference
    """The reference at the instants, (rows, n) each."""
    target: Reference
    """The reference `leads` later, for which the law is evaluated, (rows, n) each."""


@dataclass(frozen=True, eq=False)
class Loop:
    """Constants of a sampled control loop."""

    plant: Plant
    period: float
    """Control period [s]."""
    steps: int
    """Number of periods."""
    substeps: int
    """Plant steps per period."""
    lead: float
    """How far ahead of the measured state the law is evaluated [s]."""
    limit: np.ndarray
    """Largest torque per joint [N·m], (n,), inf for none."""

    @classmethod
    def of(
        cls,
        plant: Plant,
        nv: int,
        duration: float,
        period: float,
        *,
        plant_step: float | None,
        effort_limit: Any,
        lookahead: float | None,
        most: float | None = None,
    ) -> "Loop":
        """The loop of a law for nv joints with `simulate`'s arguments; raises ArgumentError if they do not match.

        It has at most `most` periods (None: `MOST_PERIODS`), each of at most `MOST_STEPS` plant steps.
        """
        if nv != plant.nv:
            raise ArgumentError(
                f"the controller has {joints_told(nv)} and the plant {plant.nv}; build both for one arm."
            )
        return cls(
            plant=plant,
            period=period,
            steps=whole(duration, period, "duration", "period", float(MOST_PERIODS if most is None else most)),
            substeps=_substeps(period, plant_step),
            lead=0.5 * period if lookahead is None else lookahead,
            limit=_effort_limit(plant, effort_limit),
        )

    @property
    def step(self) -> float:
        """Plant step [s]."""
        return self.period / self.substeps

    def start(self, reference: DesiredMotion, q0: Any, v0: Any) -> tuple[np.ndarray, np.ndarray]:
        """Start (q, v): the reference's, or q0 at rest unless v0 is given; ArgumentError if they do not match."""
        return _start(at_times(reference, np.zeros(1), self.plant.nv), q0, v0)

    def schedule(self, reference: DesiredMotion, first: int = 0, steps: int | None = None) -> Schedule:
        """Control instants first, …, first + steps, or to the end; ArgumentError if the reference is invalid there."""
        steps = self.steps - first if steps is None else steps
        times = self.period * np.arange(first, first + steps + 1.0)
        # The reference need not exist beyond the end, so the law does not look ahead at the last instant.
        seen = np.minimum(times + self.lead, self.period * self.steps)
        desired, target = (at_times(reference, t, self.plant.nv) for t in (times, seen))
        return Schedule(times, seen - times, desired, target)

    def check_size(self, starts: int, estimates: int = 0) -> None:
        """Raise ArgumentError if the run from so many starts has more than `MOST_RECORDED` numbers.

        estimates: how many numbers the law adds to each row of each start.
        """
        if (len(ROW_ARRAYS) * self.plant.nv + estimates) * (self.steps + 1) * starts > MOST_RECORDED:
            raise ArgumentError(
                f"{starts} motions of {self.steps} periods have more than {MOST_RECORDED} numbers; give a shorter"
                " duration or fewer starts, or record one motion in blocks (stream)."
            )

    def blank_run(self, times: np.ndarray, desired: Reference, q0: np.ndarray, v0: np.ndarray, controller: str) -> Run:
        """A run with the times, references (rows, n) or (rows, *batch, n) and start (*batch, n), else zeros."""
        rows, n = len(times), self.plant.nv
        shape, robot = (rows, *q0.shape), self.plant.robot
        aligned = (x if x.ndim == len(shape) else x.reshape(rows, *(1,) * (q0.ndim - 1), n) for x in desired)
        q_ref, v_ref, a_ref = (np.array(np.broadcast_to(x, shape)) for x in aligned)
        run = Run(
            t=times,
            q=np.zeros(shape),
            v=np.zeros(shape),
            tau=np.zeros(shape),
            tau_command=np.zeros(shape),
            disturbance=np.zeros(shape),
            q_ref=q_ref,
            v_ref=v_ref,
            a_ref=a_ref,
            effort_limit=self.limit,
            continuous=np.zeros(n, dtype=bool) if robot is None else robot.continuous,
            joint_names=tuple(f"q{i + 1}" for i in range(n)) if robot is None else robot.joint_names,
            period=self.period,
            robot="" if robot is None else robot.source,
            robot_sha256="" if robot is None else robot.sha256,
            robot_options={} if robot is None else robot.options,
            prismatic=np.zeros(n, dtype=bool) if robot is None else robot.prismatic,
            info={"controller": controller, "plant": repr(self.plant), "plant_step": self.step, "lookahead": self.lead}
            | ({"plant_changes": list(self.plant.changes)} if self.plant.changes else {}),
        )
        run.q[0], run.v[0] = q0, v0
        return run


def _substeps(period: float, plant_step: float | None) -> int:
    if plant_step is not None:
        return whole(period, plant_step, "period", "plant_step", float(MOST_STEPS))
    return max(1, math.ceil(period / LONGEST_PLANT_STEP - 1e-9))


def _start(desired: Reference, q0: Any, v0: Any) -> tuple[np.ndarray, np.ndarray]:
    """Start (q, v) of one batch shape."""
    rest = desired.v[0] if q0 is None else np.zeros_like(desired.v[0])
    given = {"q0": desired.q[0] if q0 is None else q0, "v0": rest if v0 is None else v0}
    start = {name: floats(name, value) for name, value in given.items()}
    nv = rest.size
    for name, x in start.items():
        if x.ndim == 0 or x.shape[-1] != nv or 0 in x.shape:
            raise ArgumentError(f"{name} has shape {x.shape}, expected (..., {nv}): one number per joint.")
        if not is_usual(x):
            raise ArgumentError(
                f"{name} is {told(x)}, expected finite numbers of at most {LARGEST:g}; correct the start."
            )
    try:
        q, v = np.broadcast_arrays(start["q0"], start["v0"])
        return q, v
    except ValueError as error:
        shapes = ", ".join(f"{name} {x.shape}" for name, x in start.items())
        raise ArgumentError(f"the starts do not broadcast ({shapes}); give equal leading axes.") from error


def _effort_limit(plant: Plant, given: Any) -> np.ndarray:
    if given is None:
        given = np.inf if plant.robot is None else plant.robot.effort_limit
    limit = floats("effort_limit", given)
    if limit.shape not in ((), (plant.nv,)) or not (limit >= SMALLEST).all():
        raise ArgumentError(
            f"effort_limit is {told(given)}, expected one number > 0 or {plant.nv} of them [N·m, N where it slides]; "
            "np.inf means none."
        )
    return np.full(plant.nv, limit)
