"""Errors of a dynamics model relative to a true one, as defined in `accuracy/relative_errors.py`."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from nbs_pin.accuracy.energy_drift import FreeMotion, free_motion
from nbs_pin.accuracy.mismatch import Mismatch, accelerations, mismatch
from nbs_pin.accuracy.relative_errors import Box, Errors, check_joints, judge, share
from nbs_pin.base.arguments import SEED, a, checked, count, maybe
from nbs_pin.base.arrays import JointArray
from nbs_pin.base.checks import PerJoint
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.records import RUN, Run
from nbs_pin.base.shown import Cells, Shown
from nbs_pin.base.units import counted
from nbs_pin.dynamics.friction import FRICTION, JointFriction
from nbs_pin.dynamics.provider import MODEL, DynamicsProvider

SPEEDS = (0.125, 0.25, 0.5, 1.0, 2.0, 4.0)
"""Multiples of the box's speed in `ModelErrors.by_speed`."""
DISTANCES = (0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 2.0)
"""Scale factors of the box in `ModelErrors.by_distance`."""
_GROWTH_SAMPLES, _RUN_STATES = 500, 5_000


class Growth(NamedTuple):
    """Errors as a function of speed, or of the distance from the centre of the box."""

    at: tuple[float, ...]
    """Multiples of the box's speed or of its size; 1 is the box itself."""
    errors: tuple[Errors, ...]
    """Errors at these multiples."""


class Scale(NamedTuple):
    """Common scale factor of all torques of a model, which free motion does not determine (docs/theory.md §6)."""

    factor: float
    """c with τ ≈ c τ̂ in least squares; 1 for a model with the correct scale."""
    error: float
    """Relative error of c τ̂, at most that of τ̂; small compared with `inverse` if only the scale is wrong."""


@dataclass(frozen=True, eq=False, repr=False)
class ModelErrors(Shown):
    """Result of `compare`; relative errors are in the Frobenius norm over the samples (0.01 is one per cent).

    Example:
        >>> import nbs_pin as nbs
        >>> truth = nbs.AnalyticDynamics()
        >>> errors = nbs.compare(nbs.AnalyticDynamics(masses=(1.1, 1.0)), truth, samples=50, motions=0)
        >>> 0.01 < errors.mass_matrix < 0.1, errors.scale.factor < 1.0
        (True, True)
    """

    mass_matrix: float
    """‖M̂ − M‖_F/‖M‖_F."""
    coriolis: float
    """Relative error of C(q, v) v."""
    gravity: float
    """Relative error of G; inf if only the model has gravity."""
    inverse: float
    """Relative error of the torque M v̇ + C v + G for uniformly distributed v̇."""
    forward: float
    """Relative error of the acceleration under the true torque for these v̇."""
    torque_nmse: float
    """Mean squared error of the torque ÷ its variance, averaged over the joints."""
    torque_rms: JointArray
    """Root mean square of the torque error per joint [N·m]."""
    torque_deviation: JointArray
    """Standard deviation of the true torque per joint [N·m]."""
    eigenvalue_margin: float
    """Smallest eigenvalue of M̂ over the samples [kg·m²]; positive for a valid model."""
    mass_ratio: tuple[float, float]
    """(lo, hi) with lo·M ⪯ M̂ ⪯ hi·M at every sample; (1, 1) for the truth."""
    energy_drift: float
    """Largest relative deviation of the true energy along free motions of the model; NaN without motions."""
    scale: Scale
    """Best common factor of all torques."""
    by_speed: Growth
    """Errors for |v_i| up to multiples of the box's speed."""
    by_distance: Growth
    """Errors on the surface of the box scaled about its centre."""
    each: Errors
    """Errors of the samples, (samples,) each, relative to the RMS size."""
    motion: FreeMotion | None
    """Free motions of both models from the same initial states, or None if `motions` was 0."""
    box: Box
    """Box from which the samples are drawn."""
    samples: int
    """Number of samples."""
    seed: int
    """Seed of the samples."""
    along_run: Errors | None = None
    """Errors over the states of the run and the true accelerations there."""
    mismatch: Mismatch | None = None
    """δ along the run and its bound (`accuracy/mismatch.py`)."""

    def _facts(self) -> Iterable[str]:
        of = {"M": self.mass_matrix, "C v": self.coriolis, "G": self.gravity, "torque": self.inverse}
        return *(f"{name} {error:.2e}" for name, error in of.items()), f"relative, {counted(self.samples, 'sample')}"

    def _cells(self) -> Cells:
        shown = {"M": "mass_matrix", "C v": "coriolis", "G": "gravity", "torque": "inverse", "acceleration": "forward"}
        rows = [(name, f"{getattr(self, key):.2e}") for name, key in shown.items()]
        return Cells(("", "relative error"), rows)

    @property
    def errors(self) -> Errors:
        """The five relative errors over the box."""
        return Errors(self.mass_matrix, self.coriolis, self.gravity, self.inverse, self.forward)


