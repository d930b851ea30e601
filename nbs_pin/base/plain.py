"""Values as JSON can store them."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np


def plain(values: Any) -> Any:
    """Arrays and numbers as JSON can store them, None for what is not finite."""
    if isinstance(values, Mapping):
        return {key: plain(value) for key, value in values.items()}
    if isinstance(values, np.ndarray | np.generic):
        values = values.tolist()
    if isinstance(values, list | tuple):
        return [plain(value) for value in values]
    return None if isinstance(values, float) and not math.isfinite(values) else values
