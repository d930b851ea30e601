"""Bounds of the inertia matrix against sampled and adversarial poses of every arm."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from nbs_pin.base.arrays import JointArray
from nbs_pin.base.claims import weakest
from nbs_pin.base.csv_files import write_csv
from nbs_pin.base.plain import plain
from nbs_pin.base.progress import tracked
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.inertia.bounds import largest_inertia_bound, least_inertia_bound
from nbs_pin.reports.markdown import Section, markdown_table, short
from nbs_pin.robots.catalogue import ROBOT_NAMES
from nbs_pin.robots.robot import load_robot

FILE = "inertia_bounds.csv"
_BATCH = 5_000
_ANGLES = 24


@dataclass(frozen=True)
class Scale:
    """How many poses of which arms."""

    arms: Sequence[str] = ROBOT_NAMES
    samples: int = 100_000
    """Uniform poses of an arm, joints that turn anywhere in a whole turn."""
    climbs: int = 50
    """Poses that search for the extremes, half of them for each."""
    sweeps: int = 8
    """Turns of a climb through all joints."""


class Row(NamedTuple):
    """One arm."""

    arm: str
    joints: int
    least_bound_kgm2: float
    """a₁."""
    least_found_kgm2: float
    """The least eigenvalue of M met."""
    least_looseness: float
    largest_bound_kgm2: float
    """a₂."""
    largest_found_kgm2: float
    """The largest."""
    largest_looseness: float
    poses: int
    outside: int
    """Poses with an eigenvalue outside [a₁, a₂]."""
    label: str
    """Of both bounds, the weaker one."""


def study(scale: Scale, seed: int = 0, progress: bool = False) -> list[Row]:
    """A row per arm."""
    return [on_arm(name, scale, seed) for name in tracked(list(scale.arms), "inertia bounds", progress)]


def on_arm(name: str, scale: Scale, seed: int = 0) -> Row:
    """Both bounds of one arm against uniform poses, and against poses that climb from the worst of them."""
    robot = load_robot(name)
    dynamics, rng = PinocchioDynamics(robot), np.random.default_rng(seed)
    largest, least = largest_inertia_bound(robot, np.eye(robot.nv)), least_inertia_bound(robot)
    slides = np.array([joint.prismatic for joint in robot.joints])
    low, high = np.where(slides, robot.lower, -np.pi), np.where(slides, robot.upper, np.pi)

    def spectra(q: Float[np.ndarray, "count n"]) -> Float[np.ndarray, "count 2"]:
        return np.asarray(np.linalg.eigvalsh(dynamics.mass_matrix(q))[:, [0, -1]])

    found, starts = [], []
    for first in range(0, scale.samples, _BATCH):
        q = rng.uniform(low, high, (min(_BATCH, scale.samples - first), robot.nv))
        found.append(spectra(q))
        starts += [q[np.argsort(found[-1][:, 0])[: scale.climbs]], q[np.argsort(-found[-1][:, 1])[: scale.climbs]]]
    half = max(1, scale.climbs // 2)
    pool = np.concatenate(starts)
    ends = spectra(pool)
    found.append(spectra(_climbed(pool[np.argsort(ends[:, 0])[:half]], low, high, lambda q: -spectra(q)[:, 0], scale)))
    found.append(spectra(_climbed(pool[np.argsort(-ends[:, 1])[:half]], low, high, lambda q: spectra(q)[:, 1], scale)))
    extremes = np.concatenate(found)
    outside = (extremes[:, 0] < least.value) | (extremes[:, 1] > largest.value)
    smallest, greatest = float(extremes[:, 0].min()), float(extremes[:, 1].max())
    return Row(
        name,
        robot.nv,
        least.value,
        smallest,
        smallest / least.value if least.value > 0.0 else float("inf"),
        float(largest.value),
        greatest,
        float(largest.value) / greatest,
        len(extremes),
        int(outside.sum()),
        str(weakest(largest.label, least.label)),
    )


def _climbed(
    q: Float[np.ndarray, "count n"],
    low: JointArray,
    high: JointArray,
    height: Callable[[np.ndarray], np.ndarray],
    scale: Scale,
) -> Float[np.ndarray, "count n"]:
    """The poses after coordinate ascent: joint by joint the best of evenly spaced angles, ever closer around it."""
    q, reach = q.copy(), 0.5 * (high - low)
    count, n = q.shape
    for _ in range(scale.sweeps):
        for joint in range(n):
            steps = np.concatenate([[0.0], np.linspace(-1.0, 1.0, _ANGLES)])
            trial = np.repeat(q[:, None], len(steps), axis=1)
            moved = trial[..., joint] + reach[joint] * steps
            trial[..., joint] = np.clip(moved, low[joint], high[joint])
            best = height(trial.reshape(-1, n)).reshape(count, -1).argmax(axis=1)
            q = trial[np.arange(count), best]
        reach = 0.35 * reach
    return q


def write(rows: Sequence[Row], folder: Path) -> None:
    """Writes `FILE`; raises OSError when it cannot be written."""
    write_csv(folder / FILE, Row._fields, rows)


def section(rows: Sequence[Row], scale: Scale) -> Section:
    """The table of the page."""
    head = ["", "a₁ [kg·m²]", "least found", "÷", "a₂ [kg·m²]", "largest found", "÷", "outside"]
    cells = [
        [
            f"{row.arm}, {row.joints} joints",
            short(row.least_bound_kgm2),
            short(row.least_found_kgm2),
            f"{row.least_looseness:.3f}",
            short(row.largest_bound_kgm2),
            short(row.largest_found_kgm2),
            f"{row.largest_looseness:.3f}",
            f"{row.outside} of {row.poses}",
        ]
        for row in rows
    ]
    text = f"""
a₁I ⪯ M(q) ⪯ a₂I over all poses, proved (docs/certificates.md), against {scale.samples} uniform poses of each arm and
{scale.climbs} that climb, joint by joint, from the worst of them, half for each end. ÷ is how loose a bound is.

{markdown_table(head, cells)}"""
    return Section("Bounds of the inertia", text, {"inertia_bounds": plain([row._asdict() for row in rows])})
