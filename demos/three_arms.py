"""Three arms that nobody tuned find their motion from 0.3 rad off and follow it: what `make demo` runs.

What to see: each arm starts beside its translucent reference, meets it within about a fifth of a second, and from then
on the two look like one: the steady error is below a millionth of a radian. The pages play in any browser.
"""

import sys
from pathlib import Path

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

import nbs_pin as nbs
from nbs_pin.base.versions import versions
from nbs_pin.cli import tracking

ARMS = ("two_link", "three_link", "panda")
START_ERROR = 0.3  # rad, in every joint, with alternating sign


def main(out: Path = Path("out/demo"), duration: float = 8.0) -> dict[str, dict]:
    """Tracks the arms in MuJoCo at 1 kHz; returns the figures of each by name."""
    console = Console(highlight=False)
    table = Table("arm", box=box.SIMPLE_HEAD)
    for heading in ("joints", "near after\n[s]", "steady error\n[rad]", "saturated\n[s]", "computed in\n[s]"):
        table.add_column(Text(heading), justify="right", no_wrap=True)
    results = {}
    for name in ARMS:
        console.print(f"{name}: {duration:g} s of motion, then picture and replay …")
        robot = nbs.load_robot(name)
        run, wall_time = tracking.track(robot, duration=duration, start_error=START_ERROR, progress=True)
        figures = results[name] = tracking.figures(run, robot)
        tracking.write_results(run, out / name, robot, {"figures": figures, "versions": versions()})
        table.add_row(
            name,
            str(robot.nv),
            f"{figures['convergence_time_s']:.2f}",
            f"{max(figures['rms_error_last_30_percent_rad']):.1e}",
            f"{figures['saturated_fraction'] * duration:.3f}",
            f"{wall_time:.1f}",
        )
    console.print(table)
    console.print("near: ‖error‖ below 0.1 rad to the end; steady: RMS, worst joint, last 30 %", soft_wrap=True)
    console.print(f"Open {out / ARMS[-1] / 'replay.html'} in a browser.", soft_wrap=True)
    return results


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:2]))
