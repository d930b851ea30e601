"""The sentences on a challenge: who tracks best, who kept what was promised, and who did not finish."""

from collections.abc import Mapping, Sequence
from typing import Any


def challenge_told(standings: Sequence[Mapping[str, Any]]) -> tuple[bool, str, tuple[str, ...]]:
    """Whether every promise was kept, the sentence, and those that qualify it, from the standings by rank."""
    best = (f"{one['entrant']} ({1e3 * one['mean_error_rad']:.3g} mrad)" for one in standings[:2])
    kept = _each((one["entrant"], one["promised"] - one["broken"], one["promised"]) for one in standings)
    missed = _each((one["entrant"], n, one["tasks"]) for one in standings if (n := one["tasks"] - one["finished"]))
    more = [f"promises kept: {kept or 'none was made'}", *([f"tasks not finished: {missed}"] if missed else [])]
    is_kept = not any(one["broken"] for one in standings)
    return is_kept, f"tracked best by {', then by '.join(best)}, on the mean of all tasks", tuple(more)


def _each(shares: Any) -> str:
    """How many of how many, by entrant; nothing of none."""
    return ", ".join(f"{some} of {whole} by {entrant}" for entrant, some, whole in shares if whole)
