"""Loads in words: those that appeared in the plant, and the one that a law believes in."""

from collections.abc import Mapping
from typing import Any

from nbs_pin.simulation.run_figures import LIGHT, load_deviation, load_of


def loads_told(figures: Mapping[str, Any]) -> tuple[str, ...]:
    """What appeared in the plant before the end of the run."""
    told = []
    for load in figures.get("loads", []):
        begin, end, last = load["from_s"], load["until_s"], figures.get("duration_s", 0.0)
        if begin < last:
            where = f" at {load['link']}" if load["link"] else ""
            then = f" and was gone at {end:g} s" if end is not None and end < last else ""
            told.append(f"a load of {load['mass_kg']:g} kg{where}, unknown to the law, appeared at {begin:g} s{then}")
    return tuple(told)


def load_learned(figures: Mapping[str, Any]) -> tuple[str, ...]:
    """The load that a law believed in the end, if it learns one."""
    found = load_of({name: x for name, x in figures.get("estimates", {}).items() if isinstance(x, int | float)})
    if found is None:
        return ()
    link, mass, centre = found
    if abs(mass) < LIGHT:
        return (f"the law believes that {link} carries no load",)
    at = ", ".join(f"{1e3 * x:z.0f}" for x in centre)
    told = f"the law estimates a load of {float(mass):.3g} kg at {link}, with its centre at ({at}) mm"
    off = load_deviation(figures["estimates"], figures.get("estimates_deviation", {}))
    if off is not None:
        apart = ", ".join(f"{1e3 * x:.2g}" for x in off[1])
        told += f"; the mass may be off by {off[0]:.2g} kg, the centre by ({apart}) mm"
    return (told,)
