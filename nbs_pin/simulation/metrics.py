"""Metrics of a run, aligned in time: row k of q is compared with row k of q_ref.

Every function returns one number per start, shape (*batch,), or one per start and joint where stated.
Torque statistics exclude the last row, whose torque was computed but never applied.
"""

from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Float

from nbs_pin.base.arguments import checked, count, number
from nbs_pin.base.arrays import Scalars, Vectors
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.plain import plain
from nbs_pin.base.records import RUN, Run
from nbs_pin.robots.robot import configuration_difference

Numbers: TypeAlias = Scalars | np.float64
"""One number per start: an array for a batch, a number for a single start."""
PAPER_THRESHOLD = 0.01
"""‖z1‖² below which the paper considers an arm converged [rad²]."""


@checked(run=RUN)
def error(run: Run) -> Float[np.ndarray, "rows *batch n"]:
    """z1 = q ⊖ q_ref at every control instant [rad], wrapped on continuous joints."""
    return configuration_difference(run.q, run.q_ref, run.continuous)


@checked(run=RUN, shift=count(0))
def squared_error(run: Run, shift: int = 0) -> Float[np.ndarray, "rows *batch"]:
    """‖z1‖² at every control instant [rad²], comparing q in row k + `shift` with q_ref in row k.

    With shift = 0 this is the tracking error. With shift = 1, the index of the authors' program, it is q(t + h) against
    q_d(t), which counts the reference's own motion within h as error (docs/theory.md §8).
    """
    if not 0 <= shift < len(run.t):
        raise ArgumentError(f"shift is {shift}, expected 0 (aligned) or 1 (the authors' index) for {len(run.t)} rows.")
    z1 = configuration_difference(run.q[shift:], run.q_ref[: len(run.t) - shift], run.continuous)
    return np.sum(z1 * z1, axis=-1)


@checked(run=RUN, shift=count(0), last=number(above=0.0, most=1.0))
def steady_error(run: Run, last: float = 0.3, shift: int = 0) -> Numbers:
    """Largest ‖z1‖² over the last fraction `last` of the time [rad²]; the paper takes the last 30 s of 100 s.

    Example:
        >>> import nbs_pin as nbs
        >>> robot = nbs.load_robot("two_link")
        >>> plant, law = nbs.DynamicsPlant.for_robot(robot), nbs.ComputedTorque.for_robot(robot)
        >>> run = nbs.simulate(plant, law, nbs.Hold([0.3, 0.2]), duration=0.1, period=0.001)
        >>> bool(nbs.metrics.steady_error(run) < 1e-12)
        True
    """
    values = squared_error(run, shift)
    start = run.t[-1] - last * (run.t[-1] - run.t[0])
    late = run.t[shift:] >= start - 1e-9 * run.period
    return np.max(values[late], axis=0)


@checked(run=RUN, shift=count(0), threshold=number(above=0.0, unit="rad²"))
def convergence_time(run: Run, threshold: float = PAPER_THRESHOLD, shift: int = 0) -> Numbers:
    """First control instant [s] from which ‖z1‖² stays below the threshold [rad²] to the end; inf if there is none.

    `shift` is that of `squared_error`; with 1, the authors' index, the time is one period shorter.
    """
    outside = ~(squared_error(run, shift) < threshold)  # NaN counts as outside
    rows = len(outside)
    last_outside = np.where(outside.any(axis=0), rows - 1 - np.argmax(outside[::-1], axis=0), -1)
    return np.append(run.t[:rows], np.inf)[last_outside + 1]


@checked(run=RUN, after=number(least=0.0, unit="s"))
def rms_error(run: Run, after: float = 0.0) -> Vectors:
    """Root mean square of z1 per joint from the time `after` [s] on [rad]."""
    return np.sqrt(np.mean(error(run)[_from(run, after)] ** 2, axis=0))


@checked(run=RUN)
def peak_torque(run: Run) -> Numbers:
    """Largest |τ_i| applied, over time and joints [N·m]."""
    return np.max(joint_peak_torque(run), axis=-1)


@checked(run=RUN)
def joint_peak_torque(run: Run) -> Vectors:
    """Largest |τ_i| applied, over time, per joint [N·m]."""
    return np.max(np.abs(run.tau[:-1]), axis=0)


@checked(run=RUN)
def rms_torque(run: Run) -> Numbers:
    """Root mean square over time of the applied ‖τ‖ [N·m]."""
    return np.sqrt(np.mean(np.sum(run.tau[:-1] ** 2, axis=-1), axis=0))


@checked(run=RUN, after=number(least=0.0, unit="s"))
def saturated_fraction(run: Run, after: float = 0.0) -> Numbers:
    """Fraction of the control periods ending after `after` [s] in which the command of some joint exceeded its limit.

    No Lyapunov argument holds in these periods (docs/theory.md §7).
    """
    exceeded = np.any(np.abs(run.tau_command[:-1]) > run.effort_limit, axis=-1)
    _from(run, after)
    return np.mean(exceeded[run.t[1:] > after + 1e-9 * run.period], axis=0)


@checked(run=RUN)
def peak_torque_rate(run: Run) -> Numbers:
    """Largest |Δτ_i|/period between control instants, over time and joints [N·m/s]; 0 for a run of one period."""
    steps = np.abs(np.diff(run.tau[:-1], axis=0)) / run.period
    return np.max(steps, axis=(0, -1), initial=0.0)


@checked(run=RUN, after=number(least=0.0, unit="s"))
def summary(run: Run, after: float = 1.0) -> dict[str, Any]:
    """All metrics above as JSON values, with units in the keys, None for inf and a list over a batch of starts.

    Figures with "late" in the key count from the time `after` [s] or half the duration, whichever is earlier.
    """
    after = min(after, 0.5 * float(run.t[-1]))
    figures = {
        "steady_error_rad2": steady_error(run),
        "steady_error_shifted_rad2": steady_error(run, shift=1),
        "convergence_time_s": convergence_time(run),
        "final_error_rad": np.linalg.norm(error(run)[-1], axis=-1),
        "rms_error_rad": rms_error(run),
        "rms_error_late_rad": rms_error(run, after),
        "peak_torque_Nm": peak_torque(run),
        "joint_peak_torque_Nm": joint_peak_torque(run),
        "rms_torque_Nm": rms_torque(run),
        "peak_torque_rate_Nm_per_s": peak_torque_rate(run),
        "saturated_fraction": saturated_fraction(run),
        "saturated_fraction_late": saturated_fraction(run, after),
        "effort_limit_Nm": run.effort_limit,
    }
    times = {"duration_s": float(run.t[-1]), "period_s": run.period, "late_after_s": after}
    return {**times, "joints": list(run.joint_names), **plain({k: np.asarray(x) for k, x in figures.items()})}


def _from(run: Run, after: float) -> np.ndarray:
    """The rows from the time `after` [s] on."""
    if not 0.0 <= after < run.t[-1]:
        raise ArgumentError(f"after is {after} s, expected a time in [0, {run.t[-1]:g}) s, inside the run.")
    return run.t >= after - 1e-9 * run.period
