"""Whether M(q) is positive definite in every pose of an arm."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pinocchio as pin
from jaxtyping import Float

from nbs_pin.base.arrays import JointArray

_SINGULAR = 1e-10
"""Smallest eigenvalue of M, relative to the joints' largest inertias, that counts as positive."""
_STILL = 1e-9
"""Least inertia about a joint's axis, relative to that about its other axes, that counts as one."""
_NEGLIGIBLE = 1e-7
"""A body below this share of what it carries may leave M singular up to rounding."""
_STARTS = 32
_FEW = 6
"""Poses that are tested where no body can vanish, and from which one is sought where one can."""


def weak_joints(model: pin.Model, low: JointArray, high: JointArray) -> tuple[list[str], str]:
    """Joints for which M(q) is not positive definite, and why; none for an arm that can be.

    If every body has a positive definite spatial inertia, no velocity leaves all of them at rest, so that M(q) ≻ 0 in
    every pose; where none is negligible beside what lies behind it, a few poses test the rounding. Otherwise (point
    masses, rods, dummies) the least eigenvalue of M, scaled by the largest inertia of each joint, is minimised over the
    poses from several starts; joints without a range are searched over one turn, or 100 m.

    Args:
        model: The arm.
        low: Least position of each joint [rad, m].
        high: Largest position of each joint [rad, m].
    """
    still, problem = _still_joints(model)
    if still:
        return still, problem
    data, draws, reach = model.createData(), np.random.default_rng(0), _reach(model)
    low, high = (
        np.where(np.isfinite(low), low, np.minimum(-reach, high - 2.0 * reach)),
        np.where(np.isfinite(high), high, np.maximum(reach, low + 2.0 * reach)),
    )
    poses = [np.clip(np.zeros(model.nv), low, high), *draws.uniform(low, high, (_STARTS, model.nv))]
    masses = [_mass(model, data, q) for q in poses]
    scale = np.sqrt(np.max([np.diag(mass) for mass in masses], axis=0))
    if not np.isfinite(masses).all() or not (scale > 0.0).all():
        weakest = int(np.argmin(np.where(np.isfinite(scale), scale, -1.0)))
        return [model.names[1 + weakest]], f"M(q) is not finite and positive definite at q = {_shown(poses[0])}"

    def least(q: JointArray) -> float:
        return float(np.linalg.eigvalsh(_mass(model, data, q) / scale / scale[:, None])[0])

    if _definite(model, low, high):
        tested = poses[:_FEW]
    else:
        tested = [_lowest(least, q, low, high) for q in sorted(poses, key=least)[:_FEW]]
    worst = min(tested, key=least)
    if least(worst) > _SINGULAR:
        return [], ""
    _, vectors = np.linalg.eigh(_mass(model, data, worst) / scale / scale[:, None])
    joint = int(np.argmax(np.abs(vectors[:, 0])))
    return [model.names[1 + joint]], f"M(q) is not finite and positive definite at q = {_shown(worst)}"


def _lowest(least: Callable[[JointArray], float], q: JointArray, low: JointArray, high: JointArray) -> JointArray:
    from scipy.optimize import minimize  # slow to import, and few arms come here

    settings = {"maxiter": 60, "ftol": 1e-16, "gtol": 1e-9}
    bounds = list(zip(low, high, strict=True))
    return np.asarray(minimize(least, q, method="L-BFGS-B", bounds=bounds, options=settings).x)


def _still_joints(model: pin.Model) -> tuple[list[str], str]:
    """Rotary joints about whose axes what they carry has next to no inertia, in whatever pose."""
    data = model.createData()
    moments: list[list[float]] = [[] for _ in range(model.nv)]
    totals: list[list[float]] = [[] for _ in range(model.nv)]
    for q in (np.zeros(model.nq), *np.random.default_rng(0).uniform(-np.pi, np.pi, (3, model.nq))):
        pin.crba(model, data, q)
        for joint in range(1, model.njoints):
            axis = np.asarray(data.joints[joint].S).ravel()[3:]
            inertia = data.Ycrb[joint].matrix()[3:, 3:]
            rotor = float(model.armature[joint - 1])
            moments[joint - 1].append(float(axis @ inertia @ axis) + rotor if axis.any() else np.inf)
            totals[joint - 1].append(float(np.trace(inertia)))
    about = {
        name: max(moment)
        for name, moment, total in zip(list(model.names)[1:], moments, totals, strict=True)
        if all(x <= _STILL * y for x, y in zip(moment, total, strict=True))
    }
    return list(about), f"moves no inertia ({next(iter(about.values()), 0.0):.2g} kg·m² about its axis)"


def _reach(model: pin.Model) -> JointArray:
    """How far joints without a range are searched: half a turn, or 100 m [rad, m]."""
    data = model.createData()
    return np.array(
        [np.pi if np.asarray(data.joints[k].S).ravel()[3:].any() else 100.0 for k in range(1, model.njoints)]
    )


def _definite(model: pin.Model, low: JointArray, high: JointArray) -> bool:
    """Whether every body is positive definite beside what it carries: its inertia beside m·r² of everything behind it.

    r is the largest distance that the bodies behind can have, from the lengths of the links.
    """
    mass, reach = np.zeros(model.njoints), np.zeros(model.njoints)
    slides = _reach(model) > np.pi
    way = np.where(slides, np.maximum(np.abs(low), np.abs(high)), 0.0)
    for k in range(model.njoints - 1, 0, -1):
        body, parent = model.inertias[k], model.parents[k]
        mass[k] += body.mass
        reach[k] = max(reach[k], float(np.linalg.norm(body.lever)))
        least = np.linalg.eigvalsh(body.inertia)[0]
        if not (body.mass > _NEGLIGIBLE * mass[k] and least > _NEGLIGIBLE * mass[k] * reach[k] ** 2):
            return False
        mass[parent] += mass[k]
        reach[parent] = max(reach[parent], reach[k] + way[k - 1] + np.linalg.norm(model.jointPlacements[k].translation))
    return True


def _mass(model: pin.Model, data: Any, q: JointArray) -> Float[np.ndarray, "n n"]:
    return np.asarray(pin.crba(model, data, q))


def _shown(q: JointArray) -> list[float]:
    return [float(x) for x in np.round(q, 3) + 0.0]
