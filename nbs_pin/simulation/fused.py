"""The run of `simulate` by one kernel, for laws and plants that have rollouts: no step asks the interpreter."""

from typing import Any

import numpy as np

from nbs_pin.base.exceptions import SimulationDiverged
from nbs_pin.base.records import Run
from nbs_pin.controllers.controller import Controller
from nbs_pin.kernels.rollouts import Course, Rollout, rollout, rollout_workspace
from nbs_pin.motions.disturbances import Disturbance, torques_over
from nbs_pin.motions.references import DesiredMotion
from nbs_pin.simulation.guards import check_loop
from nbs_pin.simulation.loop import Loop
from nbs_pin.simulation.plant import Plant
from nbs_pin.simulation.rollout import scene_of


class Fused:
    """A motion of one start, made ready: `run` is one kernel, which gives the interpreter's lock away."""

    def __init__(
        self,
        loop: Loop,
        controller: Controller,
        reference: DesiredMotion,
        start: tuple[np.ndarray, np.ndarray],
        scene: Any,
        tau_d: np.ndarray,
    ) -> None:
        times, leads, desired, target = loop.schedule(reference)
        self._loop, self._scene, self._law = loop, scene, controller.packed_law()
        # One period more than the motion has, as its last row states the torque that was not applied.
        self._course = Course(np.stack([desired.a, target.q, target.v, target.a], axis=1), leads, tau_d)
        self._run = loop.blank_run(times, desired, *start, controller=controller.law_name)
        self._run.info.update(getattr(reference, "notes", {}))

    @classmethod
    def of(
        cls,
        plant: Plant,
        controller: Controller,
        reference: DesiredMotion,
        duration: float,
        period: float,
        *,
        q0: Any = None,
        v0: Any = None,
        plant_step: float | None = None,
        effort_limit: Any = None,
        disturbance: Disturbance | None = None,
        lookahead: float | None = None,
        check: bool = True,
    ) -> "Fused | None":
        """The motion that `simulate` makes of the same arguments, for one start; None where a part has no kernel.

        Kernels hold a disturbance over the period, `simulate` over the plant step: with several of these, one that
        changes in time has none. Raises what `simulate` raises before the first step.
        """
        settings = {"plant_step": plant_step, "effort_limit": effort_limit, "lookahead": lookahead}
        loop = Loop.of(plant, controller.nv, duration, period, **settings)
        scene = scene_of(controller, loop)
        times = loop.period * np.arange(loop.steps + 1.0)
        tau_d = None if scene is None else torques_over(disturbance, times, loop.plant.nv)
        if tau_d is None or (loop.substeps > 1 and not (tau_d == tau_d[0]).all()):
            return None
        start = loop.start(reference, q0, v0)
        if check:
            check_loop(loop, controller, reference, start)
        loop.check_size(1)
        return cls(loop, controller, reference, start, scene, tau_d)

    def run(self) -> Run:
        """The run; raises SimulationDiverged if a torque or the state is not finite."""
        run, steps, n = self._run, self._loop.steps, self._loop.plant.nv
        q, v = np.empty((2, steps + 2, n))
        q[0], v[0] = run.q[0], run.v[0]
        command, memory = np.empty((steps + 1, n)), np.empty((steps + 2, 2, n))
        work = np.zeros(rollout_workspace(self._law, self._scene))
        rollout(self._course, self._scene, self._law, work, Rollout(q, v, command, memory))
        run.q[:], run.v[:], run.tau_command[:] = q[:-1], v[:-1], command
        finite = np.isfinite(np.concatenate([run.q, run.v, command], axis=1)).all(axis=1)
        if not finite.all():
            raise SimulationDiverged(
                f"the loop has diverged: at t = {float(run.t[np.argmin(finite)]):g} s a torque or the state is not"
                " finite; take a shorter plant step, or check for an unstable gain."
            )
        np.clip(command, -self._loop.limit, self._loop.limit, out=run.tau)
        run.disturbance[:-1] = self._course.tau_d[:-1]
        return run
