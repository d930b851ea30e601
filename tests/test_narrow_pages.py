"""What a phone shows of the pages: nothing beyond its screen, and no number broken in two."""

import io
from contextlib import closing

import numpy as np
import pytest
from PIL import Image

import nbs_pin as nbs
from nbs_pin.reports.pages import unbroken, written
from nbs_pin.reports.replay import replay
from nbs_pin.reports.report import report
from tests.browser import Browser, find_chromium
from tests.test_replay import moving_run
from tests.test_report import folder_of, open_with_arms

WIDTH = 390
LONG = "a link whose name somebody made so long that it says all there is to say of the arm"
LENGTHEN = f"""for (const select of document.querySelectorAll("select:not(#speed)")) {{
  select.closest("[hidden]")?.removeAttribute("hidden");
  for (const option of select.options) option.text = {LONG!r};
}}"""
BEYOND = f"""[...document.querySelectorAll("select")].map((x) => x.getBoundingClientRect())
  .filter((box) => box.right > {WIDTH} || box.left < 0 || !box.width).length"""
BROKEN = """(() => {
  const found = [], walk = document.createTreeWalker(document.querySelector("main"), NodeFilter.SHOW_TEXT);
  for (let node; node = walk.nextNode();) for (const hit of node.data.matchAll(/\\d[\\d.]*e[-−]\\d+/g)) {
    const range = document.createRange();
    range.setStart(node, hit.index); range.setEnd(node, hit.index + hit[0].length);
    const tops = new Set([...range.getClientRects()].map((box) => Math.round(box.top)));
    found.push([hit[0], tops.size]);
  }
  return found;
})()"""


@pytest.fixture(scope="module")
def run():
    """A run of a law that adapts."""
    robot = nbs.load_robot("two_link")
    law = nbs.AdaptiveLaw.for_robot(robot)
    return nbs.simulate(nbs.MujocoPlant(robot), law, nbs.Sinusoid.for_robot(robot), 0.3, 0.001)


@pytest.fixture
def phone():
    """A page of Chromium as wide as a phone."""
    if find_chromium() is None:
        pytest.skip("no Chromium: install it or set $CHROMIUM")
    with closing(Browser(WIDTH, 844)) as browser:
        browser.resize(WIDTH, 844)
        yield browser


@pytest.mark.browser
def test_dropdowns_of_long_names_stay_on_the_screen(run, phone, tmp_path):
    pages = [
        replay(run, tmp_path / "replay.html"),
        report([folder_of(tmp_path / "run", run)], tmp_path / "report.html"),
    ]
    for page in pages:
        phone.open(page, "#t=0.1")
        if page == pages[1]:
            open_with_arms(phone, page, 1)
        phone.evaluate("document.body.classList.remove('folded')")
        phone.evaluate(LENGTHEN)
        assert phone.evaluate("document.querySelectorAll('select').length") >= 3
        assert phone.evaluate(BEYOND) == 0
        assert phone.evaluate("document.documentElement.scrollWidth") <= WIDTH


@pytest.mark.browser
def test_numbers_of_a_report_are_not_broken_at_their_minus(run, phone, tmp_path):
    folder = folder_of(tmp_path / "run", run)
    (folder / "report.md").write_text("| a | b |\n|---|---|\n| " + "1.25e-07 rad " * 30 + "| c |\n\n" + "1e-7 " * 200)
    page = report([folder], tmp_path / "report.html")
    open_with_arms(phone, page, 1)
    phone.evaluate("document.querySelectorAll('details').forEach((x) => x.open = true)")
    found = phone.evaluate(BROKEN)
    assert len(found) > 200
    assert [number for number, lines in found if lines > 1] == []


def test_numbers_are_kept_whole_and_everything_else_is_as_it_was():
    assert written("<a-1e-7>") == '&lt;a<span class="number">-1e-7</span>&gt;'
    assert written("off by 1.2e-07 rad, 0.3") == 'off by <span class="number">1.2e-07</span> rad, 0.3'
    assert unbroken('<img src="1e-7.png"><b>1e-7</b>') == '<img src="1e-7.png"><b><span class="number">1e-7</span></b>'


@pytest.mark.browser
def test_without_its_panels_the_arm_stands_in_the_middle(phone, tmp_path):
    """As `tools/pictures.py` shows it: panels that are hidden take no room."""
    phone.resize(800, 600)
    phone.open(replay(moving_run(nbs.load_robot("two_link")), tmp_path / "replay.html"), "#t=0.2")
    phone.evaluate("document.querySelectorAll('body > *:not(#scene)').forEach((x) => x.style.display = 'none')")
    phone.evaluate("dispatchEvent(new Event('resize'))")
    shown = np.asarray(Image.open(io.BytesIO(phone.screenshot())).convert("HSV"))
    rows, columns = np.nonzero(shown[..., 1] > 80)  # the arm and its reference have colours, the ground hardly
    assert len(rows) > 500
    assert 0.25 < rows.mean() / 600 < 0.75
    assert 0.25 < columns.mean() / 800 < 0.75
