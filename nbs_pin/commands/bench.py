"""`nbs-pin bench`: run times of laws and plants on this machine."""

import json
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from nbs_pin.base.summaries import SUMMARY
from nbs_pin.benchmarks import bench
from nbs_pin.cli.bench import Bench
from nbs_pin.cli.values import OptionError
from nbs_pin.commands.results import Results, drawing, table, tell
from nbs_pin.reports.charts import plot_scaling
from nbs_pin.reports.plotting import Heading
from nbs_pin.reports.verdicts import verdict_of

PICTURE = "joints.png"
"""The picture that is written beside summary.json."""
_COLUMNS = {
    "control step": {
        "p50\n[µs]": "p50_us",
        "p99\n[µs]": "p99_us",
        "p99.9\n[µs]": "p99.9_us",
        "max\n[µs]": "max_us",
        "÷ two\nRNEA": "over_two_rnea",
        "torch\n÷ it": "torch_over_compiled",
    },
    "step in C": {
        "p50\n[µs]": "p50_us",
        "p99\n[µs]": "p99_us",
        "python\n[µs]": "python_us",
        "python\n÷ it": "python_over_c",
        "code, data\n[B]": "bytes",
    },
    "guarded step": {"p50\n[µs]": "p50_us", "p99\n[µs]": "p99_us", "law\n[µs]": "law_us", "guard\n[µs]": "guard_us"},
    "plant step": {"p50\n[µs]": "p50_us"},
    "simulate": {"steps\nper s": "steps_per_s", "recorded\n[MB]": "recorded_MB"},
    "model torque": {"p50\n[µs]": "p50_us", "÷ pinocchio": "over_pinocchio"},
    "joints": {"joints": "joints", "p50\n[µs]": "p50_us", "÷ two\nRNEA": "over_two_rnea"},
    "joints in C": {"joints": "joints", "p50\n[µs]": "p50_us", "code, data\n[B]": "bytes"},
    "training epoch": {"p50\n[ms]": "p50_ms", "torch\n÷ it": "torch_over_kernels"},
    "endurance": {
        "motion\n[s]": "duration_s",
        "wall\n[s]": "wall_s",
        "memory\ngrowth [MB]": "memory_growth_MB",
        "error, last\n÷ first": "last_over_first_error",
    },
    "workers": {"starts": "starts", "1 process\n[s]": "one_s", "2 processes\n[s]": "two_s", "speed-up": "speed_up"},
}


def run(options: Bench, console: Console, notes: Console) -> None:
    """Measure, write and print; raises NbsPinError or OSError."""
    known = None if options.compare is None else bench.rows_of(_read(options.compare))
    rows = []
    with notes.status("measuring; leave the machine idle otherwise") as status:
        for row in bench.bench(options.arms, calls=options.calls, long=options.long):
            rows.append(row)
            status.update(f"measured {row.key}")
    found = {"control_step_p50_us": _steps(rows)}
    verdict = verdict_of(found)
    results = Results(options.out, bench.summary(rows), report=options.report)
    with results.replaced((PICTURE,), found):
        pass  # the summary is all the data
    chain = [row.figures for row in rows if row.what == "joints"]
    lines = {"compiled law": "p50_us", "two RNEA": "two_rnea_us"}
    series = {name: [figures[key] for figures in chain] for name, key in lines.items()}
    with drawing(options.out / PICTURE) as path:
        heading = Heading("serial chains: cost of one control step", [results.facts["machine"]["processor"]], verdict)
        plot_scaling([figures["joints"] for figures in chain], series, path, heading)
    kinds = [what for what in _COLUMNS if any(row.what == what for row in rows)]
    tables = [_shown(what, _COLUMNS[what], [row for row in rows if row.what == what]) for what in kinds]
    tell(console, verdict.said, verdict.more, tables, verbose=options.verbose)
    if known is not None:
        console.print(_moved(bench.compare(rows, known)))
    results.show(console, (SUMMARY, PICTURE))


def _steps(rows: list[bench.Row]) -> dict[str, float]:
    """The time of one control step of the first law of every arm [µs]."""
    steps: dict[str, bench.Row] = {}
    for row in rows:
        if row.what == "control step":
            steps.setdefault(row.arm, row)
    return {f"{row.how} on {arm}": row.figures["p50_us"] for arm, row in steps.items()}


def _read(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise OptionError(
            f"--compare '{path}' is not JSON ({error}); give the summary.json of another bench."
        ) from None


def _shown(what: str, columns: dict[str, str], rows: list[bench.Row]) -> Table:
    shown = table(what, "what", *columns, first="arm")
    for row in rows:
        values = (row.figures.get(column) for column in columns.values())
        shown.add_row(Text(row.arm), Text(row.how), *("" if value is None else f"{value:.4g}" for value in values))
    return shown


def _moved(moved: list[tuple[str, str, float, float]]) -> Table | str:
    if not moved:
        return "no figure changed by more than 10 %"
    shown = table("changed by more than 10 %", "figure", "before", "now", "now / before", first="row")
    for key, name, before, now in moved:
        shown.add_row(Text(key), name, f"{before:.4g}", f"{now:.4g}", f"{now / before:.2f}" if before else "")
    return shown
