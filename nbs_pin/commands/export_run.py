"""`nbs-pin export-run`: a recorded run for the tools that others have."""

from rich.console import Console

from nbs_pin.base.exports import KINDS
from nbs_pin.base.records import Run
from nbs_pin.cli.export_run import ExportRun
from nbs_pin.cli.values import OptionError
from nbs_pin.commands.certify import WATCHED
from nbs_pin.commands.inputs import arm_that_ran, run_file
from nbs_pin.reports.run_export import export_run


def run(options: ExportRun, console: Console, notes: Console) -> None:
    """Write the file and print its path; raises NbsPinError or OSError."""
    source, ending = run_file(options.run_file), f".{options.to}"
    if source.suffix.lower().removeprefix(".") in KINDS:
        raise OptionError(f"'{source}' is an exported file; give the run.npz that it was made of.")
    file = options.out or source.with_suffix(ending)
    if file.is_dir():
        raise OptionError(f"--out '{file}' is a folder; give a file such as '{file / f'run{ending}'}'.")
    if file.suffix.lower() != ending:
        raise OptionError(f"--out '{file}' does not end in {ending}; rename it, or give another --to.")
    if options.out and file.exists() and not options.force:
        raise OptionError(f"'{file}' exists; give another --out, or --force to replace it.")
    with notes.status(f"writing {file}"):
        robot = arm_that_ran(options)
        signals = None if options.signals is None else options.signals.split(",")
        watched = None if options.monitored is None else options.monitored / WATCHED
        export_run(Run.load(source), file, robot, start=options.start, signals=signals, monitored=watched)
    console.print(str(file), soft_wrap=True, highlight=False, markup=False)
