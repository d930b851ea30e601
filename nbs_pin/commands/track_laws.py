"""`nbs-pin track` with several laws: each follows the same motion, one table and one picture of all."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from nbs_pin.base.summaries import RUN, SUMMARY, runs_of_laws, summary_in
from nbs_pin.base.units import measured, percent, several
from nbs_pin.cli.track import Track
from nbs_pin.cli.values import SAVED, OptionError
from nbs_pin.commands.following import Tracked, not_simulated, track
from nbs_pin.commands.results import Results, drawing, sha256_of, table, tell
from nbs_pin.reports.captions import settings_in_words
from nbs_pin.reports.law_charts import plot_laws
from nbs_pin.reports.plotting import Heading
from nbs_pin.reports.verdicts import largest_late_errors, verdict_of
from nbs_pin.robots.robot import Robot

FILES = (RUN, "tracking.png", "replay.html", SUMMARY)
"""What `nbs-pin track` writes with one law."""
PICTURE = "comparison.png"
"""The picture of several laws."""
LEARNED = "estimates.png"
"""The picture of what a law that adapts believed, with one law."""


def files_in(folder: Path) -> tuple[str, ...]:
    """What may be in the folder from a track before, with one law or several, whose place new results take."""
    found = summary_in(folder).get("figures")
    laws = found.get("laws") if isinstance(found, Mapping) else None
    return (*FILES, PICTURE, LEARNED, *runs_of_laws(laws if isinstance(laws, Mapping) else ()).values())


def track_laws(
    options: Track, robot: Robot, given: Mapping[str, Any], results: Results, console: Console, notes: Console
) -> None:
    """Track with every law, write and print; raises NbsPinError, OSError, and KeyboardInterrupt after an early end."""
    laws = _named(options.controller)
    results.facts["settings"] |= {f"{name}_sha256": sha256_of(Path(law)) for name, law in laws.items() if law != name}
    files = runs_of_laws(laws)
    results = results.check((*FILES, *files.values(), PICTURE), options.force, whole={"interrupted": False})
    done: dict[str, Tracked] = {}
    with results.made() as folder:
        for name, law in laws.items():
            try:
                done[name] = track(robot, **{**given, "controller": law}, progress=True)
            except KeyboardInterrupt:
                if not done:
                    raise
                break
            one = results.facts | {"settings": results.facts["settings"] | {"controller": law}}
            done[name].run.info.update(reference=options.reference, interrupted=done[name].interrupted, **one)
            if done[name].interrupted:
                break
        interrupted = len(done) < len(laws) or any(tracked.interrupted for tracked in done.values())
        found: dict[str, Any] = {"laws": {name: tracked.figures(robot) for name, tracked in done.items()}}
        found["not_simulated"] = not_simulated(robot, options.joint_friction)
        verdict = verdict_of(found, interrupted=interrupted)
        with notes.status(f"writing runs and picture into {folder}"):
            names = dict.fromkeys((*files.values(), *files_in(folder)))
            with results.replaced(tuple(names), found, interrupted=interrupted) as draft:
                for name, tracked in done.items():
                    tracked.run.save(draft / files[name])
            with drawing(folder / PICTURE) as path:
                runs = {name: tracked.run for name, tracked in done.items()}
                settings = settings_in_words(next(iter(runs.values())))
                plot_laws(runs, path, Heading(f"{robot.name}: {', '.join(runs)}", settings, verdict))
    shown = [_table(found["laws"])]
    left_out = [f"not simulated: {'; '.join(found['not_simulated'])}"] if found["not_simulated"] else []
    tell(console, f"{robot.name}: {verdict.said}", [*verdict.more, *left_out], shown, verbose=True)
    results.show(console, (*files.values(), PICTURE, SUMMARY), "replay", folder / files[next(iter(done))], "--open")
    if interrupted:
        raise KeyboardInterrupt


def _named(text: str) -> dict[str, str]:
    """The laws by what they are called here: by name, or by the name of their file."""
    laws = {Path(law).stem if law.endswith(SAVED) else law: law for law in text.split(",")}
    if len(laws) < len(text.split(",")):
        raise OptionError(f"--controller is '{text}', where two laws have one name; rename a file.")
    return laws


def _table(found: Mapping[str, Mapping[str, Any]]) -> Table:
    """A row per law."""
    force = several(next(iter(found.values()))["units"]["torque"])
    shown = table(
        "laws on one motion",
        "near from",
        "worst joint, RMS\nin the last 30 %",
        f"peak\n[{force}]",
        "saturated",
        first="law",
    )
    for name, of in found.items():
        late = " and ".join(measured(error, unit) for error, unit, _ in largest_late_errors(of))
        near = "never" if of["convergence_time_s"] is None else f"{of['convergence_time_s']:.3f} s"
        cells = near, late, f"{of['peak_torque_Nm']:.4g}", percent(of["saturated_fraction"], 2)
        shown.add_row(Text(name), *cells)
    return shown
