"""Conversion of a Pinocchio model to the rigid tree of the kernels."""

import numpy as np
import pinocchio as pin

from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.kernels.layout import Packed
from nbs_pin.kernels.tree_layout import Link, pack_tree

_TURNING = ("JointModelRX", "JointModelRY", "JointModelRZ", "JointModelRevoluteUnaligned")
_SLIDING = ("JointModelPX", "JointModelPY", "JointModelPZ", "JointModelPrismaticUnaligned")


def pack_model(model: pin.Model) -> Packed:
    """A Pinocchio model with its gravity and armature as a rigid tree for the kernels of `kernels/trees.py`.

    Raises:
        ArgumentError: If a joint is neither revolute nor prismatic, or stores its angle as two numbers.
    """
    data, links = model.createData(), []
    for i in range(1, model.njoints):
        kind = model.joints[i].shortname()
        if kind not in _TURNING + _SLIDING or model.idx_vs[i] != i - 1:
            raise ArgumentError(
                f"joint '{model.names[i]}' is a {kind}, expected a revolute or prismatic joint with one coordinate;"
                " lock it, or replace it by an unbounded revolute joint."
            )
        motion, slides = np.array(data.joints[i].S), kind in _SLIDING
        body, at, axis = model.inertias[i], model.jointPlacements[i], motion[:3] if slides else motion[3:]
        place = (model.parents[i], slides, axis, at.rotation, at.translation)
        links.append(Link(*place, body.mass, body.lever, body.inertia, float(model.armature[i - 1])))
    return pack_tree(links, model.gravity.linear)
