"""Numbers and names in sentences: percentages, factors and plurals of one form, and names as the files have them."""

import ast
from pathlib import Path

import pytest

import nbs_pin as nbs
from nbs_pin.base.units import counted, percent, weighed
from nbs_pin.reports.report_tables import numbers_table
from nbs_pin.reports.verdicts import verdict_of
from tests.test_report import moving_run, tracking_figures

ROOT = Path(nbs.__file__).parent


@pytest.mark.parametrize(
    ("told", "text"),
    [
        (percent(0.0), "0 %"),
        (percent(0.634, 1), "63.4 %"),
        (counted(1, "start"), "1 start"),
        (counted(0, "start"), "0 starts"),
        (counted(1, "trajectory", "trajectories"), "1 trajectory"),
        (counted(2, "trajectory", "trajectories"), "2 trajectories"),
        (weighed({"M": "1"}), "M"),
        (weighed({"M": "0.99"}), "0.99 M"),
        (weighed({"‖q‖": "0", "‖v‖": "2"}, "1", "N·m"), "2 ‖v‖ + 1 N·m"),
        (weighed({"‖q‖": "0", "‖v‖": "0"}, "0", "N·m"), "0 N·m"),
    ],
)
def test_numbers_are_told_in_one_form(told, text):
    assert told == text


def test_every_share_is_told_by_percent():
    """No other number ends in a percent sign without a space."""
    found = []
    for path in ROOT.rglob("*.py"):
        if path.name == "units.py":
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            spec = node.format_spec.values[-1:] if isinstance(node, ast.FormattedValue) and node.format_spec else []
            if any(isinstance(part, ast.Constant) and str(part.value).endswith("%") for part in spec):
                found.append(f"{path.relative_to(ROOT)}:{node.lineno}")
    assert found == []


def test_a_sentence_does_not_change_the_names_of_a_file():
    run = moving_run(nbs.load_robot("two_link"), duration=1.0)
    tracking = tracking_figures(run)
    names = [f"elbow_{k}" for k in range(run.nv)]
    beyond = {"joints": names, "outside_position_range_rad": [0.1] * run.nv}
    exciting = {
        "condition_number": 2.0, "unknowns": 1, "duration_s": 1.0, "joints": names, "clearance_m": 0.1,
        "nearest": ["elbow_0", "elbow_1"], "peak_velocity_fraction": [0.1, 0.2], "peak_torque_fraction": [0.1, 0.2],
    }  # fmt: skip
    far = tracking | {"convergence_time_s": None}
    for figures in (tracking | beyond, exciting, {"laws": {"elbow_0": tracking, "elbow_1": tracking | far}}):
        text = verdict_of(figures).text
        assert "elbow_0" in text
        assert "elbow_1" in text
        assert "Elbow" not in text


def test_a_table_does_not_change_the_names_of_a_file():
    estimates = {"load at panda_hand_tcp m [kg]": 1.0, "elbow_rms viscous friction [N·m·s/rad]": 2.0}
    shown = numbers_table({"a": {"peak_torque_rate_Nm_per_s": 3.0, "estimates": estimates}})
    assert "peak torque rate" in shown
    assert all(name in shown for name in estimates)
