"""The regressor of a rigid tree in torch, so that gradients with respect to the motion can be taken."""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from nbs_pin.robots.robot import Robot

Rows = Float[torch.Tensor, "rows n"]
_PAIRS = ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2))
"""Entries of the inertia in the order of Pinocchio's parameters."""


class TorchRegressor:
    """Y(q, v, v̇) with τ = Y π + armature v̇, for Pinocchio's parameters π = (m, m c, I) of every body in its frame.

    A body whose origin accelerates with α (against gravity), with angular velocity ω, needs the force f and the moment
    n = m c × α + I ω̇ + ω × I ω, and joint i the torque Jᵢᵀ(f, n), where J is the body's Jacobian. Arrays have a
    row per instant; the recursion over the joints is the only loop.
    """

    def __init__(self, robot: Robot) -> None:
        model, n = robot.model, robot.nv
        joints = model.createData().joints
        subspaces = np.array([np.asarray(joints[i].S).ravel() for i in range(1, n + 1)])
        self._slides = [bool(x) for x in robot.prismatic]
        axes = np.where(robot.prismatic[:, None], subspaces[:, :3], subspaces[:, 3:])
        self._axes = torch.from_numpy(axes)
        self._turn = _cross(self._axes)
        self._twice = self._turn @ self._turn
        placements = [model.jointPlacements[i] for i in range(1, n + 1)]
        self._rotation = torch.from_numpy(np.array([x.rotation for x in placements]))
        self._position = torch.from_numpy(np.array([x.translation for x in placements]))
        self._parents = [int(p) - 1 for p in robot.parents]
        self._up = torch.from_numpy(-np.asarray(model.gravity.linear, dtype=float))
        above = np.zeros((n, n))
        for body in range(n):
            joint = body
            while joint >= 0:
                above[joint, body], joint = 1.0, self._parents[joint]
        self._above = torch.from_numpy(above)[:, :, None]
        entries = np.zeros((3, len(_PAIRS), 3))
        for k, (i, j) in enumerate(_PAIRS):
            entries[i, k, j] = entries[j, k, i] = 1.0
        self._entries = torch.from_numpy(entries)

    def __call__(self, q: Rows, v: Rows, a: Rows) -> Float[torch.Tensor, "rows n parameters"]:
        """Y (rows, n, 10 n), differentiable with respect to q, v and a."""
        turned, place, axes, omega, alpha, up = self._moved(q, v, a)
        spin = _cross(omega)
        shift = _cross(alpha) + spin @ spin
        turning = torch.einsum("icj,knj->knic", self._entries, alpha)
        turning = turning + spin @ torch.einsum("icj,knj->knic", self._entries, omega)
        arm = place[:, None] - place[:, :, None]
        along = axes[:, :, None].expand_as(arm)
        slides = torch.tensor(self._slides)[None, :, None, None]
        linear = torch.where(slides, along, torch.linalg.cross(along, arm)) * self._above
        angular = torch.where(slides, 0.0, along) * self._above
        linear, angular = (torch.einsum("kibx,kbxy->kiby", x, turned) for x in (linear, angular))  # in bodies' axes
        mass = (linear * up[:, None]).sum(-1, keepdim=True)
        moment = torch.einsum("kibx,kbxy->kiby", linear, shift) - torch.einsum("kibx,kbxy->kiby", angular, _cross(up))
        inertia = torch.einsum("kibx,kbxc->kibc", angular, turning)
        return torch.cat([mass, moment, inertia], dim=-1).reshape(len(q), len(self._parents), -1)

    def _moved(self, q: Rows, v: Rows, a: Rows) -> tuple[Any, ...]:
        """Rotations, origins and axes in the base's frame; ω, ω̇ and the acceleration against gravity in the bodies'."""
        cross, still = torch.linalg.cross, q.new_zeros(len(q), 3)
        identity = torch.eye(3, dtype=q.dtype)
        base = identity.expand(len(q), 3, 3), still, still, still, self._up.expand(len(q), 3)
        sine, versine = torch.sin(q)[..., None, None], 1.0 - torch.cos(q)[..., None, None]
        bodies: list[Any] = []
        axes = []
        for i, parent in enumerate(self._parents):
            turned, origin, omega, alpha, up = bodies[parent] if parent >= 0 else base
            way, turned = turned @ self._position[i], turned @ self._rotation[i]
            axis, rate, pull = turned @ self._axes[i], v[:, i, None], a[:, i, None]
            if self._slides[i]:
                way = way + axis * q[:, i, None]
                up = up + 2.0 * rate * cross(omega, axis) + axis * pull
            up = up + cross(alpha, way) + cross(omega, cross(omega, way))
            if not self._slides[i]:
                turned = turned @ (identity + sine[:, i] * self._turn[i] + versine[:, i] * self._twice[i])
                alpha = alpha + axis * pull + cross(omega, axis) * rate
                omega = omega + axis * rate
            bodies.append((turned, origin + way, omega, alpha, up))
            axes.append(axis)
        turned, origin, *moving = (torch.stack(part, dim=1) for part in zip(*bodies, strict=True))
        own = turned.transpose(-1, -2) @ torch.stack(moving, dim=-1)
        return turned, origin, torch.stack(axes, dim=1), *own.unbind(-1)


def _cross(x: torch.Tensor) -> torch.Tensor:
    """[x]× (..., 3, 3)."""
    zero = torch.zeros_like(x[..., 0])
    a, b, c = x.unbind(-1)
    return torch.stack([zero, -c, b, c, zero, -a, -b, a, zero], dim=-1).reshape(*x.shape, 3)
