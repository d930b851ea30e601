"""What a motion has shown of the unknowns of an adaptive law: how far estimates may be off, and along what.

Feedback makes up for wrong estimates: along a motion that is followed, its torque f is the Y(π̂ − π) that they are
wrong by. In the interval of every unknown as its unit, F = mean over instants and joints of YᵢᵀYᵢ/f̄ᵢ², f̄ᵢ the RMS of
fᵢ, says how much more than f a change of the estimates would show, and (F + 1)⁻¹ is like a covariance, with the width
of the interval for what the motion does not show. Over a motion the errors of a model do not average out as noise does,
so that instants do not add up.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from nbs_pin.base.arrays import Array
from nbs_pin.base.records import Run
from nbs_pin.base.shown import mixture
from nbs_pin.controllers.adapting_model import AdaptingModel
from nbs_pin.controllers.model_law import ModelLaw
from nbs_pin.controllers.passive_outputs import Output, feedback_of, signals_of
from nbs_pin.controllers.unknowns import UPPER, Unknowns
from nbs_pin.dynamics.pseudo_inertia import inertial_parameters
from nbs_pin.dynamics.rigid_tree import RigidTree

_INSTANTS = 2000
_SILENT = 1e-6  # of the largest feedback, below which that of a joint is rounding
_WEIGHTS = np.where(UPPER[0] == UPPER[1], 1.0, np.sqrt(2.0))  # so that triangles have the norm of their matrices


class Excitation(NamedTuple):
    """What a motion has shown."""

    deviation: Float[np.ndarray, " k"]
    """How far every value of `Estimate.values` may be off, like a standard deviation, in its own unit."""
    unexcited: tuple[str, ...]
    """Directions along which the whole interval would not show, in words."""


def excitation(
    law: ModelLaw, output: Output, unknowns: Unknowns, tree: RigidTree, gravity: np.ndarray, run: Run, names: list[str]
) -> Excitation:
    """What the second half of a run has shown; names of the values."""
    rows = np.unique(np.linspace(len(run.t) // 2, len(run.t) - 1, _INSTANTS).astype(int))
    given = tuple(x[rows] for x in (run.q, run.v, run.q_ref, run.v_ref, run.a_ref))
    q, v, *aim = given
    v_r, a_r, _ = signals_of(law, output, q, v, *aim)
    now = AdaptingModel.of(unknowns, tree, gravity, np.tile(unknowns.start, (len(rows), 1)), q, v, v_r, a_r)
    shown = np.stack([_row(now, np.tile(unit, (len(rows), 1))) for unit in np.eye(law.nv)], axis=1)
    size = np.sqrt(np.square(feedback_of(law, q, v, *aim)).mean(axis=0))
    size = np.maximum(size, max(_SILENT * float(size.max()), np.finfo(float).tiny))
    shown = (shown / size[:, None]).reshape(-1, shown.shape[-1])
    information = shown.T @ shown / len(shown)
    to_values = _to_values(unknowns)
    values, directions = np.linalg.eigh(information)
    told = to_values @ directions
    deviation = np.linalg.norm(told / np.sqrt(1.0 + np.clip(values, 0.0, None)), axis=1)
    weak = (told[:, values <= 1.0] / np.linalg.norm(to_values, axis=1)[:, None]).T
    plain = [name.rpartition(" [")[0] for name in names]
    return Excitation(deviation, tuple(mixture(x, plain) for x in weak))


def _row(now: AdaptingModel, mu: Array) -> Array:
    """The derivatives of μᵀτ by all shares (rows, m)."""
    slopes = now.slopes(mu)
    bodies = slopes.bodies[..., UPPER[0], UPPER[1]] * _WEIGHTS
    return np.concatenate([bodies.reshape(len(mu), -1), slopes.numbers], axis=-1)


def _to_values(unknowns: Unknowns) -> Float[np.ndarray, "k m"]:
    """The matrix from changes of the shares to those of the values."""
    found = np.zeros((10 * len(unknowns.bodies) + len(unknowns.numbers),) * 2)
    basis = np.zeros((10, 4, 4))
    basis[np.arange(10), UPPER[0], UPPER[1]] = basis[np.arange(10), UPPER[1], UPPER[0]] = 1.0 / _WEIGHTS
    for k, body in enumerate(unknowns.bodies):
        told = np.linalg.inv(body.place) @ body.factor
        found[10 * k : 10 * k + 10, 10 * k : 10 * k + 10] = inertial_parameters(told @ basis @ told.T).T
    for k, one in enumerate(unknowns.numbers, start=10 * len(unknowns.bodies)):
        found[k, k] = one.width
    return found
