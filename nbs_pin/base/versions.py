"""What decided the numbers: the versions that a stored result remembers."""

import platform
from importlib.metadata import version

import nbs_pin


def versions() -> dict[str, str]:
    """Of Python, this package and the libraries that decide the numbers."""
    libraries = {name: version(name) for name in ("pin", "mujoco", "numpy", "torch")}
    return {"python": platform.python_version(), "nbs_pin": nbs_pin.__version__, **libraries}
