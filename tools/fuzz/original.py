"""MuJoCo's own model of an MJCF file, and how far an arm loaded from the file is from it."""

import warnings
from collections.abc import Mapping
from pathlib import Path

import mujoco
import numpy as np

from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.robots.robot import Robot

_OFF = mujoco.mjtDisableBit.mjDSBL_CONSTRAINT | mujoco.mjtDisableBit.mjDSBL_ACTUATION


def original_model(path: Path) -> mujoco.MjModel:
    """The model of the file without constraints and actuation; geoms of meshes that are not there are left out."""
    spec = mujoco.MjSpec.from_file(str(path))
    missing = {
        mesh.name for mesh in spec.meshes if mesh.file and not (path.parent / spec.meshdir / mesh.file).is_file()
    }
    for geom in list(spec.geoms):
        if geom.meshname in missing:
            spec.delete(geom)
    for mesh in list(spec.meshes):
        if mesh.name in missing:
            spec.delete(mesh)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about the form of the file
        model = spec.compile()
    model.opt.disableflags |= int(_OFF)
    return model


def followers(model: mujoco.MjModel) -> list[str]:
    """Names of the joints that equalities make follow another."""
    of_joints = [
        k for k in range(model.neq) if model.eq_type[k] == int(mujoco.mjtEq.mjEQ_JOINT) and model.eq_active0[k]
    ]
    return [joint_names(model)[model.eq_obj1id[k]] for k in of_joints]


def joint_names(model: mujoco.MjModel) -> list[str]:
    """Names of all joints, "joint3" where the third has none."""
    return [model.joint(k).name or f"joint{k + 1}" for k in range(model.njnt)]


def deviations(
    robot: Robot, model: mujoco.MjModel, held: Mapping[str, float], poses: int = 8, seed: int = 0
) -> dict[str, float]:
    """Largest deviations of an arm from MuJoCo's model in random states, relative to the largest entry.

    M, C v + G, what damping takes of the torque (with all that MuJoCo calls passive, such as springs and fluids), and
    Coulomb friction. `held`: where locked joints stand.
    """
    names, rng = joint_names(model), np.random.default_rng(seed)
    ids = [names.index(name) for name in robot.joint_names]
    at_q, at_v = model.jnt_qposadr[ids], model.jnt_dofadr[ids]
    data, dynamics = mujoco.MjData(model), PinocchioDynamics(robot)
    for name, place in held.items():
        data.qpos[model.jnt_qposadr[names.index(name)]] = place
    low, high = robot.sampling_range
    found = {"M": 0.0, "C v + G": 0.0, "damping": 0.0}
    for q in rng.uniform(low, high, (poses, robot.nv)):
        v, full = rng.standard_normal(robot.nv), np.zeros((model.nv, model.nv))
        data.qpos[at_q], data.qvel[at_v] = q, v
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, full)
        bias = data.qfrc_bias[at_v] - data.qfrc_gravcomp[at_v]
        passive = data.qfrc_passive[at_v] - data.qfrc_gravcomp[at_v]
        scale = np.abs(bias).max() + np.abs(full).max()
        pairs = {
            "M": (dynamics.mass_matrix(q), full[np.ix_(at_v, at_v)], np.abs(full).max()),
            "C v + G": (dynamics.coriolis_matrix(q, v) @ v + dynamics.gravity(q), bias, scale),
            "damping": (-robot.damping * v, passive, np.abs(passive).max() + scale),
        }
        for name, (ours, theirs, size) in pairs.items():
            found[name] = max(found[name], float(np.abs(ours - theirs).max() / size))
    losses = model.dof_frictionloss[at_v]
    found["friction"] = float(np.abs(robot.friction - losses).max() / max(1.0, np.abs(losses).max()))
    return found
