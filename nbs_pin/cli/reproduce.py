"""`nbs-pin reproduce`: the paper's experiments and further studies, on one page."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from nbs_pin.cli.reported import Reported
from nbs_pin.cli.values import integer


@dataclass(frozen=True)
class Reproduce(Reported):
    """Reproduce the paper's experiments or run further studies; write report.md, summary.json, figures and CSV files.

    Ctrl-C keeps the sections that are done.

    Example: nbs-pin reproduce --out out/reproduce
    """

    part: Literal["paper", "fair", "lnn", "models", "certificates", "all"] = "paper"
    """paper: its Table I, figures and sweep over α.
    fair: every law, tuned alike, on arms with rotors, friction, loads and encoders.
    lnn: its Figure 5, control with learned models, and what data without torque do not determine.
    models: learned models against the truth, from clean and noisy data, with and without structure; about an hour.
    certificates: certified errors against the worst ones found, a counterexample to the paper's bound,
    and bounds of the inertia against sampled configurations."""
    quick: bool = False
    """A page with few seeds, arms and epochs, to see what there is: its figures are not those of the study."""
    seed: Annotated[int, integer("--seed", most=2**31 - 1)] = 0
    """First seed; every page says how many were run."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")] = Path("out/reproduce")
    """Folder for the results."""
    force: bool = False
    """Overwrite the results of another run in that folder."""
