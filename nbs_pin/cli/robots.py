"""`nbs-pin robots`: the arms known by name."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Robots:
    """List the arms known by name, and the files that are accepted.

    Example: nbs-pin robots
    """
