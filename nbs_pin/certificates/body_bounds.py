"""Bounds, over all poses, of what errors of the bodies do to M, C and G (docs/certificates.md §14)."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pinocchio as pin
from jaxtyping import Float

from nbs_pin.base.arrays import JointArray
from nbs_pin.base.rounding import down, up
from nbs_pin.certificates.constants import Constants
from nbs_pin.certificates.loads import longest_levers
from nbs_pin.certificates.uncertainty import BodyErrors
from nbs_pin.dynamics.rigid_tree import RigidTree
from nbs_pin.inertia.energy_forms import EnergyForms, dominating, spatial_form
from nbs_pin.inertia.multipliers import largest_by_multipliers, least_by_multipliers, signed_least_by_multipliers
from nbs_pin.robots.robot import Robot

_OUTWARD = 1.0 + 1e-9
_SHARES_OF_MODEL = (1e-3, 1e-2)
"""Shares of the model's energy that are added to E where E alone is bounded."""


@dataclass(frozen=True, eq=False)
class BodyBounds:
    """Constants for −E ⪯ M̂ − M ⪯ E, with E(q) the energy of a dominating form per body, in every pose."""

    tree: RigidTree
    """The model's bodies."""
    errors: EnergyForms
    """E."""
    floor: Float[np.ndarray, "n n"]
    """D₀."""
    whole: tuple[float, float]
    """e and f with E(q) ⪯ e D₀ [s] and E(q) ⪯ f Λ⁻¹ [1/s]."""
    damped: JointArray
    """e_k with the same for the bodies that joint k moves [s]."""
    rated: JointArray
    """f_k with the same for these [1/s]."""
    degree: JointArray
    """g_k with |∂_k p| ≤ g_k max|p| for p = xᵀΔMy: 2 for a joint that turns, 8 ÷ travel for one that slides, 0 for
    joints that ΔM does not depend on [1/rad, 1/m]."""
    weight: JointArray
    """Largest |ΔG_i| [N·m]."""
    model: tuple[float, float]
    """e and f of M̂ itself."""
    model_behind: tuple[JointArray, JointArray]
    """e_k and f_k of M̂."""

    @classmethod
    def of(cls, robot: Robot, tree: RigidTree, errors: BodyErrors, constants: Constants) -> "BodyBounds":
        """The bounds of the errors of a model with the given tree."""
        forms, turned = np.zeros((tree.nv, 6, 6)), _frames(robot.model, tree)
        for i in range(tree.nv):
            own, turn = errors.body == i, np.eye(4)
            turn[:3, :3] = turned[i]
            if own.any():
                forms[i] = dominating(spatial_form(turn.T @ errors.pseudo[own] @ turn), tree.spatial_inertia(i))
        energy = EnergyForms.on(tree, forms, np.zeros(tree.nv))
        moves = ~tree.absent & np.array([energy.behind(k).forms.any() for k in range(tree.nv)])
        travel = np.where(tree.prismatic, tree.upper - tree.lower, 4.0)
        floor, degree, weight = constants.floor, np.where(moves, 8.0 / travel, 0.0), _weights(robot, tree, errors)
        metrics = floor, np.diag(1.0 / constants.rate)
        whole = tuple(_largest(energy, w) for w in metrics)
        damped, rated = (_behind(energy, w, most) for w, most in zip(metrics, whole, strict=True))
        model = tuple(up(largest_by_multipliers(tree, w).value) for w in metrics)
        own = EnergyForms.on(tree, np.array([tree.spatial_inertia(i) for i in range(tree.nv)]), 0.0 * tree.armature)
        parts = tuple(_behind(own, w, most) for w, most in zip(metrics, model, strict=True))
        ends = (model[0], model[1]), (parts[0], parts[1])
        return cls(tree, energy, floor, (whole[0], whole[1]), damped, rated, degree, weight, *ends)

    @property
    def model_degree(self) -> JointArray:
        """g_k of M̂: 0 for joints that it does not depend on."""
        travel = np.where(self.tree.prismatic, self.tree.upper - self.tree.lower, 4.0)
        return np.where(self.tree.absent, 0.0, 8.0 / travel)

    @property
    def tilts(self) -> JointArray:
        """h_k with |∂_k ΔG_i| ≤ h_k max|ΔG_i|: 1 for a joint that turns, 2 ÷ travel for one that slides."""
        return np.where(self.tree.prismatic, 2.0 / (self.tree.upper - self.tree.lower), 1.0)

    @cached_property
    def kappa(self) -> float:
        """κ of the true arm: 1/κ ≥ λ(D₀^-½(M̂ + E)D₀^-½) in every pose [1/s]; 0 if no bound is found."""
        return 1.0 / up(largest_by_multipliers(self._with(1.0, 1.0), self.floor).value)

    @cached_property
    def nu(self) -> float:
        """ν of the true arm: 1/ν ≤ λ(D₀^-½(M̂ − E)D₀^-½) in every pose [1/s]; inf if no bound is found."""
        least = down(least_by_multipliers(self._with(1.0, -1.0), self.floor).value)
        return 1.0 / least if least > 0.0 else np.inf

    def shortfall(self, sum_of_rates: float, share: float) -> float:
        """β ≥ 0 with a(M − M̂) ⪯ bM + βD₀ in every pose, a the sum of rates and b = share [1/s]; inf if none is found.

        As M ⪯ M̂ + E, it suffices that (a − b)E ⪯ bM̂ + βD₀ for a ≥ b.
        """
        least = signed_least_by_multipliers(self._with(share, share - sum_of_rates), self.floor)
        return max(0.0, -down(least))

    def _with(self, model: float, error: float) -> EnergyForms:
        """Energies model·M̂ + error·E."""
        own = np.array([self.tree.spatial_inertia(i) for i in range(self.tree.nv)])
        return EnergyForms.on(self.tree, model * own + error * self.errors.forms, model * self.tree.armature)


