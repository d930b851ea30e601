"""The summary of a folder of results: what made them, their figures, and the names of the files with the runs."""

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

SUMMARY, REPORT, RUN = "summary.json", "report.html", "run.npz"
"""Names of the summary, of the page that shows the results, and of the run of one law."""


def runs_of_laws(laws: Iterable[str]) -> dict[str, str]:
    """Names of the runs of several laws on one motion."""
    return {law: f"run-{law}.npz" for law in laws}


def summary_text(summary: Mapping[str, Any]) -> str:
    """A summary as the text of summary.json."""
    return json.dumps(summary, indent=2, allow_nan=False, ensure_ascii=False) + "\n"


def summary_in(folder: Path) -> dict[str, Any]:
    """The content of summary.json in the folder, empty if it cannot be read."""
    try:
        summary = json.loads((folder / SUMMARY).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return summary if isinstance(summary, dict) else {}
