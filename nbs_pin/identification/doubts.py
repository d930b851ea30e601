"""What a fit makes doubtful: the unit of the torques, drives that were not to be learned, learning itself."""

from collections.abc import Mapping, Sequence

from nbs_pin.base.doors import option
from nbs_pin.identification.datasets import Dataset
from nbs_pin.identification.fit_report import NOTICED, FitReport, is_far_worse
from nbs_pin.identification.log_doubts import torque_ratio
from nbs_pin.identification.remainder import Remainder, next_try
from nbs_pin.robots.robot import Robot

_SIMULATED = 1e-6
"""Share that a URDF leaves of torques that were simulated with it, as in a comparison of networks, or less."""


def doubts(
    data: Dataset, robot: Robot | None, left: Remainder | None, asked: Mapping[str, bool | None], joints: Sequence[str]
) -> tuple[str, ...]:
    """Clauses that name what is doubtful in data and in a model fitted to them, and what to do.

    left: What the model leaves of their torques, None without torque.
    asked: The arguments friction, offset and rotor_inertia of the fit.
    """
    known = robot is None or not robot.has_bodies or "doubts" in data.about
    found = ("" if known or robot is None else _unit(data, robot), _missing(left, asked, joints))
    return tuple(text for text in found if text)


def doubts_of_report(report: FitReport) -> tuple[str, ...]:
    """The same of what the report says by itself."""
    found = (_untrained(report), _held_out(report.train_nmse, report.test_nmse), _beside_urdf(report))
    return tuple(text for text in found if text)


def _unit(data: Dataset, robot: Robot) -> str:
    """Torques that are many times those of the URDF, by the statistic of `log_doubts`."""
    ratio = torque_ratio(data, robot)
    if ratio == 1.0:
        return ""
    return (
        f"the torques are {ratio:.3g} times those of the masses in the URDF of {robot.name}: are they in mA, N·mm or "
        "another unit than N·m? convert them if so"
    )


def _missing(left: Remainder | None, asked: Mapping[str, bool | None], joints: Sequence[str]) -> str:
    """Drives that were not to be learned and would explain much of what is left."""
    if left is None or left.unexplained < NOTICED or asked.get(left.cause, True) is not False:
        return ""
    return next_try(left, joints, asked)


def _held_out(train_nmse: float, test_nmse: float | None) -> str:
    """Held-out data that are predicted far worse than the fitted ones."""
    if test_nmse is None or not is_far_worse(test_nmse, train_nmse):
        return ""
    return (
        f"{test_nmse:.2g} of the torque's variance is unexplained on held-out data, and {train_nmse:.2g} on those that "
        "were fitted: the motions are too few, or held-out ones of another kind; record longer and more various ones"
    )


def _beside_urdf(report: FitReport) -> str:
    """A network that knows less than the arm's URDF."""
    found = report.train_nmse if report.test_nmse is None else report.test_nmse
    known = None if report.stopped == "interrupted" else report.details.get("urdf_nmse")
    if known is None or not _SIMULATED < known < found or not found > NOTICED:
        return ""
    where = "fitted" if report.test_nmse is None else "held-out"
    return (
        f"the arm's own URDF with friction and rotors leaves {known:.2g} of the torque's variance on {where} data, and "
        f"what was learned {found:.2g}; {option('model', 'residual')} or {option('model', 'identified')} begins with "
        "it or its geometry"
    )


def _untrained(report: FitReport) -> str:
    """A network that was not improved though much is left to learn."""
    left = report.train_nmse if report.test_nmse is None else report.test_nmse
    if report.stopped != "no better than the start" or not left > NOTICED:
        return ""
    return (
        "the network learned nothing that holds on held-out data, and the model is the untrained one with friction; "
        "record longer and more various motions, or fit 'identified' or 'chain'"
    )
