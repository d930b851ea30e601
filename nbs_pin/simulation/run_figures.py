"""What a run came to, joint by joint and along the path of its tool: the figures of summaries, pictures and pages."""

from typing import Any

import numpy as np

from nbs_pin.base.plain import plain
from nbs_pin.base.records import Run
from nbs_pin.base.units import by_quantity
from nbs_pin.controllers.unknowns import LOAD_AT, NO_MASS
from nbs_pin.robots.robot import Robot
from nbs_pin.simulation import metrics
from nbs_pin.simulation.tool_errors import tool_errors, tool_of

LIGHT = 0.02
"""A learned load of less than this [kg] is none."""


def figures(run: Run, robot: Robot | None = None) -> dict[str, Any]:
    """`metrics.summary` of the run and the RMS error over its last 30 %, as JSON can store them.

    They are None where a row is not finite. With a robot, also how far each joint left its position range, as the
    plants have no joint stops, for which share of the time it was above its velocity limit, and how far the tool was
    from its path, if it followed one. `loads` are those that appeared in the plant meanwhile, which the law did not
    know; `estimates` what a law that adapts believed in the end. `units` says in what the numbers of each joint are:
    those of one that slides are in m and N, whatever the key says.
    """
    values = metrics.summary(run)
    values["units"] = by_quantity(run.slides)
    values["rms_error_last_30_percent_rad"] = plain(metrics.rms_error(run, 0.7 * float(run.t[-1])))
    if robot is not None:
        beyond = np.maximum(robot.lower - run.q, run.q - robot.upper).reshape(-1, run.nv)
        values["outside_position_range_rad"] = plain(np.maximum(beyond.max(axis=0), 0.0))
        fast = np.abs(run.v) > robot.velocity_limit
        late = fast[run.t >= values["late_after_s"]]
        for name, rows in (("", fast), ("_late", late)):
            values[f"above_velocity_limit_fraction{name}"] = plain(rows.reshape(-1, run.nv).mean(axis=0))
        tool = tool_of(run)
        if tool is not None:
            values["tool"] = tool | plain(tool_errors(run, robot).figures())
    loads, learned = loads_of(run), estimates_of(run)
    values |= {"loads": loads} if loads else {}
    return values | ({"estimates": {name: plain(x[-1]) for name, x in learned.items()}} if learned else {})


def estimates_of(run: Run) -> dict[str, Any]:
    """What a law that adapts believed in every row, (rows, ...), by name; empty for other laws."""
    names = run.info.get("estimates")
    if run.estimates is None or not isinstance(names, list) or len(names) != run.estimates.shape[-1]:
        return {}
    return {str(name): run.estimates[..., k] for k, name in enumerate(names)}


def load_of(estimates: dict[str, Any]) -> tuple[str, Any, Any] | None:
    """Link, mass [kg] and centre (..., 3) [m] of the load among estimates by name; None where no load adapts."""
    masses = [name for name in estimates if name.startswith(LOAD_AT) and name.endswith(" m [kg]")]
    if not masses:
        return None
    link = masses[0].removeprefix(LOAD_AT).removesuffix(" m [kg]")
    firsts = [np.asarray(estimates.get(f"{LOAD_AT}{link} m{axis} [kg·m]", np.nan), dtype=float) for axis in "xyz"]
    mass = np.asarray(estimates[masses[0]], dtype=float)
    return link, mass, np.stack(firsts, axis=-1) / np.where(np.abs(mass) > NO_MASS, mass, np.inf)[..., None]


def load_deviation(estimates: dict[str, Any], deviations: dict[str, Any]) -> tuple[float, Any] | None:
    """How far mass [kg] and centre (3,) [m] of the load may be off, from the deviations of all estimates by name.

    Of the centre c = h/m it is (σ_h + |c|σ_m)/m, which is the largest for any correlation. None where it is not known.
    """
    found = load_of(estimates)
    if found is None:
        return None
    link, mass, centre = found
    names = [f"{LOAD_AT}{link} {what}" for what in ("m [kg]", *(f"m{axis} [kg·m]" for axis in "xyz"))]
    off = np.array([deviations.get(name) for name in names], dtype=float)
    if not np.isfinite(off).all():
        return None
    return float(off[0]), (off[1:] + np.abs(centre) * off[0]) / abs(mass)


def loads_of(run: Run) -> list[dict[str, Any]]:
    """The loads that appeared in the plant of a run, as the run notes them; none of those that cannot be read.

    Each has "mass_kg", "link", "from_s", and "until_s", which is None for one that stayed.
    """
    noted = run.info.get("loads")
    return [load for load in noted if _is_load(load)] if isinstance(noted, list) else []


def changes_of(run: Run) -> list[float]:
    """Times within a run at which another plant took over [s]."""
    noted = run.info.get("plant_changes")
    times = [float(t) for t in noted if _is_time(t)] if isinstance(noted, list) else []
    return [t for t in times if run.t[0] <= t <= run.t[-1]]


def _is_load(load: Any) -> bool:
    if not isinstance(load, dict) or not isinstance(load.get("link"), str):
        return False
    return all(map(_is_time, (load.get("mass_kg"), load.get("from_s")))) and (
        load.get("until_s") is None or _is_time(load["until_s"])
    )


def _is_time(t: Any) -> bool:
    return isinstance(t, int | float) and not isinstance(t, bool) and bool(np.isfinite(t))
