"""`nbs-pin faults`: the fault matrix of laws behind the guard."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from nbs_pin.cli.values import default, integer


@dataclass(frozen=True)
class Faults:
    """Inject every fault of docs/runtime.md into simulated loops behind the guard; compare with what must come of it.

    Example: nbs-pin faults --arms panda --seeds 1
    """

    arms: Annotated[tuple[str, ...], tyro.conf.arg(metavar="ROBOT")] = ("two_link", "ur5", "panda")
    """Arms by name or path."""
    seeds: Annotated[int, integer("--seeds", most=1000, least=1)] = 5
    """Trials of every row."""
    only: Annotated[tuple[str, ...], tyro.conf.arg(metavar="FAULT"), default("all")] = ()
    """Rows to run, such as F16 F21."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")] = Path("out/faults")
    """Folder for summary.json."""
