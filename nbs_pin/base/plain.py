"""Conversion of values for JSON."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np


def plain(values: Any) -> Any:
    """Arrays and numbers as lists, dictionaries and numbers for JSON, with None for non-finite numbers."""
    if isinstance(values, Mapping):
        return {key: plain(value) for key, value in values.items()}
    if isinstance(values, np.ndarray | np.generic):
        values = values.tolist()
    if isinstance(values, list | tuple):
        return [plain(value) for value in values]
    return None if isinstance(values, float) and not math.isfinite(values) else values
