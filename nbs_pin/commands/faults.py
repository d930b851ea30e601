"""`nbs-pin faults`: the fault matrix of laws behind the guard."""

import time
from typing import Any

import numpy as np
from rich.console import Console

from nbs_pin.base.files import replaced_together
from nbs_pin.base.plain import plain
from nbs_pin.base.summaries import SUMMARY, summary_in, summary_text
from nbs_pin.base.units import counted
from nbs_pin.base.versions import versions
from nbs_pin.benchmarks.faults import MATRIX, matrix
from nbs_pin.cli.exit_codes import STOPPED
from nbs_pin.cli.faults import Faults
from nbs_pin.cli.values import OptionError
from nbs_pin.commands.results import table
from nbs_pin.runtime.guard import Fault


def run(options: Faults, console: Console, notes: Console) -> int:
    """Run the matrix, write and print; 4 if a row fails.

    Raises NbsPinError, OSError, and KeyboardInterrupt after an early end, of which the whole rows are kept.
    """
    numbers = [case.fault.split()[0] for case in MATRIX]
    unknown = [name for name in options.only if name not in numbers]
    if unknown:
        raise OptionError(
            f"--only has '{unknown[0]}', which is no row; give some of {', '.join(dict.fromkeys(numbers))}."
        )
    chosen = [k for k, name in enumerate(numbers) if not options.only or name in options.only]
    began = time.perf_counter()
    found, interrupted = matrix(chosen, options.arms, options.seeds, progress=True)
    asked, chosen = len(chosen), [k for k in chosen if (k, options.arms[0]) in found]
    shown = table("faults", "wanted", *options.arms, "", first="fault")
    for column in shown.columns[1:]:  # what is wanted and codes are words
        column.justify, column.no_wrap, column.overflow = "left", False, "fold"
    for column in shown.columns[2:-1]:
        column.min_width = max(len(code.name) for code in Fault)
    rows: list[dict[str, Any]] = []
    for k in chosen:
        case, cells = MATRIX[k], []
        for arm in options.arms:
            verdicts = found[k, arm]
            values = [v.value for v in verdicts if np.isfinite(v.value)]
            said = sorted({v.said for v in verdicts} - {""})
            figure = f"{max(values):.3g}" if values else ""
            cells.append(" ".join([figure, *said]).strip())
            rows.append(
                {"fault": case.fault, "level": case.level, "wanted": case.wanted, "arm": arm}
                | {"passed": [v.passed for v in verdicts], "values": [v.value for v in verdicts], "said": said}
            )
        passed = all(v.passed for arm in options.arms for v in found[k, arm])
        shown.add_row(f"{case.fault}, {case.level}", case.wanted, *cells, "" if passed else "FAILS")
    failed = sum(not all(row["passed"]) for row in rows)
    facts = {"versions": versions(), "arms": options.arms, "only": options.only, "seeds": options.seeds}
    kept = interrupted and summary_in(options.out).get("interrupted") is False
    if not kept:
        with replaced_together(options.out, [SUMMARY]) as draft:
            summary = facts | {"interrupted": interrupted, "rows": plain(rows)}
            (draft / SUMMARY).write_text(summary_text(summary), encoding="utf-8")
    console.print(shown)
    console.print(
        "numbers are errors [rad]; before the name of a fault, the error until the stop or the time to it [s]"
    )
    wall = time.perf_counter() - began
    console.print(
        f"{len(rows) - failed} of {counted(len(rows), 'row')} passed, {counted(options.seeds, 'trial')} each, "
        f"in {wall:.0f} s"
    )
    console.print(str(options.out / SUMMARY), highlight=False, markup=False, soft_wrap=True)
    if interrupted:
        old = "; summary.json keeps the complete rows of before" if kept else ""
        console.print(f"interrupted after {len(chosen)} of {counted(asked, 'fault')}{old}", style="yellow")
        raise KeyboardInterrupt
    return STOPPED if failed else 0
