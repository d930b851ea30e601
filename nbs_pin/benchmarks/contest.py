"""The whole challenge: every entrant on every task, shared by cores, saved as it comes, resumed where it stopped."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.versions import versions
from nbs_pin.benchmarks.challenge_tasks import ARMS, DURATION, MOTIONS, PERIOD, SETTLED, START_ERROR
from nbs_pin.benchmarks.conditions import CONDITIONS
from nbs_pin.benchmarks.entrants import SHIPPED, Entrant
from nbs_pin.benchmarks.judging import BUDGET, Budget, Job, judge
from nbs_pin.benchmarks.scores import Row, row_of
from nbs_pin.campaigns.runner import run_jobs


@dataclass(frozen=True)
class Contest:
    """Who is judged on which tasks."""

    entrants: tuple[Entrant, ...] = tuple(map(Entrant, SHIPPED))
    seed: int = 0
    arms: tuple[str, ...] = ARMS
    motions: tuple[str, ...] = tuple(MOTIONS)
    conditions: tuple[str, ...] = tuple(CONDITIONS)
    budget: Budget = BUDGET

    @property
    def plan(self) -> dict[str, Any]:
        """All that determines the results but the entrants, whose files are in the keys of their jobs."""
        tasks = {"motions": list(self.motions), "conditions": list(self.conditions), "budget": self.budget._asdict()}
        numbers = {"period": PERIOD, "duration": DURATION, "settled": SETTLED, "start_error": START_ERROR}
        return {"seed": self.seed, **tasks, **numbers, "versions": versions()}

    def jobs(self) -> dict[str, Job]:
        """All jobs by key: promises, some of which take long, before runs; each is asked for once."""
        found: dict[str, Job] = {}
        for entrant in self.entrants:
            if entrant.may_promise:
                found |= {_key("promise", entrant, arm): self._job("promise", entrant, arm) for arm in self.arms}
        for entrant in self.entrants:
            found |= {_key("run", entrant, arm): self._job("run", entrant, arm) for arm in self.arms}
        return found

    def held(self, folder: Path, *, workers: int = 2, progress: bool = False) -> list[Row]:
        """Run what the folder does not have yet, and return every row, entrant by entrant.

        Raises:
            ArgumentError: If the folder has results of another challenge, or another process adds to it.
            OSError: If it cannot be written.
        """
        found = run_jobs(judge, self.jobs(), folder, self.plan, workers=workers, label="challenge", progress=progress)
        rows = []
        for entrant in self.entrants:
            for arm in self.arms:
                runs = found[_key("run", entrant, arm)].result or {}
                promises = found[_key("promise", entrant, arm)].result or {} if entrant.may_promise else {}
                for motion in self.motions:
                    for condition in self.conditions:
                        key = f"{motion} {condition}"
                        promise = (promises.get(key, {}).get("result") or {}).get("promise")
                        rows.append(row_of(entrant.shown, (arm, motion, condition), runs[key], promise))
        return rows

    def _job(self, kind: Any, entrant: Entrant, arm: str) -> Job:
        name = entrant.promises_of if kind == "promise" else entrant.name
        return Job(kind, name, arm, self.seed, self.motions, self.conditions, self.budget)


QUICK: dict[str, tuple[str, ...]] = {
    "arms": ("ur5e",),
    "motions": ("sinusoid", "moves"),
    "conditions": ("nominal", "friction", "load", "delay"),
}
"""A few tasks, to see in a minute what there is."""


def _key(kind: str, entrant: Entrant, arm: str) -> str:
    name = entrant.promises_of if kind == "promise" else entrant.name
    return " ".join(word for word in (kind, arm, name, entrant.digest) if word)


def entrants_of(names: Sequence[str], *, alone: bool = False) -> tuple[Entrant, ...]:
    """The entrants shipped, unless `alone`, and those of these names, each once.

    Raises ArgumentError for an unknown name, or for two that the tables would call the same.
    """
    shipped = () if alone else map(Entrant, SHIPPED)
    found = tuple(dict.fromkeys((*shipped, *map(Entrant.read, names))))
    called = [entrant.shown for entrant in found]
    for name in called:
        if called.count(name) > 1:
            raise ArgumentError(f"two entrants are called '{name}' in the tables; rename a file or its function.")
    return found
