"""`nbs-pin report`: results of one or more commands on one page."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from nbs_pin.cli.values import default, several_of


@dataclass(frozen=True)
class Report:
    """Write one page with the results of commands side by side, which opens in any browser without a network.

    It begins with a verdict, and has numbers, certificates, pictures, and of every run the charts and the replay, on
    one time; the commands, settings and versions are on it.

    Example: nbs-pin report out/track-panda out/track-panda-2 --open
    """

    folders: Annotated[tuple[Path, ...], tyro.conf.Positional, several_of("DIR")]
    """Folders with the results, each with its summary.json."""
    out: Annotated[
        Path | None, tyro.conf.arg(metavar="FILE"), default("report.html in the folder, or beside the first of several")
    ] = None
    """The page to write."""
    open: bool = False
    """Open the page in the browser."""
    force: bool = False
    """Overwrite the page of other folders, or the file that --out names."""
