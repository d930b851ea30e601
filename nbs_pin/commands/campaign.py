"""`nbs-pin campaign`: many closed-loop runs from a file; the table, a picture, the worst runs and a summary."""

import time
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from nbs_pin.base.progress import heartbeat
from nbs_pin.base.summaries import RUN, SUMMARY, summary_in
from nbs_pin.base.units import counted, percent
from nbs_pin.campaigns.campaign import Campaign as Plan
from nbs_pin.campaigns.journal import JOURNAL, forget
from nbs_pin.campaigns.table import CampaignTable, check_parquet, figures_of_rows, in_words, run_campaign
from nbs_pin.campaigns.trials import run_of
from nbs_pin.cli.campaign import Campaign
from nbs_pin.commands.results import Results, drawing, table, tell
from nbs_pin.kernels.threads import cores
from nbs_pin.reports.campaign_charts import plot_campaign
from nbs_pin.reports.plotting import Heading
from nbs_pin.reports.verdicts import verdict_of

CSV, PARQUET, PICTURE = "table.csv", "table.parquet", "errors.png"
FILES = (CSV, PARQUET, PICTURE, SUMMARY)
"""What it writes besides the journal and runs."""


def run(options: Campaign, console: Console, notes: Console) -> None:
    """Run what is left, write and print; raises NbsPinError, OSError, and KeyboardInterrupt after an early end."""
    plan = Plan.load(options.file)
    if options.parquet:
        check_parquet()
    results = Results.of(options, options.file.stem, None, workers=None, cluster=None, campaign=plan.plan)
    begun = (results.folder / JOURNAL).exists()
    if options.force:
        forget(results.folder)
    elif not begun:
        results = results.check(FILES, force=False, whose="another command")
    with results.made() as folder:
        start = time.perf_counter()
        try:
            with heartbeat(options.file.stem):
                done = run_campaign(
                    plan, folder, workers=options.workers or cores(), cluster=options.cluster, progress=True
                )
        except KeyboardInterrupt:
            notes.print(f"what was done is kept in {folder / JOURNAL}; the same command goes on.")
            raise
        wall = time.perf_counter() - start
        runs = _names(done, plan.keep_runs)
        with notes.status(f"writing the table and {counted(len(runs), 'run')} into {folder}"):
            _write(done, runs, results, options.file.stem, parquet=options.parquet)
    verdict = verdict_of(done.figures)
    reasons = dict.fromkeys(row.failure for row in done.failures)
    lines = [*verdict.more, *(f"failed: {reason}" for reason in list(reasons)[:3]), f"ran in {wall:.1f} s"]
    tell(console, f"{options.file.stem}: {verdict.said}", lines, [_table(done)], verbose=options.verbose)
    results.show(console, (CSV, PARQUET, PICTURE, *runs, SUMMARY), *(("replay", folder, "--open") if runs else ()))


def _names(done: CampaignTable, most: int) -> dict[str, Any]:
    """The worst trials by the names of the files with their runs."""
    return {RUN if k == 0 else f"run-{row.trial.number}.npz": row.trial for k, row in enumerate(done.worst(most))}


def _write(done: CampaignTable, runs: dict[str, Any], results: Results, title: str, *, parquet: bool) -> None:
    """Write the table and the runs, which are simulated again, and draw the picture."""
    figures = done.figures
    before = summary_in(results.folder).get("runs")
    old = [name for name in before if isinstance(name, str)] if isinstance(before, list) else []
    names = dict.fromkeys((CSV, PARQUET, PICTURE, *runs, *(Path(name).name for name in old)))
    with results.replaced(tuple(names), figures, runs=list(runs)) as draft:
        done.write_csv(draft / CSV)
        if parquet:
            done.write_parquet(draft / PARQUET)
        for name, trial in runs.items():
            recorded, _ = run_of(trial)
            recorded.info.update(results.facts)
            recorded.save(draft / name)
    if done.worst(1):
        with drawing(results.folder / PICTURE) as path:
            plot_campaign(done, path, Heading(title, _settings(done), verdict_of(figures)))


def _settings(done: CampaignTable) -> list[str]:
    campaign = done.campaign
    fixed = [in_words(dict(campaign.fixed))]
    drawn = [f"random {', '.join(name.replace('_', ' ') for name in campaign.random)}"] if campaign.random else []
    return [*fixed, *drawn, f"seed {campaign.seed}"]


def _table(done: CampaignTable) -> Table:
    """A row per group."""
    shown = table("groups", "trials", "failed", "median RMS", "worst RMS", "converged", "saturated", first="group")
    for words, rows in done.groups().items():
        of = figures_of_rows(rows)
        count = len(rows)
        errors = (
            "" if of[key] is None else f"{of[key]:.3g}" for key in ("median_rms_error_rad", "worst_rms_error_rad")
        )
        shares = (percent(of[key] / count) for key in ("converged", "saturated"))
        shown.add_row(Text(words), str(count), str(of["failed"]), *errors, *shares)
    return shown
