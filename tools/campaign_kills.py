"""A campaign killed at random moments: each time the same command goes on, and its table is that of an undisturbed one.

    python tools/campaign_kills.py               # 20 kills, about two minutes
    python tools/campaign_kills.py --kills 5 --seed 3

The process group of `nbs-pin campaign` gets SIGKILL up to a second after its first new result. After every kill the
file of results has whole lines only, but for the last, and none that it had before is lost. Otherwise the exit code
is 1.
"""

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import nbs_pin as nbs

PLAN = """
robot = "panda"
duration = 2.0
start_spread = 0.2
samples = {samples}

[random]
payload = {{ from = 0.0, to = 2.0 }}
"""


def results(journal: Path) -> dict[str, str]:
    """The whole lines of the file, by key."""
    lines = journal.read_text().split("\n")[1:-1] if journal.exists() else []
    return {json.loads(line)["key"]: line for line in lines}


def main() -> int:
    """Kill, go on, compare."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    rng = random.Random(given.seed)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "plan.toml").write_text(PLAN.format(samples=80 * given.kills))
        command = [sys.executable, "-m", "nbs_pin.cli", "campaign", "plan.toml", "--workers", "2"]
        journal, before = folder / "out" / "campaign-plan" / "results.jsonl", {}
        for kill in range(given.kills):
            process = subprocess.Popen(command, cwd=folder, process_group=0, stdout=subprocess.DEVNULL,
                                       stderr=subprocess.DEVNULL)  # fmt: skip
            while process.poll() is None and len(results(journal)) <= len(before):
                time.sleep(0.01)
            time.sleep(rng.random())
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            after, torn = results(journal), journal.read_bytes()[-1:] != b"\n"
            print(f"kill {kill + 1}: {len(after)} results{', the last line torn' if torn else ''}", flush=True)
            if not before.items() < after.items() or len(after) >= 80 * given.kills:
                print("a result was lost, or all were done before the kill")
                return 1
            before = after
        subprocess.run(command, cwd=folder, check=True)
        alone = nbs.run_campaign(nbs.Campaign.load(folder / "plan.toml"), folder / "alone", workers=2)
        same = alone.write_csv(folder / "alone.csv").read_bytes() == (journal.parent / "table.csv").read_bytes()
        print(f"the table is {'' if same else 'not '}that of an undisturbed campaign of {len(alone.rows)} trials")
        return 0 if same else 1


if __name__ == "__main__":
    sys.exit(main())
