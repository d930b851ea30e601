"""Evaluation of a controller from starts that its training did not use."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from nbs_pin.base.exceptions import SimulationDiverged
from nbs_pin.base.records import Run
from nbs_pin.controllers.controller import Controller
from nbs_pin.motions.references import DesiredMotion
from nbs_pin.simulation import metrics
from nbs_pin.simulation.loop import Loop
from nbs_pin.simulation.rollout import Batch, Motions, motions, recorded

FRESH_STARTS = 20
"""Starts per reference for comparing a trained controller with the untrained one."""


def fresh_batch(
    loop: Loop, references: Sequence[DesiredMotion], start_error: float, seed: int, starts: int = FRESH_STARTS
) -> Batch:
    """Motions along each reference from `starts` random starts at rest within ±start_error [rad] of its start.

    The random stream of a seed differs from that of `train`.
    """
    draw, batches = np.random.default_rng((seed, 1)), []
    for reference in references:
        begin = loop.schedule(reference, 0, 0).desired.q[0]
        away = draw.uniform(-start_error, start_error, (starts, loop.plant.nv))
        batches.append(Batch.of(loop, reference, begin + away))
    return Batch.joined(batches)


def compared(controller: Controller, batch: Batch) -> Run:
    """The motions of a batch as a run; a diverging motion is NaN from there on or, without kernels, entirely."""
    with torch.no_grad():
        try:
            motion = motions(controller, batch)
        except SimulationDiverged:  # without kernels one diverging start stops the whole batch
            motion = Motions(*(torch.cat(parts) for parts in zip(*_one_by_one(controller, batch), strict=True)))
    return recorded(motion, batch, type(controller).__name__)


def fresh_figures(run: Run) -> dict[str, float]:
    """Metrics over all starts of a run, with units in the keys.

    Median and worst convergence time, inf for a motion that does not converge or is not finite; largest ‖z1‖² in the
    last 30 % of the time, largest torque, root mean square of ‖τ‖ over starts and time, and fraction of the time with
    a saturated joint: NaN if some motion is not finite.
    """
    finite = np.isfinite(run.q).all(axis=(0, -1)) & np.isfinite(run.tau_command).all(axis=(0, -1))
    with np.errstate(over="ignore", invalid="ignore"):  # from diverging motions
        times = np.where(finite, metrics.convergence_time(run), np.inf)
        steady, peak, rms, saturated = (
            np.where(finite, measure(run), np.nan)
            for measure in (metrics.steady_error, metrics.peak_torque, metrics.rms_torque, metrics.saturated_fraction)
        )
    return {
        "convergence_time_median_s": float(np.median(times)),
        "convergence_time_worst_s": float(times.max()),
        "steady_error_rad2": float(steady.max()),
        "peak_torque_Nm": float(peak.max()),
        "rms_torque_Nm": float(np.sqrt(np.mean(rms**2))),
        "saturated_fraction": float(saturated.mean()),
    }


def _one_by_one(controller: Controller, batch: Batch) -> list[Motions]:
    """The motions of a batch, computed one by one; NaN for one that diverges."""
    names, done = ("aims", "desired", "q0", "v0", "tau_d"), []
    for k in range(len(batch)):
        one = replace(batch, **{name: getattr(batch, name)[k : k + 1] for name in names})
        try:
            done.append(motions(controller, one))
        except SimulationDiverged:
            state = torch.full((1, batch.loop.steps + 1, batch.loop.plant.nv), torch.nan, dtype=torch.float64)
            done.append(Motions(state, state, state[:, 1:]))
    return done
