"""`nbs-pin reproduce`: the paper's experiments and further studies, on one page."""

import time
from collections.abc import Callable, Iterable
from typing import Any

from rich.console import Console

from nbs_pin.base.summaries import SUMMARY
from nbs_pin.benchmarks import fair
from nbs_pin.cli.reproduce import Reproduce
from nbs_pin.commands.results import Results, tell
from nbs_pin.reports.markdown import page
from nbs_pin.reproduction import certificate_study, learned_loop, model_study, paper

FILES = ("report.md", SUMMARY)
"""The files that are written besides those of the parts."""
PARTS: dict[str, Callable[..., Iterable[Any]]] = {
    "paper": paper.reproduce_paper,
    "fair": fair.fair_part,
    "lnn": learned_loop.reproduce_learned,
    "models": model_study.reproduce_models,
    "certificates": certificate_study.reproduce_certificates,
}
"""Functions that write the files of a part into a folder and give its sections of the page, one by one."""


QUICK: dict[str, Any] = {
    "paper": paper.QUICK,
    "fair": fair.QUICK,
    "lnn": learned_loop.QUICK,
    "models": model_study.QUICK,
    "certificates": certificate_study.QUICK,
}
"""How much of everything --quick does."""


def run(options: Reproduce, console: Console, notes: Console) -> None:
    """Run the parts, write and print; raises NbsPinError, OSError, and KeyboardInterrupt after an early end."""
    results = Results.of(options, "paper", None)
    results = results.check(FILES, options.force, whole={"interrupted": False})
    chosen = list(PARTS) if options.part == "all" else [options.part]
    began = time.perf_counter()
    with results.made() as folder:
        for name in FILES[::-1]:  # what describes earlier parts, which are replaced one by one
            (folder / name).unlink(missing_ok=True)
        sections: list[Any] = []
        try:
            for name in chosen:
                for section in PARTS[name](folder, options.seed, True, *([QUICK[name]] if options.quick else [])):
                    sections.append(section)
            interrupted = False
        except KeyboardInterrupt:
            if not sections:
                raise
            interrupted = True
        wall_time = time.perf_counter() - began
        typed = f"nbs-pin reproduce --part {options.part} --seed {options.seed}{' --quick' * options.quick}"
        lead = f"Written by `{typed}` in {wall_time:.0f} s{', interrupted before its end' * interrupted}."
        figures = {name: value for section in sections for name, value in section.figures.items()}
        with results.replaced(FILES[:1], figures, interrupted=interrupted, wall_time_s=wall_time) as draft:
            (draft / FILES[0]).write_text(page("The paper's experiments, reproduced", lead, sections), encoding="utf-8")
    done = "interrupted after" if interrupted else "done in"
    tell(console, f"{', '.join(chosen)}: {len(sections)} sections, {done} {wall_time:.0f} s", verbose=False)
    results.show(console, FILES)
    if interrupted:
        raise KeyboardInterrupt
