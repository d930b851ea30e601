"""`nbs-pin robots`: the arms known by name."""

import math
from dataclasses import dataclass
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text


@dataclass(frozen=True)
class Robots:
    """List the arms known by name, and what else is accepted.

    Example: nbs-pin robots
    """

    def run(self, console: Console, notes: Console) -> None:
        """Prints the table; raises NbsPinError when an arm cannot be loaded."""
        table = Table(box=box.SIMPLE_HEAD)
        table.add_column("name", no_wrap=True)
        for heading in ("joints", "effort [N·m]", "continuous", "friction"):
            table.add_column(Text(heading), justify="right", no_wrap=True)
        with notes.status("loading every arm"):
            from nbs_pin.cli.arms import known_arms

            for arm in known_arms():
                table.add_row(*_cells(arm))
        console.print(table)
        console.print(
            "ROBOT may also be a path to a .urdf file, or .xacro with the extra nbs-pin[xacro]:\n"
            "one fixed base, at most 64 moving joints, their limits stated.",
            highlight=False,
            markup=False,
        )


def _cells(arm: Any) -> tuple[str, ...]:
    """The columns of a `studies.arms.Arm`."""
    span = f"{arm.least_effort:g}" + (f" to {arm.most_effort:g}" if arm.most_effort > arm.least_effort else "")
    effort = "none" if math.isinf(arm.least_effort) else span
    frictions = {"viscous": arm.viscous_friction, "Coulomb": arm.coulomb_friction}
    kinds = [kind for kind, present in frictions.items() if present]
    return arm.name, str(arm.joints), effort, str(arm.continuous), ", ".join(kinds) or "no"
