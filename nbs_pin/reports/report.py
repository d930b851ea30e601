"""Reports: the results of commands on one page for the browser, which begins with a verdict and needs no network."""

import base64
import html
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from markdown_it import MarkdownIt

from nbs_pin.base.exceptions import FileFormatError, NbsPinError
from nbs_pin.base.files import write_whole
from nbs_pin.base.records import Run
from nbs_pin.base.summaries import SUMMARY, summary_in
from nbs_pin.reports.captions import arm_in_words, law_in_words, settings_in_words
from nbs_pin.reports.pages import page
from nbs_pin.reports.replay import shown_run
from nbs_pin.reports.report_tables import (
    bench_table,
    certificate_tables,
    folded,
    joints_table,
    numbers_table,
    table,
)  # fmt: skip
from nbs_pin.reports.signals import MAX_ROWS
from nbs_pin.reports.verdicts import Verdict, verdict_of
from nbs_pin.robots.named import robot_of

_RUN, _PAGE = "run.npz", "report.md"
_DRAWN = ("tracking.png",)
"""Pictures that the charts show better."""
_PER_JOINT = ("rms_error_rad", "rms_error_late_rad", "joint_peak_torque_Nm", "rms_test_torque_error_Nm")
_MOST_PICTURES = 12e6
"""Pictures in all are at most this large [bytes]; further ones are named."""


@dataclass(frozen=True)
class _Result:
    """A folder of results."""

    folder: Path
    label: str
    summary: Mapping[str, Any]
    run: Run | None

    @property
    def figures(self) -> Mapping[str, Any]:
        found = self.summary.get("figures")
        return found if isinstance(found, Mapping) else {}

    @property
    def verdict(self) -> Verdict:
        return verdict_of(self.figures, interrupted=self.summary.get("interrupted") is True)


def report(folders: Sequence[Path], path: Path) -> Path:
    """Write a page with the results in the folders, side by side; returns its path.

    Verdicts come first, then the figures in a table, charts and replays of the runs on one time, certificates,
    pictures, and for each folder its command, settings and versions. An arm that is no longer found is not drawn,
    and the page says so.

    Raises:
        FileFormatError: If a folder has no readable summary.json, or a run is damaged.
    """
    results = _results(folders)
    runs, missing = _runs(results)
    title = _title(results)
    body = {
        "heading": html.escape(title),
        "verdicts": "".join(_card(result) for result in results),
        "comparison": _comparison(results),
        "details": "".join(_details(result, missing.get(result.label, "")) for result in results),
        "absent": "" if runs else "absent",
    }
    return write_whole(path, page("report.html", title, {"runs": runs}, **body))


def _results(folders: Sequence[Path]) -> list[_Result]:
    results: list[_Result] = []
    for folder in folders:
        summary = summary_in(folder)
        if not summary:
            raise FileFormatError(f"{folder / SUMMARY}: no summary of results; give a folder that a command wrote.")
        label = folder.resolve().name
        if label in [result.label for result in results]:
            label = str(folder)
        run = Run.load(folder / _RUN) if (folder / _RUN).is_file() else None
        results.append(_Result(folder, label, summary, run))
    return results


