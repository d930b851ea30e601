"""The Pinocchio model of a checked description."""

import xml.etree.ElementTree as ET

import numpy as np
import pinocchio as pin

from nbs_pin.base.doors import option
from nbs_pin.base.exceptions import RobotError
from nbs_pin.robots.mass_matrix import weak_joints
from nbs_pin.robots.urdf import Urdf
from nbs_pin.robots.urdf_checks import lock_too
from nbs_pin.robots.urdf_options import UrdfOptions


def build_model(urdf: Urdf) -> pin.Model:
    """The Pinocchio model with limits and armature of `urdf.joints`; raises RobotError if it cannot be built."""
    try:
        model = pin.buildModelFromXML(urdf.without_geometry().decode())
    except (ValueError, RuntimeError) as error:
        raise RobotError(f"{urdf.path}: Pinocchio cannot build it ({error}); simplify the file.") from error
    by_name = {joint.name: joint for joint in urdf.joints}
    model.armature = np.array([by_name[name].armature for name in model.names[1:]])
    return with_limits(model, urdf)


def with_limits(model: pin.Model, urdf: Urdf) -> pin.Model:
    """The model, its limits set to those of `urdf.joints`."""
    by_name = {joint.name: joint for joint in urdf.joints}
    joints = [by_name[name] for name in model.names[1:]]
    effort, velocity = (np.array([getattr(joint, key) for joint in joints]) for key in ("effort", "velocity"))
    model.lowerPositionLimit = np.array([joint.lower for joint in joints])
    model.upperPositionLimit = np.array([joint.upper for joint in joints])
    model.lowerEffortLimit, model.upperEffortLimit = -effort, effort
    model.lowerVelocityLimit, model.upperVelocityLimit = -velocity, velocity
    return model


def check_inertia(urdf: Urdf, model: pin.Model, options: UrdfOptions) -> None:
    """Raise RobotError unless M(q) ≻ 0 in every pose within the limits."""
    names, problem = weak_joints(model, model.lowerPositionLimit, model.upperPositionLimit)
    if not names:
        return
    joints = ET.fromstring(urdf.xml).findall("joint")
    own = next((joint for joint in joints if joint.get("name") == names[0]), None)
    unsaid = own is not None and own.find("axis") is None
    problem += "; it states no <axis>, which URDF reads as 1 0 0" if unsaid else ""
    remedy = f"{'add <axis xyz=…>, ' if unsaid else ''}give the links behind it inertia about its axis"
    rest = f"lock it ({lock_too(options, names)}), or learn all bodies from a log ({option('inertia_from', 'links')})"
    raise RobotError(f"{urdf.path}: joint '{names[0]}': {problem}; {remedy}, {rest}.")
