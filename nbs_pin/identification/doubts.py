"""What a fit makes doubtful: the unit of the torques, drives that were not to be learned, learning itself."""

from collections.abc import Mapping

import numpy as np

from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.dynamics.provider import DynamicsProvider
from nbs_pin.identification.datasets import Dataset
from nbs_pin.identification.fit_report import FitReport
from nbs_pin.identification.remainder import next_try, remainder
from nbs_pin.robots.robot import Robot

_SOME = 2_000
"""Samples that are looked at."""
_OTHER_UNIT = 20.0
"""Ratio of torques, measured to URDF, that wrong masses do not explain."""
_ALIKE = 0.5
"""Correlation of the two from which on they are of one motion."""
_NOTICED = 0.02
"""Unexplained share of the torque's variance that is worth a word."""
_WORSE = 5.0
"""Ratio of the unexplained share on held-out data to that on fitted ones that is worth a word."""


def doubts(
    model: DynamicsProvider,
    data: Dataset,
    friction: JointFriction | None,
    robot: Robot | None,
    asked: Mapping[str, bool | None],
) -> tuple[str, ...]:
    """Clauses that name what is doubtful in a model fitted to the data and what to do.

    `asked` holds the arguments friction, offset and rotor_inertia of the fit.
    """
    some = data.take(np.sort(np.random.default_rng(0).permutation(len(data))[:_SOME]))
    found = (
        "" if robot is None or not robot.has_bodies or data.about.get("doubts") else _unit(some, robot),
        _missing(model, some, friction, asked, robot),
    )
    return tuple(text for text in found if text)


def doubts_of_report(report: FitReport) -> tuple[str, ...]:
    """The same of what the report says by itself."""
    found = (_untrained(report), _held_out(report.train_nmse, report.test_nmse))
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


def _missing(
    model: DynamicsProvider,
    data: Dataset,
    friction: JointFriction | None,
    asked: Mapping[str, bool | None],
    robot: Robot | None,
) -> str:
    """Drives that were not to be learned and would explain much of what is left."""
    if not data.tau.std(axis=0).any():
        return ""
    found = remainder(model, data, friction)
    names = tuple(f"joint {i + 1}" for i in range(data.nv)) if robot is None else robot.joint_names
    left_out = asked.get(found.cause, True) is False
    return next_try(found, names, asked) if left_out and found.unexplained >= _NOTICED else ""


def _held_out(train_nmse: float, test_nmse: float | None) -> str:
    """Held-out data that are predicted far worse than the fitted ones."""
    if test_nmse is None or not test_nmse > max(_WORSE * train_nmse, _NOTICED):
        return ""
    return (
        f"{test_nmse:.2g} of the torque's variance is unexplained on held-out data, and {train_nmse:.2g} on those that "
        "were fitted: the motions are too few, or held-out ones of another kind; record longer and more various ones"
    )


def _untrained(report: FitReport) -> str:
    """A network that was not improved though much is left to learn."""
    left = report.train_nmse if report.test_nmse is None else report.test_nmse
    if report.stopped != "no better than the start" or not left > _NOTICED:
        return ""
    return (
        "the network learned nothing that holds on held-out data, and the model is the untrained one with friction; "
        "record longer and more various motions, or fit 'identified' or 'chain'"
    )
