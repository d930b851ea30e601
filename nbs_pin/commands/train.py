"""`nbs-pin train`: train a controller through the closed loop, and compare before and after on fresh starts."""

import shlex
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console
from rich.text import Text

from nbs_pin.base.doors import typed_command
from nbs_pin.base.plain import plain
from nbs_pin.base.records import Run
from nbs_pin.base.summaries import SUMMARY
from nbs_pin.base.units import by_quantity, counted, percent, several
from nbs_pin.cli.train import Train
from nbs_pin.cli.values import plain_numbers
from nbs_pin.commands.inputs import arm_of, law_of
from nbs_pin.commands.results import Results, drawing, keywords, table, tell
from nbs_pin.controllers.controller import Controller
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.motions.references import Sinusoid, check_reference
from nbs_pin.reports.captions import arm_in_words, chosen, law_in_words
from nbs_pin.reports.charts import plot_training
from nbs_pin.reports.plotting import Heading
from nbs_pin.reports.verdicts import verdict_of
from nbs_pin.robots.robot import Robot
from nbs_pin.simulation.costs import stage_cost
from nbs_pin.simulation.dynamics_plant import DynamicsPlant
from nbs_pin.simulation.loop import Loop
from nbs_pin.storage.checkpoints import save
from nbs_pin.training.evaluation import compared, fresh_batch, fresh_figures
from nbs_pin.training.train import Training, train

CHECKPOINT = "training.ckpt"
"""The checkpoint that `train_robot` keeps up to date in its folder."""
FILES = ("controller.nbs", "learning.png", SUMMARY)
"""Files of `write_results`."""
_LONGER = 3.0  # duration of fresh motions over that of training motions


def run(options: Train, console: Console, notes: Console) -> None:
    """Train, write and print; raises NbsPinError, OSError, and KeyboardInterrupt after an early end."""
    with notes.status(f"loading {options.robot}"):
        robot = arm_of(options)
    results = Results.of(options, robot.name, robot, robot=robot.source)
    if options.resume:
        results = results.held(CHECKPOINT)
    else:
        whose, remedy = "another or an unfinished training", "give another --out, --resume to continue it"
        names, whole = (CHECKPOINT, *FILES), {"interrupted": False}
        told: dict[str, Any] = {"whole": whole, "whose": whose, "remedy": remedy, "unfinished": CHECKPOINT}
        results = results.check(names, options.force, **told)
    given = keywords(options, train_robot) | {
        "frequencies": tuple(plain_numbers(options.frequencies) or ()),
        "gains": not options.fixed_gains,
        **{name: getattr(options, name) for name in ("epochs", "optimiser", "learning_rate", "patience", "resume")},
    }
    with results.made() as folder:
        result = train_robot(robot, **given, folder=folder, progress=True)
        interrupted = result.training.stopped == "interrupted"
        with notes.status(f"drawing the picture into {folder}"):
            found = write_results(result, results, interrupted=interrupted)
    _print(console, f"{robot.name}, {options.controller}", found, verbose=options.verbose, interrupted=interrupted)
    results.show(console, FILES, *(_resumed(results.folder) if interrupted else _tracked(options, results.folder)))
    if interrupted:
        raise KeyboardInterrupt


def _resumed(folder: Path) -> list[str]:
    """The command that was typed, as it goes on in the folder: with other settings it would be another training."""
    typed = [word for word in shlex.split(typed_command())[1:] if word not in ("--force", "--resume")]
    if not any(word.partition("=")[0] == "--out" for word in typed):
        typed += ["--out", str(folder)]
    return [*typed, "--resume"]


def _tracked(options: Train, folder: Path) -> list[str]:
    """The command that tracks with the law, on the arm that it was trained for."""
    command = ["track", options.robot, "--controller", str(folder / FILES[0]), "--period", f"{options.period:g}"]
    limit = [] if options.effort_limit is None else ["--effort-limit", f"{options.effort_limit:g}"]
    return [*command, *limit, *(["--no-effort-limit"] if options.no_effort_limit else []), *options.arm.typed()]


class Trained(NamedTuple):
    """A training, and the same fresh motions before and after it."""

    training: Training
    before: Run
    after: Run


