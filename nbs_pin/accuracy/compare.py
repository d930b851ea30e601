"""How far a model of an arm is from the truth: M, C v, G, inverse and forward dynamics, and where the error grows.

Any two dynamics providers can be compared; what a relative error is stands in `accuracy/relative_errors.py`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from nbs_pin.accuracy.energy_drift import FreeMotion, free_motion
from nbs_pin.accuracy.mismatch import Mismatch, accelerations, mismatch
from nbs_pin.accuracy.relative_errors import Box, Errors, check_joints, judge, share
from nbs_pin.base.arrays import JointArray
from nbs_pin.base.checks import PerJoint
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.records import Run
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.dynamics.provider import DynamicsProvider

SPEEDS = (0.125, 0.25, 0.5, 1.0, 2.0, 4.0)
"""Shares of the box's speed at which `ModelErrors.by_speed` looks."""
DISTANCES = (0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 2.0)
"""Sizes of the box, on whose surface `ModelErrors.by_distance` looks."""
_GROWTH_SAMPLES, _RUN_STATES = 500, 5_000


class Growth(NamedTuple):
    """How the errors change with speed, or with the distance from the middle of the box."""

    at: tuple[float, ...]
    """Shares of the box's speed, or sizes of the box; 1 is the box itself."""
    errors: tuple[Errors, ...]
    """The errors there."""


class Scale(NamedTuple):
    """The one factor by which all torques of a model may be wrong: free motion alone cannot tell it."""

    factor: float
    """c with τ ≈ c τ̂ in least squares; 1 for a model whose scale is right (docs/theory.md §6)."""
    error: float
    """Relative error of c τ̂, never above that of τ̂: small beside `inverse` where only the scale is wrong."""


@dataclass(frozen=True, eq=False)
class ModelErrors:
    """What `compare` found; relative errors are Frobenius ones over the samples (0.01 is one per cent)."""

    mass_matrix: float
    """‖M̂ − M‖_F/‖M‖_F."""
    coriolis: float
    """The same of C(q, v) v."""
    gravity: float
    """The same of G; inf for an arm without gravity whose model has some."""
    inverse: float
    """The same of the torque M v̇ + C v + G for uniform v̇."""
    forward: float
    """The same of the acceleration under the true torque for those v̇."""
    torque_nmse: float
    """Mean over joints of the torque's mean squared error ÷ variance."""
    torque_rms: JointArray
    """Root mean square of the torque error per joint [N·m]."""
    torque_deviation: JointArray
    """Standard deviation of the true torque per joint [N·m]."""
    eigenvalue_margin: float
    """Least eigenvalue of M̂ over the samples [kg·m²]; positive, or the model is none."""
    mass_ratio: tuple[float, float]
    """(lo, hi) with lo·M ⪯ M̂ ⪯ hi·M at every sample; (1, 1) for the truth."""
    energy_drift: float
    """How far the true energy strays along the model's free motion, worst start and time; NaN without motions."""
    scale: Scale
    """The best common factor of all torques."""
    by_speed: Growth
    """Errors for |v_i| up to these shares of the box's speed."""
    by_distance: Growth
    """Errors on the surface of the box, shrunk and grown about its middle by these factors."""
    each: Errors
    """The samples' own errors, (samples,) each, as shares of the RMS size."""
    motion: FreeMotion | None
    """Free motions of both from the same starts, or None where none were asked for."""
    box: Box
    """Where the samples are."""
    samples: int
    """How many they are."""
    seed: int
    """Of the samples."""
    along_run: Errors | None = None
    """Errors over the states of the run and the accelerations the truth has there."""
    mismatch: Mismatch | None = None
    """δ along the run, and the bound it keeps (`accuracy/mismatch.py`)."""

    @property
    def errors(self) -> Errors:
        """The five relative errors over the box."""
        return Errors(self.mass_matrix, self.coriolis, self.gravity, self.inverse, self.forward)


