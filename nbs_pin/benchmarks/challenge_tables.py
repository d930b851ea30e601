"""The tables of the challenge as texts, for the shell, the page and Markdown."""

from collections.abc import Mapping, Sequence
from typing import Any

from nbs_pin.base.units import percent
from nbs_pin.benchmarks.scores import Row, Standing, mean_errors
from nbs_pin.reports.markdown import markdown_table, short

STANDINGS = (
    ("mean [mrad]", "mean RMS error of all tasks, by which entrants are ranked"),
    ("median [mrad]", "half of the tasks are below"),
    ("peak [mrad]", "largest error of a joint in a task that was finished"),
    ("saturated", "share of the time with a joint at its effort limit"),
    ("finished", "tasks finished within the limits of the arm"),
    ("promises", "tasks for which it promised something"),
    ("broken", "promises that a run exceeded"),
    ("promise ÷ worst", "how wide the promises are: the median over tasks, 1 would be exact"),
)
"""Columns of the standings, and what they mean."""
MATRIX = "mean RMS error [mrad] by condition"
"""Title of the table of entrants and conditions."""


def in_mrad(error: float | None) -> str:
    """An error in three digits."""
    return "none" if error is None else short(1e3 * error)


def standing_cells(of: Standing) -> list[str]:
    """The texts of `STANDINGS`."""
    return [
        in_mrad(of.mean_error_rad),
        in_mrad(of.median_error_rad),
        in_mrad(of.peak_error_rad),
        "none" if of.saturated_fraction is None else percent(of.saturated_fraction, 1),
        f"{of.finished} of {of.tasks}",
        str(of.promised) if of.promised else "none",
        str(of.broken) if of.promised else "",
        "" if of.promise_over_worst is None else short(of.promise_over_worst),
    ]


def matrix_cells(errors: Mapping[str, float], columns: Sequence[str]) -> list[str]:
    """The errors of one entrant in these columns."""
    return [in_mrad(errors[column]) for column in columns]


def written_table(found: Sequence[Standing], rows: Sequence[Row], facts: Mapping[str, Any]) -> str:
    """The standings and the errors by condition in Markdown, with machine, versions and date."""
    heads = ("entrant", *(head for head, _ in STANDINGS))
    first = markdown_table(heads, [(each.entrant, *standing_cells(each)) for each in found])
    errors, conditions = mean_errors(rows, "condition"), list(dict.fromkeys(row.condition for row in rows))
    second = markdown_table(
        ("entrant", *conditions), [(each.entrant, *matrix_cells(errors[each.entrant], conditions)) for each in found]
    )
    return f"{first}\n\nThe {MATRIX}:\n\n{second}\n\n{origin(facts)}\n"


def origin(facts: Mapping[str, Any]) -> str:
    """Date, seed, machine and versions in a sentence."""
    made = ", ".join(f"{name} {version}" for name, version in facts["versions"].items())
    return f"Seed {facts['settings']['seed']}, {facts['date']}, {facts['machine']['processor']}; {made}."
