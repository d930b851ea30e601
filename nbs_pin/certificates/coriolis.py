"""Bounds of the Coriolis terms, of ∂M/∂q and of gravity's change in every pose, and of what a reference asks of them.

Norms: |x|² = xᵀD₀x for velocities, |f|_* = √(fᵀD₀⁻¹f) for torques, |x|_M² = xᵀMx. With ±∂_iM ⪯ γ_iM and
±∂_iM ⪯ γ'_iD₀ (`inertia/derivatives.py`), C(q, v)z is the sum of three terms ½xᵀ∂_vM z, ½xᵀ∂_zM v, −½vᵀ∂_xM z.
Σ γ_i|v_i| and Σ γ'_i|v_i| stand for the least bounds known of ±∂_vM by M and by D₀, those by rates of links included.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from nbs_pin.base.arrays import JointArray
from nbs_pin.base.rounding import SLACK, least_eigenvalue
from nbs_pin.certificates.constants import Constants
from nbs_pin.certificates.sampled_motion import SampledMotion
from nbs_pin.dynamics.pinocchio_tree import pack_model
from nbs_pin.dynamics.rigid_tree import RigidTree
from nbs_pin.inertia.bounds import body_shares, largest_diagonal, largest_inertia_bound, least_inertia_bound
from nbs_pin.inertia.christoffel import christoffel_bounds, gravity_bounds
from nbs_pin.inertia.derivatives import inertia_derivatives, link_derivatives, link_rates, rate_bound, single_rates
from nbs_pin.robots.robot import Robot

MOST_JOINTS = 8
"""Arms with more joints take too long."""
_SHAPE = 1e-6
"""Share of D₀ by which it may differ from a multiple of another one."""


class MotionBounds(NamedTuple):
    """Greatest values of a reference: of each joint, sums over the joints, and norms."""

    fastest: JointArray
    """|v_d,i| [rad/s]."""
    turn: float
    """Σ γ_i|v_d,i| [1/s]."""
    turn_d: float
    """Σ γ'_i|v_d,i|."""
    speed_1: float
    """Σ |v_d,i| [rad/s]."""
    speed: float
    """|v_d|."""
    acceleration: float
    """|a_d|."""
    jerk: float
    """|ȧ_d|."""


class Sizes(NamedTuple):
    """Bounds of a velocity."""

    turn: float
    """Σ γ_i|v_i| [1/s]."""
    turn_d: float
    """Σ γ'_i|v_i|."""
    energy: float
    """|v|_M."""
    speed: float
    """|v|."""


@dataclass(frozen=True, eq=False)
class CoriolisBounds:
    """Constants of an arm and of D₀."""

    relative: JointArray
    """γ [1/rad]."""
    by_floor: JointArray
    """γ' [s/rad]."""
    turn: float
    """Σ γ_i|v_i| ≤ turn·|v|_M."""
    turn_d: float
    """Σ γ'_i|v_i| ≤ turn_d·|v|_M."""
    sum_m: float
    """Σ |v_i| ≤ sum_m·|v|_M."""
    sum: float
    """Σ |v_i| ≤ sum·|v|."""
    spread: float
    """Σ γ_i|v_i| ≤ spread·|v|."""
    spread_d: float
    """Σ γ'_i|v_i| ≤ spread_d·|v|."""
    pull: float
    """Σ γ_i|(Λf)_i| ≤ pull·√(fᵀΛf)."""
    pull_d: float
    """Σ γ'_i|(Λf)_i| ≤ pull_d·√(fᵀΛf)."""
    pull_sum: float
    """Σ |(Λf)_i| ≤ pull_sum·√(fᵀΛf)."""
    links: Float[np.ndarray, "n n"]
    """B of the rates a = Bv of links."""
    link_relative: JointArray
    """γ of ∂_vM for the rates of links."""
    link_floor: JointArray
    """γ' of ∂_vM for the rates of links."""
    diagonal: JointArray
    """max M_ii [kg·m²]."""
    single: JointArray
    """|v_i| ≤ single_i·|v|_M."""
    christoffel: Float[np.ndarray, "n n n"]
    """Bound of |Γ_ijk|; entry i of C(q, a)b is Σ Γ_ijk a_j b_k [kg·m²]."""
    gravity_slope: Float[np.ndarray, "n n"]
    """Bound of |∂G_i/∂q_j| [N·m/rad]."""
    gravity: float
    """|G(q + u) − G(q)|_* ≤ gravity·Σ|u_i|."""
    loss_m: float
    """|Λ^½f|_M ≤ loss_m·‖f‖."""
    loss_inverse: float
    """‖Λ^-½M^-½f‖ ≤ loss_inverse·‖f‖."""

    @classmethod
    def of(cls, robot: Robot, constants: Constants) -> "CoriolisBounds":
        """The bounds for an arm; inf where a joint that slides or a failed search leaves none."""
        floor, rate = constants.floor, constants.rate
        return _bounds(_Key(robot), floor.tobytes(), rate.tobytes(), len(rate))

    def sizes(self, energy: float, speed: float) -> Sizes:
        """Of a velocity with |v|_M ≤ energy and |v| ≤ speed."""
        turn, turn_d = min(self.turn * energy, self.spread * speed), min(self.turn_d * energy, self.spread_d * speed)
        return Sizes(turn, turn_d, energy, speed)

    @property
    def _by_links(self) -> tuple[JointArray, JointArray]:
        return self.link_relative, self.link_floor

    def motion(self, motion: SampledMotion, floor: Float[np.ndarray, "n n"], jerk: JointArray) -> MotionBounds:
        """The bounds of a reference with |ȧ_d,i| ≤ jerk_i, at and between its samples."""
        largest = [float(np.sqrt(np.einsum("ti,ij,tj->t", x, floor, x).max())) for x in (motion.v, motion.a)]
        largest.append(math.sqrt(jerk @ np.abs(floor) @ jerk))
        largest[1] += motion.half * largest[2]
        fastest = np.abs(motion.v).max(axis=0) + motion.half * (np.abs(motion.a).max(axis=0) + motion.half * jerk)
        speeds = [float(w @ fastest) for w in (self.relative, self.by_floor, np.ones(len(floor)))]
        between = np.abs(self.links) @ (np.abs(motion.a).max(axis=0) + motion.half * jerk)
        turning = np.abs(motion.v @ self.links.T).max(axis=0) + motion.half * between
        speeds[:2] = (min(s, float(w @ turning)) for s, w in zip(speeds, self._by_links, strict=False))
        largest[0] += motion.half * largest[1]
        return MotionBounds(fastest, *speeds, *largest)


