"""Identification of the inertial parameters and friction of an arm whose geometry is known.

The torque is linear in them (`regressor`) and depends only on some directions, the base parameters. The others are
chosen such that every body is physically consistent (`consistent_fit`).
"""

import numpy as np

from nbs_pin.base.arguments import checked, flag, maybe, number
from nbs_pin.base.doors import in_words
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.units import percent
from nbs_pin.dynamics.coupled import CoupledDynamics
from nbs_pin.dynamics.identified import IdentifiedDynamics
from nbs_pin.dynamics.pseudo_inertia import inertial_parameters
from nbs_pin.identification.compatibility import arm_fault
from nbs_pin.identification.consistent_fit import consistent_fit
from nbs_pin.identification.coupling import Given, geometry_of, in_motors, settled
from nbs_pin.identification.datasets import DATA, Dataset
from nbs_pin.identification.drive_choice import Wanted
from nbs_pin.identification.drive_terms import DriveTerms
from nbs_pin.identification.explain import explain, nmse, weighted
from nbs_pin.identification.regressor import (
    RobotGeometry,
    equation_rows,
    expectation,
    of_all_joints,
    torque_size,
    triangle,
)
from nbs_pin.robots.robot import ARM, Robot

_SOME, _PRIOR = 1_000, 0.3
"""Samples that decide on the signs of torques; γ of these fits."""
_WELL = 0.02
"""Unexplained share of the torque's variance below which its signs are not doubted."""


@checked(
    data=DATA,
    robot=ARM,
    friction=maybe(flag),
    offset=maybe(flag),
    rotor_inertia=maybe(flag),
    transition=number(above=0.0, unit="rad/s"),
    regularisation=number(least=1e-30, most=1e30, unit="measurements"),
)
def identify(
    data: Dataset,
    robot: Robot,
    *,
    friction: bool | None = None,
    offset: bool | None = None,
    rotor_inertia: bool | None = None,
    coupling: Given = None,
    transition: float = 0.01,
    regularisation: float = 0.3,
) -> IdentifiedDynamics:
    """Find the physically consistent inertial parameters that explain the data best; `report` tells how well.

    Geometry and gravity are the robot's; its inertias are not used. Least squares weighted by each joint's noise, which
    is estimated from the residual, is followed by the same over physically consistent bodies (`consistent_fit`). Clean
    data give M, C and G to rounding. Where physical bodies leave far more than that noise, joints are weighted by their
    torque, so that the model is never worse than none on the data it is fitted to, in the mean over joints.

    Args:
        data: Samples with torque, at least two equations per base parameter.
        robot: The arm of the data.
        friction: None finds for every joint the friction that its data show (`drive_choice`): none, Coulomb, viscous,
            unlike in both directions, higher at low speed (Stribeck), growing with the load. True finds viscous and
            Coulomb coefficients of every joint, False none.
        offset: Find a constant torque of every joint, or of none; None of those whose data show one.
        rotor_inertia: Find the rotor inertia of every joint, or of none; None does so if the robot has any
            (`Robot.armature`), otherwise of joints whose data show one.
        coupling: N of drives that are coupled, row k for how motor k turns with every joint; the result is then of
            `CoupledDynamics`. None looks for neighbours that are, and warns if there are some; False is none. Data with
            the torques of the motors are converted to those of the joints.
        transition: Speed scale of the Coulomb friction [rad/s] (`JointFriction`).
        regularisation: γ, the number of measurements that the prior is worth: homogeneous balls along the links,
            lighter towards the tip, with masses that give torques of the recorded size; it matters if data are scarce.

    Raises:
        ArgumentError: If the data have another joint tree or are of another arm (`compatibility.py`), have fewer than
            two equations per base parameter or no torque, which inertias of every scale explain, if the torque of a
            joint has the wrong sign (`sign_fault`), or if the arm neither moves nor carries weight.

    Example:
        >>> import nbs_pin as nbs
        >>> robot = nbs.load_robot("two_link")
        >>> report = nbs.identify(nbs.collect(robot, "uniform", samples=100), robot).report
        >>> report.base_parameters, report.excited, report.unidentifiable
        (6, 6, ())
    """
    _check_arm(data, robot)
    wanted = Wanted(friction, offset, rotors_wanted(rotor_inertia, robot), transition)
    fault = sign_fault(data, robot)
    if fault:
        raise ArgumentError(f"{in_words(data, 'the data')}: {fault}.")
    data, coupled = settled(data, robot, coupling, wanted)
    bodies = explain(geometry_of(RobotGeometry(robot), coupled), in_motors(data, coupled), wanted, regularisation)
    parameters = inertial_parameters(bodies.factors @ bodies.factors.swapaxes(1, 2))
    if coupled is not None:
        drag = bodies.terms.friction(bodies.scalars, coupled.matrix)
        return CoupledDynamics(robot, parameters, coupled.matrix, drag, bodies.rotors, bodies.report)
    return IdentifiedDynamics(robot, parameters, bodies.friction, bodies.rotors, bodies.report)


