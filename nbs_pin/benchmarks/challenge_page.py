"""The page of the challenge: who tracks how well, where, and whether promises were kept; one file without a network."""

import html
import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal

from nbs_pin.base.units import counted, percent
from nbs_pin.benchmarks.challenge_tables import STANDINGS, in_mrad, origin, standing_cells
from nbs_pin.benchmarks.challenge_tasks import DURATION, PERIOD, SAID, SETTLED, START_ERROR
from nbs_pin.benchmarks.conditions import CONDITIONS
from nbs_pin.benchmarks.contest import Contest
from nbs_pin.benchmarks.scores import UNFINISHED, Row, Standing, mean_errors, standings
from nbs_pin.reports.markdown import short
from nbs_pin.reports.pages import page, written
from nbs_pin.reports.report_tables import folded, table
from nbs_pin.reports.verdicts import Verdict

_LEAST, _MOST = 1e-6, UNFINISHED
"""Ends of the axis of errors [rad]; smaller ones are drawn at its beginning."""
_COLD, _HOT = 1e-4, 0.1
"""Errors at which the colours of tables begin and end [rad]."""
_TITLE = "Tracking challenge"


def challenge_page(contest: Contest, rows: Sequence[Row], verdict: Verdict, facts: Mapping[str, Any]) -> bytes:
    """The page, from all rows; facts: settings, versions, machine and date."""
    found = standings(rows)
    said = [verdict.said, *verdict.more]
    parts = [
        f'<p class="lead">{_sentences(said[:1])}</p><p>{_sentences(said[1:])}</p>',
        _tasks(contest),
        "<h2>Standings</h2>",
        _standings(found),
        "<h2>Every task</h2>",
        _strips(found, rows),
        *(_matrix(found, rows, by) for by in ("condition", "arm", "motion")),
        _broken(rows),
        _unfinished(rows),
        _rules(contest),
        _every(found, rows),
        f'<p class="soft">{written(origin(facts))}</p>',
    ]
    return page("challenge.html", _TITLE, {}, heading=_TITLE, body="".join(parts))


def _sentences(texts: Sequence[str]) -> str:
    return written(" ".join(f"{text[0].upper()}{text[1:]}." for text in texts))


def _tasks(contest: Contest) -> str:
    counts = (
        (len(contest.arms), "arm"),
        (len(contest.motions), "motion"),
        (len(contest.conditions), "condition"),
        (len(contest.entrants), "entrant"),
    )
    return f'<p class="soft">{" × ".join(counted(n, word) for n, word in counts)}, seed {contest.seed}</p>'


def _standings(found: Sequence[Standing]) -> str:
    heads = "".join(f'<th title="{html.escape(why)}">{html.escape(head)}</th>' for head, why in STANDINGS)
    lines = []
    for each in found:
        cells = []
        for (head, _), text in zip(STANDINGS, standing_cells(each), strict=True):
            bad = (head == "broken" and each.broken) or (head == "finished" and each.finished < each.tasks)
            cells.append(f"<td{' class=broken' if bad else ''}>{written(text)}</td>")
        lines.append(f"<tr><td>{html.escape(each.entrant)}</td>{''.join(cells)}</tr>")
    what = "".join(f"<li><b>{html.escape(head)}</b>: {html.escape(why)}</li>" for head, why in STANDINGS)
    return (
        _table(f"<th>entrant</th>{heads}", lines) + f"<details><summary>the columns</summary><ul>{what}</ul></details>"
    )


def _matrix(found: Sequence[Standing], rows: Sequence[Row], by: Literal["condition", "arm", "motion"]) -> str:
    """The mean errors as a table whose colours go with the logarithm."""
    errors, columns = mean_errors(rows, by), list(dict.fromkeys(getattr(row, by) for row in rows))
    if len(columns) < 2:
        return ""
    lines = []
    for each in found:
        cells = (
            f'<td style="--hot: {_between(errors[each.entrant][column], _COLD, _HOT):.3f}">'
            f"{written(in_mrad(errors[each.entrant][column]))}</td>"
            for column in columns
        )
        lines.append(f"<tr><td>{html.escape(each.entrant)}</td>{''.join(cells)}</tr>")
    heads = "".join(f"<th>{html.escape(column)}</th>" for column in columns)
    title = f"<h2>By {by}: mean RMS error [mrad]</h2>"
    return title + _table(f"<th>entrant</th>{heads}", lines, "wide heat")


