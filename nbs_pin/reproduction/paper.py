"""The paper's experiments on its two-link arm reproduced: Table I, its figures and the sweep over α."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from nbs_pin.base.records import Run
from nbs_pin.base.torch_threads import one_thread
from nbs_pin.controllers.neural_backstepping import paper_controller
from nbs_pin.dynamics.analytic import AnalyticDynamics
from nbs_pin.reports.charts import plot_motions
from nbs_pin.reports.markdown import Section
from nbs_pin.reproduction import paper_alpha, paper_table
from nbs_pin.reproduction.paper_table import follow

FILES = (paper_table.FILE, "untrained.png", "trained.png", *paper_alpha.FILES)
"""What `reproduce_paper` writes."""


class Scale(NamedTuple):
    """How much of everything: the paper's own numbers and ten seeds, some minutes on two cores."""

    seeds: int = 10
    epochs: int = 200
    alphas: int = 40
    duration: float = 100.0
    """Duration of every run that is scored [s]."""


QUICK = Scale(seeds=2, epochs=20, alphas=5, duration=20.0)
"""To see the page in half a minute; its figures are not the paper's."""


def reproduce_paper(
    folder: Path, seed: int = 0, progress: bool = False, scale: Scale | None = None
) -> Iterator[Section]:
    """Run the study, write `FILES` into the folder and yield the sections of the page, each once it is done."""
    scale = scale or Scale()
    seeds = range(seed, seed + scale.seeds)
    alphas = np.linspace(0.0, 2.0, scale.alphas + 1)[1:]
    with one_thread():
        pids, pid_runs = paper_table.pid_rows(scale.duration)
        authors, authors_run = paper_table.authors_rows(seeds, scale.epochs, scale.duration, progress)
        package, package_runs = paper_table.package_rows(seeds, scale.epochs, scale.duration, progress)
        yield paper_table.section([*pids, *authors, *package], seeds, folder)
        yield _motions(seeds, authors_run, package_runs, pid_runs, folder)
        flat = paper_alpha.as_printed(alphas, seeds, scale.epochs, scale.duration)
        swept = paper_alpha.sweep(alphas, seed, scale.epochs, scale.duration, progress)
    yield paper_alpha.section(flat, swept, seeds, folder)


def _motions(seeds: range, authors: Run, package: Sequence[Run], pids: dict[str, Run], folder: Path) -> Section:
    """The paper's figures: one network without training from four starts, all of them after training beside PID."""
    law = paper_controller(AnalyticDynamics(), seed=seeds[0])
    starts = [np.zeros(2), *np.random.default_rng(seeds[0]).uniform(-np.pi, np.pi, (3, 2))]
    untrained = {f"from ({q[0]:.2f}, {q[1]:.2f})": [follow(law, 20.0, q0=q[None])] for q in starts}
    plot_motions({"NBS without training: four starts at rest": untrained}, folder / "untrained.png", until=20.0)
    trained: dict[str, dict[str, Sequence[Run]]] = {
        "NBS after training": {"the paper's program, every seed": [authors], "this package, every seed": package},
        "PID": {name: [run] for name, run in pids.items()},
    }
    plot_motions(trained, folder / "trained.png", until=4.0)
    text = f"""
Without training, from zero and three random starts (the paper's figure "without training"; network of seed {seeds[0]}).
Solid: joint 1, dashed: joint 2, black: desired. The dashed grey line is the paper's mark of convergence.

![Motions without training](untrained.png)

After training, and PID (the paper's figure "after training"), from zero.

![Motions after training and under PID](trained.png)"""
    return Section("The motions", text)