def compare(
    model: DynamicsProvider,
    truth: DynamicsProvider,
    samples: int = 2_000,
    speed: PerJoint = 2.0,
    seed: int = 1,
    box: Sequence[PerJoint] | None = None,
    run: Run | None = None,
    motions: int = 10,
    *,
    friction: JointFriction | None = None,
) -> ModelErrors:
    """How far the model is from the truth on `samples` uniform states of a box, beyond it, and along a run.

    speed: |v_i| up to this [rad/s], one number or one per joint. box: (lower, upper) [rad], each one number or one per
    joint, for instance where the data of the fit lie; None takes the position limits of the truth's arm, a whole turn
    where they allow it. run: a closed loop with the truth as its plant; several starts make the bound on δ say
    something of further ones (`accuracy/mismatch.py`). motions: free ones from random states of the box; 0 saves their time.
    friction: of that plant; it is no part of M, C, G, but v̇ along the run is wrong without it.
    Joints that slide are compared in their own units beside those that turn, as M has them.
    Raises ArgumentError for another number of joints, an empty box, or a model that is not finite at some sample.
    """
    check_joints(model, truth)
    if samples < 2 or samples != int(samples):
        raise ArgumentError(f"samples is {samples}, expected a whole number of at least 2; 2000 is usual.")
    chosen = box_of(model, truth, box, speed)
    rng = np.random.default_rng(seed)
    state = chosen.states(rng, samples)
    judged = judge(model, truth, *state)
    rms, deviation = np.sqrt(np.mean((judged.modelled - judged.true) ** 2, axis=0)), judged.true.std(axis=0)
    margin, ratio = _eigenvalues(model.mass_matrix(state[0]), truth.mass_matrix(state[0]))
    by_speed, by_distance = _growth(model, truth, chosen, rng)
    motion = free_motion(model, truth, *chosen.states(rng, motions)[:2]) if motions else None
    return ModelErrors(
        **judged.errors._asdict(),
        torque_nmse=float(np.mean(share(rms, deviation) ** 2)),
        torque_rms=rms,
        torque_deviation=deviation,
        eigenvalue_margin=margin,
        mass_ratio=ratio,
        energy_drift=np.nan if motion is None else motion.worst,
        scale=best_scale(judged.true, judged.modelled),
        by_speed=by_speed,
        by_distance=by_distance,
        each=judged.each,
        motion=motion,
        box=chosen,
        samples=samples,
        seed=seed,
        along_run=None if run is None else _along(model, truth, run, friction),
        mismatch=None if run is None else mismatch(model, truth, run, friction=friction),
    )


def box_of(model: DynamicsProvider, truth: DynamicsProvider, box: Sequence[PerJoint] | None, speed: PerJoint) -> Box:
    """The box that `compare` looks in for these arguments."""
    if box is None:
        return Box.of_robot(truth.robot or model.robot, truth.nv, speed)
    if len(box) != 2:
        raise ArgumentError(f"the box has {len(box)} parts, expected two: (lower, upper).")
    return Box.of(box[0], box[1], speed, truth.nv)


def _eigenvalues(modelled: np.ndarray, true: np.ndarray) -> tuple[float, tuple[float, float]]:
    """Least eigenvalue of M̂, and the range of those of M^−½ M̂ M^−½."""
    modelled = 0.5 * (modelled + np.swapaxes(modelled, -1, -2))
    root = np.linalg.inv(np.linalg.cholesky(true))
    ratios = np.linalg.eigvalsh(root @ modelled @ np.swapaxes(root, -1, -2))
    return float(np.linalg.eigvalsh(modelled).min()), (float(ratios.min()), float(ratios.max()))


def best_scale(true: Float[np.ndarray, "samples n"], modelled: Float[np.ndarray, "samples n"]) -> Scale:
    """The one factor that brings the modelled torques nearest to the true ones [N·m]."""
    factor = float(share(np.vdot(true, modelled), np.vdot(modelled, modelled)))
    return Scale(factor, float(share(np.linalg.norm(true - factor * modelled), np.linalg.norm(true))))


def _growth(
    model: DynamicsProvider, truth: DynamicsProvider, box: Box, rng: np.random.Generator
) -> tuple[Growth, Growth]:
    """Errors by speed and by distance, of the same draws but for what is scaled."""
    q, v, a = box.states(rng, _GROWTH_SAMPLES)
    u = rng.uniform(-1.0, 1.0, q.shape)
    surface = u / np.abs(u).max(axis=1, keepdims=True)
    faster = (judge(model, truth, q, s * v, a).errors for s in SPEEDS)
    farther = (judge(model, truth, box.at(r * surface), v, a).errors for r in DISTANCES)
    return Growth(SPEEDS, tuple(faster)), Growth(DISTANCES, tuple(farther))


def _along(model: DynamicsProvider, truth: DynamicsProvider, run: Run, friction: JointFriction | None) -> Errors:
    """Errors on at most some thousand states of the run, drawn without return."""
    states = run.q[:-1], run.v[:-1], accelerations(truth, run, friction)
    q, v, a = (x.reshape(-1, run.nv) for x in states)
    rows = np.random.default_rng(0).permutation(len(q))[:_RUN_STATES]
    return judge(model, truth, q[rows], v[rows], a[rows]).errors
