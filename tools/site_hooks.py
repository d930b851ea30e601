"""What MkDocs does besides: links to other files of the repository become their paths, commands show their help."""

import contextlib
import io
import os
import posixpath
import re
from pathlib import Path
from typing import Any

from pymdownx.slugs import slugify

ROOT = Path(__file__).parent.parent
_CITED = re.compile(r"docs/(theory|certificates)\.md(?:\s+§(\d+))?")
_LINK = re.compile(r"\[([^\]]*)\]\(((?:\.\./)+[^)#\s]+)(?:#[^)\s]*)?\)")


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """Rewrites links that leave the docs, which the site has not got, and fills in the help of the commands."""
    docs, folder = Path(config.docs_dir), Path(page.file.abs_src_path).parent

    def rewritten(link: re.Match[str]) -> str:
        target = (folder / link[2]).resolve()
        if docs in target.parents:
            return link[0]
        path = target.relative_to(ROOT).as_posix()
        text = link[1].strip("`")
        return f"`{path}`" if path.endswith(text) else f"`{text}` (`{path}`)"

    return re.sub(r"^<!-- help of every command -->$", lambda _: commands(), _LINK.sub(rewritten, markdown), flags=re.M)


def on_page_content(html: str, page: Any, config: Any, files: Any) -> str:
    """Makes links of the sections that docstrings and texts cite as docs/theory.md §2."""

    def linked(cited: re.Match[str]) -> str:
        name, section = cited[1], cited[2]
        target = posixpath.relpath(f"{name}.html", posixpath.dirname(page.url) or ".")
        anchor = f"#{_sections(Path(config.docs_dir) / f'{name}.md')[section]}" if section else ""
        return f'<a href="{target}{anchor}">{name}{f" §{section}" if section else ""}</a>'

    parts = re.split(r"(<(?:pre|code|a)\b.*?</(?:pre|code|a)>)", html, flags=re.S)  # code stays as it is
    return "".join(part if k % 2 else _CITED.sub(linked, part) for k, part in enumerate(parts))


def _sections(page: Path) -> dict[str, str]:
    """Anchors of the numbered sections of a page."""
    anchor = slugify(case="lower")
    headings = re.findall(r"^## (§(\d+) .*)$", page.read_text(), flags=re.M)
    return {number: anchor(heading, "-") for heading, number in headings}


def commands() -> str:
    """A section for every command with what `--help` prints."""
    from nbs_pin import cli  # only this page needs it

    os.environ |= {"COLUMNS": "96", "NO_COLOR": "1", "TERM": "dumb"}
    sections = []
    for name in cli.COMMANDS:
        with contextlib.redirect_stdout(io.StringIO()) as printed:
            cli.parse([name, "--help"])
        text = re.sub(r" +$", "", printed.getvalue(), flags=re.M).strip()
        sections.append(f"## {name}\n\n```text\n{text}\n```\n")
    return "\n".join(sections)
