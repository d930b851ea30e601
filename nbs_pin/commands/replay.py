"""`nbs-pin replay`: a recorded run as a page for the browser."""

import webbrowser

from rich.console import Console

from nbs_pin.base.exports import KINDS
from nbs_pin.base.records import Run
from nbs_pin.cli.replay import Replay
from nbs_pin.commands.inputs import arm_that_ran, run_file
from nbs_pin.commands.results import page_file
from nbs_pin.reports.replay import replay
from nbs_pin.reports.run_import import import_run


def run(options: Replay, console: Console, notes: Console) -> None:
    """Write the page and print its path; raises NbsPinError or OSError."""
    source = run_file(options.run_file)
    page = page_file(options.out, source.with_name("replay.html"), force=options.force)
    with notes.status(f"drawing {page}"):
        robot = arm_that_ran(options)
        exported = source.suffix.lower().removeprefix(".") in KINDS
        played = import_run(source, robot) if exported else Run.load(source)
        replay(played, page, robot, start=options.start)
    console.print(str(page), soft_wrap=True, highlight=False, markup=False)
    if options.open and not webbrowser.open(page.resolve().as_uri()):
        notes.print(f"nbs-pin: no browser could be opened; open {page} yourself.", soft_wrap=True, markup=False)