def _strips(found: Sequence[Standing], rows: Sequence[Row]) -> str:
    """A dot for the error of every task on a logarithmic axis, a lane for each entrant, a bar at the mean."""
    conditions = list(dict.fromkeys(row.condition for row in rows))
    key = "".join(
        f'<span><i class="c{k % 7}"></i>{html.escape(condition)}</span>' for k, condition in enumerate(conditions)
    )
    lanes = []
    for each in found:
        dots = "".join(
            f'<i class="c{conditions.index(row.condition) % 7}" style="left:{_left(row.counted)};'
            f'top:{18 + 64 * conditions.index(row.condition) / max(1, len(conditions) - 1):.0f}%"></i>'
            for row in rows
            if row.entrant == each.entrant
        )
        mean = f'<b style="left:{_left(each.mean_error_rad)}" title="mean"></b>'
        lanes.append(f'<div class="name">{html.escape(each.entrant)}</div><div class="lane">{dots}{mean}</div>')
    ticks = "".join(
        f'<span style="left:{_left(10.0**k)}">{10.0 ** (k + 3):g}</span>'
        for k in range(round(math.log10(_LEAST)), round(math.log10(_MOST)) + 1)
    )
    scale = f'<div class="name soft">[mrad]</div><div class="lane scale">{ticks}</div>'
    note = '<p class="soft">RMS error of each task; the bar is the mean, at the right end is what was not finished.</p>'
    return f'<div class="key">{key}</div><div class="strip">{"".join(lanes)}{scale}</div>{note}'


def _left(error: float) -> str:
    """A place between 2 and 98 percent of a lane."""
    return f"{2.0 + 96.0 * _between(error, _LEAST, _MOST):.2f}%"


def _between(error: float, least: float, most: float) -> float:
    """Where an error lies on a logarithmic axis from 0 to 1."""
    share = math.log(max(error, least) / least) / math.log(most / least)
    return min(share, 1.0)


def _broken(rows: Sequence[Row]) -> str:
    broken = [row for row in rows if row.promise == "broken"]
    if not broken:
        return ""
    cells = [
        [row.entrant, row.arm, row.motion, row.condition, _ratio(row), in_mrad(row.peak_error_rad)] for row in broken
    ]
    heads = ["entrant", "arm", "motion", "condition", "promise ÷ worst", "peak [mrad]"]
    return f"<h2>Broken promises</h2>{table(heads, cells)}"


def _unfinished(rows: Sequence[Row]) -> str:
    """Why tasks were not finished, each reason once."""
    reasons: dict[tuple[str, str], int] = {}
    for row in rows:
        if row.failed:
            reasons[row.entrant, row.failed] = reasons.get((row.entrant, row.failed), 0) + 1
    if not reasons:
        return ""
    cells = [[entrant, str(count), why] for (entrant, why), count in reasons.items()]
    return f"<h2>Not finished</h2>{table(['entrant', 'tasks', 'why'], cells)}"


def _rules(contest: Contest) -> str:
    budget = contest.budget
    lines = [
        f"Every arm is simulated in MuJoCo, {DURATION:g} s of each motion with torques held for {1e3 * PERIOD:g} ms and"
        f" cut off at the effort limits. It begins up to {START_ERROR:g} rad off the reference on every joint; errors"
        f" count after {SETTLED:g} s.",
        "A law is given the arm as its description has it and the reference. It is not told the condition.",
        f"A task that is not finished, or that leaves the position or velocity limits, counts as {UNFINISHED:g} rad.",
        "A promise bounds the error of every joint from that second on. It is given beforehand, in another process, for"
        " a known condition; the law is not told of it. It is broken if one joint goes farther.",
        f"An entrant is stopped if a run takes more than {budget.run:g} s, and given up on an arm after"
        f" {budget.stops} stops.",
        *(f"{name}: {SAID[name]}." for name in contest.motions),
        *(f"{name}: {CONDITIONS[name].said}." for name in contest.conditions),
    ]
    return f"<h2>How it is judged</h2><ul>{''.join(f'<li>{html.escape(line)}</li>' for line in lines)}</ul>"


def _every(found: Sequence[Standing], rows: Sequence[Row]) -> str:
    """All rows, folded by entrant."""
    heads = ["arm", "motion", "condition", "RMS [mrad]", "peak [mrad]", "saturated", "promise", "promise ÷ worst", ""]
    parts = []
    for each in found:
        cells = [
            [
                row.arm,
                row.motion,
                row.condition,
                in_mrad(row.rms_error_rad),
                in_mrad(row.peak_error_rad),
                "none" if row.saturated_fraction is None else percent(row.saturated_fraction, 1),
                row.promise,
                _ratio(row),
                row.failed,
            ]
            for row in rows
            if row.entrant == each.entrant
        ]
        parts.append(folded(f"all tasks of {each.entrant}", table(heads, cells)))
    return f"<h2>All figures</h2>{''.join(parts)}"


def _ratio(row: Row) -> str:
    return "" if row.promise_over_worst is None else short(row.promise_over_worst)


def _table(heads: str, lines: Sequence[str], kind: str = "wide") -> str:
    return f'<div class="{kind}"><table><thead><tr>{heads}</tr></thead><tbody>{"".join(lines)}</tbody></table></div>'
