"""Inverse kinematics of a frame: pink brings it near a pose within the joint limits, Newton's method onto it.

Of the configurations that put the frame where it is wanted, the one is taken that is nearest to a posture q₀:

    minimise  h(q) = Σ_i ½x_i² + c(y_i) − c(y_i⁰) − c'(y_i⁰)(y_i − y_i⁰)   with   pose(q) = pose wanted,

where x = (q − q₀)/min(w, π) and y = (q − middle)/w for joints of half range w, and c(y) = y¹², or 0 for a joint without
limits, so that a redundant arm keeps away from its stops. h is 0 at q₀ alone. The solution depends on the pose, not on
the way to it: a closed path closes in the joints too, and a smooth path gives smooth joints.
"""

import warnings
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from jaxtyping import Bool, Float

from nbs_pin.base.arrays import JointArray
from nbs_pin.base.doors import option
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.shown import joints_told
from nbs_pin.base.units import counted
from nbs_pin.robots.robot import Robot

_POWER = 12
"""Of the function that keeps a redundant arm from its stops."""
_POSTURE_COST = 1e-3
"""Weight of the posture for pink, where the frame's has 1 per metre and radian."""
_PINK_STEPS, _NEWTON_STEPS = 60, 30
_NEAR = 1e-3
"""Error from which Newton's method takes over [m, rad]."""
_EXACT = 1e-12
"""Error of a pose and size of a step that is left, both relative to the reach and the ranges of joints."""
_GOOD = 1e-10
"""What counts as exact where rounding leaves no more."""
_CONVEX = 0.05
"""Least curvature along spare joints, as a share of that of h, with which a step is taken."""
_TRIES = 200
"""Configurations of which the directions are taken in which a frame can move."""
_RANK = 1e-6


class Solution(NamedTuple):
    """A configuration and how well it puts the frame where it was wanted."""

    q: JointArray
    missed: float
    """Distance of the frame's origin from where it was wanted [m]."""
    turned: float
    """Angle of the frame from the orientation wanted [rad], 0 if it is free."""

    @property
    def exact(self) -> bool:
        """Whether the pose is met to rounding."""
        return max(self.missed, self.turned) <= _GOOD


