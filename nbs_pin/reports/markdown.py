"""Pages of studies in Markdown: sections with the numbers behind them, and tables."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple


class Section(NamedTuple):
    """A part of a page."""

    title: str
    markdown: str
    """The text without the title."""
    figures: Mapping[str, Any] = {}
    """Every number in it, by name, as JSON can store it."""


def page(title: str, lead: str, sections: Sequence[Section]) -> str:
    """One Markdown page."""
    return "\n\n".join([f"# {title}", lead, *(f"## {s.title}\n\n{s.markdown.strip()}" for s in sections)]) + "\n"


def markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table with a first column of text and further columns of numbers."""
    ruler = ["---", *(["---:"] * (len(head) - 1))]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in (head, ruler, *rows))


def short(value: float, never: str = "∞") -> str:
    """The number in three digits, as 1.30e-6 rather than 0.0000013; `never` if it is not finite."""
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
