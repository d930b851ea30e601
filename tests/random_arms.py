"""Random arms: 1 to 12 joints, branched or not, turning and sliding, with rotors, friction and any mount."""

from pathlib import Path

import numpy as np

import nbs_pin as nbs


def random_arm(seed: int, folder: Path, joints: int | None = None) -> nbs.Robot:
    """An arm drawn with this seed, its description written into the folder.

    Links are rods of random mass with inertias that such bodies have, masses fall towards the tips, and efforts carry
    the arm with a margin. Rotors are up to the inertia of what the joint carries, Coulomb friction a few percent of the
    effort.
    """
    rng = np.random.default_rng(seed)
    count = int(rng.integers(1, 13)) if joints is None else joints
    parts, parents, depth = ['<robot name="random"><link name="l0"/>'], [], [0]
    for i in range(1, count + 1):
        parent = int(rng.integers(0, i)) if rng.random() < 0.2 else i - 1
        parents.append(parent)
        depth.append(depth[parent] + 1)
    for i, parent in enumerate(parents, 1):
        parts += [_link(rng, i, depth[i]), _joint(rng, i, parent)]
    path = folder / f"random-{seed}.urdf"
    path.write_text("".join([*parts, "</robot>"]))
    robot = nbs.load_robot(path, base_rpy=rng.uniform(-np.pi, np.pi, 3).tolist(), base_xyz=rng.normal(size=3).tolist())
    dynamics, q = nbs.PinocchioDynamics(robot), rng.uniform(*robot.sampling_range, (50, robot.nv))
    mass = np.diagonal(dynamics.mass_matrix(q), axis1=1, axis2=2).max(axis=0)
    effort = 3.0 * np.abs(dynamics.gravity(q)).max(axis=0) + 30.0 * mass
    return (
        robot.with_armature(rng.uniform(0.0, 1.0, count) * mass)
        .with_friction(
            coulomb=0.02 * rng.uniform(0.0, 1.0, count) * effort, viscous=rng.uniform(0.0, 2.0, count) * mass
        )
        .with_effort_limit(effort)
    )


def _text(values: np.ndarray) -> str:
    return " ".join(f"{x:.6f}" for x in values)


def _link(rng: np.random.Generator, i: int, depth: int) -> str:
    mass = float(rng.uniform(1.0, 5.0)) * 0.7**depth
    length, width = rng.uniform(0.15, 0.5), rng.uniform(0.03, 0.08)
    along, about = mass * (3.0 * width**2 + length**2) / 12.0, mass * width**2 / 2.0
    origin = f'<origin xyz="{_text(rng.uniform(-0.1, 0.1, 3))}" rpy="{_text(rng.uniform(-3.0, 3.0, 3))}"/>'
    inertia = f'<inertia ixx="{along:.9f}" iyy="{along:.9f}" izz="{about:.9f}" ixy="0" ixz="0" iyz="0"/>'
    return f'<link name="l{i}"><inertial>{origin}<mass value="{mass:.6f}"/>{inertia}</inertial></link>'


def _joint(rng: np.random.Generator, i: int, parent: int) -> str:
    axis = rng.normal(size=3)
    kind = "prismatic" if rng.random() < 0.2 else "continuous" if rng.random() < 0.15 else "revolute"
    lower, upper = (-0.3, 0.3) if kind == "prismatic" else (-2.5, 2.5)
    ends = "" if kind == "continuous" else f'lower="{lower}" upper="{upper}" '
    return (
        f'<joint name="j{i}" type="{kind}"><parent link="l{parent}"/><child link="l{i}"/>'
        f'<origin xyz="{_text(rng.uniform(-0.3, 0.3, 3))}" rpy="{_text(rng.uniform(-3.0, 3.0, 3))}"/>'
        f'<axis xyz="{_text(axis / np.linalg.norm(axis))}"/><limit {ends}effort="100" velocity="10"/></joint>'
    )
