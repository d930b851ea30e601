"""`nbs-pin bench`: what the laws and plants cost on this machine."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from nbs_pin.cli.values import OptionError, integer

_COLUMNS = {
    "control step": {
        "p50\n[µs]": "p50_us",
        "p99\n[µs]": "p99_us",
        "p99.9\n[µs]": "p99.9_us",
        "max\n[µs]": "max_us",
        "÷ two\nRNEA": "over_two_rnea",
        "torch\n÷ it": "torch_over_compiled",
    },
    "plant step": {"p50\n[µs]": "p50_us"},
    "simulate": {"steps\nper s": "steps_per_s", "recorded\n[MB]": "recorded_MB"},
    "model torque": {"p50\n[µs]": "p50_us", "÷ pinocchio": "over_pinocchio"},
    "joints": {"joints": "joints", "p50\n[µs]": "p50_us", "÷ two\nRNEA": "over_two_rnea"},
    "training epoch": {"p50\n[ms]": "p50_ms", "torch\n÷ it": "torch_over_kernels"},
    "endurance": {
        "motion\n[s]": "duration_s",
        "wall\n[s]": "wall_s",
        "memory\ngrowth [MB]": "memory_growth_MB",
        "error, last\n÷ first": "last_over_first_error",
    },
    "workers": {"starts": "starts", "1 process\n[s]": "one_s", "2 processes\n[s]": "two_s", "speed-up": "speed_up"},
}


@dataclass(frozen=True)
class Bench:
    """Time every law on arms of your choice, plant steps, and cost against the number of joints.

    Example: nbs-pin bench --arms panda ur5 --out out/bench --compare old/summary.json
    """

    arms: Annotated[tuple[str, ...], tyro.conf.arg(metavar="ROBOT")] = ("two_link", "panda", "ur5")
    """Arms by name or path."""
    calls: Annotated[int, integer("--calls", most=10_000_000)] = 20_000
    """How often each control step is timed."""
    long: bool = False
    """Also an hour of motion and a thousand starts; a few minutes."""
    compare: Annotated[Path | None, tyro.conf.arg(metavar="SUMMARY")] = None
    """summary.json of an earlier bench: also print what moved by more than a tenth."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")] = Path("out/bench")
    """Folder for summary.json and joints.png."""

    def run(self, console: Console, notes: Console) -> None:
        """Measures, writes and prints; raises NbsPinError or OSError."""
        old = None if self.compare is None else _read(self.compare)
        with notes.status("compiling"):
            from nbs_pin.base.files import write_whole
            from nbs_pin.benchmarks import bench
            from nbs_pin.reports.charts import plot_scaling

        known = None if old is None else bench.rows_of(old)
        rows = []
        with notes.status("measuring; leave the machine alone") as status:
            for row in bench.bench(self.arms, calls=self.calls, long=self.long):
                rows.append(row)
                status.update(f"measured {row.key}")
        self.out.mkdir(parents=True, exist_ok=True)
        summary = json.dumps(bench.summary(rows), indent=2, allow_nan=False)
        write_whole(self.out / "summary.json", summary.encode())
        chain = [row.figures for row in rows if row.what == "joints"]
        lines = {"compiled law": "p50_us", "two RNEA": "two_rnea_us"}
        series = {name: [figures[key] for figures in chain] for name, key in lines.items()}
        plot_scaling([figures["joints"] for figures in chain], series, self.out / "joints.png")
        for what, columns in _COLUMNS.items():
            if any(row.what == what for row in rows):
                console.print(_table(what, columns, [row for row in rows if row.what == what]))
        if known is not None:
            console.print(_moved(bench.compare(rows, known)))
        console.print(str(self.out / "summary.json"), str(self.out / "joints.png"), sep="\n", highlight=False)


def _read(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise OptionError(f"--compare '{path}' is no JSON ({error}); give the summary.json of another bench.") from None


def _table(what: str, columns: dict[str, str], rows: list[Any]) -> Table:
    table = Table(title=Text(what), box=box.SIMPLE_HEAD, title_justify="left", title_style="bold")
    for heading in ("arm", "what"):
        table.add_column(heading, no_wrap=True)
    for heading in columns:
        table.add_column(Text(heading), justify="right", no_wrap=True)
    for row in rows:
        values = (row.figures.get(column) for column in columns.values())
        table.add_row(row.arm, row.how, *("" if value is None else f"{value:.4g}" for value in values))
    return table


def _moved(moved: list[tuple[str, str, float, float]]) -> Table | str:
    if not moved:
        return "nothing moved by more than a tenth"
    table = Table(title=Text("moved by more than a tenth"), box=box.SIMPLE_HEAD, title_justify="left")
    for heading in ("row", "figure", "before", "now", "now / before"):
        table.add_column(heading)
    for key, name, before, now in moved:
        table.add_row(key, name, f"{before:.4g}", f"{now:.4g}", f"{now / before:.2f}" if before else "")
    return table
