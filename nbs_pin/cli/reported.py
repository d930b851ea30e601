"""The option of every command that writes results: a page of all of them."""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Reported:
    """Whether to write a page of the results."""

    report: bool = False
    """Also write report.html: verdict, numbers, charts and replay on one page that needs no network."""
