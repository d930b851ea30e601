"""Folders that commands write into, and what is said of defaults."""

import contextlib
import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import tyro

from nbs_pin.cli.values import OptionError


def default(hint: str) -> Any:
    """What --help says of an option whose default is worked out later."""
    return tyro.conf.arg(help_behavior_hint=f"(default: {hint})")


def folder_for(out: Path | None, command: str, robot: str) -> Path:
    """The folder asked for, or out/COMMAND-ROBOT."""
    return out or Path("out") / f"{command}-{re.sub(r'[^A-Za-z0-9_.-]', '_', robot)}"


@contextlib.contextmanager
def made(folder: Path) -> Iterator[None]:
    """The folder, made before any long work so that a bad path is known at once; unmade again if it stays empty."""
    new = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        yield
    finally:
        for path in new:
            if path.is_dir() and not any(path.iterdir()):
                path.rmdir()


def check_folder(
    folder: Path,
    names: tuple[str, ...],
    same: Mapping[str, Any],
    force: bool,
    *,
    whose: str = "another run",
    remedy: str = "give another --out",
) -> None:
    """Raises OptionError when the folder holds results that are not those of the very same run, unless forced.

    names: the files that count as results. same: what summary.json must say. whose, remedy: words of the error.
    """
    if folder.exists() and not folder.is_dir():
        raise OptionError(f"--out '{folder}' is a file; give a folder.")
    present = [name for name in names if (folder / name).exists()]
    if not present or force:
        return
    summary = summary_in(folder)  # results without a readable summary are another run's
    if {key: summary.get(key) for key in same} != same:
        raise OptionError(f"'{folder}' holds {present[0]} of {whose}; {remedy}, or --force to replace it.")


def summary_in(folder: Path) -> dict[str, Any]:
    """What summary.json of the folder holds, nothing when it cannot be read."""
    try:
        summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return summary if isinstance(summary, dict) else {}
