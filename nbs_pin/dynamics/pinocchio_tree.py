"""Conversion of a Pinocchio model to the rigid tree of the kernels."""

import numpy as np
import pinocchio as pin

from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.kernels.layout import Packed
from nbs_pin.kernels.tree_layout import Link, frame_along, pack_tree

_TURNING = ("JointModelRX", "JointModelRY", "JointModelRZ", "JointModelRevoluteUnaligned")
_SLIDING = ("JointModelPX", "JointModelPY", "JointModelPZ", "JointModelPrismaticUnaligned")


def pack_model(model: pin.Model) -> Packed:
    """A Pinocchio model with its gravity and armature as a rigid tree for the kernels of `kernels/trees.py`.

    Raises:
        ArgumentError: If a joint is neither revolute nor prismatic, or stores its angle as two numbers.
    """
    axes, links = _axes(model), []
    for i in range(1, model.njoints):
        kind = model.joints[i].shortname()
        if kind not in _TURNING + _SLIDING or model.idx_vs[i] != i - 1:
            raise ArgumentError(
                f"joint '{model.names[i]}' is a {kind}, expected a revolute or prismatic joint with one coordinate;"
                " lock it, or replace it by an unbounded revolute joint."
            )
        body, at = model.inertias[i], model.jointPlacements[i]
        place = (model.parents[i], kind in _SLIDING, axes[i - 1], at.rotation, at.translation)
        links.append(Link(*place, body.mass, body.lever, body.inertia, float(model.armature[i - 1])))
    return pack_tree(links, model.gravity.linear)


def tree_frames(model: pin.Model) -> np.ndarray:
    """R (n, 3, 3) of every body's frame in the tree, whose z is the joint's axis, in Pinocchio's frame of the joint."""
    return np.array([frame_along(axis) for axis in _axes(model)])


def _axes(model: pin.Model) -> list[np.ndarray]:
    """The axis of every joint in its own frame."""
    data = model.createData()
    motions = [np.array(data.joints[i].S) for i in range(1, model.njoints)]
    kinds = [model.joints[i].shortname() for i in range(1, model.njoints)]
    return [motion[:3] if kind in _SLIDING else motion[3:] for motion, kind in zip(motions, kinds, strict=True)]
