"""The options of every command that writes results: a page of all of them, and pictures for print."""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Reported:
    """What to write of the results besides files and pictures."""

    report: bool = False
    """Also write report.html: verdict, numbers, charts and replay on one page that needs no network."""
    svg: bool = False
    """Also write every picture as SVG, for print."""