def rotors_wanted(given: bool | None, robot: Robot | None) -> bool | None:
    """Whether rotor inertias are to be found: as given, or of every joint of a robot that states some."""
    stated = robot is not None and bool(robot.armature.any())
    return True if given is None and stated else given


def sign_fault(data: Dataset, robot: Robot) -> str:
    """Whether the torque of a joint, or of all, has the wrong sign, as a clause for an error message, or "".

    Friction and physical bodies in the arm's geometry are fitted to some of the samples, with signs as they are and
    reversed: of one joint or of all, then of a further one, as long as that halves what is unexplained. The data are
    at fault if a tenth or less remains.
    """
    some = data.take(np.sort(np.random.default_rng(0).permutation(len(data))[:_SOME]))
    geometry, rotors = RobotGeometry(robot), ("rotor",) if robot.armature.any() else ()
    factors = DriveTerms.of(data.nv, "viscous", "coulomb", *rotors).factors(some)
    triangles = of_all_joints(triangle(equation_rows(geometry, some, factors)))
    equations = expectation(geometry, len(some), factors, triangles).in_units(triangles)
    size, n = torque_size(equations, len(some)), data.nv

    def unexplained(signs: np.ndarray) -> float:
        turned = equations.copy()
        turned[:, :, -1] *= signs[:, None]
        fit = consistent_fit(*weighted(turned, size), n, _PRIOR)
        return nmse(turned, fit, some)

    stated = best = unexplained(np.ones(n))
    signs, tries = np.ones(n), [*(1.0 - 2.0 * np.eye(n)), -np.ones(n)]
    while best > _WELL:
        left, found = min(((unexplained(signs * turn), k) for k, turn in enumerate(tries)), key=lambda x: x[0])
        if left > 0.5 * best:
            break
        best, signs = left, signs * tries[found]
    if best > 0.1 * stated or (signs > 0.0).all():
        return ""
    wrong = [name for name, sign in zip(robot.joint_names, signs, strict=True) if sign < 0.0]
    all_wrong = len(wrong) == n
    which = "every joint" if all_wrong else " and ".join(wrong)
    return (
        f"sign of tau of {which}? {_percent(stated)} of the torque's variance is unexplained, and with the sign "
        f"reversed {_percent(best)}; reverse it{', or gravity if the arm hangs' if all_wrong else ''}"
    )


def _percent(share: float) -> str:
    return percent(share, 2 if share < 0.1 else 0)


def _check_arm(data: Dataset, robot: Robot) -> None:
    """Raise ArgumentError unless the data have the joints of the robot and some torque."""
    fault = arm_fault(data, robot)
    if fault:
        raise ArgumentError(f"{fault}.")
    if not data.tau.any():
        raise ArgumentError(
            f"{in_words(data, 'the data')} has no torque: inertias of every scale explain such a motion; "
            "record torques."
        )
