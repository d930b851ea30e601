"""What the switches, charts and keys of a report do in a browser."""

from contextlib import closing

import numpy as np
import pytest

import nbs_pin as nbs
from nbs_pin.reports.report import report
from tests.browser import Browser, find_chromium
from tests.test_replay import moving_run
from tests.test_report import folder_of, open_with_arms


@pytest.fixture
def page(tmp_path):
    """The report of one run."""
    return report(
        [folder_of(tmp_path / "run", moving_run(nbs.load_robot("two_link"), duration=1.0))], tmp_path / "a.html"
    )


@pytest.fixture
def browser():
    """A page of Chromium."""
    if find_chromium() is None:
        pytest.skip("no Chromium: install it or set $CHROMIUM")
    with closing(Browser(1280, 800)) as browser:
        yield browser


@pytest.mark.browser
def test_charts_of_different_arms_show_each_its_own_joints_and_tips(browser, tmp_path):
    names = ("two_link", "three_link")
    runs = [moving_run(nbs.load_robot(name), duration=1.0) for name in names]
    page = report([folder_of(tmp_path / name, run) for name, run in zip(names, runs, strict=True)], tmp_path / "a.html")
    open_with_arms(browser, page, 2)
    for joint in range(3):
        browser.evaluate(f"document.querySelectorAll('.joints button')[{joint}].click()")
        drawn = browser.evaluate("report.plots()[0].data.slice(1).map(row => [...row])")
        asked = [np.abs(run.q - run.q_ref)[:, joint] for run in runs if joint < run.nv]
        assert len(drawn) == len(asked)
        np.testing.assert_allclose(drawn, asked, rtol=1e-4)
    browser.evaluate("[...document.querySelectorAll('.signals button')].find(b => b.textContent === 'tip').click()")
    assert browser.evaluate("report.plots().at(-1).series.slice(1).map(line => line.label)") == list(names)


@pytest.mark.browser
def test_the_trace_of_the_reference_needs_both_switches(page, browser):
    open_with_arms(browser, page, 1)
    if not browser.evaluate("report.scenes[0].is3D"):
        pytest.skip("no WebGL")
    for ghost, traces in ((0, 1), (0, 0), (1, 0), (1, 1), (0, 1)):
        for k, wanted in enumerate((ghost, traces)):
            box = f"document.querySelectorAll('.view input')[{k}]"
            browser.evaluate(f"{box}.checked === {str(bool(wanted)).lower()} || {box}.click()")
        assert browser.evaluate("report.scenes[0].shown()") == [bool(ghost), bool(traces), bool(ghost and traces)]


@pytest.mark.browser
def test_keys_leave_alone_what_has_the_focus(page, browser):
    open_with_arms(browser, page, 1)
    pressed = """(selector, key) => {
      const on = document.querySelector(selector);
      const event = new KeyboardEvent("keydown", {key, bubbles: true, cancelable: true});
      const before = [report.time, document.querySelector("#play").textContent].join();
      on.focus(); on.dispatchEvent(event);
      return [event.defaultPrevented, [report.time, document.querySelector("#play").textContent].join() !== before];
    }"""
    browser.evaluate(
        "document.querySelector('main').insertAdjacentHTML('beforeend', '<input id=typed><p contenteditable id=p>')"
    )
    for selector, key, acts in (
        ("#typed", " ", False), ("#typed", "ArrowLeft", False), ("#p", " ", False), ("select", "ArrowLeft", False),
        (".view input", " ", False), ("#bar button", " ", False), ("summary", " ", False), ("body", "Home", False),
        ("body", "End", False), ("body", " ", True), ("body", "ArrowRight", True), ("#time", "Home", True),
    ):  # fmt: skip
        assert browser.evaluate(f"({pressed})('{selector}', '{key}')") == [acts, acts], (selector, key)
