"""Checks that a built site loads nothing from elsewhere and has no dead link: python tools/check_site.py FOLDER."""

import re
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

LOADED = {"script": "src", "link": "href", "img": "src", "iframe": "src", "source": "src"}
"""What a browser fetches by itself."""


class Page(HTMLParser):
    """The anchors of a page, what it loads and where its links lead."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.anchors: set[str] = set()
        self.loads: list[str] = []
        self.links: list[str] = []
        self.feed(path.read_text())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Collects one element."""
        given = {name: value or "" for name, value in attrs}
        self.anchors |= {given[name] for name in ("id", "name") if name in given}
        target = given.get(LOADED.get(tag, ""), "")
        if target and given.get("rel") != "canonical":
            self.loads.append(target)
        if tag == "a" and "href" in given:
            self.links.append(given["href"])


def faults(site: Path) -> list[str]:
    """One sentence for each fault."""
    pages = {path: Page(path) for path in sorted(site.rglob("*.html"))}
    found = [f"{site} has no page"] if not pages else []
    for path, page in pages.items():
        where = path.relative_to(site)
        found += [f"{where} loads {target}" for target in page.loads if urlsplit(target).netloc]
        for target in {*page.loads, *page.links}:
            parts = urlsplit(target)
            if parts.scheme or parts.netloc:
                continue
            file = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            file = file / "index.html" if file.is_dir() else file
            if where.name == "404.html" and parts.path.startswith("/"):
                continue  # it is served from anywhere
            if not file.exists():
                found.append(f"{where} links to {target}, which does not exist")
            elif parts.fragment and file in pages and unquote(parts.fragment) not in pages[file].anchors:
                found.append(f"{where} links to {target}, which has no such anchor")
    for sheet in site.rglob("*.css"):
        if re.search(r"url\(\s*['\"]?(?:https?:)?//", sheet.read_text()) or "@import" in sheet.read_text():
            found.append(f"{sheet.relative_to(site)} loads from another machine")
    return found


if __name__ == "__main__":
    wrong = faults(Path(sys.argv[1]).resolve())
    print("\n".join(wrong) or f"{sys.argv[1]}: no dead link, nothing loaded from elsewhere")
    sys.exit(bool(wrong))
