"""Maps of the errors of a model over the positions of two joints."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from nbs_pin.accuracy.relative_errors import Box, Errors, judge
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.dynamics.provider import DynamicsProvider


class ErrorMap(NamedTuple):
    """Errors over the positions of two joints, with the rest of the state drawn from the box."""

    joints: tuple[int, int]
    """Indices of the joints on the horizontal and vertical axis."""
    x: Float[np.ndarray, " points"]
    """Positions of the first joint [rad]."""
    y: Float[np.ndarray, " points"]
    """Positions of the second joint [rad]."""
    errors: Errors
    """(points, points) each, row k at y[k]: RMS over the draws, relative to the RMS size over the whole map."""


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
    """Errors on a grid of points × points over two joints, with the same draws of the other states in every cell.

    Raises:
        ArgumentError: If a joint index, from 0, does not exist or is given twice.
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
    """The two joints with which the torque error varies most, in ascending order, for an `error_map`.

    The criterion is the variance of its means over eight parts of each joint's range.

    Raises:
        ArgumentError: If the arm has a single joint.
    """
    if truth.nv < 2:
        raise ArgumentError("the arm has one joint, but an error map needs two; use `ModelErrors.by_distance`.")
    q, v, a = box.states(np.random.default_rng(seed), samples)
    error = np.square(judge(model, truth, q, v, a).each.inverse)
    means = [[part.mean() for part in np.array_split(error[order], 8)] for order in np.argsort(q, axis=0).T]
    first, second = sorted(np.argsort(-np.var(means, axis=1), kind="stable")[:2].tolist())
    return first, second
