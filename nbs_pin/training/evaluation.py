"""What a controller does from starts that its training never saw."""

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
"""Starts per reference on which a controller is compared with what it was before."""


def fresh_batch(
    loop: Loop, references: Sequence[DesiredMotion], start_error: float, seed: int, starts: int = FRESH_STARTS
) -> Batch:
    """So many motions along each reference, at rest within ±start_error [rad] of its start.

    They are drawn apart from those of `train`, whose seed is the number alone.
    """
    draw, batches = np.random.default_rng((seed, 1)), []
    for reference in references:
        begin = loop.schedule(reference, 0, 0).desired.q[0]
        away = draw.uniform(-start_error, start_error, (starts, loop.plant.nv))
        batches.append(Batch.of(loop, reference, begin + away))
    return Batch.joined(batches)


def compared(controller: Controller, batch: Batch) -> Run:
    """The motions of a batch as a run; what diverges is NaN from there on, or as a whole without kernels."""
    with torch.no_grad():
        try:
            motion = motions(controller, batch)
        except SimulationDiverged:  # without kernels the plant refuses to go on, and takes every start along
            motion = Motions(*(torch.cat(parts) for parts in zip(*_one_by_one(controller, batch), strict=True)))
    return recorded(motion, batch, type(controller).__name__)


def fresh_figures(run: Run) -> dict[str, float]:
    """Figures over the starts of a run, units in the keys; inf where there is no time of convergence.

    Median and worst time of convergence; the largest ‖z1‖² of the last 30 % of the time; the largest torque, the root
    mean square over starts and time of ‖τ‖, and the fraction of the time for which some joint is at its limit: NaN for
    these four when some motion is not finite, which has not converged either.
    """
    finite = np.isfinite(run.q).all(axis=(0, -1)) & np.isfinite(run.tau_command).all(axis=(0, -1))
    with np.errstate(over="ignore", invalid="ignore"):  # of motions on their way out of the finite numbers
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
    """The motions of a batch, each by itself; NaN for one that diverges."""
    names, done = ("aims", "desired", "q0", "v0", "tau_d"), []
    for k in range(len(batch)):
        one = replace(batch, **{name: getattr(batch, name)[k : k + 1] for name in names})
        try:
            done.append(motions(controller, one))
        except SimulationDiverged:
            state = torch.full((1, batch.loop.steps + 1, batch.loop.plant.nv), torch.nan, dtype=torch.float64)
            done.append(Motions(state, state, state[:, 1:]))
    return done
