"""`nbs-pin replay`: a recorded run as a page that plays in the browser."""

import webbrowser
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console

from nbs_pin.cli.values import OptionError, integer


def _default(hint: str) -> Any:
    return tyro.conf.arg(help_behavior_hint=f"(default: {hint})")


@dataclass(frozen=True)
class Replay:
    """Turn a recorded run into one page that plays in any browser without a network.

    Example: nbs-pin replay out/track-panda/run.npz --open
    """

    run_file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """A run.npz, or the folder that holds one."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE"), _default("replay.html beside the run")] = None
    """The page to write."""
    robot: Annotated[str | None, tyro.conf.arg(metavar="ROBOT"), _default("the one the run names")] = None
    """The arm that ran, when its file has moved."""
    start: Annotated[int, integer("--start", most=10**6)] = 0
    """Which start of a batched run to show."""
    open: bool = False
    """Open the page in the browser."""
    force: bool = False
    """Replace the file that --out names."""

    def run(self, console: Console, notes: Console) -> None:
        """Writes the page and says where; raises NbsPinError or OSError."""
        source = self.run_file / "run.npz" if self.run_file.is_dir() else self.run_file
        page = self.out or source.with_name("replay.html")
        if page.is_dir():
            raise OptionError(f"--out '{page}' is a folder; give a file such as '{page / 'replay.html'}'.")
        if self.out and page.exists() and not self.force:
            raise OptionError(f"'{page}' exists; give another --out, or --force to replace it.")
        with notes.status(f"drawing {page}"):
            from nbs_pin.base.records import Run
            from nbs_pin.reports.replay import replay
            from nbs_pin.robots.robot import load_robot

            run = Run.load(source)
            replay(run, page, None if self.robot is None else load_robot(self.robot), start=self.start)
        console.print(str(page), soft_wrap=True, highlight=False, markup=False)
        if self.open and not webbrowser.open(page.resolve().as_uri()):
            notes.print(f"nbs-pin: no browser could be opened; open {page} yourself.", soft_wrap=True, markup=False)