@checked(
    model=MODEL,
    truth=MODEL,
    samples=count(2, 1_000_000),
    seed=SEED,
    box=maybe(a((list, tuple, np.ndarray), "(lower, upper)")),
    run=maybe(RUN),
    motions=count(0, 100_000),
    friction=maybe(FRICTION),
)
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
    """Errors of a model relative to the truth on uniformly drawn states of a box, outside the box, and along a run.

    Args:
        speed: Largest |v_i| [rad/s, m/s], one number or one per joint.
        box: (lower, upper) [rad, m], each one number or one per joint, for instance the range of the fitted data. None
            takes the position limits of the truth's arm, at most one turn.
        run: Closed loop with the truth as plant, for `along_run` and `mismatch`. Its bound on δ extends to further
            starts only if the run has many.
        motions: Number of free motions from random states of the box; 0 skips them.
        friction: Friction of the plant of `run`, needed for v̇ along it; not part of M, C, G.

    Raises:
        ArgumentError: If numbers of joints differ, the box is empty, or the model is not finite at some sample.

    Example:
        >>> import nbs_pin as nbs
        >>> model, truth = nbs.AnalyticDynamics(masses=(1.0, 1.1)), nbs.AnalyticDynamics()
        >>> round(nbs.compare(model, truth, samples=100, motions=0).inverse, 3)
        0.075
    """
    check_joints(model, truth)
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
    """The box of `compare` for these arguments."""
    if box is None:
        return Box.of_robot(truth.robot or model.robot, truth.nv, speed)
    if np.ndim(box) == 0 or len(box) != 2:
        raise ArgumentError(f"the box has {np.size(box)} parts, expected two; give (lower, upper).")
    return Box.of(box[0], box[1], speed, truth.nv)


def _eigenvalues(modelled: np.ndarray, true: np.ndarray) -> tuple[float, tuple[float, float]]:
    """Smallest eigenvalue of M̂, and the range of the eigenvalues of M^−½ M̂ M^−½."""
    modelled = 0.5 * (modelled + np.swapaxes(modelled, -1, -2))
    root = np.linalg.inv(np.linalg.cholesky(true))
    ratios = np.linalg.eigvalsh(root @ modelled @ np.swapaxes(root, -1, -2))
    return float(np.linalg.eigvalsh(modelled).min()), (float(ratios.min()), float(ratios.max()))


def best_scale(true: Float[np.ndarray, "samples n"], modelled: Float[np.ndarray, "samples n"]) -> Scale:
    """The common factor of the modelled torques that fits the true torques best in least squares."""
    factor = float(share(np.vdot(true, modelled), np.vdot(modelled, modelled)))
    return Scale(factor, float(share(np.linalg.norm(true - factor * modelled), np.linalg.norm(true))))


def _growth(
    model: DynamicsProvider, truth: DynamicsProvider, box: Box, rng: np.random.Generator
) -> tuple[Growth, Growth]:
    """Errors by speed and by distance, from the same random draws."""
    q, v, a = box.states(rng, _GROWTH_SAMPLES)
    u = rng.uniform(-1.0, 1.0, q.shape)
    surface = u / np.abs(u).max(axis=1, keepdims=True)
    faster = (judge(model, truth, q, s * v, a).errors for s in SPEEDS)
    farther = (judge(model, truth, box.at(r * surface), v, a).errors for r in DISTANCES)
    return Growth(SPEEDS, tuple(faster)), Growth(DISTANCES, tuple(farther))


def _along(model: DynamicsProvider, truth: DynamicsProvider, run: Run, friction: JointFriction | None) -> Errors:
    """Errors on at most `_RUN_STATES` states of the run, drawn without replacement."""
    states = run.q[:-1], run.v[:-1], accelerations(truth, run, friction)
    q, v, a = (x.reshape(-1, run.nv) for x in states)
    rows = np.random.default_rng(0).permutation(len(q))[:_RUN_STATES]
    return judge(model, truth, q[rows], v[rows], a[rows]).errors