class _Key:
    """A robot by the numbers of its model, for the cache."""

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        packed = pack_model(robot.model)
        travel, gravity = (robot.lower, robot.upper), robot.model.gravity.vector
        self._state = tuple(x.tobytes() for x in (packed.layout, packed.weights, *travel, gravity))

    def __hash__(self) -> int:
        return hash(self._state)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Key) and self._state == other._state


class _Arm(NamedTuple):
    """What does not depend on D₀, with names as in `CoriolisBounds`."""

    relative: JointArray
    single: JointArray
    turn: float
    sum_m: float
    links: Float[np.ndarray, "n n"]
    link_relative: JointArray
    by_links: JointArray
    """`single` for the rates of links."""
    shares: Float[np.ndarray, "n n"]
    """`body_shares`."""


@lru_cache(maxsize=32)
def _arm(key: _Key) -> _Arm:
    tree, n, links = RigidTree.of(key.robot), key.robot.nv, link_rates(key.robot)
    relative, single = inertia_derivatives(tree), single_rates(tree)
    by_links = single if np.array_equal(links, np.eye(n)) else single_rates(tree, links)
    link_relative = link_derivatives(tree, relative)
    turn, sum_m = (rate_bound(tree, weights, single) for weights in (relative, np.ones(n)))
    turn = min(turn, rate_bound(tree, link_relative, by_links, links))
    return _Arm(relative, single, turn, sum_m, links, link_relative, by_links, body_shares(tree))


@lru_cache(maxsize=32)
def _of_shape(key: _Key, shape_bytes: bytes, n: int) -> tuple[JointArray, JointArray]:
    return _both(key, np.frombuffer(shape_bytes).reshape(n, n))


def _both(key: _Key, floor: Float[np.ndarray, "n n"]) -> tuple[JointArray, JointArray]:
    by_floor = inertia_derivatives(key.robot, floor)
    return by_floor, link_derivatives(key.robot, by_floor, floor)


def _by_floor(key: _Key, floor: Float[np.ndarray, "n n"]) -> tuple[JointArray, JointArray]:
    """γ' of joints and of links, from those of the same floor in other units: designs of one arm differ by a factor.

    ±∂_iM ⪯ γ'F and F ⪯ D₀/s(1 − ε) give γ'/s(1 − ε) for D₀; a search takes long.
    """
    size = float(floor[0, 0])
    shape = np.round(floor / size, 10)
    if least_eigenvalue(floor / size - (1.0 - _SHAPE) * shape) <= 0.0:
        return _both(key, floor)
    joints, links = _of_shape(key, shape.tobytes(), len(floor))
    scale = (1.0 + SLACK) / (size * (1.0 - _SHAPE))
    return joints * scale, links * scale


@lru_cache(maxsize=32)
def _bounds(key: _Key, floor_bytes: bytes, rate_bytes: bytes, n: int) -> CoriolisBounds:
    floor, rate = np.frombuffer(floor_bytes).reshape(n, n), np.frombuffer(rate_bytes)
    tree, inverse = RigidTree.of(key.robot), np.abs(np.linalg.inv(floor))
    relative, single, turn, sum_m, links, link_relative, by_links, shares = _arm(key)
    heaviest = largest_inertia_bound(tree, floor).value
    own = (relative, link_relative)
    by_floor, link_floor = (np.minimum(x, y * heaviest) for x, y in zip(_by_floor(key, floor), own, strict=True))
    turn_d = min(rate_bound(tree, by_floor, single), rate_bound(tree, link_floor, by_links, links))

    def largest(weights: JointArray) -> float:
        return math.sqrt(weights @ inverse @ weights)

    def pulled(weights: JointArray) -> float:
        return math.sqrt(weights**2 @ rate)

    gravity_slope = gravity_bounds(tree, shares, float(np.linalg.norm(key.robot.model.gravity.linear)))
    slowness = np.diag(1.0 / rate)
    return CoriolisBounds(
        relative=relative,
        by_floor=by_floor,
        turn=turn,
        turn_d=turn_d,
        sum_m=sum_m,
        sum=largest(np.ones(n)),
        spread=largest(relative),
        spread_d=largest(by_floor),
        pull=pulled(relative),
        pull_d=pulled(by_floor),
        pull_sum=pulled(np.ones(n)),
        links=links,
        link_relative=link_relative,
        link_floor=link_floor,
        diagonal=largest_diagonal(tree, shares),
        single=single,
        christoffel=christoffel_bounds(tree, shares),
        gravity_slope=gravity_slope,
        gravity=float(np.max([largest(column) for column in gravity_slope.T])),
        loss_m=math.sqrt(largest_inertia_bound(tree, slowness).value),
        loss_inverse=1.0 / math.sqrt(max(least_inertia_bound(tree, slowness).value, 1e-300)),
    )
