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
_STARTS = 12
_FEW = 6
"""Poses that are tested where no body can vanish."""


def weak_joints(model: pin.Model, low: JointArray, high: JointArray) -> tuple[list[str], str]:
    """Joints for which M(q) is not positive definite, and why; none for an arm that can be.

    If every body has a positive definite spatial inertia, no velocity leaves all of them at rest, so that M(q) ≻ 0 in
    every pose; then only rounding is tested, at a few poses. Otherwise (point masses, rods) the least eigenvalue of M,
    scaled by the largest inertia of each joint, is minimised over the poses from several starts.

    Args:
        model: The arm.
        low: Least position of each joint [rad, m].
        high: Largest position of each joint [rad, m].
    """
    still, problem = _still_joints(model)
    if still:
        return still, problem
    data, draws = model.createData(), np.random.default_rng(0)
    poses = [np.clip(np.zeros(model.nv), low, high), *draws.uniform(low, high, (_STARTS, model.nv))]
    masses = [_mass(model, data, q) for q in poses]
    scale = np.sqrt(np.max([np.diag(mass) for mass in masses], axis=0))
    if not np.isfinite(masses).all() or not (scale > 0.0).all():
        weakest = int(np.argmin(np.where(np.isfinite(scale), scale, -1.0)))
        return [model.names[1 + weakest]], f"M(q) is not finite and positive definite at q = {_shown(poses[0])}"

    def least(q: JointArray) -> float:
        return float(np.linalg.eigvalsh(_mass(model, data, q) / scale / scale[:, None])[0])

    if all(_definite(inertia) for inertia in list(model.inertias)[1:]):
        tested = poses[:_FEW]
    else:
        tested = [_lowest(least, q, low, high) for q in poses]
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
            moments[joint - 1].append(float(axis @ inertia @ axis) if axis.any() else np.inf)
            totals[joint - 1].append(float(np.trace(inertia)))
    about = {
        name: max(moment)
        for name, moment, total in zip(list(model.names)[1:], moments, totals, strict=True)
        if all(x <= _STILL * y for x, y in zip(moment, total, strict=True))
    }
    return list(about), f"moves no inertia ({next(iter(about.values()), 0.0):.2g} kg·m² about its axis)"


def _definite(inertia: pin.Inertia) -> bool:
    """Whether a body at rest is the only one without kinetic energy."""
    moments = np.linalg.eigvalsh(inertia.inertia)
    return bool(inertia.mass > 0.0 and moments[0] > 1e-9 * (moments[-1] + inertia.mass * (inertia.lever**2).sum()))


def _mass(model: pin.Model, data: Any, q: JointArray) -> Float[np.ndarray, "n n"]:
    return np.asarray(pin.crba(model, data, q))


def _shown(q: JointArray) -> list[float]:
    return [float(x) for x in np.round(q, 3) + 0.0]
