"""Results as tables for people."""

from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text


def print_tracking(console: Console, title: str, figures: dict[str, Any], wall_time: float) -> None:
    """A row per joint, then what counts for the whole arm; `figures` as `studies.tracking.figures` gives them."""
    after = figures["late_after_s"]
    table = Table(title=Text(title), box=box.SIMPLE_HEAD, title_justify="left", title_style="bold")
    table.add_column("joint", overflow="fold")
    for heading in ("RMS error\n[rad]", f"after {after:g} s\n[rad]", "last 30 %\n[rad]", "peak\n[N·m]", "limit\n[N·m]"):
        table.add_column(Text(heading), justify="right", no_wrap=True)
    columns = ("rms_error_rad", "rms_error_late_rad", "rms_error_last_30_percent_rad")
    torques = zip(figures["joint_peak_torque_Nm"], figures["effort_limit_Nm"], strict=True)
    for joint, errors, (peak, limit) in zip(
        figures["joints"], zip(*(figures[name] for name in columns), strict=True), torques, strict=True
    ):
        table.add_row(
            Text(joint), *(f"{e:.2e}" for e in errors), f"{peak:.4g}", "none" if limit is None else f"{limit:.4g}"
        )
    console.print(table)
    for line in _lines(figures, wall_time):
        console.print(line, highlight=False, markup=False)


def print_training(console: Console, title: str, figures: dict[str, Any]) -> None:
    """What training changed, a row per figure; `figures` as `studies.training.figures` gives them."""
    table = Table(title=Text(title), box=box.SIMPLE_HEAD, title_justify="left", title_style="bold")
    table.add_column("")
    for heading in ("before", "after"):
        table.add_column(heading, justify="right", no_wrap=True)
    for name in ("training", "held-out"):
        costs = figures[f"{name.replace('-', '_')}_cost"]
        table.add_row(Text(f"mean cost of {name} motions"), *(_number(cost, ".4g") for cost in costs))
    both = figures["before"], figures["after"]
    for name in ("median", "worst"):
        times = (on[f"convergence_time_{name}_s"] for on in both)
        table.add_row(Text(f"converged, {name} [s]"), *("never" if t is None else f"{t:.3f}" for t in times))
    table.add_row(Text("peak torque [N·m]"), *(_number(on["peak_torque_Nm"], ".4g") for on in both))
    table.add_row(Text("RMS torque [N·m]"), *(_number(on["rms_torque_Nm"], ".4g") for on in both))
    table.add_row(Text("some joint at its limit"), *(_number(on["saturated_fraction"], ".2%") for on in both))
    console.print(table)
    ended = {"epochs": "all done", "patience": "no further progress", "interrupted": "interrupted"}
    for line in (
        f"held-out cost lowered by {_number(figures['held_out_cost_lowered_by'], '.1%')}; "
        f"converged is ‖error‖ < 0.1 rad to the end, from {figures['fresh_starts']} fresh starts",
        f"{figures['epochs']} epochs in {figures['seconds']:.1f} s ({ended[figures['stopped']]}), "
        f"the best after {figures['best_epoch']}",
    ):
        console.print(line, highlight=False, markup=False, soft_wrap=True)


def converged(figures: dict[str, Any]) -> str:
    """When the error came to stay below the paper's threshold, in words."""
    time = figures["convergence_time_s"]
    return "not within the run" if time is None else f"{time:.3f} s"


def _number(value: float | None, form: str) -> str:
    return "not finite" if value is None else format(value, form)


def _lines(figures: dict[str, Any], wall_time: float) -> list[str]:
    saturated, late = figures["saturated_fraction"], figures["saturated_fraction_late"]
    outside = zip(figures["joints"], figures["outside_position_range_rad"], strict=True)
    return [
        f"converged (‖error‖ < 0.1 rad to the end): {converged(figures)}",
        f"some joint at its effort limit: {saturated:.2%} of the time, {late:.2%} after {figures['late_after_s']:g} s",
        *(f"{joint} went {excess:.3g} rad beyond its range, which the plant lets it" for joint, excess in outside
          if excess > 0.0),
        f"simulated {figures['duration_s']:g} s in {wall_time:.1f} s",
    ]  # fmt: skip
