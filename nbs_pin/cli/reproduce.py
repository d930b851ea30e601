"""`nbs-pin reproduce`: the paper's experiments again, on one page."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from nbs_pin.cli.values import integer


@dataclass(frozen=True)
class Reproduce:
    """Run the paper's experiments and the fair comparison, and write report.md, summary.json, pictures and CSV.

    Example: nbs-pin reproduce --out out/reproduce
    """

    part: Literal["paper", "fair", "lnn", "models", "certificates", "all"] = "paper"
    """paper: its Table I, its figures and its sweep over α. fair: every law tuned alike and judged on fresh starts.
    lnn: its Figure 5, control on learned models, and what data without torque leave open.
    models: learned models against the truth, from clean data, from noisy data, and what structure is worth;
    about an hour.
    certificates: certified errors against the worst that an adversary finds, the paper's bound broken by one joint, and
    bounds of the inertia against poses."""
    seed: Annotated[int, integer("--seed", most=2**31 - 1)] = 0
    """First of the seeds; every page says how many were run."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")] = Path("out/reproduce")
    """Folder for the results."""
    force: bool = False
    """Replace the results of another run in that folder."""
