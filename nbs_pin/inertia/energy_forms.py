"""Quadratic forms of the bodies' twists in place of their energies, for bounds of inertia that is not known exactly."""

from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Float

from nbs_pin.base.arrays import JointArray
from nbs_pin.dynamics.rigid_tree import RigidTree, cross

_RELATIVE = 0.1
"""Share of the mean that is added to the metric of `dominating`, so that it is definite for every body."""
_ROUNDING = 1e-12


@dataclass(frozen=True, eq=False)
class EnergyForms(RigidTree):
    """The joints of a tree whose bodies have the given forms in the twist (v, ω) as twice their energy."""

    source: RigidTree
    """The tree with the bodies' own energies."""
    forms: Float[np.ndarray, "n 6 6"]

    @classmethod
    def on(cls, tree: RigidTree, forms: Float[np.ndarray, "n 6 6"], armature: JointArray) -> "EnergyForms":
        """The tree with other forms and other rotor inertia, of either sign."""
        kept = {field.name: getattr(tree, field.name) for field in fields(RigidTree)} | {"armature": armature}
        return cls(**kept, source=tree, forms=forms)

    def spatial_inertia(self, i: int) -> Float[np.ndarray, "6 6"]:
        """The form of body i."""
        return self.forms[i]

    def plus(self, forms: Float[np.ndarray, "n 6 6"], armature: JointArray) -> "EnergyForms":
        """The same with forms and rotor inertia added."""
        return EnergyForms.on(self.source, self.forms + forms, self.armature + armature)

    def behind(self, i: int) -> "EnergyForms":
        """The same with the forms of the bodies that joint i moves, and no others."""
        moved = np.array([i in self.path(k) for k in range(self.nv)])
        return EnergyForms.on(self.source, np.where(moved[:, None, None], self.forms, 0.0), self.armature)


def spatial_form(pseudo: Float[np.ndarray, "g 4 4"]) -> Float[np.ndarray, "g 6 6"]:
    """Twice the kinetic energy, as a form in the twist (v, ω), of bodies with the given pseudo-inertias."""
    second, first, mass = pseudo[:, :3, :3], pseudo[:, :3, 3], pseudo[:, 3, 3]
    out = np.zeros((len(pseudo), 6, 6))
    out[:, :3, :3] = mass[:, None, None] * np.eye(3)
    out[:, :3, 3:] = -cross(first)
    out[:, 3:, :3] = cross(first)
    out[:, 3:, 3:] = np.trace(second, axis1=1, axis2=2)[:, None, None] * np.eye(3) - second
    return out


def dominating(forms: Float[np.ndarray, "g 6 6"], metric: Float[np.ndarray, "6 6"]) -> Float[np.ndarray, "6 6"]:
    """E ⪰ 0 with −E ⪯ Σ s_g F_g ⪯ E for all |s_g| ≤ 1: the sum of |F_g|, absolute values in the metric."""
    size = np.array([*[np.trace(metric[:3, :3])] * 3, *[np.trace(metric[3:, 3:])] * 3]) / 3.0
    root = np.linalg.cholesky(metric + _RELATIVE * np.diag(size + 1e-12))
    inner = np.linalg.solve(root, np.linalg.solve(root, forms).mT)
    values, vectors = np.linalg.eigh(0.5 * (inner + inner.mT))
    values = np.abs(values) + _ROUNDING * np.abs(values).max(axis=1, keepdims=True)
    absolute = root @ (vectors * values[:, None]) @ vectors.mT @ root.T
    total = absolute.sum(axis=0)
    return np.asarray(0.5 * (total + total.T))
