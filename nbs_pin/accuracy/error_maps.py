"""The errors of a model over two joints of an arm."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from nbs_pin.accuracy.relative_errors import Box, Errors, judge
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.dynamics.provider import DynamicsProvider


class ErrorMap(NamedTuple):
    """Errors over two joints, all else drawn from the box."""

    joints: tuple[int, int]
    """Indices of the joints across and up."""
    x: Float[np.ndarray, " points"]
    """Configurations of the first [rad]."""
    y: Float[np.ndarray, " points"]
    """Configurations of the second [rad]."""
    errors: Errors
    """(points, points) each, row k at y[k]: RMS over the draws, as a share of the RMS size over the whole map."""


def error_map(
    model: DynamicsProvider,
    truth: DynamicsProvider,
    box: Box,
    joints: tuple[int, int],
    *,
    points: int = 25,
    draws: int = 8,
    seed: int = 1,
) -> ErrorMap:
    """The errors on a grid of points × points over two joints, the same few draws of all else in every cell.

    joints: indices from 0. Raises ArgumentError for joints that the arm does not have, or one joint twice.
    """
    i, j = joints
    if i == j or not {i, j} <= set(range(truth.nv)):
        raise ArgumentError(f"joints {joints} were given, expected two different ones of 0 to {truth.nv - 1}.")
    q, v, a = (np.tile(x, (points * points, 1)) for x in box.states(np.random.default_rng(seed), draws))
    x, y = (np.linspace(box.lower[k], box.upper[k], points) for k in joints)
    q[:, i], q[:, j] = (np.repeat(grid.ravel(), draws) for grid in np.meshgrid(x, y))
    each = judge(model, truth, q, v, a).each
    cells = (np.sqrt(np.mean(np.reshape(e, (points, points, draws)) ** 2, axis=-1)) for e in each)
    return ErrorMap((i, j), x, y, Errors(*cells))


def telling_joints(
    model: DynamicsProvider, truth: DynamicsProvider, box: Box, *, samples: int = 2_000, seed: int = 1
) -> tuple[int, int]:
    """The two joints over which the error of the torque varies most, in order: what an `error_map` should show.

    By the variance between the means over eight parts of each joint's range. Raises ArgumentError for a single joint.
    """
    if truth.nv < 2:
        raise ArgumentError("an arm of one joint was given, and a map needs two; look at the errors by distance.")
    q, v, a = box.states(np.random.default_rng(seed), samples)
    error = np.square(judge(model, truth, q, v, a).each.inverse)
    means = [[part.mean() for part in np.array_split(error[order], 8)] for order in np.argsort(q, axis=0).T]
    first, second = sorted(np.argsort(-np.var(means, axis=1), kind="stable")[:2].tolist())
    return first, second
