"""A campaign done: its trials with their figures, as a table and in files."""

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from nbs_pin.base.arguments import a, checked, count, flag, maybe, path, text, writable
from nbs_pin.base.csv_files import write_csv
from nbs_pin.base.exceptions import ArgumentError, MissingExtra, NbsPinError
from nbs_pin.base.files import whole_file
from nbs_pin.base.shown import Cells, Shown
from nbs_pin.base.units import counted, measured
from nbs_pin.base.versions import versions
from nbs_pin.campaigns.campaign import Campaign, Trial
from nbs_pin.campaigns.runner import run_jobs
from nbs_pin.campaigns.trials import Figures, figures_of, is_fused
from nbs_pin.campaigns.variables import VARIABLES, Span

_KIND = ("robot", "law", "bandwidth", "period", "disturbance", "friction", "unknown_viscous", "unknown_coulomb",
         "plant", "integrator", "plant_step")  # fmt: skip
"""What decides whether a trial is one kernel."""


class Row(NamedTuple):
    """A trial and what came of it.

    Example:
        >>> import tempfile
        >>> import nbs_pin as nbs
        >>> campaign = nbs.Campaign({"robot": "pnda"})
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     row = nbs.run_campaign(campaign, folder).rows[0]
        >>> row.figures is None, "did you mean panda" in row.failure
        (True, True)
    """

    trial: Trial
    figures: Figures | None
    """None where it failed."""
    failure: str
    """Why it failed, in a sentence; empty where it did not."""