def train_robot(
    robot: Robot,
    *,
    controller: Controller | str = "nbs",
    bandwidth: float = 8.0,
    frequencies: tuple[float, ...] = (0.5, 1.0, 2.0),
    starts: int = 32,
    start_error: float = 0.3,
    duration: float = 1.0,
    period: float = 0.005,
    cost: str = "torque-aware",
    seed: int = 0,
    folder: Path | None = None,
    **settings: Any,
) -> Trained:
    """Train a law for the arm on sinusoids of these frequencies [rad/s], within the arm's effort limits.

    controller: a law by name, a .nbs file (`law_of`), or a built one. starts: in total, divided among the frequencies.
    cost: by name (`stage_cost`). folder: where `CHECKPOINT` is kept, None for no checkpoint. duration, period [s],
    start_error [rad] and settings (epochs, optimiser, resume, …): as in `train`. The fresh motions last three times
    longer, from `FRESH_STARTS` starts per frequency that are not used in training.

    Raises:
        ArgumentError: If settings do not fit or a motion violates the arm's limits; other errors as in `train`.
        KeyboardInterrupt: If Ctrl-C comes before the end of the first epoch.
    """
    references = [Sinusoid.for_robot(robot, frequency) for frequency in frequencies]
    for reference in references:
        check_reference(reference, robot, _LONGER * duration)
    if not isinstance(controller, Controller):
        controller = law_of(controller, robot, bandwidth=bandwidth, period=period, seed=seed)
    plant = DynamicsPlant(PinocchioDynamics(robot))
    training = train(
        controller,
        plant,
        references,
        starts=max(1, round(starts / len(references))),
        start_error=start_error,
        duration=duration,
        period=period,
        effort_limit=robot.effort_limit,
        cost=stage_cost(cost, robot),
        seed=seed,
        checkpoint=None if folder is None else folder / CHECKPOINT,
        **settings,
    )
    if not training.history.size:
        raise KeyboardInterrupt
    steps = _LONGER * round(duration / period)
    loop = Loop.of(plant, robot.nv, steps * period, period, plant_step=period, effort_limit=None, lookahead=None)
    fresh = fresh_batch(loop, references, start_error, seed)
    return Trained(training, compared(controller, fresh), compared(training.controller, fresh))


def figures(result: Trained) -> dict[str, Any]:
    """The effect of training as JSON can store it; None for times never reached and numbers that are not finite."""
    training = result.training
    held_out, best = training.held_out, training.best_epoch
    numbers: dict[str, Any] = plain(
        {
            "epochs": len(training.history) - (training.stopped != "interrupted"),
            "best_epoch": best,
            "stopped": training.stopped,
            "training_cost": [training.history[0], training.history[best]],
            "held_out_cost": [held_out[0], held_out[best]],
            "held_out_cost_lowered_by": 1.0 - held_out[best] / held_out[0],
            "seconds": training.seconds,
            "units": {name: several(given) for name, given in by_quantity(result.before.slides).items()},
            "fresh_starts": result.before.q.shape[1],
            "fresh_duration_s": result.before.t[-1],
            "before": fresh_figures(result.before),
            "after": fresh_figures(result.after),
        }
    )
    return numbers


def write_results(result: Trained, results: Results, *, interrupted: bool) -> dict[str, Any]:
    """Write `FILES`, the picture last, and return the figures; raises OSError if they cannot be written."""
    numbers, training = figures(result), result.training
    curves = plain({"history": training.history, "held_out": training.held_out})
    with results.replaced(FILES, numbers, interrupted=interrupted, **curves) as draft:
        save(training.controller, draft / FILES[0], info={"trained": results.facts | {"interrupted": interrupted}})
    shown = training.history, training.held_out, training.best_epoch, result.before, result.after
    with drawing(results.folder / FILES[1]) as path:
        settings = chosen(results.facts["settings"], "bandwidth", "period", "start_error", "cost", "optimiser", "seed")
        title = f"{arm_in_words(result.after)}: {law_in_words(result.after)}, trained"
        plot_training(*shown, path, Heading(title, settings, verdict_of(numbers, interrupted=interrupted)))
    return numbers


def _print(console: Console, title: str, figures: dict[str, Any], *, verbose: bool, interrupted: bool) -> None:
    """Print the gain, and a row per figure, before and after training; `figures` from the function of that name."""
    shown = table(title, "before", "after", first="")
    for name in ("training", "held-out"):
        costs = figures[f"{name.replace('-', '_')}_cost"]
        shown.add_row(Text(f"mean cost of {name} motions"), *(_number(cost, ".4g") for cost in costs))
    both = figures["before"], figures["after"]
    for name in ("median", "worst"):
        times = (on[f"convergence_time_{name}_s"] for on in both)
        shown.add_row(Text(f"converged, {name} [s]"), *("never" if t is None else f"{t:.3f}" for t in times))
    shown.add_row(
        Text(f"peak torque [{figures['units']['torque']}]"), *(_number(on["peak_torque_Nm"], ".4g") for on in both)
    )
    shown.add_row(
        Text(f"RMS torque [{figures['units']['torque']}]"), *(_number(on["rms_torque_Nm"], ".4g") for on in both)
    )
    shown.add_row(Text("some joint at its limit"), *(_share(on["saturated_fraction"]) for on in both))
    ended = {"epochs": "all done", "patience": "no further progress", "interrupted": "interrupted"}
    verdict = verdict_of(figures, interrupted=interrupted)
    lines = (
        *verdict.more,
        f"converged means ‖error‖ < 0.1 {figures['units']['position']} to the end, "
        f"over {counted(figures['fresh_starts'], 'fresh start')}",
        f"{counted(figures['epochs'], 'epoch')} in {figures['seconds']:.1f} s ({ended[figures['stopped']]}), "
        f"the best after {figures['best_epoch']}",
    )
    tell(console, f"{title}: {verdict.said}", lines, [shown], verbose=verbose)


def _number(value: float | None, form: str) -> str:
    return "not finite" if value is None else format(value, form)


def _share(value: float | None) -> str:
    return "not finite" if value is None else percent(value, 2)
