"""Scores: what the tasks of every entrant amount to, the same from the same seed."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

UNFINISHED = 1.0
"""Error that counts for a task not finished within the limits of the arm, and the largest that counts [rad]."""


class Row(NamedTuple):
    """One entrant on one task."""

    entrant: str
    arm: str
    motion: str
    condition: str
    rms_error_rad: float | None
    """Of ‖z1‖, from a second on; None, as all figures, where the run ended early."""
    peak_error_rad: float | None
    """Largest |z1_i|, from a second on."""
    saturated_fraction: float | None
    """Share of the control periods with some joint at its effort limit."""
    promise: Literal["none", "kept", "broken"]
    promise_over_worst: float | None
    """Geometric mean over the joints of promised ÷ largest error; None without a promise or a run."""
    failed: str
    """Why the task was not finished within the limits of the arm; empty if it was."""

    @property
    def counted(self) -> float:
        """The error that counts [rad]."""
        return UNFINISHED if self.failed or self.rms_error_rad is None else min(self.rms_error_rad, UNFINISHED)


class Standing(NamedTuple):
    """What all tasks of an entrant amount to."""

    entrant: str
    mean_error_rad: float
    """Mean of the errors that count, by which entrants are ranked."""
    median_error_rad: float
    finished: int
    tasks: int
    peak_error_rad: float | None
    """Largest of the tasks that were finished; None if none was."""
    saturated_fraction: float | None
    """Mean of these."""
    promised: int
    """Tasks for which it promised something."""
    broken: int
    promise_over_worst: float | None
    """Median of these tasks."""


def row_of(entrant: str, task: tuple[str, str, str], answer: Mapping[str, Any], promise: Sequence[float] | None) -> Row:
    """A row from the answer of a run, and the promise for its task.

    A run that fails breaks its promise, as does any joint that goes farther than promised.
    """
    result = answer.get("result")
    if result is None:
        return Row(entrant, *task, None, None, None, "none" if promise is None else "broken", None, answer["failure"])
    state: Literal["none", "kept", "broken"] = "none"
    ratio = None
    if promise is not None:
        worst, bound = np.array(result["worst"]), np.array(promise)
        state = "kept" if (worst <= bound).all() and not result["left"] else "broken"
        smallest = np.finfo(float).tiny
        ratio = math.exp(float(np.mean(np.log(bound / np.maximum(worst, smallest)))))
    return Row(entrant, *task, result["rms"], result["peak"], result["saturated"], state, ratio, result["left"])


def standings(rows: Sequence[Row]) -> list[Standing]:
    """The entrants, the one of the least mean error first."""
    each: dict[str, list[Row]] = {}
    for row in rows:
        each.setdefault(row.entrant, []).append(row)
    return sorted((_standing(name, own) for name, own in each.items()), key=lambda one: one.mean_error_rad)


def mean_errors(rows: Sequence[Row], by: Literal["condition", "arm", "motion"]) -> dict[str, dict[str, float]]:
    """The mean of the errors that count [rad] by entrant, and by condition, arm or motion."""
    cells: dict[str, dict[str, list[float]]] = {}
    for row in rows:
        cells.setdefault(row.entrant, {}).setdefault(getattr(row, by), []).append(row.counted)
    return {entrant: {key: float(np.mean(x)) for key, x in of.items()} for entrant, of in cells.items()}


def _standing(name: str, rows: Sequence[Row]) -> Standing:
    done, promised = [row for row in rows if not row.failed], [row for row in rows if row.promise != "none"]
    ratios = [row.promise_over_worst for row in promised if row.promise_over_worst is not None]
    errors = [row.counted for row in rows]
    return Standing(
        entrant=name,
        mean_error_rad=float(np.mean(errors)),
        median_error_rad=float(np.median(errors)),
        finished=len(done),
        tasks=len(rows),
        peak_error_rad=max((row.peak_error_rad or 0.0 for row in done), default=None),
        saturated_fraction=float(np.mean([row.saturated_fraction for row in done])) if done else None,
        promised=len(promised),
        broken=sum(row.promise == "broken" for row in promised),
        promise_over_worst=float(np.median(ratios)) if ratios else None,
    )
