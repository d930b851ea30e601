"""`nbs-pin reproduce`: the paper's experiments and further studies, on one page."""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from nbs_pin.benchmarks.fair import fair_part
from nbs_pin.cli.reproduce import Reproduce
from nbs_pin.commands.results import SUMMARY, Results
from nbs_pin.reports.markdown import page
from nbs_pin.reproduction.certificate_study import reproduce_certificates
from nbs_pin.reproduction.learned_loop import reproduce_learned
from nbs_pin.reproduction.model_study import reproduce_models
from nbs_pin.reproduction.paper import reproduce_paper

FILES = ("report.md", SUMMARY)
"""The files that are written besides those of the parts."""
PARTS: dict[str, Callable[[Path, int, bool], Sequence[Any]]] = {
    "paper": reproduce_paper,
    "fair": fair_part,
    "lnn": reproduce_learned,
    "models": reproduce_models,
    "certificates": reproduce_certificates,
}
"""Functions that write the files of a part into a folder and return its sections of the page."""


def run(options: Reproduce, console: Console, notes: Console) -> None:
    """Run the parts, write and print; raises NbsPinError or OSError."""
    results = Results.of(options, "paper", None)
    results = results.check(FILES, options.force)
    chosen = list(PARTS) if options.part == "all" else [options.part]
    began = time.perf_counter()
    with results.made() as folder:
        for name in FILES[::-1]:  # what describes earlier parts, which are replaced one by one
            (folder / name).unlink(missing_ok=True)
        sections = [section for name in chosen for section in PARTS[name](folder, options.seed, True)]
        wall_time = time.perf_counter() - began
        lead = f"Written by `nbs-pin reproduce --part {options.part} --seed {options.seed}` in {wall_time:.0f} s."
        figures = {name: value for section in sections for name, value in section.figures.items()}
        with results.replaced(FILES[:1], figures, wall_time_s=wall_time) as draft:
            (draft / FILES[0]).write_text(page("The paper's experiments, reproduced", lead, sections), encoding="utf-8")
    console.print(f"{', '.join(chosen)}: done in {wall_time:.0f} s", highlight=False)
    results.show(console, FILES)
