"""How objects are shown: in one line at a prompt, and as a small table in a notebook."""

import html
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from nbs_pin.base.units import counted


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


def joints_told(count: int) -> str:
    """A number of joints in words."""
    return counted(count, "joint")


def spread(name: str, values: Any, unit: str) -> str:
    """The range of a quantity over the joints, such as "effort 12 to 87 N·m"."""
    least, most = float(np.min(values)), float(np.max(values))
    range_ = f"{least:.3g}" if f"{least:.3g}" == f"{most:.3g}" else f"{least:.3g} to {most:.3g}"
    return f"{name} {range_} {unit}".rstrip()
