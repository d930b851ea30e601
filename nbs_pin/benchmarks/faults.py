"""The fault matrix: every row on every arm, on all cores (docs/runtime.md)."""

from collections.abc import Sequence

import numpy as np

from nbs_pin.benchmarks import faults_ridden, faults_stopped
from nbs_pin.benchmarks.fault_rows import CASES, Verdict
from nbs_pin.benchmarks.fault_trial import arm_named
from nbs_pin.simulation.processes import on_all_cores

MODULES = (faults_ridden, faults_stopped)
"""Where the rows are written."""
MATRIX = sorted(CASES, key=lambda case: int(case.fault[1:].split()[0]))
"""All rows, by their numbers."""


def judge(at: int, arm: str, seed: int) -> Verdict:
    """One trial of row `at`."""
    return MATRIX[at].judge(arm_named(arm), np.random.default_rng([at, seed]))


def matrix(
    chosen: Sequence[int], arms: Sequence[str], seeds: int, *, progress: bool = False
) -> dict[tuple[int, str], list[Verdict]]:
    """The trials of the chosen rows, by row and arm."""
    tasks = [(at, arm, seed) for arm in arms for at in chosen for seed in range(seeds)]
    found: dict[tuple[int, str], list[Verdict]] = {}
    for (at, arm, _), verdict in zip(tasks, on_all_cores(judge, tasks, "faults", progress), strict=True):
        found.setdefault((at, arm), []).append(verdict)
    return found
