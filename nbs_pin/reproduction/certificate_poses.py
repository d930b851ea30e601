"""Bounds of the inertia matrix against sampled and adversarial poses of every arm."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from nbs_pin.base.arrays import JointArray
from nbs_pin.base.claims import weakest
from nbs_pin.base.progress import tracked
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.inertia.bounds import largest_inertia_bound, least_inertia_bound
from nbs_pin.reports.markdown import Section, markdown_table, short
from nbs_pin.reproduction.study import write_records
from nbs_pin.robots.catalogue import ROBOT_NAMES
from nbs_pin.robots.robot import load_robot

FILE = "inertia_bounds.csv"
_BATCH, _ANGLES = 5_000, 24
_OUTWARD = np.array([[-1.0], [1.0]])  # signs with which the smallest and the largest eigenvalue approach their bounds


class Scale(NamedTuple):
    """Which arms, and how many poses of each."""

    arms: Sequence[str] = ROBOT_NAMES
    samples: int = 100_000
    """Uniform poses of an arm, every revolute joint over a whole turn."""
    climbs: int = 50
    """Poses that search for the extremes, half of them for each."""
    sweeps: int = 8
    """Passes of the search over all joints."""


class Row(NamedTuple):
    """One arm."""

    arm: str
    joints: int
    least_bound_kgm2: float
    """a₁."""
    least_found_kgm2: float
    """Smallest eigenvalue of M found."""
    least_looseness: float
    """Found ÷ a₁."""
    largest_bound_kgm2: float
    """a₂."""
    largest_found_kgm2: float
    """Largest eigenvalue of M found."""
    largest_looseness: float
    """a₂ ÷ found."""
    poses: int
    outside: int
    """Poses with an eigenvalue outside [a₁, a₂]."""
    label: str
    """The weaker one of both bounds."""


def study(scale: Scale, seed: int = 0, progress: bool = False) -> list[Row]:
    """A row per arm."""
    return [on_arm(name, scale, seed) for name in tracked(list(scale.arms), "inertia bounds", progress)]


def on_arm(name: str, scale: Scale, seed: int = 0) -> Row:
    """Both bounds of one arm against uniform poses, and against poses that climb from the worst of them."""
    robot = load_robot(name)
    dynamics, rng = PinocchioDynamics(robot), np.random.default_rng(seed)
    largest, least = largest_inertia_bound(robot, np.eye(robot.nv)), least_inertia_bound(robot)
    low, high = np.where(robot.prismatic, robot.lower, -np.pi), np.where(robot.prismatic, robot.upper, np.pi)

    def heights(q: Float[np.ndarray, "count n"]) -> Float[np.ndarray, "2 count"]:
        """−λ_min and λ_max of M."""
        return np.linalg.eigvalsh(dynamics.mass_matrix(q))[:, [0, -1]].T * _OUTWARD

    found, starts = [], []
    for first in range(0, scale.samples, _BATCH):
        q = rng.uniform(low, high, (min(_BATCH, scale.samples - first), robot.nv))
        found.append(heights(q))
        starts += [q[np.argsort(-height)[: scale.climbs]] for height in found[-1]]
    pool, half = np.concatenate(starts), max(1, scale.climbs // 2)
    for end, height in enumerate(heights(pool)):
        best = pool[np.argsort(-height)[:half]]
        found.append(heights(_climbed(best, low, high, heights, end, scale.sweeps)))
    smallest, greatest = np.concatenate(found, axis=1) * _OUTWARD
    least_found, largest_found = float(smallest.min()), float(greatest.max())
    outside = (smallest < least.value) | (greatest > largest.value)
    looseness = least_found / least.value if least.value > 0.0 else np.inf, float(largest.value) / largest_found
    return Row(
        *(name, robot.nv, least.value, least_found, looseness[0], float(largest.value), largest_found, looseness[1]),
        *(len(outside), int(outside.sum()), str(weakest(largest.label, least.label))),
    )


def _climbed(
    q: np.ndarray, low: JointArray, high: JointArray, heights: Callable[[Any], np.ndarray], end: int, sweeps: int
) -> Float[np.ndarray, "count n"]:
    """The poses after coordinate ascent: joint by joint the best of evenly spaced angles, ever closer around it."""
    reach, (count, n) = 0.5 * (high - low), q.shape
    steps = np.concatenate([[0.0], np.linspace(-1.0, 1.0, _ANGLES)])
    for _ in range(sweeps):
        for joint in range(n):
            trial = np.repeat(q[:, None], len(steps), axis=1)
            trial[..., joint] = np.clip(trial[..., joint] + reach[joint] * steps, low[joint], high[joint])
            q = trial[np.arange(count), heights(trial.reshape(-1, n))[end].reshape(count, -1).argmax(axis=1)]
        reach = 0.35 * reach
    return q


def section(rows: Sequence[Row], scale: Scale, folder: Path) -> Section:
    """The table of the page, with its file in the folder."""
    head = ["", "a₁ [kg·m²]", "least found", "÷", "a₂ [kg·m²]", "largest found", "÷", "outside"]
    cells = [
        [
            f"{row.arm}, {row.joints} joints",
            *(short(row.least_bound_kgm2), short(row.least_found_kgm2), f"{row.least_looseness:.3f}"),
            *(short(row.largest_bound_kgm2), short(row.largest_found_kgm2), f"{row.largest_looseness:.3f}"),
            f"{row.outside} of {row.poses}",
        ]
        for row in rows
    ]
    text = f"""
a₁I ⪯ M(q) ⪯ a₂I over all poses, proved (docs/certificates.md), against {scale.samples} uniform poses of each arm and
{scale.climbs} that climb, joint by joint, from the worst of them, half for each end. ÷ is the looseness of a bound.

{markdown_table(head, cells)}"""
    return Section("Bounds of the inertia", text, {"inertia_bounds": write_records(folder / FILE, rows)})
