"""Put the tables of a challenge into docs/challenge.md: python tools/challenge_table.py out/challenge."""

import re
import sys
from pathlib import Path

PAGE = Path(__file__).parent.parent / "docs" / "challenge.md"
PLACE = re.compile(r"(?<=<!-- challenge.md -->\n).*?(?=<!-- end -->)", re.S)


def with_tables(page: str, tables: str) -> str:
    """The page with these tables in their place."""
    return PLACE.sub(lambda _: tables, page)


if __name__ == "__main__":
    tables = (Path(sys.argv[1]) / "challenge.md").read_text(encoding="utf-8")
    PAGE.write_text(with_tables(PAGE.read_text(encoding="utf-8"), tables), encoding="utf-8")