@dataclass(frozen=True, eq=False)
class InverseKinematics:
    """Configurations of an arm that put a frame at poses, nearest to a posture."""

    robot: Robot
    frame: str
    posture: JointArray
    hold: bool
    """Whether the orientation counts, or the position alone."""

    @cached_property
    def reach(self) -> float:
        """How far the frame gets from the middle of its positions [m]: the length that scales errors."""
        points = self.robot.pose(self._tries, self.frame)[:, :3, 3]
        return max(float(np.linalg.norm(points - points.mean(axis=0), axis=-1).max()), 1e-3)

    @cached_property
    def _tries(self) -> Float[np.ndarray, "tries n"]:
        return np.random.default_rng(0).uniform(*self.robot.one_turn_range, (_TRIES, self.robot.nv))

    @cached_property
    def scale(self) -> Float[np.ndarray, "6"]:
        """Factors of an error (position [m], angles [rad]) that make it dimensionless."""
        return np.array([1.0 / self.reach] * 3 + [1.0] * 3)

    @cached_property
    def moving(self) -> Bool[np.ndarray, " n"]:
        """True for the joints that move the frame."""
        return self.robot.supporting(self.frame)

    @cached_property
    def directions(self) -> Float[np.ndarray, "k 6"]:
        """Orthonormal rows: the directions of (position, angle), scaled, in which the frame can move anywhere.

        Three are left of an arm in a plane, or two if the orientation is free. Raises ArgumentError if the arm has
        fewer joints than the frame has such directions: it could not follow a path.
        """
        rows = 6 if self.hold else 3
        columns = (self.scale[:, None] * self.robot.jacobian(self._tries, self.frame))[:, :rows]
        left, sizes, _ = np.linalg.svd(np.concatenate(list(columns), axis=1), full_matrices=False)
        rank = int((sizes > _RANK * sizes[0]).sum()) if sizes[0] > 0.0 else 0
        joints = int(self.moving.sum())
        if joints < max(rank, 1):
            what = "position and orientation" if self.hold else "position"
            remedy = (
                f"let the orientation free ({option('orientation', 'free')})" if self.hold else "give another frame"
            )
            raise ArgumentError(
                f"{joints_told(joints)} of {self.robot.name} can move '{self.frame}', whose {what} varies in "
                f"{counted(max(rank, 1), 'direction')}, so that it cannot follow a path; {remedy}."
            )
        basis = np.zeros((rank, 6))
        basis[:, :rows] = left[:, :rank].T
        return basis

    def jacobian(self, q: Float[np.ndarray, "*batch n"]) -> Float[np.ndarray, "*batch k n"]:
        """Jacobian of the directions that count, scaled."""
        return np.asarray(self.directions @ (self.scale[:, None] * self.robot.jacobian(q, self.frame)))

    def steadiness(self, q: Float[np.ndarray, "*batch n"]) -> Float[np.ndarray, "*batch"]:
        """Smallest singular value of `jacobian`: 0 where the frame cannot move in some direction."""
        return np.asarray(np.linalg.svd(self.jacobian(q), compute_uv=False)[..., len(self.directions) - 1])

    def error(self, q: JointArray, pose: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "6"]:
        """Position [m] and rotation vector [rad] of the frame against the pose, along the axes of the base."""
        return pose_error(self.robot.pose(q, self.frame), pose)

    def solution(self, q: JointArray, pose: Float[np.ndarray, "4 4"]) -> Solution:
        """The configuration with its errors."""
        error = self.error(q, pose)
        turned = float(np.linalg.norm(error[3:])) if self.hold else 0.0
        return Solution(q, float(np.linalg.norm(error[:3])), turned)

    def solve(self, q: JointArray, pose: Float[np.ndarray, "4 4"]) -> Solution:
        """The configuration that puts the frame at the pose, from q on; not exact if it was not found."""
        found = self.refine(q, pose)
        return found if found.exact else self.refine(self.approach(q, pose), pose)

    def approach(self, q: JointArray, pose: Float[np.ndarray, "4 4"]) -> JointArray:
        """A configuration within the joint limits near the pose, by steps of pink's quadratic programs."""
        import pink
        from pink.limits import ConfigurationLimit
        from pink.tasks import FrameTask, PostureTask

        model = self.robot.model.copy()  # pink keeps notes in it
        lower, upper = model.lowerPositionLimit, model.upperPositionLimit
        configuration = pink.Configuration(model, model.createData(), np.clip(q, lower, upper))
        frame = FrameTask(self._unique_frame(model), 1.0, 1.0 if self.hold else 0.0, lm_damping=1e-3)
        frame.set_target(pin.SE3(pose))
        posture = PostureTask(_POSTURE_COST)
        posture.set_target(self.posture)
        limits = [ConfigurationLimit(model, config_limit_gain=1.0)]
        last = np.inf
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # qpsolvers says that it makes matrices sparse
            for step in range(_PINK_STEPS):
                v = pink.solve_ik(configuration, [frame, posture], 1.0, "clarabel", limits=limits, safety_break=False)
                configuration.integrate_inplace(v * min(1.0, 0.5 / max(float(np.abs(v).max()), 1e-9)), 1.0)
                left = float(np.abs(self.solution(configuration.q, pose)[1:]).max())
                if left < _NEAR or (step % 10 == 9 and left > 0.99 * last):
                    break
                last = left if step % 10 == 9 else last
        return np.clip(configuration.q, lower, upper)

    def _unique_frame(self, model: pin.Model) -> str:
        """A name that only this frame has, as pink finds it by its name alone."""
        index = self.robot.frame_id(self.frame)
        model.frames[index].name = f"{self.frame} of the path"
        return str(model.frames[index].name)

    def refine(self, q: JointArray, pose: Float[np.ndarray, "4 4"]) -> Solution:
        """Newton's method on pose(q) = pose and, of a redundant arm, ∇h + Jᵀλ = 0, from q on."""
        k, n = len(self.directions), self.robot.nv
        redundant = int(self.moving.sum()) > k or not self.moving.all()
        for _ in range(_NEWTON_STEPS):
            left, J = self.directions @ (self.scale * self.error(q, pose)), self.jacobian(q)
            if not redundant:
                step = -np.linalg.lstsq(J, left, rcond=None)[0]
            else:
                slope, bend = self._attraction(q)
                multipliers = np.linalg.lstsq(J.T, -slope, rcond=None)[0]
                system = np.zeros((n + k, n + k))
                system[:n, :n] = self._hessian(bend, self._curvature(q, J, multipliers), J)
                system[:n, n:], system[n:, :n] = J.T, J
                step = np.linalg.lstsq(system, -np.concatenate([slope, left]), rcond=None)[0][:n]
            size = float(np.abs(step / self._half).max())
            q = q + step * min(1.0, 0.2 / max(size, 1e-9))
            if size <= _EXACT:
                break
        return self.solution(q, pose)

    def _hessian(
        self, bend: JointArray, curvature: Float[np.ndarray, "n n"], J: Float[np.ndarray, "k n"]
    ) -> Float[np.ndarray, "n n"]:
        """Hessian of h + λᵀ pose; that of h alone where spare joints would be led to a maximum or a saddle."""
        full, null = np.diag(bend) + curvature, np.linalg.svd(J)[2][len(J) :]
        convex = not len(null) or np.linalg.eigvalsh(null @ full @ null.T)[0] > _CONVEX * bend.min()
        return full if convex else np.diag(bend)

    @cached_property
    def _half(self) -> JointArray:
        lower, upper = self.robot.sampling_range
        half = 0.5 * (upper - lower)
        return np.where(self.robot.prismatic, half, np.minimum(half, np.pi))

    def _attraction(self, q: JointArray) -> tuple[JointArray, JointArray]:
        """Gradient of h and the diagonal of its Hessian."""
        lower, upper = self.robot.sampling_range
        middle, half = 0.5 * (lower + upper), 0.5 * (upper - lower)
        limited = np.isfinite(self.robot.upper - self.robot.lower)
        y, start = (np.where(limited, (x - middle) / half, 0.0) for x in (q, self.posture))
        slope = _POWER * (y ** (_POWER - 1) - start ** (_POWER - 1)) / half
        bend = _POWER * (_POWER - 1) * y ** (_POWER - 2) / half**2
        return (q - self.posture) / self._half**2 + slope, 1.0 / self._half**2 + bend

    def _curvature(
        self, q: JointArray, J: Float[np.ndarray, "k n"], multipliers: Float[np.ndarray, " k"]
    ) -> Float[np.ndarray, "n n"]:
        """The Hessian of λᵀ times the pose, by differences of the Jacobian."""
        step = 1e-6
        moved = self.directions @ (self.scale[:, None] * self.robot.jacobian(q + step * np.eye(len(q)), self.frame))
        change = np.einsum("jkn,k->jn", moved - J, multipliers) / step
        return np.asarray(0.5 * (change + change.T))


def pose_error(
    actual: Float[np.ndarray, "*batch 4 4"], wanted: Float[np.ndarray, "*batch 4 4"]
) -> Float[np.ndarray, "*batch 6"]:
    """Position [m] and rotation vector [rad] of poses against others, along the axes of the base."""
    from scipy.spatial.transform import Rotation

    turn = actual[..., :3, :3] @ wanted[..., :3, :3].swapaxes(-1, -2)
    angles = Rotation.from_matrix(turn.reshape(-1, 3, 3)).as_rotvec().reshape(*turn.shape[:-2], 3)
    return np.concatenate([actual[..., :3, 3] - wanted[..., :3, 3], angles], axis=-1)
