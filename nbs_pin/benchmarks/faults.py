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
) -> tuple[dict[tuple[int, str], list[Verdict]], bool]:
    """The trials of the chosen rows, by row and arm, and whether Ctrl-C ended them.

    Then only complete rows are returned. Raises KeyboardInterrupt if that came before the first row was complete.
    """
    tasks = [(at, arm, seed) for at in chosen for arm in arms for seed in range(seeds)]
    verdicts: list[Verdict] = []
    try:
        verdicts.extend(on_all_cores(judge, tasks, "faults", progress))
    except KeyboardInterrupt:
        if len(verdicts) < len(arms) * seeds:
            raise
    whole = len(verdicts) - len(verdicts) % (len(arms) * seeds)
    found: dict[tuple[int, str], list[Verdict]] = {}
    for (at, arm, _), verdict in zip(tasks[:whole], verdicts[:whole], strict=True):
        found.setdefault((at, arm), []).append(verdict)
    return found, whole < len(tasks)
