"""`nbs-pin challenge`: laws of anyone on the same arms, motions and conditions."""

import datetime
import time
from collections.abc import Collection

from rich.console import Console
from rich.table import Table
from rich.text import Text

from nbs_pin.base.csv_files import write_csv
from nbs_pin.base.plain import plain
from nbs_pin.base.summaries import SUMMARY
from nbs_pin.base.units import counted
from nbs_pin.benchmarks.bench import machine
from nbs_pin.benchmarks.challenge_page import challenge_page
from nbs_pin.benchmarks.challenge_tables import MATRIX, STANDINGS, matrix_cells, standing_cells, written_table
from nbs_pin.benchmarks.challenge_tasks import ARMS, MOTIONS
from nbs_pin.benchmarks.conditions import CONDITIONS
from nbs_pin.benchmarks.contest import QUICK, Contest, entrants_of
from nbs_pin.benchmarks.scores import Row, Standing, mean_errors, standings
from nbs_pin.campaigns.journal import JOURNAL, forget
from nbs_pin.cli.challenge import Challenge
from nbs_pin.cli.values import OptionError
from nbs_pin.commands.results import Results, table, tell
from nbs_pin.kernels.threads import cores
from nbs_pin.reports.verdicts import verdict_of
from nbs_pin.robots.robot import load_robot

FILES = ("challenge.html", "tasks.csv", "challenge.md", SUMMARY)
"""The files that are written besides the journal."""


def run(options: Challenge, console: Console, notes: Console) -> None:
    """Judge what the folder does not have yet, write and print; raises NbsPinError or OSError."""
    contest = _contest(options)
    results = Results.of(options, "challenge", None)
    if options.force:
        forget(results.folder)
    elif not (results.folder / JOURNAL).exists():
        results = results.check(FILES, force=False, whose="another command")
    began = time.perf_counter()
    with results.made() as folder:
        rows = contest.held(folder, workers=options.workers or cores(), progress=True)
        found = standings(rows)
        figures = {
            "standings": [each._asdict() for each in found],
            "errors_by_condition_rad": mean_errors(rows, "condition"),
            "errors_by_arm_rad": mean_errors(rows, "arm"),
            "errors_by_motion_rad": mean_errors(rows, "motion"),
        }
        verdict = verdict_of(figures)
        facts = results.facts | {"machine": machine(), "date": datetime.date.today().isoformat()}
        with results.replaced(FILES[:-1], plain(figures), machine=facts["machine"], date=facts["date"]) as draft:
            write_csv(draft / FILES[1], Row._fields, rows)
            (draft / FILES[2]).write_text(written_table(found, rows, facts), encoding="utf-8")
            (draft / FILES[0]).write_bytes(challenge_page(contest, rows, verdict, facts))
    shown = _standings(found), _matrix(found, rows)
    tell(console, verdict.said, verdict.more, shown, verbose=options.verbose)
    wall = time.perf_counter() - began
    notes.print(f"{counted(len(rows), 'task')} of {counted(len(found), 'entrant')}, in {wall:.0f} s")
    results.show(console, FILES)


def _contest(options: Challenge) -> Contest:
    if options.alone and not options.entrant:
        raise OptionError("--alone leaves out our laws, but no --entrant is given; give one.")
    chosen = QUICK if options.quick else {"arms": ARMS, "motions": tuple(MOTIONS), "conditions": tuple(CONDITIONS)}
    for arm in options.arms:
        load_robot(arm)
    given = {
        "arms": options.arms,
        "motions": _known("motions", options.motions, MOTIONS),
        "conditions": _known("conditions", options.conditions, CONDITIONS),
    }
    arms, motions, conditions = (tuple(dict.fromkeys(of or chosen[name])) for name, of in given.items())
    return Contest(entrants_of(options.entrant, alone=options.alone), options.seed, arms, motions, conditions)


def _known(flag: str, given: tuple[str, ...], names: Collection[str]) -> tuple[str, ...]:
    for name in given:
        if name not in names:
            raise OptionError(f"--{flag} has '{name:.80}'; give some of {', '.join(names)}.")
    return given


def _standings(found: list[Standing]) -> Table:
    shown = table("standings", *(head.replace(" ", "\n") for head, _ in STANDINGS), first="entrant")
    for each in found:
        shown.add_row(Text(each.entrant), *standing_cells(each))
    return shown


def _matrix(found: list[Standing], rows: list[Row]) -> Table:
    errors = mean_errors(rows, "condition")
    conditions = list(dict.fromkeys(row.condition for row in rows))
    shown = table(MATRIX, *conditions, first="entrant")
    for each in found:
        shown.add_row(Text(each.entrant), *matrix_cells(errors[each.entrant], conditions))
    return shown
