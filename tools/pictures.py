"""Makes every picture of README and docs from real runs: python tools/pictures.py [FOLDER]; half an hour, and Chromium.

Results that FOLDER (out/pictures) already holds are used again; delete them to simulate anew.
"""

import io
import sys
from pathlib import Path

from PIL import Image

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT))

from nbs_pin import cli  # noqa: E402
from tests.browser import Browser  # noqa: E402
from tests.pages import blocks  # noqa: E402

IMAGES = ROOT / "docs" / "images"
RUNS = {
    "swing": "track panda --reference circle:0.1 --frame panda_hand --duration 5 --start-error 0.3",
    "track": "track ur5 --start-error 0.3 --frequency 2",
    "circle": "track panda --reference circle:0.1 --frame panda_hand",
    "certify": "certify panda --disturbance 5",
    "train": "train two_link",
    "collect": "collect three_link --samples 1000 --encoder-bits 16 --torque-noise 0.5",
    "learn": "learn {collect}/data.npz",
    "compare": "compare {learn}/model.nbs",
    "adapt": "track panda --controller nbs,adaptive --payload 2@5 --duration 20",
    "adapt-one": "track panda --controller adaptive --payload 2@5-14 --duration 20",
    "campaign": "campaign {loads}",
    "my-track": "track {arm} --start-error 0.3 --duration 4",
    "my-certify": "certify {arm} --disturbance 2",
}
"""The commands behind the pictures; {NAME} is the folder of another one."""
CHARTS = {
    "certificate": ("certify", "certificate"),
    "learning": ("train", "learning"),
    "errors": ("compare", "errors"),
    "tracking": ("track", "tracking"),
    "adapt-comparison": ("adapt", "comparison"),
    "adapt-estimates": ("adapt-one", "estimates"),
    "campaign": ("campaign", "errors"),
    "tutorial-tracking": ("my-track", "tracking"),
    "tutorial-certificate": ("my-certify", "certificate"),
}
"""Command and name of the pictures that a command draws itself."""
SCENE = (190, 30, 770, 520)
"""The part of the page in which the arm moves."""


def run(folder: Path) -> dict[str, Path]:
    """Runs what has not been run; returns the folder of each command."""
    folder.mkdir(parents=True, exist_ok=True)
    arm = folder / "my_arm.urdf"
    arm.write_text(next(text for _, title, text in blocks(ROOT / "docs" / "tutorial.md") if title == arm.name))
    folders, loads = {name: folder / name for name in RUNS}, ROOT / "demos" / "loads.toml"
    for name, line in RUNS.items():
        if not (folders[name] / "summary.json").exists():
            code = cli.main([*line.format(arm=arm, loads=loads, **folders).split(), "--out", str(folders[name])])
            if code:
                raise SystemExit(f"nbs-pin {line} ended with {code}")
    return folders


def frames(page: Path, times: list[float], width: int, height: int) -> list[Image.Image]:
    """The scene of a replay page at these times, without its panels."""
    browser = Browser(width, height, patience=300.0)
    try:
        browser.resize(width, height)  # the page, of which a window may show less
        browser.open(page, f"#t={times[0]}")
        browser.evaluate("document.querySelectorAll('body > *:not(#scene)').forEach((x) => x.style.display = 'none')")
        browser.evaluate("dispatchEvent(new Event('resize'))")
        shots = []
        for t in times:
            browser.evaluate(f"replay.seek({t})")
            shots.append(Image.open(io.BytesIO(browser.screenshot())).convert("RGB"))
        return shots
    finally:
        browser.close()


def main(folder: Path) -> None:
    """Runs the commands and writes the pictures."""
    folders = run(folder)
    IMAGES.mkdir(exist_ok=True)
    # The first second, in which the arm finds the path, at half speed.
    times = [k / 40 for k in range(40)] + [1.0 + k / 15 for k in range(60)]
    first, *rest = (
        shot.crop(SCENE).resize((422, 356)) for shot in frames(folders["swing"] / "replay.html", times, 880, 550)
    )
    first.save(IMAGES / "swing.webp", save_all=True, append_images=rest, duration=60, loop=0, quality=72, method=6)
    for name, t in (("track", 0.05), ("circle", 3.3)):
        (shot,) = frames(folders[name] / "replay.html", [t], 840, 560)
        shot.resize((480, 320), Image.Resampling.LANCZOS).save(IMAGES / f"{name}.webp", quality=85, method=6)
    for name, (command, chart) in CHARTS.items():
        picture = Image.open(folders[command] / f"{chart}.png").convert("RGB")
        picture.thumbnail((1000, 1000), Image.Resampling.LANCZOS)
        picture.save(IMAGES / f"{name}.webp", quality=75, method=6)
    with Image.open(IMAGES / "errors.webp") as picture:
        picture.crop((0, 0, picture.width, 5 * picture.height // 12)).save(IMAGES / "errors-of-a-model.webp", method=6)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "out" / "pictures")
