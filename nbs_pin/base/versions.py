"""Versions that are stored with a result."""

import platform
from importlib.metadata import version

import nbs_pin


def versions() -> dict[str, str]:
    """Versions of Python, this package and the libraries that affect the numbers."""
    libraries = {name: version(name) for name in ("pin", "mujoco", "numpy", "torch")}
    return {"python": platform.python_version(), "nbs_pin": nbs_pin.__version__, **libraries}
