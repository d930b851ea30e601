"""`nbs-pin report`: results of one or more commands on one page."""

import webbrowser

from rich.console import Console

from nbs_pin.base.summaries import REPORT
from nbs_pin.cli.report import Report
from nbs_pin.cli.values import OptionError
from nbs_pin.commands.results import page_file
from nbs_pin.reports.report import report


def run(options: Report, console: Console, notes: Console) -> None:
    """Write the page and print its path; raises NbsPinError or OSError."""
    if not options.folders:
        raise OptionError("no folder was given; give those of results, such as out/track-panda.")
    first = options.folders[0]
    usual = (first if len(options.folders) == 1 else first.parent) / REPORT
    page = page_file(options.out, usual, force=options.force, is_own=len(options.folders) == 1)
    with notes.status(f"drawing {page}"):
        report(options.folders, page)
    console.print(str(page), soft_wrap=True, highlight=False, markup=False)
    if options.open and not webbrowser.open(page.resolve().as_uri()):
        notes.print(f"nbs-pin: no browser could be opened; open {page} yourself.", soft_wrap=True, markup=False)