def _largest(errors: EnergyForms, weight: Float[np.ndarray, "n n"]) -> float:
    """The largest E over W in every pose, inf if no bound is found.

    A check of definiteness needs some energy in every twist, so that shares of the model's are added.
    """
    tree = errors.source
    own = np.array([tree.spatial_inertia(i) for i in range(tree.nv)])
    raised = [errors.plus(share * own, share * tree.armature) for share in _SHARES_OF_MODEL]
    return min(up(largest_by_multipliers(x, weight).value) for x in raised) if errors.forms.any() else 0.0


def _behind(errors: EnergyForms, weight: Float[np.ndarray, "n n"], whole: float) -> JointArray:
    """Per joint, the largest E over W of the bodies that it moves: no larger than that of a joint before it."""
    found = np.zeros(errors.nv)
    for k, parent in enumerate(errors.parents.tolist()):
        found[k] = min(found[parent] if parent >= 0 else whole, _largest(errors.behind(k), weight))
    return found


def _frames(model: pin.Model, tree: RigidTree) -> Float[np.ndarray, "n 3 3"]:
    """Rotation of each frame of the tree, with z along its joint, in that of Pinocchio's joint."""
    frames: list[np.ndarray] = []
    for i, p in enumerate(tree.parents.tolist()):
        parent = frames[p] if p >= 0 else np.eye(3)
        frames.append(np.asarray(model.jointPlacements[i + 1].rotation).T @ parent @ tree.rotation[i])
    return np.array(frames)


def _weights(robot: Robot, tree: RigidTree, errors: BodyErrors) -> JointArray:
    """Largest |ΔG_i| [N·m]: a point mass at its longest lever arm, a pure first moment at most its size."""
    total = np.zeros(robot.nv)
    for body, row in zip(errors.body.tolist(), errors.parameters, strict=True):
        mass, first = float(row[0]), row[1:4]
        if mass != 0.0:
            total += abs(mass) * longest_levers(robot, body + 1, first / mass)
        elif first.any():
            turning = [k for k in tree.path(body) if not tree.prismatic[k]]
            total[turning] += float(np.linalg.norm(first))
    return np.asarray(total * float(np.linalg.norm(robot.gravity_vector)) * _OUTWARD)
