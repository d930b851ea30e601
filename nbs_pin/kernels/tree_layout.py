"""How a rigid tree is packed for the kernels of `trees.py`: every joint's axis is the z axis of its body's frame.

A joint is R₀Rz(q) and p when it turns, R₀ and p + q R₀z when it slides. A body is m, h = Σ m x and E = Σ m xxᵀ about
its frame's origin.

    tree layout     n, then per joint: parent (0 is the base, i + 1 the body of joint i), its `JointCode`
    tree weights    −gravity (3), then per joint: R₀ (9), p (3), m, h (3), E (xx, xy, xz, yy, yz, zz), armature
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.kernels.layout import JointCode, Packed

TREE_SIZE, TREE_JOINTS, PER_JOINT = 0, 1, 2
"""Where n lies in the layout and where the joints begin, and numbers in the layout for each of them."""
BODY, ROW, BASE = 23, 67, 3
"""Numbers per joint in the weights and in the scratch space, and before the first joint in the weights."""
PLACE, MASS, FIRST, SECOND, ARMATURE = 9, 12, 13, 16, 22
"""Where p, m, h, E and the armature of a joint's body lie, after R₀ (at 0)."""


class Link(NamedTuple):
    """A joint and the body behind it, in the body's own frame, which is the parent's frame times the joint."""

    parent: int
    """0 is the base, i + 1 the body of link i; a parent comes before its children."""
    prismatic: bool
    axis: np.ndarray
    """(3,), not zero; its length does not matter."""
    rotation: np.ndarray
    """(3, 3), of the joint at q = 0 in the parent's frame."""
    position: np.ndarray
    """(3,) [m]."""
    mass: float
    """[kg]."""
    centre: np.ndarray
    """(3,), centre of mass [m]."""
    inertia: np.ndarray
    """(3, 3), about the centre of mass [kg·m²]."""
    armature: float = 0.0
    """Inertia of the rotor [kg·m², kg]."""


def pack_tree(links: Sequence[Link], gravity: np.ndarray) -> Packed:
    """The tree for the kernels of `trees.py`.

    Args:
        links: joints and bodies, parents first.
        gravity: its acceleration in the base frame, (3,) [m/s²].

    Raises:
        ArgumentError: when a parent does not come before its child.
    """
    layout, weights, frames = [len(links)], [-np.asarray(gravity)], [np.eye(3)]
    for i, link in enumerate(links):
        if not 0 <= link.parent <= i:
            raise ArgumentError(f"link {i} has parent {link.parent}; give links with parents first, 0 for the base.")
        frame, parent = frame_along(link.axis), frames[link.parent]
        frames.append(frame)
        rotation, position = parent.T @ link.rotation @ frame, parent.T @ link.position
        centre, inertia = frame.T @ link.centre, frame.T @ link.inertia @ frame
        second = 0.5 * np.trace(inertia) * np.eye(3) - inertia + link.mass * np.outer(centre, centre)
        moments = [[link.mass], link.mass * centre, second[np.triu_indices(3)], [link.armature]]
        layout += [link.parent, JointCode.PRISMATIC if link.prismatic else JointCode.REVOLUTE]
        weights += [rotation.ravel(), position, *moments]
    return Packed(np.array(layout, dtype=np.int64), np.concatenate(weights).astype(float))


def tree_workspace(part: Packed) -> int:
    """Size of the scratch space that each kernel of a tree needs."""
    n = int(part.layout[TREE_SIZE])
    return (n + 1) * ROW + 2 * n


def frame_along(axis: np.ndarray) -> np.ndarray:
    """A rotation that takes z to the direction of the axis."""
    z = np.asarray(axis) / np.linalg.norm(axis)
    x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])
