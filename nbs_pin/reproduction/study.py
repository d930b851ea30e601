"""What the studies share: records as CSV and JSON, spreads over the seeds, the noise."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nbs_pin.base.csv_files import write_csv
from nbs_pin.base.plain import plain
from nbs_pin.identification.measurement import Noise
from nbs_pin.reports.markdown import short

NOISE = Noise(encoder=2.0**-16, torque=0.5)
"""Noise of the sensors: encoder resolution [turn] and torque [N·m]."""


def write_records(path: Path, records: Sequence[Any]) -> list[dict[str, Any]]:
    """Write named tuples of one class to a CSV file; returns them as JSON can store them."""
    write_csv(path, records[0]._fields, records)
    return [plain(record._asdict()) for record in records]


def spread(values: Sequence[float] | np.ndarray, form: Callable[[float], str] = short) -> str:
    """The least, **median** and greatest value, or the only one."""
    if len(values) == 1:
        return form(float(values[0]))
    low, middle, high = (form(float(of(values))) for of in (np.min, np.median, np.max))
    return f"{low} – **{middle}** – {high}"
