"""Forward kinematics of an arm by names of links and joints, thin over Pinocchio."""

import difflib
from functools import cached_property

import numpy as np
import pinocchio as pin
from jaxtyping import Bool, Float

from nbs_pin.base.arrays import over_rows
from nbs_pin.base.checks import LARGEST, floats, is_usual, told
from nbs_pin.base.exceptions import ArgumentError

_SHOWN = 8
"""Most names in an error."""


class Kinematics:
    """Poses and Jacobians of the frames of `model`; a frame is a link or a joint, by its name in the description."""

    model: pin.Model

    @cached_property
    def _frame_ids(self) -> dict[str, int]:
        """Pinocchio's index of each frame; of a link and a joint with one name, the link's."""
        kinds = (pin.FrameType.JOINT, pin.FrameType.FIXED_JOINT, pin.FrameType.BODY)
        numbered = list(enumerate(self.model.frames))[1:]  # without Pinocchio's own "universe"
        found = {frame.name: index for kind in kinds for index, frame in numbered if frame.type == kind}
        return dict(sorted(found.items(), key=lambda entry: entry[1]))

    @property
    def frames(self) -> tuple[str, ...]:
        """Names of all links and joints, fixed ones included, from the base outwards: each is a frame of `pose`.

        Example:
            >>> import nbs_pin as nbs
            >>> nbs.load_robot("two_link").frames
            ('base', 'joint1', 'link1', 'joint2', 'link2', 'tip_joint', 'tip')
        """
        return tuple(self._frame_ids)

    def frame_id(self, frame: str) -> int:
        """Pinocchio's index of the frame; raises ArgumentError, with the nearest names, if there is none."""
        if not isinstance(frame, str) or frame not in self._frame_ids:
            near = difflib.get_close_matches(frame, self.frames, n=3, cutoff=0.5) if isinstance(frame, str) else []
            hint = f"did you mean {' or '.join(near)}?" if near else f"give one of {', '.join(self.frames[-_SHOWN:])}."
            raise ArgumentError(f"the arm has no link or joint {told(frame)}; {hint}")
        return self._frame_ids[frame]

    def supporting(self, frame: str) -> Bool[np.ndarray, " n"]:
        """True for the joints between the base and the frame: the others do not move it."""
        moved = np.zeros(self.model.nv, dtype=bool)
        moved[[joint - 1 for joint in self.model.supports[self.model.frames[self.frame_id(frame)].parentJoint]][1:]] = 1
        return moved

    def pose(self, q: Float[np.ndarray, "*batch n"], frame: str) -> Float[np.ndarray, "*batch 4 4"]:
        """Homogeneous pose [R p; 0 1] of the frame in that of the root link, p [m]; of a mounted arm, in the world.

        Raises:
            ArgumentError: If the arm has no such frame, or q is not of finite numbers of shape (..., n) [rad].

        Example:
            >>> import nbs_pin as nbs
            >>> nbs.load_robot("two_link").pose([0.0, 0.0], "tip")[:3, 3]
            array([2., 0., 0.])
        """
        index, data = self.frame_id(frame), self.model.createData()
        joint, placement = self.model.frames[index].parentJoint, self.model.frames[index].placement

        def of(row: np.ndarray) -> np.ndarray:
            pin.forwardKinematics(self.model, data, row)
            return np.asarray((data.oMi[joint] * placement).homogeneous)

        return over_rows(of, self._configurations(q))

    def jacobian(self, q: Float[np.ndarray, "*batch n"], frame: str) -> Float[np.ndarray, "*batch 6 n"]:
        """J with (ṗ, ω) = J v: velocity ṗ of the frame's origin [m/s] above its angular velocity ω [rad/s].

        Both are along the axes of the root link's frame (Pinocchio's LOCAL_WORLD_ALIGNED).

        Raises:
            ArgumentError: If the arm has no such frame, or q is not of finite numbers of shape (..., n) [rad].
        """
        index, data = self.frame_id(frame), self.model.createData()

        def of(row: np.ndarray) -> np.ndarray:
            return np.asarray(pin.computeFrameJacobian(self.model, data, row, index, pin.LOCAL_WORLD_ALIGNED))

        return over_rows(of, self._configurations(q))

    def _configurations(self, q: Float[np.ndarray, "*batch n"]) -> Float[np.ndarray, "*batch n"]:
        q = floats("q", q)
        if q.ndim == 0 or q.shape[-1] != self.model.nv or not is_usual(q):
            raise ArgumentError(
                f"q is {told(q)}, expected (..., {self.model.nv}): one finite number of at most {LARGEST:g} per joint."
            )
        return q
