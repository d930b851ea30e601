"""`nbs-pin reproduce`: the paper's experiments again, on one page."""

import dataclasses
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.console import Console

from nbs_pin.cli.folders import check_folder, made
from nbs_pin.cli.values import integer

FILES = ("report.md", "summary.json")
"""What it writes beside the files of its parts."""


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

    def run(self, console: Console, notes: Console) -> None:
        """Runs, writes and prints; raises NbsPinError or OSError."""
        with notes.status("loading"):
            from nbs_pin.base.files import write_whole
            from nbs_pin.base.pages import page
            from nbs_pin.base.versions import versions
            from nbs_pin.benchmarks.fair import fair_part
            from nbs_pin.reproduction.certificate_study import reproduce_certificates
            from nbs_pin.reproduction.learned_loop import reproduce_learned
            from nbs_pin.reproduction.model_study import reproduce_models
            from nbs_pin.reproduction.paper import reproduce_paper

            parts: dict[str, Callable[[Path, int, bool], Sequence[Any]]] = {
                "paper": reproduce_paper,
                "fair": fair_part,
                "lnn": reproduce_learned,
                "models": reproduce_models,
                "certificates": reproduce_certificates,
            }
        facts: dict[str, Any] = {"settings": self._settings(), "versions": versions()}
        check_folder(self.out, FILES, facts, self.force)
        chosen = list(parts) if self.part == "all" else [self.part]
        began = time.perf_counter()
        with made(self.out):
            sections = [section for name in chosen for section in parts[name](self.out, self.seed, True)]
            wall_time = time.perf_counter() - began
            lead = f"Made by `nbs-pin reproduce --part {self.part} --seed {self.seed}` in {wall_time:.0f} s."
            text = page("The paper's experiments, run again", lead, sections)
            figures = {name: value for section in sections for name, value in section.figures.items()}
            summary = facts | {"wall_time_s": wall_time, "figures": figures}
            write_whole(self.out / "report.md", text.encode())
            encoded = json.dumps(summary, indent=2, allow_nan=False, ensure_ascii=False) + "\n"
            write_whole(self.out / "summary.json", encoded.encode())
        console.print(f"{', '.join(chosen)}: done in {wall_time:.0f} s", highlight=False)
        for name in FILES:
            console.print(str(self.out / name), soft_wrap=True, highlight=False, markup=False)

    def _settings(self) -> dict[str, Any]:
        """Everything that decides the results, as JSON can store it."""
        settings = dataclasses.asdict(self)
        del settings["out"], settings["force"]
        return settings
