"""The summary of a folder of results: what made them, and their figures."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

SUMMARY, REPORT = "summary.json", "report.html"
"""Names of the summary and of the page that shows the results."""


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
