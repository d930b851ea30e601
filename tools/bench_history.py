"""Appends what laws, plants and models cost on this machine to bench-history.jsonl: one line per run.

python tools/bench_history.py [FILE]
"""

import datetime
import json
import subprocess
import sys
from pathlib import Path

from nbs_pin.benchmarks import bench

ROOT = Path(__file__).parent.parent


def line() -> dict[str, object]:
    """The date, the commit, the machine, the versions and every figure by its row."""
    commit = subprocess.run(["git", "describe", "--always", "--dirty"], cwd=ROOT, capture_output=True, text=True)
    rows = list(bench.bench(("two_link", "panda"), calls=5000, chains=(7, 30)))
    found = bench.summary(rows)
    figures = {row.key: {name: float(f"{value:.4g}") for name, value in row.figures.items()} for row in rows}
    date = datetime.datetime.now(datetime.UTC).isoformat(timespec="minutes")
    facts = {"date": date, "commit": commit.stdout.strip() or "unknown"}
    return facts | {"machine": found["machine"], "versions": found["versions"], "figures": figures}


def main() -> None:
    """Measures and appends."""
    file = Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "bench-history.jsonl"
    text = json.dumps(line(), ensure_ascii=False)
    with file.open("a", encoding="utf-8") as history:
        history.write(text + "\n")
    print(f"one line appended to {file}")


if __name__ == "__main__":
    main()