def _runs(results: Sequence[_Result]) -> tuple[list[dict[str, Any]], dict[str, str]]:
    """What the page shows of the runs, and why some arms are not drawn, by label."""
    moved = [result for result in results if result.run is not None]
    shown: list[dict[str, Any]] = []
    missing, built = {}, dict[tuple[str, str], int]()
    for result in moved:
        assert result.run is not None
        try:
            one = shown_run(result.run, robot_of(result.run), most=3 * MAX_ROWS // max(3, len(moved)))
        except NbsPinError as error:
            missing[result.label] = str(error)
            continue
        arm = result.run.robot, result.run.robot_sha256
        if arm in built:  # the same arm is on the page once
            one["scene"]["commands"] = built[arm]
        built.setdefault(arm, len(shown))
        shown.append(one | {"label": result.label})
    return shown, missing


def _title(results: Sequence[_Result]) -> str:
    arms = dict.fromkeys(_arm(result) for result in results)
    return f"{', '.join(arms)}: {'report' if len(results) == 1 else f'{len(results)} results side by side'}"


def _arm(result: _Result) -> str:
    if result.run is not None:
        return arm_in_words(result.run)
    settings = result.summary.get("settings", {})
    named = next((settings[key] for key in ("robot", "against") if settings.get(key)), result.label)
    return Path(str(named)).stem


def _card(result: _Result) -> str:
    facts = [law_in_words(result.run), *settings_in_words(result.run)] if result.run is not None else []
    said = html.escape(" · ".join(facts))
    name = html.escape(result.label)
    lines = f'<h2>{name}</h2><p>{html.escape(result.verdict.text)}</p><p class="soft">{said}</p>'
    return f'<section class="card {result.verdict.level}">{lines}</section>'


def _comparison(results: Sequence[_Result]) -> str:
    """Figures of several results in one table, in which a row is a figure."""
    if len(results) == 1 or not any(result.figures for result in results):
        return ""
    worst = {result.label: _with_worst(result.figures) for result in results}
    return f"<h2>Side by side</h2>{numbers_table(worst)}"


def _with_worst(figures: Mapping[str, Any]) -> dict[str, Any]:
    """The figures, of those per joint the largest."""
    per_joint: dict[str, Any] = {name: figures.get(name) for name in _PER_JOINT}
    largest = {f"largest_{name}": max(values) for name, values in per_joint.items() if _is_flat(values)}
    return {**largest, **figures}


def _is_flat(values: Any) -> bool:
    return isinstance(values, list) and bool(values) and not isinstance(values[0], list)


def _details(result: _Result, missing: str) -> str:
    figures, summary = result.figures, result.summary
    parts = [f"<h2>{html.escape(result.label)}</h2>"]
    if missing:
        parts.append(f'<p class="warning">The arm is not drawn and the run has no charts: {html.escape(missing)}</p>')
    if "certificate" in figures:
        parts.append(certificate_tables(figures))
    parts.append(joints_table(figures))
    if isinstance(summary.get("rows"), list):
        parts.append(bench_table(summary["rows"]))
    pictures = _pictures(result.folder)
    if (result.folder / _PAGE).is_file():
        parts.append(_written(result.folder / _PAGE, pictures))
    parts += [
        f"<figure>{image}<figcaption>{html.escape(name)}</figcaption></figure>" for name, image in pictures.items()
    ]
    parts.append(folded("all figures", numbers_table({"value": figures})))
    parts.append(_origin(summary))
    return f"<section>{''.join(parts)}</section>"


def _pictures(folder: Path) -> dict[str, str]:
    """The pictures in the folder by name, each within the page."""
    found, left = {}, _MOST_PICTURES
    for picture in sorted(folder.glob("*.png")):
        if picture.name in _DRAWN and (folder / _RUN).is_file():
            continue
        content, name = picture.read_bytes(), html.escape(picture.name)
        if len(content) > left:
            found[picture.name] = f"<p>{name} is in the folder; it is too large for this page.</p>"
            continue
        left -= len(content)
        data = base64.b64encode(content).decode()
        found[picture.name] = f'<img src="data:image/png;base64,{data}" alt="{name}">'
    return found


def _written(page: Path, pictures: dict[str, str]) -> str:
    """A page in Markdown, with those of the pictures that it shows, which are taken out of them."""
    text = MarkdownIt("js-default", {"html": False}).render(page.read_text(encoding="utf-8"))
    return re.sub(r'<img src="([\w.-]+)"[^>]*>', lambda shown: pictures.pop(shown[1], ""), text)


def _origin(summary: Mapping[str, Any]) -> str:
    """The command, the settings and the versions that made the results."""
    settings, made = summary.get("settings") or {}, summary.get("versions") or {}
    command = html.escape(str(summary.get("command") or "made in Python, or by an earlier version"))
    rows = [[name, _plain(value)] for name, value in settings.items() if value not in (None, {}, False)]
    machine = [[name, _plain(value)] for name, value in {**made, **(summary.get("machine") or {})}.items()]
    seed = settings.get("seed", summary.get("seed"))
    said = "" if seed is None else f" · seed {html.escape(str(seed))}"
    version = html.escape(str(made.get("nbs_pin", "")))
    origin = f'<p class="command"><code>{command}</code></p><p class="soft">nbs_pin {version}{said}</p>'
    return origin + folded("settings and versions", table(["setting", "value"], [*rows, *machine]))


def _plain(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