@dataclass(frozen=True, eq=False, repr=False)
class CampaignTable(Shown):
    """A row for every trial of a campaign.

    Example:
        >>> import tempfile
        >>> import nbs_pin as nbs
        >>> campaign = nbs.Campaign({"robot": "two_link", "duration": 0.2}, grid={"payload": [0.0, 1.0]})
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     table = nbs.run_campaign(campaign, folder)
        >>> table.column("payload"), table.worst(1)[0].trial.number
        ([0.0, 1.0], 1)
    """

    campaign: Campaign
    rows: tuple[Row, ...]

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the columns: trial and sample, the variables that the campaign names, figures, failure."""
        return "trial", "sample", *self.campaign.stated, *Figures._fields, "failure"

    @checked(name=text)
    def column(self, name: str) -> list[Any]:
        """The values of a column, None for the figures of a trial that failed."""
        if name not in self.columns:
            raise ArgumentError(f"there is no column '{name:.80}'; give one of {', '.join(self.columns)}.")
        if name in Figures._fields:
            return [None if row.figures is None else getattr(row.figures, name) for row in self.rows]
        if name in ("trial", "sample"):
            return [row.trial[0 if name == "trial" else 1] for row in self.rows]
        return [row.failure if name == "failure" else row.trial.values[name] for row in self.rows]

    @property
    def failures(self) -> tuple[Row, ...]:
        """The rows of the trials that failed."""
        return tuple(row for row in self.rows if row.figures is None)

    @checked(most=count(0))
    def worst(self, most: int) -> tuple[Row, ...]:
        """At most so many rows, of the largest RMS errors, the largest first."""
        done = [(row.figures.rms_error_rad, -row.trial.number, row) for row in self.rows if row.figures is not None]
        return tuple(row for _, _, row in sorted(done, key=lambda x: x[:2], reverse=True)[:most])

    @checked(path=writable)
    def write_csv(self, path: str | Path) -> Path:
        """Write the table as CSV, with numbers in full precision; an empty cell is None."""
        columns = [self.column(name) for name in self.columns]
        return write_csv(Path(path), self.columns, list(zip(*columns, strict=True)))

    @checked(path=writable)
    def write_parquet(self, path: str | Path) -> Path:
        """Write the table as Parquet, for pandas, polars, duckdb and dask; raises MissingExtra without pyarrow."""
        table, write = check_parquet()
        with whole_file(path) as file:
            write(table({name: self.column(name) for name in self.columns}), file, compression="zstd")
        return Path(path)

    @checked(most=count(1))
    def groups(self, most: int = 24) -> dict[str, tuple[Row, ...]]:
        """The rows by the values of what varies in steps, in words: by as many variables as make at most `most`."""
        stepped = {**self.campaign.grid, **{k: x for k, x in self.campaign.random.items() if not isinstance(x, Span)}}
        while prod(len(values) for values in stepped.values()) > most:
            stepped.popitem()
        found: dict[str, list[Row]] = {}
        for row in self.rows:
            found.setdefault(in_words({name: row.trial.values[name] for name in stepped}), []).append(row)
        return {words: tuple(rows) for words, rows in found.items()}

    @property
    def figures(self) -> dict[str, Any]:
        """What summary.json keeps: counts, medians and the worst trial, of all and of each group."""
        worst, varied = self.worst(1), (*self.campaign.grid, *self.campaign.random)
        groups = {words: figures_of_rows(rows) for words, rows in self.groups().items()}
        found = {"trials": len(self.rows), **figures_of_rows(self.rows), "groups": groups if len(groups) > 1 else {}}
        if worst:
            trial, figures, _ = worst[0]
            assert figures is not None
            about = {name: trial.values[name] for name in varied}
            told = in_words(about) if about else ""
            found["worst"] = {"trial": trial.number, "settings": about, "told": told, "joint": figures.worst_joint}
            found["unit"] = figures.unit
        return found

    def _facts(self) -> Iterable[str]:
        yield counted(len(self.rows), "trial")
        if self.failures:
            yield counted(len(self.failures), "failure")
        for row in self.worst(1):
            assert row.figures is not None
            errors = [error for error in self.column("rms_error_rad") if error is not None]
            yield f"median RMS error {measured(float(np.median(errors)), row.figures.unit)}"
            yield f"worst {measured(row.figures.rms_error_rad, row.figures.unit)} in trial {row.trial.number}"

    def _cells(self) -> Cells:
        names = [*self.campaign.grid, *self.campaign.random]
        rows = [
            (
                str(row.trial.number),
                *(str(row.trial.values[name]) for name in names),
                f"{row.figures.rms_error_rad:.3g}",
            )
            for row in self.worst(10)
            if row.figures is not None
        ]
        return Cells(("trial", *names, "RMS error [rad]"), rows)


def in_words(values: Mapping[str, Any]) -> str:
    """Values of variables, as in "nbs, payload 2 kg"; "all" without any."""
    told = []
    for name, value in values.items():
        number = f"{name.replace('_', ' ')} {value:.4g} {VARIABLES[name].unit}" if VARIABLES[name].is_number else value
        told.append("usual " + name if value is None else str(number).strip())
    return ", ".join(told) or "all"


def figures_of_rows(rows: Sequence[Row]) -> dict[str, Any]:
    """Counts and errors of some rows, as JSON can store them."""
    done = [row.figures for row in rows if row.figures is not None]
    errors = np.array([figures.rms_error_rad for figures in done])
    return {
        "failed": sum(row.figures is None for row in rows),
        "converged": sum(figures.converged_s is not None for figures in done),
        "saturated": sum(figures.saturated_share > 0.0 for figures in done),
        "median_rms_error_rad": float(np.median(errors)) if done else None,
        "worst_rms_error_rad": float(errors.max()) if done else None,
    }


def check_parquet() -> tuple[Any, Any]:
    """What makes a table of columns, and what writes it; raises MissingExtra without pyarrow."""
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError as error:
        raise MissingExtra("Parquet needs pyarrow: pip install 'nbs-pin[parquet]'.") from error
    return pyarrow.table, parquet.write_table


@checked(
    campaign=a(Campaign, "a Campaign, such as Campaign.load reads"),
    folder=path,
    workers=count(1, 1024, "workers"),
    cluster=maybe(text),
    progress=flag,
)
def run_campaign(
    campaign: Campaign, folder: str | Path, *, workers: int = 1, cluster: str | None = None, progress: bool = False
) -> CampaignTable:
    """Run every trial of the campaign that the folder has no result of, and return the table of all of them.

    Every result is saved as it comes, in results.jsonl in the folder: the same call goes on where one was stopped, also
    by a kill. A trial that fails, as its arm cannot be read or its law diverges, is a row with the reason. The table is
    the same from any number of workers. Trials whose law and plant have kernels are shared by threads, others by
    processes.

    Args:
        campaign: What is run.
        folder: Where the results are saved.
        workers: How many trials run at once on this machine.
        cluster: Address of a scheduler of dask.distributed, whose workers run the trials; files are found there under
            the same paths.
        progress: Show a progress bar on a terminal after 2 s.

    Raises:
        ArgumentError: If the folder has results of another campaign, of other versions or files, or is in use; it
            names what changed.
        FileFormatError: If results.jsonl is damaged.
        MissingExtra: If a cluster is given and dask.distributed is not installed.
        OSError: If the folder cannot be written.

    Example:
        >>> import tempfile
        >>> import nbs_pin as nbs
        >>> campaign = nbs.Campaign({"robot": "two_link", "duration": 0.2}, grid={"law": ["nbs", "pid"]})
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     len(nbs.run_campaign(campaign, folder).rows)
        2
    """
    trials = campaign.trials
    outcomes = run_jobs(
        figures_of,
        {str(trial.number): trial for trial in trials},
        folder,
        {**campaign.plan, "files": _files(trials), "versions": versions()},
        workers=workers,
        processes=workers > 1 and cluster is None and not _shared_by_threads(trials),
        cluster=cluster,
        label="trials",
        progress=progress,
    )
    rows = []
    for trial, outcome in zip(trials, outcomes.values(), strict=True):
        rows.append(Row(trial, None if outcome.result is None else Figures(**outcome.result), outcome.failure))
    return CampaignTable(campaign, tuple(rows))


def _shared_by_threads(trials: Iterable[Trial]) -> bool:
    """Whether every kind of trial is one kernel, which threads can run at once."""
    kinds = {tuple(trial.values[name] for name in _KIND): trial for trial in trials}
    for trial in kinds.values():
        if trial.values["disturbance"].startswith("noise"):
            return False  # it is drawn by the interpreter, a number at a time
        try:
            if not is_fused(trial):
                return False
        except NbsPinError:  # a failure takes no time
            continue
    return True


def _files(trials: Iterable[Trial]) -> dict[str, str]:
    """SHA-256 of the files that the trials name."""
    names = dict.fromkeys(trial.values[name] for trial in trials for name in ("robot", "law", "reference"))
    files: Mapping[str, Path] = {name: Path(name) for name in names}
    return {name: hashlib.sha256(f.read_bytes()).hexdigest() for name, f in files.items() if f.is_file()}
