"""Reports: the results of commands on one page for the browser, which begins with a verdict and needs no network."""

import base64
import html
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from markdown_it import MarkdownIt

from nbs_pin.base.exceptions import FileFormatError, NbsPinError
from nbs_pin.base.files import write_whole
from nbs_pin.base.records import Run
from nbs_pin.base.summaries import RUN, SUMMARY, runs_of_laws, summary_in
from nbs_pin.reports.captions import arm_in_words, law_in_words, settings_in_words
from nbs_pin.reports.pages import page, unbroken, written
from nbs_pin.reports.replay import shown_run
from nbs_pin.reports.report_tables import (
    bench_table,
    certificate_tables,
    folded,
    joints_table,
    numbers_table,
    table,
    transient_tables,
)  # fmt: skip
from nbs_pin.reports.signals import MAX_ROWS
from nbs_pin.reports.verdicts import Verdict, verdict_of
from nbs_pin.robots.named import robot_of

_PAGE = "report.md"
_DRAWN = ("tracking.png",)
"""Pictures that the charts show better."""
_MOST_PICTURES = 12e6
"""Pictures in all are at most this large [bytes]; further ones are named."""


@dataclass(frozen=True)
class _Result:
    """A folder of results."""

    folder: Path
    label: str
    summary: Mapping[str, Any]
    runs: Mapping[str, Run]
    """The runs in it, by what they are called on the page."""

    @property
    def figures(self) -> Mapping[str, Any]:
        found = self.summary.get("figures")
        return found if isinstance(found, Mapping) else {}

    @property
    def parts(self) -> dict[str, Mapping[str, Any]]:
        """The figures by what they are called on the page: of several laws, those of each."""
        laws = self.figures.get("laws")
        return {_of_law(self.label, law): of for law, of in laws.items()} if laws else {self.label: self.figures}

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
        "details": "".join(_details(result, missing) for result in results),
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
        files = {label: RUN} | {_of_law(label, law): file for law, file in runs_of_laws(_laws(summary)).items()}
        runs = {name: Run.load(folder / file) for name, file in files.items() if (folder / file).is_file()}
        results.append(_Result(folder, label, summary, runs))
    return results


def _laws(summary: Mapping[str, Any]) -> Iterable[str]:
    found = summary.get("figures")
    return found["laws"] if isinstance(found, Mapping) and "laws" in found else ()


def _of_law(label: str, law: str) -> str:
    return f"{label}, {law}"


def _runs(results: Sequence[_Result]) -> tuple[list[dict[str, Any]], dict[str, str]]:
    """What the page shows of the runs, and why some arms are not drawn, by what the runs are called."""
    moved = [(label, run) for result in results for label, run in result.runs.items()]
    shown: list[dict[str, Any]] = []
    missing, built = {}, dict[tuple[str, str], int]()
    for label, run in moved:
        try:
            one = shown_run(run, robot_of(run), most=3 * MAX_ROWS // max(3, len(moved)))
        except NbsPinError as error:
            missing[label] = str(error)
            continue
        arm = run.robot, run.robot_sha256
        if arm in built:  # the same arm is on the page once
            one["scene"]["commands"] = built[arm]
        built.setdefault(arm, len(shown))
        shown.append(one | {"label": label})
    return shown, missing


def _title(results: Sequence[_Result]) -> str:
    arms = dict.fromkeys(_arm(result) for result in results)
    return f"{', '.join(arms)}: {'report' if len(results) == 1 else f'{len(results)} results side by side'}"


def _arm(result: _Result) -> str:
    for run in result.runs.values():
        return arm_in_words(run)
    settings = result.summary.get("settings", {})
    named = next((settings[key] for key in ("robot", "against") if settings.get(key)), result.label)
    return Path(str(named)).stem


def _card(result: _Result) -> str:
    runs = list(result.runs.values())
    facts = [*dict.fromkeys(map(law_in_words, runs)), *(settings_in_words(runs[0]) if runs else [])]
    said = written(" · ".join(facts))
    name = html.escape(result.label)
    lines = f'<h2>{name}</h2><p>{written(result.verdict.text)}</p><p class="soft">{said}</p>'
    return f'<section class="card {result.verdict.level}">{lines}</section>'


def _comparison(results: Sequence[_Result]) -> str:
    """Figures of several results in one table, in which a row is a figure."""
    parts = {label: figures for result in results for label, figures in result.parts.items()}
    return f"<h2>Side by side</h2>{numbers_table(parts)}" if len(parts) > 1 and any(parts.values()) else ""


def _details(result: _Result, missing: Mapping[str, str]) -> str:
    figures, summary, lost = result.figures, result.summary, [name for name in result.runs if name in missing]
    parts = [f"<h2>{html.escape(result.label)}</h2>"]
    for name in lost:
        whose = f"{html.escape(name)}: " if len(result.runs) > 1 else ""
        why = f"The arm is not drawn and the run has no charts: {written(missing[name])}"
        parts.append(f'<p class="warning">{whose}{why}</p>')
    if "certificate" in figures:
        parts.append(certificate_tables(figures))
    if "transient" in figures:
        parts.append(transient_tables(figures))
    for label, of in result.parts.items():
        parts.append(f"<h3>{html.escape(label)}</h3>" if len(result.parts) > 1 else "")
        parts.append(joints_table(of))
    if isinstance(summary.get("rows"), list):
        parts.append(bench_table(summary["rows"]))
    pictures = _pictures(result.folder, () if lost or not result.runs else _DRAWN)
    if (result.folder / _PAGE).is_file():
        parts.append(_written(result.folder / _PAGE, pictures))
    parts += [
        f"<figure>{image}<figcaption>{html.escape(name)}</figcaption></figure>" for name, image in pictures.items()
    ]
    named = result.parts if len(result.parts) > 1 else {"value": figures}
    parts.append(folded("all figures", numbers_table(named)))
    parts.append(_origin(summary))
    return f"<section>{''.join(parts)}</section>"


def _pictures(folder: Path, left_out: Sequence[str]) -> dict[str, str]:
    """The other pictures in the folder by name, each within the page."""
    found, left = {}, _MOST_PICTURES
    for picture in sorted(folder.glob("*.png")):
        if picture.name in left_out:
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
    text = unbroken(MarkdownIt("js-default", {"html": False}).render(page.read_text(encoding="utf-8")))
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
