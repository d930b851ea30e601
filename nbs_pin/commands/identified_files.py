"""Files of identified bodies: their numbers with standard deviations, and descriptions of an arm that has them."""

import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from nbs_pin.base.csv_files import write_csv
from nbs_pin.base.units import units_of
from nbs_pin.dynamics.coupled import CoupledDynamics
from nbs_pin.dynamics.identified import IdentifiedDynamics
from nbs_pin.dynamics.pseudo_inertia import PARAMETER_NAMES, PARAMETER_UNITS
from nbs_pin.robots.robot import load_robot
from nbs_pin.simulation.mujoco_plant import MujocoPlant

FILES = ("parameters.csv", "model.urdf", "model.xml")
"""The files; URDF and MJCF cannot hold coupled drives."""
_HEAD = ("joint", "parameter", "unit", "value", "standard deviation", "urdf")
_OF_DRIVE = {"viscous": "damping", "asymmetry": "damping", "rotor": "inertia", "load": ""}
"""Quantities of the terms of drives (`JointUnits`), empty for none; all others are torques."""


def write_identified(model: IdentifiedDynamics, folder: Path) -> None:
    """Write them into a folder; the model is one that `fit` made."""
    write_csv(folder / FILES[0], _HEAD, list(_rows(model)))
    if not isinstance(model, CoupledDynamics):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that URDF has fewer terms of friction; the table has them all
            urdf = model.write_urdf(folder / FILES[1])
            arm = load_robot(urdf, gravity=model.robot.gravity_vector.tolist(), zero_limits="unlimited")
            MujocoPlant(arm, joint_friction="keep").write_mjcf(folder / FILES[2])


def _rows(model: IdentifiedDynamics) -> Iterator[tuple[Any, ...]]:
    """Rows of the table: ten for every body, then one for every number of the drives."""
    robot, details = model.robot, model.report.details
    for i, joint in enumerate(robot.joint_names):
        stated = robot.model.inertias[i + 1].toDynamicParameters() if robot.has_bodies else [""] * len(PARAMETER_UNITS)
        columns = (PARAMETER_NAMES, PARAMETER_UNITS, model.parameters[i], details["parameter_deviations"][i], stated)
        for row in zip(*columns, strict=True):
            yield joint, *row
    rotors = model.motor_inertia if isinstance(model, CoupledDynamics) else model.rotor_inertia
    joints = units_of(joint.prismatic for joint in robot.joints)
    for name, deviations in details["drive_deviations"].items():
        for j in (int(k) for k in np.flatnonzero(deviations)):
            value = rotors[j] if name == "rotor" else getattr(model.friction, name)[j]
            quantity = _OF_DRIVE.get(name, "torque")
            unit = getattr(joints[j], quantity) if quantity else ""
            yield robot.joint_names[j], name, unit, value, deviations[j], ""
