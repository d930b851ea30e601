"""How objects are shown: in one line at a prompt, and as a small table in a notebook."""

import html
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np


class Cells(NamedTuple):
    """A small table of texts."""

    headings: Sequence[str] = ()
    rows: Sequence[Sequence[str]] = ()


class Shown:
    """What is shown by the facts that its class states, the most important first."""

    def _facts(self) -> Iterable[str]:
        """Short facts in words, numbers with units."""
        raise NotImplementedError

    def _cells(self) -> Cells:
        """What a notebook shows below the facts; nothing unless a class states it."""
        return Cells()

    def __repr__(self) -> str:
        return f"{type(self).__name__}({', '.join(self._facts())})"

    def _repr_html_(self) -> str:
        """The facts and the table, for a notebook; every text is escaped."""
        name, facts = html.escape(type(self).__name__), html.escape(", ".join(self._facts()))
        headings, rows = self._cells()
        table = "".join([_row("th", headings), *(_row("td", row) for row in rows)])
        return f"<div><b>{name}</b> {facts}{f'<table>{table}</table>' if rows else ''}</div>"


def _row(tag: str, cells: Sequence[str]) -> str:
    return f"<tr>{''.join(f'<{tag}>{html.escape(cell)}</{tag}>' for cell in cells)}</tr>"


def mixture(parts: Any, names: Sequence[str]) -> str:
    """The largest components of a direction in words, such as "+0.80 link1 m −0.60 link2 m"."""
    parts = np.asarray(parts) / np.linalg.norm(parts)
    largest = [k for k in np.argsort(-np.abs(parts))[:4] if abs(parts[k]) > 0.2]
    return " ".join(f"{parts[k]:+.2f} {names[k]}" for k in largest)


def counted(count: int, noun: str, plural: str = "") -> str:
    """A number of things in words: "1 start", "2 starts"; plural: of a noun that takes more than an s."""
    return f"{count} {noun if count == 1 else plural or f'{noun}s'}"


def joints_told(count: int) -> str:
    """A number of joints in words."""
    return counted(count, "joint")


def weighed(factors: Mapping[str, str], constant: str = "0", unit: str = "") -> str:
    """A sum of numbers times symbols and a constant: "2 a + b + 3 N" for {"a": "2", "b": "1", "c": "0"}, "3", "N"."""
    terms = [of if factor == "1" else f"{factor} {of}" for of, factor in factors.items() if factor != "0"]
    return " + ".join([*terms, *([f"{constant} {unit}".rstrip()] if constant != "0" or not terms else [])])


def spread(name: str, values: Any, unit: str) -> str:
    """The range of a quantity over the joints, such as "effort 12 to 87 N·m"."""
    least, most = float(np.min(values)), float(np.max(values))
    range_ = f"{least:.3g}" if f"{least:.3g}" == f"{most:.3g}" else f"{least:.3g} to {most:.3g}"
    return f"{name} {range_} {unit}".rstrip()
