"""`nbs-pin campaign`: many closed-loop runs from a file, shared by workers, saved as they come."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from nbs_pin.cli.reported import Reported
from nbs_pin.cli.values import Verbose, default, integer


@dataclass(frozen=True)
class Campaign(Reported):
    """Run every trial of a campaign; write table.csv, errors.png, the worst runs and summary.json.

    The file states what is the same in all trials, and in [grid] and [random] what varies. Each result is saved as it
    comes: the same command goes on where one was stopped. A trial that fails is a row with the reason.

    Example: nbs-pin campaign demos/loads.toml --workers 2
    """

    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE.toml")]
    """The campaign (docs/howto/many-runs.md)."""
    workers: Annotated[int | None, integer("--workers", least=1, most=1024), default("one per core")] = None
    """How many trials run at once on this machine."""
    cluster: Annotated[str | None, tyro.conf.arg(metavar="ADDRESS"), default("this machine")] = None
    """Scheduler of dask.distributed whose workers run the trials, such as tcp://10.0.0.1:8786."""
    parquet: bool = False
    """Also write table.parquet."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR"), default("out/campaign-FILE")] = None
    """Folder for the results."""
    force: bool = False
    """Begin again, in place of other results in that folder."""
    verbose: Verbose = False
    """Also print the tables; summary.json always has every number."""
