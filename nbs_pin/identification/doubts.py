"""What a fit makes doubtful in its data: the unit of the torques, and friction that was not to be learned."""

import numpy as np

from nbs_pin.base.doors import option
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.dynamics.provider import DynamicsProvider
from nbs_pin.identification.datasets import Dataset
from nbs_pin.identification.fit_report import torque_errors
from nbs_pin.robots.robot import Robot

_SOME = 2_000
"""Samples that are looked at."""
_OTHER_UNIT = 20.0
"""Ratio of torques, measured to URDF, that wrong masses do not explain."""
_ALIKE = 0.5
"""Correlation of the two from which on they are of one motion."""
_NOTICED = 0.02
"""Unexplained share of the torque's variance of which friction is worth a word, and then half of it."""
_TRANSITION = 0.01
"""Speed scale of Coulomb friction [rad/s]."""


def doubts(
    model: DynamicsProvider, data: Dataset, friction: JointFriction | None, robot: Robot | None
) -> tuple[str, ...]:
    """Clauses that name what is doubtful and what to do."""
    some = data.take(np.sort(np.random.default_rng(0).permutation(len(data))[:_SOME]))
    found = (
        "" if robot is None or data.about.get("doubts") else _unit(some, robot),
        "" if friction is not None else _friction(model, some),
    )
    return tuple(text for text in found if text)


def _unit(data: Dataset, robot: Robot) -> str:
    """Torques that are many times those of the URDF: the median over the joints, each by least squares."""
    stated = PinocchioDynamics(robot).reference_torque(data.q, data.v, data.v, data.a)
    size, alike = (np.square(x).sum(axis=0) for x in (stated, data.tau))
    product, known = (stated * data.tau).sum(axis=0), (size > 1e-12 * size.max()) & (alike > 0.0)
    if not known.any() or np.median(product[known] / np.sqrt(size[known] * alike[known])) < _ALIKE:
        return ""
    ratio = float(np.median(product[known] / size[known]))
    if 1.0 / _OTHER_UNIT < ratio < _OTHER_UNIT:
        return ""
    return (
        f"the torques are {ratio:.3g} times those of the masses in the URDF of {robot.name}: are they in mA, N·mm or "
        "another unit than N·m? convert them if so"
    )


def _friction(model: DynamicsProvider, data: Dataset) -> str:
    """Friction that would explain most of what is left."""
    left, variance = -torque_errors(model, data), data.tau.var(axis=0)
    if not (variance > 0.0).any():
        return ""
    varies = variance > 1e-12 * variance.max()
    explained = np.zeros(data.nv)
    for i in np.flatnonzero(varies):
        kinds = np.column_stack([data.v[:, i], np.tanh(data.v[:, i] / _TRANSITION)])
        explained[i] = (
            np.square(left[:, i]).mean()
            - np.square(left[:, i] - kinds @ np.linalg.lstsq(kinds, left[:, i], rcond=None)[0]).mean()
        )
    share = float((explained[varies] / variance[varies]).mean())
    total = float((np.square(left).mean(axis=0)[varies] / variance[varies]).mean())
    if total < _NOTICED or share < 0.5 * total:
        return ""
    return (
        f"{total:.1%} of the torque's variance is unexplained, most of which friction would explain; give "
        f"{option('friction', True)} to learn it too"
    )
