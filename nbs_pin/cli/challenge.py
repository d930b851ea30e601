"""`nbs-pin challenge`: laws of anyone on the same arms, motions and conditions."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from nbs_pin.cli.values import Verbose, default, integer


@dataclass(frozen=True)
class Challenge:
    """Judge laws on five arms, four motions and seven conditions, and whether they keep what they promise.

    Ours take part with default settings. Write challenge.html, a page that needs no network, tables (tasks.csv,
    challenge.md) and summary.json. Results are saved as they come: the same command goes on where one was stopped, and
    runs of further entrants are added.

    Example: nbs-pin challenge --entrant my_law.py:make
    """

    entrant: Annotated[tuple[str, ...], tyro.conf.arg(metavar="ENTRANT"), default("none")] = ()
    """Further entrants: FILE.py:FUNCTION, where FUNCTION(robot, period) returns a callable of q, v, q_d, v_d, a_d, t
    that returns torques, or a Controller; a law of ours by name, or one as C, such as c:sliding-mode."""
    alone: bool = False
    """Judge only these, without ours."""
    arms: Annotated[tuple[str, ...], tyro.conf.arg(metavar="ROBOT"), default("all five")] = ()
    """Some of the arms, or other ones by name."""
    motions: Annotated[tuple[str, ...], tyro.conf.arg(metavar="MOTION"), default("all four")] = ()
    """Some of the motions: sinusoid, moves, circle, excitation."""
    conditions: Annotated[tuple[str, ...], tyro.conf.arg(metavar="CONDITION"), default("all seven")] = ()
    """Some of the conditions: nominal, friction, inertia, load, delay, encoders, limits."""
    quick: bool = False
    """A minute's worth of tasks, to see what there is."""
    seed: Annotated[int, integer("--seed", most=2**31 - 1)] = 0
    """Seed of the starts and of the bodies that differ."""
    workers: Annotated[int, integer("--workers", most=1024)] = 0
    """Processes at once; 0 takes one per core."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")] = Path("out/challenge")
    """Folder for the results."""
    force: bool = False
    """Begin again, and overwrite the results of another challenge in that folder."""
    verbose: Verbose = False
    """Also print the tables."""
