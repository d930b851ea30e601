"""Rows of the fault matrix: what goes wrong, how much, and what must come of it (docs/runtime.md)."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from nbs_pin.benchmarks.fault_trial import STRIKE, Arm, Outcome


class Verdict(NamedTuple):
    """What one trial gave."""

    passed: bool
    value: float
    """The figure that is compared [rad or s], or NaN where none is."""
    said: str = ""
    """A stop, in a word."""


class Case(NamedTuple):
    """A row of the matrix."""

    fault: str
    level: str
    wanted: str
    judge: Callable[[Arm, np.random.Generator], Verdict]


CASES: list[Case] = []
"""All rows, in order."""


def case(fault: str, level: str, wanted: str) -> Callable[[Any], Any]:
    """Decorator: add a row."""

    def add(judge: Callable[[Arm, np.random.Generator], Verdict]) -> Any:
        CASES.append(Case(fault, level, wanted, judge))
        return judge

    return add


def rows(fault: str, wanted: str, *levels: tuple[str, Any]) -> Callable[[Any], Any]:
    """Decorator: add a row for each level, whose number the function takes last."""

    def add(judge: Callable[[Arm, np.random.Generator, Any], Verdict]) -> Any:
        for level, size in levels:
            limit = size[-1] if isinstance(size, tuple) else size
            told = wanted.format(limit)
            made = Case(fault, level, told, lambda arm, rng, size=size: judge(arm, rng, size))  # type: ignore[misc]
            CASES.append(made)
        return judge

    return add


def below(outcome: Outcome, limit: float, value: float | None = None) -> Verdict:
    """Passed if it went on, legally, with the RMS error or another figure within the limit."""
    found = outcome.rms if value is None else value
    goes_on = outcome.report is None and not outcome.diverged and outcome.is_legal
    return Verdict(goes_on and found <= limit, found, outcome.code)


def stopped(outcome: Outcome, *codes: str, within: float, after: int = STRIKE) -> Verdict:
    """Passed if it stopped for one of these faults in time, legally."""
    found = (outcome.stopped - after) * outcome.period
    done = outcome.stops(*codes, within=within, after=after) and outcome.is_legal and not outcome.diverged
    return Verdict(done, found, outcome.code)
