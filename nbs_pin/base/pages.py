"""Pages of studies: sections of Markdown, the numbers behind them, and tables in Markdown and CSV."""

import csv
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from nbs_pin.base.files import write_whole


class Section(NamedTuple):
    """A part of a page."""

    title: str
    markdown: str
    """Its text, without the title."""
    figures: Mapping[str, Any] = {}
    """Every number in it, by name, as JSON can store it."""


def page(title: str, lead: str, sections: Sequence[Section]) -> str:
    """One Markdown page."""
    return "\n\n".join([f"# {title}", lead, *(f"## {s.title}\n\n{s.markdown.strip()}" for s in sections)]) + "\n"


def markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table whose first column is text and whose others are numbers."""
    ruler = ["---", *(["---:"] * (len(head) - 1))]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in (head, ruler, *rows))


def write_csv(path: Path, head: Sequence[str], rows: Sequence[Sequence[Any]]) -> Path:
    """A table as a file, whole or not at all; numbers in full precision."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([head, *rows])
    return write_whole(path, text.getvalue().encode())


def short(value: float, never: str = "∞") -> str:
    """A number in three digits, 1.30e-6 rather than 0.0000013; `never` for one that is not finite."""
    if not math.isfinite(value):
        return never
    if value == 0.0:
        return "0"
    mantissa, exponent = f"{value:.2e}".split("e")
    power = int(exponent)
    if not -2 <= power <= 3:
        return f"{mantissa}e{power}"
    text = f"{float(f'{value:.2e}'):.{max(2 - power, 0)}f}"
    return text.rstrip("0") if power < 0 else text


def plain(values: Any) -> Any:
    """Arrays and numbers as JSON can store them, None for what is not finite."""
    if isinstance(values, Mapping):
        return {key: plain(value) for key, value in values.items()}
    if isinstance(values, np.ndarray | np.generic):
        values = values.tolist()
    if isinstance(values, list | tuple):
        return [plain(value) for value in values]
    return None if isinstance(values, float) and not math.isfinite(values) else values
