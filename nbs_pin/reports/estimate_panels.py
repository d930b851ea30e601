"""What a law that adapts believed during a run, in the panels in which pictures and pages show it."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from nbs_pin.base.records import Run
from nbs_pin.simulation.run_figures import LIGHT, estimates_of, load_of, loads_of

CARRIED = "carried"
"""The curve beside the mass that was learned: what the plant carried, unknown to the law."""
_KINDS = ("Coulomb friction", "viscous friction", "rotor inertia", "constant torque", "constant acceleration")
_USUAL, _SHARE = 95.0, 0.25


class Panel(NamedTuple):
    """Curves of one unit."""

    title: str
    unit: str
    curves: dict[str, Float[np.ndarray, " rows"]]
    """By name; NaN where there is nothing to tell."""
    of_joints: bool
    """Whether the names are those of joints."""


def panels_of(run: Run) -> list[Panel]:
    """Mass and centre of the load first, then masses of links and numbers of joints; none of a law that adapts nothing.

    The run has one start. Joints that turn and joints that slide have panels of their own.
    """
    found = estimates_of(run)
    load = load_of(found)
    panels = [] if load is None else _of_load(run, *load)
    links = {name: x for name, x in found.items() if name.endswith(" m [kg]") and not name.startswith("load at ")}
    if links:
        panels.append(Panel("mass behind", "kg", {name.removesuffix(" m [kg]"): x for name, x in links.items()}, True))
    for kind in _KINDS:
        by_unit: dict[str, dict[str, np.ndarray]] = {}
        for name in (name for name in found if f" {kind} [" in name):
            joint, _, unit = name.rpartition(f" {kind} [")
            by_unit.setdefault(unit.removesuffix("]"), {})[joint] = found[name]
        panels += [Panel(kind, unit, curves, True) for unit, curves in by_unit.items()]
    return panels


def _of_load(run: Run, link: str, mass: Float[np.ndarray, " rows"], centre: Float[np.ndarray, "rows 3"]) -> list[Panel]:
    carried = np.zeros(len(run.t))
    for one in (one for one in loads_of(run) if one["link"] in ("", link)):
        until = np.inf if one["until_s"] is None else one["until_s"]
        carried[(run.t >= one["from_s"]) & (run.t < until)] += one["mass_kg"]
    masses = {"learned": mass} | ({CARRIED: carried} if carried.any() else {})
    # The centre of what is nearly nothing jumps about.
    least = max(_SHARE * float(np.percentile(np.abs(mass), _USUAL)), LIGHT)
    shown = np.where((np.abs(mass) > least)[:, None], 1e3 * centre, np.nan)
    return [
        Panel(f"mass of the load at {link}", "kg", masses, False),
        Panel(f"its centre in the frame of {link}", "mm", {axis: shown[:, k] for k, axis in enumerate("xyz")}, False),
    ]
