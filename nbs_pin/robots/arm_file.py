"""Arms in `.toml` files: a description, and what it leaves out."""

import difflib
import tomllib
from pathlib import Path
from typing import Any

from nbs_pin.base.exceptions import RobotError

OPTIONS = (
    "gravity", "lock", "zero_limits", "limits", "repair", "inertia_from", "xacro_args", "package_dirs", "armature",
    "rotor_inertia", "viscous_friction", "coulomb_friction", "payload", "tool", "base_rpy", "base_xyz",
)  # fmt: skip
"""Arguments of `load_robot` that such a file can state."""
_LARGEST = 1_000_000  # bytes


def read_arm_file(path: Path) -> tuple[str, dict[str, Any]]:
    """The description that a `.toml` file names, a catalogue name or a path, and the arguments of `load_robot` in it.

    Paths are relative to the folder of the file.

    Raises:
        RobotError: If it is not such a file.
    """
    try:
        with path.open("rb") as file:
            data = file.read(_LARGEST + 1)
        if len(data) > _LARGEST:
            raise RobotError(f"{path}: too large: over {_LARGEST} bytes; state only the description and its options.")
        stated = tomllib.loads(data.decode("utf-8"))
    except (UnicodeDecodeError, tomllib.TOMLDecodeError, RecursionError) as error:
        raise RobotError(f"{path}: it is not TOML ({error}); write for instance description = 'arm.urdf'.") from error
    description = stated.pop("description", None)
    if not isinstance(description, str):
        raise RobotError(f"{path}: it names no description; write for instance description = 'arm.urdf' at its top.")
    unknown = next((name for name in stated if name not in OPTIONS), None)
    if unknown is not None:
        near = difflib.get_close_matches(unknown, OPTIONS, n=1) or OPTIONS
        raise RobotError(f"{path}: '{unknown:.60}' is no option of an arm; give description, {', '.join(near)}.")
    if "package_dirs" in stated:
        stated["package_dirs"] = [str(path.parent / str(name)) for name in _list(stated["package_dirs"])]
    if "tool" in stated:
        tool = stated["tool"] if isinstance(stated["tool"], dict) else {"file": stated["tool"]}
        stated["tool"] = {**tool, "file": str(path.parent / str(tool.get("file", "")))}
    beside = path.parent / description
    return (str(beside) if beside.is_file() or beside.suffix else description), stated


def _list(value: Any) -> list[Any]:
    return value if isinstance(value, list) else [value]
